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

EVERY = 5


def main() -> int:
    """Read DIR/objects.json and write both folders; a second call changes nothing."""
    if len(sys.argv) != 3:
        sys.exit("usage: python scripts/split_objects.py DIR OUT")
    source, out = Path(sys.argv[1]).resolve(), Path(sys.argv[2])
    index = source / "objects.json"
    if not index.is_file():
        sys.exit(f"error: {index}: no such file. Name a folder of YCB objects that has one")
    objects = sorted(json.loads(index.read_text()), key=lambda entry: entry["key"])
    for name, chosen in (
        ("train", [entry for i, entry in enumerate(objects) if i % EVERY != EVERY - 1]),
        ("test", objects[EVERY - 1 :: EVERY]),
    ):
        folder = out / name
        folder.mkdir(parents=True, exist_ok=True)
        for entry in chosen:
            for path in entry["files"].values():
                (folder / path).parent.mkdir(exist_ok=True)
                shutil.copyfile(source / path, folder / path)
        (folder / "objects.json").write_text(json.dumps(chosen, indent=1) + "\n")
        print(f"{folder}: {len(chosen)} objects")
    return 0


if __name__ == "__main__":
    sys.exit(main())
