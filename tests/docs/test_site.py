"""The site that `make site` builds: whole, with search and references, and without the network."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from datagen.cli import VERBS
from tests.conftest import REPOSITORY

DOCS = REPOSITORY / "docs"


def build(folder: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(
        command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=False
    )
    assert built.returncode == 0, built.stdout + built.stderr


def test_the_site_is_whole_and_fetches_nothing(tmp_path: Path) -> None:
    """One test, since a site takes seconds to build."""
    for name in ("material", "mkdocstrings_handlers.python"):
        pytest.importorskip(name, reason="the extra `docs` is not installed")
    build(tmp_path)
    every_page_is_there_and_can_be_searched(tmp_path)
    nothing_is_fetched_from_elsewhere(tmp_path)
    references_come_from_the_program(tmp_path)


def every_page_is_there_and_can_be_searched(site: Path) -> None:
    pages = {page.relative_to(DOCS).with_suffix(".html").as_posix() for page in DOCS.rglob("*.md")}
    assert all((site / page).is_file() for page in pages)
    index = json.loads((site / "search" / "search_index.json").read_text("utf-8"))["docs"]
    assert pages <= {entry["location"].partition("#")[0] for entry in index}


def nothing_is_fetched_from_elsewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        text = page.read_text("utf-8")
        fetched = re.findall(r"<(?:script|img|iframe)[^>]*\ssrc=\"?(https?:[^\">\s]+)", text)
        fetched += re.findall(
            r"<link[^>]*rel=\"?(?:stylesheet|preconnect)[^>]*href=\"?(https?:[^\">\s]+)", text
        )
        assert not fetched, page


def references_come_from_the_program(site: Path) -> None:
    commands = (site / "reference" / "command-line.html").read_text("utf-8")
    assert all(f'id="datagen-{verb}"' in commands for verb in VERBS)
    python = (site / "reference" / "python.html").read_text("utf-8")
    named = re.findall(r"^::: (\S+)$", (DOCS / "reference" / "python.md").read_text("utf-8"), re.MULTILINE)
    assert named and all(f'id="{name}"' in python for name in named)
