"""Two YCB folders of one: the objects that models are trained on, and every fifth, which they never see.

    python scripts/split_objects.py DIR OUT

Writes OUT/train and OUT/test: each an objects.json and copies of its objects' files. Objects are taken
in the order of their names, so that the same folder gives the same two.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

EVERY = 5
_MOST_BYTES = 16 * 2**20


class Refused(Exception):
    """Input that cannot be used, in one line: `place: field: problem. Fix`."""


def main(arguments: list[str]) -> int:
    """Read DIR/objects.json and write both folders; a second call changes nothing. 2 where it cannot."""
    if len(arguments) != 2:
        sys.stderr.write("usage: python scripts/split_objects.py DIR OUT\n")
        return 2
    source, out = Path(arguments[0]).resolve(), Path(arguments[1]).resolve()
    try:
        objects = sorted(_read(source), key=lambda entry: entry["key"])
        _write(source, out / "train", [entry for i, entry in enumerate(objects) if i % EVERY != EVERY - 1])
        _write(source, out / "test", objects[EVERY - 1 :: EVERY])
    except Refused as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    except OSError as error:
        sys.stderr.write(f"error: {error.filename or out}: {error.strerror or error}. Check both folders\n")
        return 2
    return 0


def _read(source: Path) -> list[dict[str, Any]]:
    """The entries of objects.json, whose keys differ and whose files lie in the folder."""
    index = source / "objects.json"
    if not index.is_file():
        raise Refused(f"{index}: no such file. Name a folder of YCB objects that has one")
    if index.stat().st_size > _MOST_BYTES:
        raise Refused(f"{index}: larger than {_MOST_BYTES:,} bytes. Give the set's own index")
    try:
        entries = json.loads(index.read_bytes())
    except (ValueError, RecursionError) as error:
        raise Refused(f"{index}: not JSON ({error}). Fetch the index again") from None
    fix = "Correct it or fetch the index again"
    if not isinstance(entries, list) or len(entries) < EVERY:
        raise Refused(f"{index}: not a list of {EVERY} objects or more. {fix}")
    keys: set[str] = set()
    for number, entry in enumerate(entries):
        key, files = (entry.get(name) if isinstance(entry, dict) else None for name in ("key", "files"))
        if not isinstance(key, str) or key in keys:
            raise Refused(f"{index}: [{number}].key: not a name of its own. {fix}")
        keys.add(key)
        if not isinstance(files, dict) or not files:
            raise Refused(f"{index}: [{number}].files: no files. {fix}")
        for path in files.values():
            if not isinstance(path, str) or not _is_inside(source, path):
                problem = f"{str(path)[:80]!r} is no file inside {source}"
                raise Refused(f"{index}: [{number}].files: {problem}. {fix}")
    return entries


def _is_inside(source: Path, path: str) -> bool:
    """Whether a relative path leads to a file of the folder, and through no `..` or link out of it."""
    try:
        inside = ".." not in Path(path).parts and (source / path).resolve().is_relative_to(source)
        return inside and (source / path).is_file()
    except (OSError, ValueError, RuntimeError):  # a zero byte, a name too long, a loop of links
        return False


def _write(source: Path, folder: Path, chosen: list[dict[str, Any]]) -> None:
    """Copy the files, then the index; a folder with another index is left as it is."""
    index, text = folder / "objects.json", json.dumps(chosen, indent=1) + "\n"
    if index.exists() and index.read_text() != text:
        raise Refused(f"{index}: lists other objects. Choose another OUT")
    for entry in chosen:
        for path in entry["files"].values():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / path, folder / path)
    draft = index.with_suffix(".part")
    draft.write_text(text)
    draft.replace(index)
    print(f"{folder}: {len(chosen)} objects")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
