"""Links, anchors and paths in the documents, and names of documents in the code, lead somewhere."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

DOCS = REPOSITORY / "docs"
PAGES = sorted(
    page
    for pattern in ("*.md", "docs/**/*.md", "benchmarks/*.md", "examples/**/*.md")
    for page in REPOSITORY.glob(pattern)
)
# Where code, tests and files for users name documents. The changelog names those of its time.
FOLDERS = ("benchmarks", "datagen", "docs", "scripts", "tests")

_FENCED = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
_HEADING = re.compile(r"^#{1,6} (.+)$", re.MULTILINE)


def prose(page: Path) -> str:
    """A page without its blocks of code."""
    return _FENCED.sub("", page.read_text("utf-8"))


def links(page: Path) -> Iterator[tuple[str, Path, str]]:
    """(link, file that it names, anchor or "") of every link of a page to a file."""
    for link in _LINK.findall(re.sub(r"`[^`\n]*`", "", prose(page))):
        if not re.match(r"[a-z]+:", link):
            file, _, anchor = link.partition("#")
            yield link, (page.parent / file).resolve() if file else page, anchor


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as a host of Markdown files makes them and as the site does."""
    made: set[str] = set()
    for heading in _HEADING.findall(prose(page)):
        text = re.sub(r"[`*]|\]\([^)]*\)|\[", "", heading).strip().lower()
        word = re.sub(r"[^\w\s-]", "", text)
        hosted, site = re.sub(r"\s", "-", word), re.sub(r"[-\s]+", "-", word)
        if hosted == site:
            made.add(site)
    return made


def dead_links(page: Path) -> list[str]:
    dead: list[str] = []
    for link, file, anchor in links(page):
        inside = not page.is_relative_to(DOCS) or file.is_relative_to(DOCS)  # the site has nothing else
        if not (file.exists() and inside) or (anchor and anchor not in anchors(file)):
            dead.append(link)
    return dead


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_every_link_leads_somewhere(page: Path) -> None:
    assert dead_links(page) == []


def test_every_page_is_in_the_sites_menu() -> None:
    named = set(re.findall(r"\S+\.md$", (REPOSITORY / "mkdocs.yml").read_text(), re.MULTILINE))
    assert named == {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}


def test_documents_that_are_named_in_code_are_there() -> None:
    missing: list[str] = []
    files = [file for folder in FOLDERS for file in (REPOSITORY / folder).rglob("*") if file.is_file()]
    for file in [*files, *(REPOSITORY / name for name in ("Makefile", "pyproject.toml", "README.md"))]:
        named = re.findall(r"\bdocs/[\w/.-]+\.md\b", file.read_text("utf-8", errors="ignore"))
        missing += [f"{file.name}: {name}" for name in named if not (REPOSITORY / name).is_file()]
    assert not missing


def test_files_that_are_named_in_documents_are_there() -> None:
    """`tests/...py`, `test_name.py` alone, and modules by their path, outside blocks of code."""
    tests = {file.name for file in (REPOSITORY / "tests").rglob("test_*.py")}
    missing: list[str] = []
    for page in PAGES:
        for name in re.findall(r"`((?:\w+/)*\w+\.py)`", prose(page)):
            is_there = (REPOSITORY / name).is_file() or ("/" not in name and name in tests)
            if not is_there and ("/" in name or name.startswith("test_")):
                missing.append(f"{page.name}: {name}")
    assert not missing


def test_a_dead_link_is_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "# A page\n\n[a](gone.md) [b](#a-page) [c](#gone) `[d](code.md)`\n\n```\n[e](code.md)\n```\n"
    )
    assert dead_links(page) == ["gone.md", "#gone"]
