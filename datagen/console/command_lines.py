"""Command lines that a user can paste, and what an interrupted command says."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager


def words_of(options: Mapping[str, object]) -> list[str]:
    """Options as words of a command line; None and False say nothing."""
    words: list[str] = []
    for name, value in options.items():
        if value is True:
            words.append(name)
        elif value is not None and value is not False:
            words += [name, str(value)]
    return words


def command_line(words: Sequence[str]) -> str:
    """The command that a user can paste."""
    return shlex.join(["datagen", *words])


def continue_with(words: Sequence[str]) -> str:
    """The last line of a command that another one continues, and that command."""
    return f"Continue with:\n  {command_line(words)}"


def say_interrupted(how: str, words: Sequence[str]) -> None:
    """Say that the command was interrupted, and with which words it goes on."""
    sys.stderr.write(f"interrupted{how}. {continue_with(words)}\n")


@contextmanager
def resumable(words: Sequence[str]) -> Generator[None]:
    """Tell whoever interrupts the block how to go on."""
    try:
        yield
    except KeyboardInterrupt:
        say_interrupted(" early; what is committed stays", words)
        raise
