"""Folders of ProcTHOR houses: JSON lines (compressed or not) or single JSON files, and a size table."""

from __future__ import annotations

import itertools
import os
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

from datagen.schemas.errors import InputError
from datagen.schemas.identity import digest_of
from datagen.workers.furniture.assets import TABLE_NAMES, Asset, read_asset_table
from datagen.workers.furniture.solids import hash_bytes
from datagen.workers.houses.house import House
from datagen.workers.houses.line_index import MAX_LINES, LineIndex, houses_cache, open_lines
from datagen.workers.houses.loader import build_house
from datagen.workers.json_document import parse_json

_MAX_FILES = 100_000
_SUFFIXES = (".jsonl.gz", ".jsonl", ".json")
# Tables that may be stored with the houses.
_NOT_HOUSES = {
    *TABLE_NAMES, "type_annotations.json", "placement-annotations.json", "receptacles.json",
    "wall-holes.json", "asset_groups.json", "metadata.json",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class ProcthorHouses:
    """The houses of one folder, found by id in memory-mapped files."""

    digest: str
    folder: Path
    assets: dict[str, Asset]
    files: list[LineIndex]
    rows: dict[str, tuple[int, int]]  # id -> file and row
    clashes: dict[str, str] = field(default_factory=dict)  # id -> the lines that share it
    kind: str = "procthor"

    def house_ids(self) -> list[str]:
        """Ids, sorted."""
        return list(self.rows)

    def load(self, house_id: str) -> House:
        """The house. Raises InputError that names the file, its line, the house and the JSON path."""
        if house_id not in self.rows:
            raise InputError(self.folder, "", f"has no house {house_id!r}", "Give one of its ids.")
        if house_id in self.clashes:
            fix = "Rename or remove one of them."
            raise InputError(self.folder, house_id, f"two houses: {self.clashes[house_id]}", fix)
        file, row = self.rows[house_id]
        index = self.files[file]
        text = index.line(row)
        place = f"{index.path}:{index.line_numbers[row]} ({house_id})"
        return build_house(parse_json(text, place), house_id, index.digests[row].tobytes().hex(), self.assets)


def open_procthor(folder: str) -> ProcthorHouses:
    """The houses below a folder. A damaged house is reported when it is loaded, not here.

    The digest covers the ids and bytes of all houses and the size table, not the names of files.
    The digest is therefore the same if files are compressed or divided differently.
    """
    path = Path(folder)
    fix = "Name it as procthor:DIR, where DIR holds *.jsonl.gz and asset_sizes.json."
    if not folder or not path.is_dir():
        raise InputError(folder or "procthor", "", "no such folder of houses", fix)
    assets, table = read_asset_table(path)
    with os.scandir(path) as entries:
        found = (e.name for e in entries if e.name.endswith(_SUFFIXES) and e.name not in _NOT_HOUSES)
        names = sorted(itertools.islice(found, _MAX_FILES + 1))
    if not names:
        raise InputError(path, "", "has no *.jsonl.gz, *.jsonl or *.json file with houses", fix)
    if len(names) > _MAX_FILES:
        raise InputError(path, "", f"has more than {_MAX_FILES} files", "Join them as JSON lines.")
    cache = houses_cache()
    files, houses = list[LineIndex](), 0
    for name in names:
        if not name.isprintable():
            raise InputError(path, name, "has unprintable characters", "Rename the file.")
        # Small .json files are read in memory; only files of many houses are worth unpacking.
        files.append(open_lines(path / name, None if name.endswith(".json") else cache))
        houses += len(files[-1].ids)
        if houses > MAX_LINES:
            raise InputError(path, name, f"has more than {MAX_LINES:,} houses", "Divide them among folders.")
    rows, clashes = _rows(files)
    if not rows:
        raise InputError(path, "", "has files without houses", fix)
    digests = [[i, files[f].digests[r].tobytes().hex()] for i, (f, r) in rows.items()]
    digest = digest_of([digests, hash_bytes(table.decode("utf-8", "replace")).hex()])
    return ProcthorHouses(digest, path, assets, files, rows, clashes)


def _rows(files: list[LineIndex]) -> tuple[dict[str, tuple[int, int]], dict[str, str]]:
    """File and row of each id, sorted by id, and clashing ids; identical copies of a house count once."""
    found: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for f, index in enumerate(files):
        stem = index.path.name.split(".")[0]
        for row, own in enumerate(index.ids):
            found[own or f"{stem}-{int(index.line_numbers[row]):06d}"].append((f, row))
    rows: dict[str, tuple[int, int]] = {}
    clashes: dict[str, str] = {}
    for house_id in sorted(found):
        copies = found[house_id]
        rows[house_id] = copies[0]
        if len({files[f].digests[r].tobytes() for f, r in copies}) > 1:
            named = [f"{files[f].path.name}:{files[f].line_numbers[r]}" for f, r in copies[:4]]
            clashes[house_id] = " and ".join(named)
    return rows, clashes
