"""Divide a YCB folder into training objects and, every fifth object, test objects.

Objects are divided in the order of their keys, so that the same folder always gives the same two parts.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any, Literal

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import is_inside, read_regular, whole_file
from datagen.workers.source_statement import STATEMENT

Part = Literal["train", "test"]
EVERY = 5
INDEX = "objects.json"
_MOST_BYTES = 16 * 2**20
_FIX = "Correct it or fetch the index again"


def split_objects(source: Path, out: Path) -> dict[Part, int]:
    """Write OUT/train and OUT/test, each an index and copies of its objects' files; return their sizes.

    A second call changes nothing. InputError for an index that is broken or leads out of its folder, and for
    an OUT that holds other objects.
    """
    source, out = source.resolve(), out.resolve()
    objects = sorted(_read(source), key=lambda entry: entry["key"])
    kept = [entry for i, entry in enumerate(objects) if i % EVERY != EVERY - 1]
    held_out = objects[EVERY - 1 :: EVERY]
    _write(source, out / "train", kept)
    _write(source, out / "test", held_out)
    return {"train": len(kept), "test": len(held_out)}


def _read(source: Path) -> list[dict[str, Any]]:
    """The entries of the index, checked: keys are unique, and files are in the folder."""
    index = source / INDEX
    data = read_regular(index, _MOST_BYTES, "Name a folder of YCB objects that has one")
    try:
        entries = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(index, "", f"is not JSON ({error})", _FIX) from None
    if not isinstance(entries, list) or len(entries) < EVERY:
        raise InputError(index, "", f"is not a list of {EVERY} objects or more", _FIX)
    keys: set[str] = set()
    for number, entry in enumerate(entries):
        key, files = (entry.get(name) if isinstance(entry, dict) else None for name in ("key", "files"))
        if not isinstance(key, str) or key in keys:
            raise InputError(index, f"[{number}].key", "is not a unique name", _FIX)
        keys.add(key)
        if not isinstance(files, dict) or not files:
            raise InputError(index, f"[{number}].files", "names no files", _FIX)
        for path in files.values():
            is_known = isinstance(path, str) and ".." not in Path(path).parts
            if not is_known or not is_inside(source, source / path) or not (source / path).is_file():
                problem = f"{str(path)[:80]!r} is no file inside {source}"
                raise InputError(index, f"[{number}].files", problem, _FIX)
    return entries


def _write(source: Path, folder: Path, chosen: list[dict[str, Any]]) -> None:
    """Copy the files, then the index; a folder with another index is left as it is."""
    index, text = folder / INDEX, json.dumps(chosen, indent=1) + "\n"
    if index.exists():
        if index.read_text() != text:
            raise InputError(index, "", "lists other objects", "Choose another output folder")
        return
    for entry in chosen:
        for path in entry["files"].values():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / path, folder / path)
    if (source / STATEMENT).is_file():
        shutil.copyfile(source / STATEMENT, folder / STATEMENT)
    with whole_file(index, alone=True) as file:
        file.write(text.encode())
