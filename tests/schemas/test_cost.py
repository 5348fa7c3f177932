"""The stage clock, on a clock that a test turns."""

from __future__ import annotations

import pytest

from datagen.schemas import run_records
from datagen.schemas.run_records import StageClock


class Hands:
    """Both clocks of the process; CPU seconds pass at half the speed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 0.0
        monkeypatch.setattr(run_records.time, "perf_counter", lambda: self.now_s)
        monkeypatch.setattr(run_records.time, "process_time", lambda: self.now_s / 2)


def test_a_stage_within_another_is_counted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    hands, clock = Hands(monkeypatch), StageClock()
    with clock.stage("draw"):
        hands.now_s += 1
        with clock.stage("grasps"):
            hands.now_s += 10
            with clock.stage("execute"):
                hands.now_s += 100
        with clock.stage("grasps"):
            hands.now_s += 20
        hands.now_s += 2
    assert clock.wall_s == {"draw": 3, "grasps": 30, "execute": 100}
    assert clock.cpu_s == {"draw": 1.5, "grasps": 15, "execute": 50}


def test_a_stage_that_fails_is_paid_and_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    hands, clock = Hands(monkeypatch), StageClock()
    with pytest.raises(ValueError), clock.stage("draw"), clock.stage("settle"):
        hands.now_s += 5
        raise ValueError
    with clock.stage("draw"):
        hands.now_s += 1
    assert clock.wall_s == {"settle": 5, "draw": 1}


def test_an_unknown_stage_is_refused() -> None:
    with pytest.raises(KeyError, match="unknown stage"), StageClock().stage("lunch"):
        pass
