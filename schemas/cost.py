"""What an attempt cost: seconds by stage, memory, bytes, and the machine that paid."""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field

STAGES = ("draw", "settle", "observe", "visibility", "grasps", "ik", "plan", "execute", "write")


@dataclass
class StageClock:
    """Adds up wall, CPU and GPU seconds by stage. `other` is what no stage claimed.

    CPU seconds are those of the whole process, so that a library's threads are counted.
    """

    wall_s: dict[str, float] = field(default_factory=dict)
    cpu_s: dict[str, float] = field(default_factory=dict)
    gpu_s: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Generator[None]:
        if name not in STAGES:
            raise KeyError(f"unknown stage {name!r}; stages are {', '.join(STAGES)}")
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            self.wall_s[name] = self.wall_s.get(name, 0.0) + time.perf_counter() - wall
            self.cpu_s[name] = self.cpu_s.get(name, 0.0) + time.process_time() - cpu
