"""Every `datagen` command in the documents is one that the program understands."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
from cyclopts.exceptions import CycloptsError

from datagen.cli import VERBS, build_app
from tests.conftest import REPOSITORY

PAGES = sorted([REPOSITORY / "README.md", *(REPOSITORY / "docs").rglob("*.md")])
_BLOCK = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_SYNTAX = re.compile(r"[\[\]]|\.\.\.")  # marks what may be left out or repeated
_REAL = {"REAL": "", "$REAL": "", "$NEW": "", "$NEAR": "", "$TRIALS": "RUN"}


def commands(page: Path) -> Iterator[list[str]]:
    """The words of each command in a page's blocks of shell lines, with numbers for placeholders."""
    blocks = _BLOCK.findall(page.read_text("utf-8"))
    for block in (text for language, text in blocks if language in ("", "console")):
        for line in re.sub(r" *\\\n(?:> )? *", " ", block).splitlines():
            found = re.match(r"(?:\$ |> )?(datagen [^#|>&]*)", line)
            if found and not re.search(r"  +[^#\s]", line):  # not a diagram with two columns
                words = shlex.split(_SYNTAX.sub("", found[1]))
                words = [_REAL.get(word, word) for word in words if _REAL.get(word, word)]
                yield [
                    "1"
                    if re.fullmatch("[A-Z]", word) and before.startswith("--") and before != "--trial"
                    else word
                    for before, word in zip(["", *words], words, strict=False)
                ]


def test_there_are_commands_of_all_verbs() -> None:
    assert {words[1] for page in PAGES for words in commands(page)} == set(VERBS)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_the_command_line_understands_them(page: Path) -> None:
    app, refused = build_app(), list[str]()
    for words in commands(page):
        try:
            app.parse_args(words[1:], exit_on_error=False, print_error=False)
        except CycloptsError as error:
            refused.append(f"{shlex.join(words)}: {error}")
    assert not refused, "\n".join(refused)
