"""Tests that need an extra, where it is installed; elsewhere a skip that says so."""

from __future__ import annotations

import pytest

from datagen.workers.extras import EXTRAS

SIM_INSTALLED = not EXTRAS["sim"].missing()
needs_sim = pytest.mark.skipif(not SIM_INSTALLED, reason="the extra `sim` is not installed")
needs_robots = pytest.mark.skipif(
    bool(EXTRAS["robots"].missing()), reason="the extra `robots` is not installed"
)
needs_pybullet = pytest.mark.skipif(
    bool(EXTRAS["pybullet"].missing()), reason="pybullet is not installed: no wheels from Python 3.12 on"
)
