"""The robots that the conformance tests open: every entry of the registry over its reaches and heights."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import pytest

from datagen.workers.extras import EXTRAS
from datagen.workers.robots import ROBOTS, open_robot, robot_limits, robot_source
from datagen.workers.robots.robot import Robot
from tests.sim_extra import needs_robots

Case = tuple[str, float | None, float]

_SHARES_OF_REACH = (0.0, 0.1, 0.3, 0.65, 1.0)  # shares of the range of a robot that is scaled
_ON_PEDESTAL_M = 0.8


def cases_of(name: str) -> list[Case]:
    """What one robot is opened with: `open_robot`'s arguments."""
    limits = robot_limits(name)
    low, high = limits.reach_m
    reaches = [None] if low == high else [low + share * (high - low) for share in _SHARES_OF_REACH]
    heights = dict.fromkeys(limits.base_height_m or [_ON_PEDESTAL_M])
    return [(name, reach_m, height_m) for reach_m in reaches for height_m in heights]


def label_of(case: Case) -> str:
    """A case's name among the tests."""
    name, reach_m, height_m = case
    return f"{name}-{reach_m or height_m:g}"


def _params(name: str) -> list[Any]:
    if "mani_skill" not in robot_source(name).keys.urdf and EXTRAS["robots"].missing():
        return [pytest.param(None, id=name, marks=needs_robots)]
    return [pytest.param(case, id=label_of(case)) for case in cases_of(name)]


CASES = tuple(param for name in ROBOTS for param in _params(name))


@lru_cache
def opened(case: Case) -> Robot:
    """One robot a case, kept over the tests."""
    return open_robot(*case)
