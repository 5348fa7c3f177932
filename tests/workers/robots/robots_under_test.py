"""The robots that the conformance tests open: every entry of the registry over its reaches and heights."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import pytest

from datagen.workers.extras import EXTRAS
from datagen.workers.robots import ROBOTS, open_robot, robot_limits, robot_source
from datagen.workers.robots.robot import Robot
from tests.sim_extra import needs_robots

Case = tuple[str, float | None]  # a robot, and the share of the range of reaches of one that is scaled

_SHARES_OF_REACH = (0.0, 0.1, 0.3, 0.65, 1.0)
_ON_PEDESTAL_M = 0.8


def cases_of(name: str) -> list[Case]:
    """What one robot is opened with. None is opened while tests are collected: all together take seconds."""
    scaled = robot_source(name).keys.scaled is not None
    return [(name, share) for share in _SHARES_OF_REACH] if scaled else [(name, None)]


def _params(name: str) -> list[Any]:
    if "mani_skill" not in robot_source(name).keys.urdf and EXTRAS["robots"].missing():
        return [pytest.param(None, id=name, marks=needs_robots)]
    return [
        pytest.param((name, share), id=name if share is None else f"{name}-{share:g}")
        for name, share in cases_of(name)
    ]


CASES = tuple(param for name in ROBOTS for param in _params(name))


@lru_cache
def opened(case: Case) -> Robot:
    """One robot a case, kept over the tests."""
    (name, share), limits = case, robot_limits(case[0])
    low, high = limits.reach_m
    height_m = _ON_PEDESTAL_M if limits.base_height_m is None else limits.base_height_m[0]
    return open_robot(name, None if share is None else low + share * (high - low), height_m)
