"""The one error for bad input: it names the place, the field, the problem and the fix."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path


class InputError(ValueError):
    """Input that cannot be used. The command line prints it as one line and exits with 2.

    `place` is a file, a folder, a run or a command-line option; `field` is the part of it that is wrong (a
    JSON path, a column, a line), or "" for the whole; `fix` says how to fix it.
    """

    def __init__(self, place: str | Path, field: str, problem: str, fix: str) -> None:
        self.place = str(place)
        self.field = field
        self.problem = problem
        self.fix = fix
        super().__init__(str(self))

    def __str__(self) -> str:
        where = f"{self.place}: {self.field}" if self.field else self.place
        return one_line(f"{where}: {self.problem}. {self.fix}")

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str, str]]:
        # Exceptions are pickled between processes; the default would call __init__ with one argument.
        return (type(self), (self.place, self.field, self.problem, self.fix))


def refuse_not_utf8(text: str) -> str:
    """Return the text. InputError where it is not valid Unicode: a record must be, a file name need not."""
    try:
        text.encode()
    except UnicodeEncodeError:
        fix = "Rename it, or reach it through a link in UTF-8"
        raise InputError(repr(text)[:300], "", "the name is not UTF-8", fix) from None
    return text


def printable(text: str) -> str:
    """The text with control and formatting characters as escapes: \\x1b, \\u202e."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def one_line(text: str) -> str:
    """The text on one line, printable, with single spaces."""
    return printable(" ".join(text.split()))


def choices(valid: Iterable[object], given: str = "") -> str:
    """`Did you mean b? Choose one of: a, b, c.` for the fix of an error; `given` is the mistyped name."""
    names = sorted(map(str, valid))
    near = get_close_matches(given, names, n=1)
    return f"{f'Did you mean {near[0]}? ' if near else ''}Choose one of: {', '.join(names)}"
