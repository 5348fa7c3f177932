"""Verbs that are also Python functions, command lines to copy, and interruptions."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

Verb = TypeVar("Verb", bound=Callable[..., Any])
PRINTER = "print_result"


def prints(printer: Callable[..., int]) -> Callable[[Verb], Verb]:
    """Name the function that prints what a verb returns, on the command line, and gives the exit code.

    It is called with the result and, by name, with the arguments of the verb.
    """

    def with_printer(verb: Verb) -> Verb:
        setattr(verb, PRINTER, printer)
        return verb

    return with_printer


class Interrupted(KeyboardInterrupt):
    """The command stopped cleanly on request; `result` is what it would have returned."""

    def __init__(self, message: str, result: Any) -> None:
        self.result = result
        super().__init__(message)


def words_of(options: Mapping[str, object]) -> list[str]:
    """Options as words of a command line; None and False are omitted."""
    words: list[str] = []
    for name, value in options.items():
        if value is True:
            words.append(name)
        elif value is not None and value is not False:
            words += [name, str(value)]
    return words


def command_line(words: Sequence[str]) -> str:
    """The quoted command line."""
    return shlex.join(["datagen", *words])


def resume_with(words: Sequence[str]) -> str:
    """The sentence that names the command that resumes."""
    return f"Resume with:\n  {command_line(words)}"


def print_interrupted(how: str, words: Sequence[str]) -> None:
    """Print that the command was interrupted, and the command that resumes it."""
    sys.stderr.write(f"interrupted{how}. {resume_with(words)}\n")


@contextmanager
def resumable(words: Sequence[str]) -> Generator[None]:
    """Print how to resume where the block is interrupted."""
    try:
        yield
    except KeyboardInterrupt:
        print_interrupted("; committed shards are kept", words)
        raise
