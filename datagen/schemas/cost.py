"""Cost of an attempt: wall and CPU seconds by stage."""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field

STAGES = ("draw", "settle", "observe", "visibility", "grasps", "plan", "execute", "write")


@dataclass
class StageClock:
    """Adds up wall and CPU seconds by stage.

    CPU seconds are those of the whole process, so that threads of libraries count. The time of a nested stage
    is subtracted from the outer one, so that every second counts once.
    """

    wall_s: dict[str, float] = field(default_factory=dict)
    cpu_s: dict[str, float] = field(default_factory=dict)
    _inner: list[tuple[float, float]] = field(default_factory=list)  # (wall, CPU) spent within open stages

    @contextmanager
    def stage(self, name: str) -> Generator[None]:
        if name not in STAGES:
            raise KeyError(f"unknown stage {name!r}; stages are {', '.join(STAGES)}")
        wall, cpu = time.perf_counter(), time.process_time()
        self._inner.append((0.0, 0.0))
        try:
            yield
        finally:
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            inner_wall, inner_cpu = self._inner.pop()
            self.wall_s[name] = self.wall_s.get(name, 0.0) + wall - inner_wall
            self.cpu_s[name] = self.cpu_s.get(name, 0.0) + cpu - inner_cpu
            if self._inner:
                outer_wall, outer_cpu = self._inner[-1]
                self._inner[-1] = (outer_wall + wall, outer_cpu + cpu)
