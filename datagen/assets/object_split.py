"""Divide a YCB folder of either layout into training objects and, every fifth object, test objects.

Objects are divided in the order of their keys, so that the same folder always gives the same two parts.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import is_inside, read_regular, whole_file
from datagen.workers.objects import MANISKILL_INDEXES, YCB_INDEXES
from datagen.workers.source_statement import STATEMENT

Part = Literal["train", "test"]
EVERY = 5
_MOST_BYTES = 16 * 2**20
_FIX = "Correct it or fetch the index again"


@dataclass(frozen=True)
class _Object:
    key: str
    entry: Any  # in the index
    files: list[str]  # relative to the folder


def split_objects(source: Path, out: Path) -> dict[Part, int]:
    """Write OUT/train and OUT/test, each an index and copies of its objects' files; return their sizes.

    A second call changes nothing. InputError for an index that is broken or leads out of its folder, and for
    an OUT that holds other objects.
    """
    source, out = source.resolve(), out.resolve()
    index = next(
        (source / name for name in YCB_INDEXES if (source / name).is_file()), source / YCB_INDEXES[0]
    )
    objects = sorted(_read(source, index), key=lambda each: each.key)
    kept = [each for i, each in enumerate(objects) if i % EVERY != EVERY - 1]
    held_out = objects[EVERY - 1 :: EVERY]
    _write(source, out / "train" / index.name, kept)
    _write(source, out / "test" / index.name, held_out)
    return {"train": len(kept), "test": len(held_out)}


def _read(source: Path, index: Path) -> list[_Object]:
    """The objects of the index, checked: keys are unique, and files are in the folder."""
    data = read_regular(
        index, _MOST_BYTES, f"Name a folder of YCB objects, with one of {', '.join(YCB_INDEXES)}"
    )
    try:
        entries: Any = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(index, "", f"is not JSON ({error})", _FIX) from None
    kind = dict if index.name in MANISKILL_INDEXES else list
    if type(entries) is not kind or len(entries) < EVERY:
        raise InputError(index, "", f"is not a {kind.__name__} of {EVERY} objects or more", _FIX)
    if isinstance(entries, dict):
        return [_Object(key, entry, _model_files(source, index, key)) for key, entry in entries.items()]
    found: dict[str, _Object] = {}
    for number, entry in enumerate(entries):
        key, files = (entry.get(name) if isinstance(entry, dict) else None for name in ("key", "files"))
        if not isinstance(key, str) or key in found:
            raise InputError(index, f"[{number}].key", "is not a unique name", _FIX)
        if not isinstance(files, dict) or not files:
            raise InputError(index, f"[{number}].files", "names no files", _FIX)
        for path in files.values():
            is_known = isinstance(path, str) and ".." not in Path(path).parts
            if not is_known or not is_inside(source, source / path) or not (source / path).is_file():
                problem = f"{str(path)[:80]!r} is no file inside {source}"
                raise InputError(index, f"[{number}].files", problem, _FIX)
        found[key] = _Object(key, entry, list(files.values()))
    return list(found.values())


def _model_files(source: Path, index: Path, key: str) -> list[str]:
    """All files of an object in ManiSkill's layout."""
    home = source / "models" / key
    if "/" in key or not is_inside(source, home) or not home.is_dir():
        raise InputError(index, key[:80], f"has no folder in {source / 'models'}", _FIX)
    inside = [path for path in sorted(home.rglob("*")) if path.is_file() and is_inside(home, path)]
    return [str(path.relative_to(source)) for path in inside]


def _write(source: Path, index: Path, chosen: list[_Object]) -> None:
    """Copy the files, then the index; a folder with another index is left as it is."""
    by_key = {each.key: each.entry for each in chosen}
    listed = by_key if index.name in MANISKILL_INDEXES else list(by_key.values())
    folder, text = index.parent, json.dumps(listed, indent=1) + "\n"
    if index.exists():
        if index.read_text() != text:
            raise InputError(index, "", "lists other objects", "Choose another output folder")
        return
    for path in (path for each in chosen for path in each.files):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source / path, folder / path)
    if (source / STATEMENT).is_file():
        shutil.copyfile(source / STATEMENT, folder / STATEMENT)
    with whole_file(index, alone=True) as file:
        file.write(text.encode())
