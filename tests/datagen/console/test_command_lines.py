"""Verbs declared by a dataclass of options, and interruptions."""

from __future__ import annotations

import inspect
import os
import signal
import threading
from dataclasses import KW_ONLY, dataclass
from typing import Any

import pytest
from cyclopts import App

from datagen.console.command_lines import interruptible, options_of
from datagen.console.options import Whole


@dataclass(frozen=True)
class Wanted:
    """Options of `make`.

    Args:
        source: Source of labels.
        n: Labels wanted.
    """

    source: str
    _: KW_ONLY
    n: Whole = 3

    def __post_init__(self) -> None:
        if self.n < 0:
            raise ValueError("below 0")


@options_of(Wanted)
def make(wanted: Wanted) -> str:
    """Make labels.

    Examples:
        >>> make("sim", n=2)
        'sim 2'
    """
    return f"{wanted.source} {wanted.n}"


def test_a_verb_has_the_options_of_its_dataclass_in_python_and_on_the_command_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert make("sim") == "sim 3" and make("sim", n=2) == "sim 2"
    unknown: dict[str, Any] = {"m": 1}
    for call in (lambda: make("sim", n=-1), lambda: make("sim", **unknown)):
        with pytest.raises((ValueError, TypeError)):
            call()
    assert list(inspect.signature(make).parameters) == ["source", "n"]
    app = App(name="datagen", result_action="return_value")
    app.command(make, name="make")
    assert app(["make", "sim", "--n", "1e3"]) == "sim 1000"
    app.help_print(["make"])
    shown = capsys.readouterr().out
    assert "Make labels." in shown and "Labels wanted. [default: 3]" in shown and "Example" not in shown


def test_the_first_interrupt_is_noted_and_the_second_ends() -> None:
    assert threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), interruptible() as stopping:
        assert not stopping()
        os.kill(os.getpid(), signal.SIGINT)
        assert stopping()
        os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
