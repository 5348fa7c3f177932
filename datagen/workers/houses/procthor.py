"""Folders of houses of ProcTHOR, as JSON lines, or of Holodeck, as JSON files, and a size table."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from datagen.schemas.errors import InputError
from datagen.schemas.identity import digest_of
from datagen.schemas.safe_files import read_regular
from datagen.workers.furniture.assets import Asset, read_asset_table
from datagen.workers.furniture.solids import hash_bytes
from datagen.workers.houses.house import House
from datagen.workers.houses.line_index import MAX_LINE_BYTES, MAX_LINES, Line, LineIndex, open_lines
from datagen.workers.houses.loader import build_house, read_house
from datagen.workers.json_document import JsonNode, parse_json
from datagen.workers.source_statement import read_statement

_MAX_FILES = 100_000
_Place = tuple[LineIndex, Line]


@dataclass(frozen=True, eq=False)
class ProcthorHouses:
    """The houses of one folder, found by id."""

    digest: str
    folder: Path
    assets: dict[str, Asset]
    places: dict[str, _Place]  # by id
    clashes: dict[str, str] = field(default_factory=dict)  # id -> the lines that share it
    statement: Mapping[str, str] = field(default_factory=dict)
    kind: str = "procthor"

    def house_ids(self) -> list[str]:
        return list(self.places)

    def load(self, house_id: str) -> House:
        """The house. Raises InputError that names the file, its line, the house and the JSON path."""
        document, digest = self.document(house_id)
        return build_house(document, house_id, digest, self.assets)

    def examine(self, house_id: str) -> Mapping[str, int]:
        """The findings of the house, without building it. Raises InputError as `load` does."""
        return read_house(self.document(house_id)[0], self.assets).findings

    def document(self, house_id: str) -> tuple[JsonNode, str]:
        """The parsed document of a house, and the sha256 of its bytes. Raises InputError that names it."""
        if house_id not in self.places:
            raise InputError(self.folder, "", f"has no house {house_id!r}", "Give one of its ids.")
        if house_id in self.clashes:
            fix = "Rename or remove one of them."
            raise InputError(self.folder, house_id, f"two houses: {self.clashes[house_id]}", fix)
        index, line = self.places[house_id]
        return parse_json(index.text(line), f"{index.path}:{line.number} ({house_id})"), line.sha256


def open_procthor(folder: str) -> ProcthorHouses:
    """The houses below a folder. A damaged house is reported when it is loaded, not here.

    The digest covers the ids and bytes of all houses and the size table, not the names of files.
    The digest is therefore the same if files are compressed or divided differently.
    """
    path = Path(folder)
    fix = "Name it as procthor:DIR, where DIR holds *.jsonl.gz and asset_sizes.json, or Holodeck's *.json."
    if not folder or not path.is_dir():
        raise InputError(folder or "procthor", "", "no such folder of houses", fix)
    with os.scandir(path) as entries:
        found = (e.name for e in entries if e.name.endswith((".jsonl.gz", ".jsonl")))
        names = sorted(itertools.islice(found, _MAX_FILES + 1))
    documents = () if names else itertools.islice(house_documents(path), _MAX_FILES + 1)
    names = names or sorted(p.relative_to(path).as_posix() for p in documents)
    if not names:
        raise InputError(path, "", "has no *.jsonl.gz, *.jsonl or *.json file with houses", fix)
    assets, table = read_asset_table(path, is_needed=not names[0].endswith(".json"))
    if len(names) > _MAX_FILES:
        raise InputError(path, "", f"has more than {_MAX_FILES} files", "Join them as JSON lines.")
    files, houses = list[LineIndex](), 0
    for name in names:
        if not name.isprintable():
            raise InputError(path, name, "has unprintable characters", "Rename the file.")
        files.append(open_lines(path / name))
        houses += len(files[-1].lines)
        if houses > MAX_LINES:
            raise InputError(path, name, f"has more than {MAX_LINES:,} houses", "Divide them among folders.")
    places, clashes = _by_id(files, path)
    if not places:
        raise InputError(path, "", "has files without houses", fix)
    digests = [[house_id, line.sha256] for house_id, (_, line) in places.items()]
    digest = digest_of([digests, hash_bytes(table.decode("utf-8", "replace")).hex()])
    return ProcthorHouses(digest, path, assets, places, clashes, read_statement(path))


def house_documents(folder: Path) -> Iterator[Path]:
    """The JSON files of a folder, or of folders in it, that hold a house each."""
    for path in itertools.chain(folder.glob("*.json"), folder.glob("*/*.json")):
        with contextlib.suppress(InputError):  # too large to be a house
            text = read_regular(path, MAX_LINE_BYTES, "")
            if all(f'"{key}"'.encode() in text for key in ("rooms", "walls", "objects")):
                yield path


def _by_id(files: list[LineIndex], folder: Path) -> tuple[dict[str, _Place], dict[str, str]]:
    """The line of each id, sorted by id, and clashing ids; identical copies of a house count once."""
    found: dict[str, list[_Place]] = defaultdict(list)
    for index in files:
        stem = index.path.name.split(".")[0]
        own = (
            index.path.relative_to(folder).with_suffix("").as_posix() if index.path.suffix == ".json" else ""
        )
        for line in index.lines:
            found[line.house_id or own or f"{stem}-{line.number:06d}"].append((index, line))
    places: dict[str, _Place] = {}
    clashes: dict[str, str] = {}
    for house_id in sorted(found):
        copies = found[house_id]
        places[house_id] = copies[0]
        if len({line.sha256 for _, line in copies}) > 1:
            clashes[house_id] = " and ".join(f"{i.path.name}:{line.number}" for i, line in copies[:4])
    return places, clashes
