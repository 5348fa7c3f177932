"""The one error that people see for bad input: it names the place, the field and the mend."""

from __future__ import annotations

from pathlib import Path


class InputError(ValueError):
    """Input that cannot be used. The command line prints it as one line and exits with 2.

    `place` is a file, a folder, a run or a command-line option; `field` is where in it the
    trouble lies (a JSON path, a column, a line), or "" when the whole place is at fault.
    """

    def __init__(self, place: str | Path, field: str, problem: str, mend: str) -> None:
        self.place = str(place)
        self.field = field
        self.problem = problem
        self.mend = mend
        super().__init__(str(self))

    def __str__(self) -> str:
        where = f"{self.place}: {self.field}" if self.field else self.place
        return one_line(f"{where}: {self.problem}. {self.mend}")

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str, str]]:
        # Exceptions cross process borders; the default would call __init__ with one argument.
        return (type(self), (self.place, self.field, self.problem, self.mend))


def refuse_not_utf8(text: str) -> str:
    """The text. InputError where it is no Unicode, as the name of a file may be: no record holds it."""
    try:
        text.encode()
    except UnicodeEncodeError:
        mend = "Rename it, or reach it through a link in UTF-8"
        raise InputError(repr(text)[:300], "", "the name is not UTF-8", mend) from None
    return text


def printable(text: str) -> str:
    """The text with each character that a terminal or a page acts on as its escape: \\x1b, \\u202e."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def one_line(text: str) -> str:
    """The text on one line, printable, without runs of spaces."""
    return printable(" ".join(text.split()))


def choices(valid: object) -> str:
    """`choose one of: a, b, c` for an error's mend."""
    return "Choose one of: " + ", ".join(sorted(str(v) for v in valid))  # type: ignore[attr-defined]
