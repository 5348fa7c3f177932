"""Read point clouds from untrusted PCD files of PCL, ASCII or binary, organised or not."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular
from datagen.train.prediction.ply import PointFile, cloud_of, columns_of, count_of
from datagen.workers.image_file import FILE_FIX, MAX_FILE_BYTES

_MAX_HEADER_BYTES = 1 << 16
_KINDS = {"F4": "f4", "F8": "f8", **{f"{k}{n}": f"{k.lower()}{n}" for k in "UI" for n in (1, 2, 4, 8)}}
_FIX = "Save the cloud again as binary PCD, with x, y and z in metres"


def read_pcd(path: Path) -> PointFile:
    """The finite points of a file: x, y, z, and optionally rgb, and target."""
    data = read_regular(path, MAX_FILE_BYTES, FILE_FIX)
    match = re.search(rb"^DATA +(\w+) *\r?\n", data[:_MAX_HEADER_BYTES], re.MULTILINE)
    if match is None:
        raise InputError(path, "header", "is not that of a PCD file", _FIX)
    head = {
        words[0]: words[1:]
        for line in data[: match.start()].decode("ascii", errors="replace").splitlines()
        if (words := line.split())
    }
    names, form = head.get("FIELDS", []), match[1].decode()
    kinds = [kind + size for kind, size in zip(head.get("TYPE", []), head.get("SIZE", []), strict=False)]
    counts = head.get("COUNT", ["1"] * len(names))
    sound = len(names) == len(kinds) == len(counts) <= 64 and all(kind in _KINDS for kind in kinds)
    if not sound or not all(re.fullmatch("[0-9]{1,3}", each) for each in counts):
        raise InputError(path, "header", "has FIELDS, SIZE, TYPE and COUNT that do not agree", _FIX)
    if form not in ("ascii", "binary"):
        raise InputError(path, "DATA", f"is {form[:40]}", _FIX)
    rows = list[tuple[str, str]]()
    for name, kind, count in zip(names, kinds, counts, strict=True):
        # PCL pads rows with fields that are all named `_`.
        numbered = (f"{name}.{len(rows) + k}" if k or name == "_" else name for k in range(int(count)))
        rows += [(each, _KINDS[kind]) for each in list(numbered)]
    fields = {name for name, _ in rows}
    missing = [axis for axis in "xyz" if axis not in fields]
    if missing or len(fields) < len(rows):
        what = f"no field {missing[0]}" if missing else "a field named twice"
        raise InputError(path, "FIELDS", what, _FIX)
    count = count_of(path, "POINTS", " ".join(head.get("POINTS", [])))
    if not count:
        raise InputError(path, "POINTS", "has no vertices", _FIX)
    columns = columns_of(path, memoryview(data)[match.end() :], count, rows, "<" if form == "binary" else "")
    if (packed := next((name for name in ("rgb", "rgba") if name in fields), None)) is not None:
        # PCL stores the bytes of a colour as those of a float.
        stored_as = np.float32 if dict(rows)[packed] == "f4" else np.uint32
        with np.errstate(all="ignore"):
            bits = columns[packed].astype(stored_as).view(np.uint32)
        columns |= {
            name: (bits >> n).astype(np.uint8) for name, n in (("red", 16), ("green", 8), ("blue", 0))
        }
    return cloud_of(path, columns)
