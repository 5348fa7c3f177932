"""The robots that the conformance test opens: every entry of the registry, and scales of the family."""

from __future__ import annotations

from functools import lru_cache

from workers.robots import open_robot
from workers.robots.robot import Robot

CASES: tuple[tuple[str, float | None, float], ...] = (
    ("panda", None, 0.8),
    ("panda-scaled", 0.3, 0.5),
    ("panda-scaled", 0.37, 0.8),
    ("panda-scaled", 0.5, 0.8),
    ("panda-scaled", 0.75, 0.8),
    ("panda-scaled", 1.0, 1.0),
    ("xarm7", None, 0.6),
    ("fetch", None, 0.75),
    ("fetch", None, 1.1),
)
IDS = [f"{name}-{reach_m or height_m}" for name, reach_m, height_m in CASES]


@lru_cache
def opened(case: tuple[str, float | None, float]) -> Robot:
    """One robot a case, kept over the tests."""
    return open_robot(*case)
