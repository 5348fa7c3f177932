"""Progress over known steps, on a terminal and off it."""

from __future__ import annotations

import io
import json
import sys

import pytest

from datagen.console.steps import steps


def test_lines_say_how_far_it_is(capsys: pytest.CaptureFixture[str]):
    times = iter([0.0, 4.0, 11.0, 12.0, 30.0])
    with steps("shards", 8, as_json=True, clock=lambda: next(times)) as step:
        for _ in range(4):
            step()
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [(line["done"], line["of"], line["what"]) for line in lines] == [
        (2, 8, "shards"),
        (4, 8, "shards"),
    ]
    assert [line["per_s"] for line in lines] == [0.2, 0.1]
    assert [line["left_s"] for line in lines] == [33, 30]


def test_a_terminal_gets_a_bar_and_nothing_else_does(monkeypatch: pytest.MonkeyPatch):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    for stream, shown in ((Terminal(), True), (io.StringIO(), False)):
        monkeypatch.setattr(sys, "stderr", stream)
        with steps("commits read", 3) as step:
            for _ in range(3):
                step()
        assert ("commits read" in stream.getvalue()) == shown
        assert ("3/3" in stream.getvalue()) == shown
