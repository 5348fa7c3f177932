"""A folder's own statement of its title, licence and attribution: `source.json`."""

from __future__ import annotations

import os
from pathlib import Path

from datagen.schemas.safe_files import read_regular
from datagen.workers.json_document import parse_json

STATEMENT = "source.json"
_KEYS = ("title", "licence", "attribution")


def read_statement(folder: Path) -> dict[str, str]:
    """What the folder states of itself, by key; empty where it has no statement. InputError for a bad one."""
    path = folder / STATEMENT
    if not os.path.lexists(path):  # a link to nothing is refused
        return {}
    fix = f"Write {{{', '.join(_KEYS)}}}, each a text, or remove it"
    root = parse_json(read_regular(path, 1 << 16, fix), str(path))
    return {key: node.text() for key in _KEYS if (node := root.find(key)) is not None}
