"""Command lines to copy, and the message of an interrupted command."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager


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


def say_interrupted(how: str, words: Sequence[str]) -> None:
    """Print that the command was interrupted, and the command that resumes it."""
    sys.stderr.write(f"interrupted{how}. {resume_with(words)}\n")


@contextmanager
def resumable(words: Sequence[str]) -> Generator[None]:
    """Print how to resume where the block is interrupted."""
    try:
        yield
    except KeyboardInterrupt:
        say_interrupted("; committed shards are kept", words)
        raise
