"""Tests that need an extra, where it is installed; elsewhere a skip that says so."""

from __future__ import annotations

from typing import Any

import pytest

from datagen.workers.extras import EXTRAS
from datagen.workers.robots import ROBOTS, robot_source

SIM_INSTALLED = not EXTRAS["sim"].missing()
needs_sim = pytest.mark.skipif(not SIM_INSTALLED, reason="the extra `sim` is not installed")
needs_robots = pytest.mark.skipif(
    bool(EXTRAS["robots"].missing()), reason="the extra `robots` is not installed"
)

needs_pybullet = pytest.mark.skipif(
    bool(EXTRAS["pybullet"].missing()), reason="pybullet is not installed: no wheels from Python 3.12 on"
)


def named_robots() -> list[Any]:
    """The names of the registry as parameters of a test, those whose files the extra brings with its mark."""

    def marks(name: str) -> tuple[Any, ...]:
        return () if "mani_skill" in robot_source(name).keys.urdf else (needs_robots,)

    return [pytest.param(name, marks=marks(name)) for name in ROBOTS]
