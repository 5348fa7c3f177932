"""The stage clock, on a clock that a test turns."""

from __future__ import annotations

import pytest

from datagen.schemas import run_records
from datagen.schemas.run_records import StageClock


def test_nested_and_failing_stages_are_counted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, clock = [0.0], StageClock()
    monkeypatch.setattr(run_records.time, "perf_counter", lambda: now_s[0])
    monkeypatch.setattr(run_records.time, "process_time", lambda: now_s[0] / 2)
    with clock.stage("draw"):
        now_s[0] += 1
        with pytest.raises(ValueError), clock.stage("grasps"):
            now_s[0] += 10
            with clock.stage("execute"):
                now_s[0] += 100
                raise ValueError
        with clock.stage("grasps"):
            now_s[0] += 20
        now_s[0] += 2
    assert clock.wall_s == {"draw": 3, "grasps": 30, "execute": 100}
    assert clock.cpu_s == {"draw": 1.5, "grasps": 15, "execute": 50}
    with pytest.raises(KeyError, match="unknown stage"), clock.stage("lunch"):
        pass
