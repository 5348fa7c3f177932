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


def test_the_site_is_whole_and_fetches_nothing(tmp_path: Path) -> None:
    """One test, since a site takes seconds to build."""
    for name in ("material", "mkdocstrings_handlers.python"):
        pytest.importorskip(name, reason="the extra `docs` is not installed")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(tmp_path)],
        cwd=REPOSITORY, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stdout + built.stderr

    # Every page is there and can be searched.
    pages = {page.relative_to(DOCS).with_suffix(".html").as_posix() for page in DOCS.rglob("*.md")}
    assert all((tmp_path / page).is_file() for page in pages)
    index = json.loads((tmp_path / "search" / "search_index.json").read_text("utf-8"))["docs"]
    assert pages <= {entry["location"].partition("#")[0] for entry in index}

    # Nothing is fetched from elsewhere.
    script = re.compile(r"<(?:script|img|iframe)[^>]*\ssrc=\"?(https?:[^\">\s]+)")
    style = re.compile(r"<link[^>]*rel=\"?(?:stylesheet|preconnect)[^>]*href=\"?(https?:[^\">\s]+)")
    for page in tmp_path.rglob("*.html"):
        text = page.read_text("utf-8")
        assert not script.findall(text) + style.findall(text), page
        assert "```" not in text, f"{page}: a block of code is shown as text"

    # References come from the program.
    commands = (tmp_path / "reference" / "command-line.html").read_text("utf-8")
    assert all(f'id="datagen-{verb}"' in commands for verb in VERBS)
    assert "datagen benchmark make --houses" in commands and "mkdocs --" not in commands
    python = (tmp_path / "reference" / "python.html").read_text("utf-8")
    named = re.findall(r"^::: (\S+)$", (DOCS / "reference" / "python.md").read_text("utf-8"), re.MULTILINE)
    assert named and all(f'id="{name}"' in python for name in named)


def test_the_table_of_verbs_is_whole() -> None:
    table = (DOCS / "reference" / "command-line.md").read_text("utf-8").partition("\n## ")[0]
    assert [verb for verb in VERBS if f"`{verb}" not in table] == []
