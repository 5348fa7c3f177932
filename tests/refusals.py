"""What a refused command line must look like."""

from __future__ import annotations

import re

import pytest

from datagen import cli


def refused(arguments: list[str], capture: pytest.CaptureFixture[str], *words: str) -> str:
    """Run a command line that must be refused; its one line of error, which holds all the words."""
    capture.readouterr()
    assert cli.run(arguments) == 2
    (told,) = without_phases(capture.readouterr().err)
    assert told.startswith("error: "), told
    assert "Traceback" not in told and len(told) < 2000
    assert re.search(r"[.!] (See: datagen|[A-Z`]\S* \S)|Choose from: ", told), f"no fix in: {told}"
    for word in words:
        assert word in told, f"{word!r} not in: {told}"
    return told


PHASES = {
    "opening houses and objects", "opening runs", "starting Ray", "checking the machines", "making labels",
    "relabelling", "compiling the planner for this machine, once: about 20 s",
    "compiling kinematics for this machine, once: about 5 s",
}  # fmt: skip


def without_phases(told: str) -> list[str]:
    """The lines on standard error, but for those of phases, the built-in houses and costs."""
    lines = [line for line in told.splitlines() if line not in PHASES]
    return [line for line in lines if not line.startswith(("Using built-in houses.", "frames: about"))]
