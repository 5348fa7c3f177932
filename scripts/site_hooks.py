"""Additions of the site to the documents: help of every verb, titles of examples, links to whole pictures."""

from __future__ import annotations

import re
from typing import Any

from datagen.cli import build_app

COMMANDS = "reference/command-line.md"


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """A document's text for the site (mkdocs calls this)."""
    if page.file.src_uri == COMMANDS:
        markdown += "\n## All options\n\n" + command_help()
    markdown = re.sub(r"^```(\w+) (?:file|line)=(\S+)$", r'```\1 title="\2"', markdown, flags=re.MULTILINE)
    return re.sub(r"^(!\[.*\]\((.*\.png)\))$", r"[\1](\2)", markdown, flags=re.MULTILINE)


def command_help() -> str:
    """A section for every verb, from the command line's own help."""
    text = build_app().generate_docs(heading_level=2)
    text = text.replace(" -m mkdocs", "")  # cyclopts names the running program in verbs of two words
    return text[text.index("### datagen ") :]
