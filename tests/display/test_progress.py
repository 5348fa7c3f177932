"""Progress on a terminal, in lines of text elsewhere, and in JSON lines where they are asked for."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable

import pytest
from rich.console import Console

from datagen.display.progress import Pace, Progress, clock_text, counting, steps
from tests.cluster.simulated import FakeClock


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture(autouse=True)
def _usual_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")


@pytest.mark.parametrize("as_json", [True, False])
def test_off_a_terminal_lines_say_how_far_it_is(as_json: bool, capsys: pytest.CaptureFixture[str]):
    clock = FakeClock()
    with steps("shards", 8, as_json, clock) as step:
        for clock.now_s in (4.0, 11.0, 12.0, 30.0):
            step()
    lines = capsys.readouterr().err.splitlines()
    if as_json:
        keys = ("done", "of", "what", "per_s", "left_s")
        told = [tuple(json.loads(line)[key] for key in keys) for line in lines]
        assert told == [(2, 8, "shards", 0.2, 33), (4, 8, "shards", 0.1, 30)]
    else:
        assert lines == ["shards 2/8  0/s  0:00:33 left", "shards 4/8  0/s  0:00:30 left"]


def test_a_terminal_gets_a_bar_and_nothing_else_does(monkeypatch: pytest.MonkeyPatch):
    for stream, shown in ((Terminal(), True), (io.StringIO(), False)):
        monkeypatch.setattr(sys, "stderr", stream)
        with steps("commits read", 3) as step:
            for _ in range(3):
                step()
        assert ("commits read" in stream.getvalue()) == shown
        assert ("3/3" in stream.getvalue()) == shown


@pytest.mark.parametrize(
    ("as_json", "told"),
    [
        (False, ["opening houses [and objects]", "shards 3/4  2 retries", "sealing"]),
        (
            True,
            [
                '{"event": "phase", "phase": "opening houses [and objects]"}',
                '{"event": "progress", "retries": 2}',
                '{"event": "phase", "phase": "sealing"}',
            ],
        ),
    ],
)
def test_off_a_terminal_a_phase_is_named_when_it_begins_and_its_last_state_follows(
    as_json: bool, told: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("FORCE_COLOR", "1")  # makes no terminal of a pipe
    with Progress(as_json, FakeClock()) as progress:
        progress.phase("opening houses [and objects]")
        progress.update("shards", 3, 4, lambda: ("2 retries", {"retries": 2}))
        progress.phase("sealing")
    assert capsys.readouterr().err.splitlines() == told


def test_a_terminal_names_a_phase_and_keeps_the_bar_alone(monkeypatch: pytest.MonkeyPatch):
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    with Progress() as progress:
        progress.phase("opening [runs]")
        assert "opening [runs]" in stream.getvalue()  # before anything else happens
        progress.update("shards", 3, 4, lambda: ("2 retries", {}))
        progress.phase("sealing")
    drawn = stream.getvalue()
    assert "sealing" in drawn
    last = drawn[drawn.rindex("\x1b[2K") :]  # what stays: drawn after the last line that was erased
    assert "3/4" in last and "sealing" not in last and "opening" not in last


@pytest.mark.parametrize("fail", [KeyboardInterrupt, ValueError])
def test_an_interrupted_bar_gives_the_terminal_back(
    fail: Callable[[], BaseException], monkeypatch: pytest.MonkeyPatch
):
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    with pytest.raises((KeyboardInterrupt, ValueError)), counting("shards checked") as seen:
        seen(1, 3)
        raise fail()
    assert sys.stderr is stream and stream.getvalue().rstrip().endswith("\x1b[?25h")  # the cursor is shown
    assert "1/3" in stream.getvalue()


def test_foreign_text_does_not_act_on_the_terminal():
    for terminal in (True, False):
        out = io.StringIO()
        progress = Progress(console=Console(file=out, force_terminal=terminal, color_system=None))
        progress.say("note", {}, "[red]a\x1b[2Jb")
        assert "[red]a" in out.getvalue() and "\x1b[2J" not in out.getvalue()


def test_the_rate_is_that_of_the_last_minute():
    clock, total = FakeClock(), 0
    pace = Pace(clock)
    assert pace.per_s() == 0 and pace.left_s(10) is None
    for second in range(1, 301):
        clock.now_s = second
        total += 1 if second <= 200 else 5
        pace.see(total)
    assert pace.per_s() == 5.0 and pace.left_s(10) == 2.0
    pace.see(0)  # attempts that ran were killed
    assert pace.per_s() == 0 and pace.left_s(10) is None


def test_clock_text():
    assert [clock_text(s) for s in (None, 0, 59.6, 3600, 3725.4, 360_000)] == [
        "-:--:--", "0:00:00", "0:01:00", "1:00:00", "1:02:05", "100:00:00",
    ]  # fmt: skip
