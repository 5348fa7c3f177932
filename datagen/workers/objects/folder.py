"""Objects of any folder: meshes, URDF, SDF and MJCF files, as `object_files` finds them."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import QhullError

from datagen.schemas.errors import InputError
from datagen.schemas.identity import digest_of
from datagen.schemas.safe_files import read_regular
from datagen.workers.content_cache import CacheFolder
from datagen.workers.extras import versions_of
from datagen.workers.objects import YCB_INDEXES
from datagen.workers.objects.decomposition import LATE
from datagen.workers.objects.model import LoadedOnce, ObjectModel, ObjectSource
from datagen.workers.objects.object_files import TABLE, ObjectFiles, find_objects
from datagen.workers.objects.object_reading import GIVEN, Given, read_object
from datagen.workers.objects.scan import CACHE, model_of, restored_scan, stored_scan
from datagen.workers.objects.surfaces import SUFFIXES
from datagen.workers.objects.ycb import YcbObjects
from datagen.workers.source_statement import read_statement

# Part of every digest: raise it when the same files are read differently.
VERSION = 1
_LISTED = 3  # part of the key of cached lists alone: digests are of what was read
ALL = "*"  # the name of the row that holds for all objects
_LISTS = CacheFolder("folders", most_files=64)
_LIBRARIES = ("coacd", "pycollada", "scipy", "trimesh")


@dataclass(frozen=True)
class Found:
    """An object of the folder: usable with a digest, unusable with a reason."""

    digest: str
    mass_kg: float
    notes: dict[str, str]  # by cause
    reason: str = ""


class FolderObjects(LoadedOnce):
    """The usable objects of a folder, all examined when it is opened first, then listed in the cache."""

    kind = "folder"

    def __init__(self, folder: Path) -> None:
        """Raises InputError that names the folder without any usable object, or the table's line."""
        self._root, self.statement = folder, read_statement(folder)
        files, tree = find_objects(folder)
        self._files = {entry.name: entry for entry in files}
        self._table = _read_table(folder / TABLE, {*self._files, ALL})
        key = digest_of([tree, [*self._files], SUFFIXES, VERSION, _LISTED, versions_of(_LIBRARIES)])
        stored = _LISTS.load(key)
        if stored is None:
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                found = dict(zip(self._files, pool.map(self._examined, files), strict=True))
            if not any(LATE in each.reason for each in found.values()):  # of a busy machine, perhaps
                listed = json.dumps({name: asdict(each) for name, each in found.items()})
                _LISTS.store(key, {"list": np.array(listed)})
        else:
            found = {name: Found(**each) for name, each in json.loads(str(stored["list"])).items()}
        self._found = {name: each for name, each in found.items() if not each.reason}
        self.excluded: Mapping[str, str] = {n: each.reason for n, each in found.items() if each.reason}
        self.notes: Mapping[str, Mapping[str, str]] = {n: each.notes for n, each in self._found.items()}
        if not self._found:
            first = next(iter(self.excluded.values()), "there is no mesh, URDF, SDF or MJCF file")
            raise InputError(folder, "", "has no usable object", f"First reason: {first}")
        self._digests = {name: each.digest for name, each in self._found.items()}
        self.digest = digest_of(self._digests)
        self._models: dict[str, ObjectModel] = {}

    def _model(self, name: str) -> ObjectModel:
        found = self._found[name]
        stored = CACHE.load(f"{found.digest}-folder")
        if stored is None:
            scan = read_object(self._files[name], self._root, self._given(name)).scan
        else:
            scan = restored_scan(stored)
        return model_of(name, found.digest, found.mass_kg, scan)

    def _given(self, name: str) -> Given:
        return {**self._table.get(ALL, {}), **self._table.get(name, {})}

    def _examined(self, entry: ObjectFiles) -> Found:
        try:
            if not entry.name.isprintable() or len(entry.name) > 200:
                raise InputError(
                    entry.path, "", "its name has unprintable or too many characters", "Rename it"
                )
            read = read_object(entry, self._root, self._given(entry.name))
        except (QhullError, ValueError, LookupError, ArithmeticError, MemoryError) as error:
            if not isinstance(error, InputError):  # numbers that no check foresaw
                error = InputError(entry.path, "", f"cannot be read ({type(error).__name__})", "Repair it")
            where = os.path.relpath(error.place, self._root)
            where = f"{where}: {error.field}" if error.field else where
            return Found("", 0.0, {}, f"{error.problem} ({where}). {error.fix}")
        content = hashlib.sha256()
        arrays = stored_scan(read.scan)
        for name in sorted(arrays):
            content.update(f"{name} {arrays[name].dtype} {arrays[name].shape}".encode())
            content.update(arrays[name].tobytes())
        digest = digest_of([VERSION, content.hexdigest(), read.mass_kg.hex()])
        CACHE.store(f"{digest}-folder", arrays)
        return Found(digest, read.mass_kg, read.notes)


def open_folder(folder: str) -> ObjectSource:
    """The objects of a folder; one with an index of YCB objects is read as `ycb:` reads it.

    Raises InputError if no folder is given, and as `FolderObjects` and `YcbObjects` do.
    """
    if not folder:
        raise InputError("folder", "", "has no folder", "Write `folder:DIR`")
    path = Path(folder).expanduser()
    return YcbObjects(path) if any((path / name).is_file() for name in YCB_INDEXES) else FolderObjects(path)


def _read_table(path: Path, names: set[str]) -> dict[str, Given]:
    """The rows of `objects.csv` by name, empty where there is no table. InputError names a bad line."""
    if not path.exists():
        return {}
    fix = f"Write the columns name, {', '.join(GIVEN)}, with empty cells where nothing is known"
    text = read_regular(path, 1 << 24, fix).decode("utf-8-sig", "replace")
    rows: dict[str, Given] = {}
    for number, row in enumerate(csv.DictReader(io.StringIO(text), skipinitialspace=True), 2):
        name, given, line = row.get("name") or "", Given(), f"line {number}"
        if name not in names or name in rows:
            problem = f"{name!r:.80} is {'twice here' if name in rows else 'no object'}"
            raise InputError(path, line, problem, fix)
        for key, cell in row.items():
            if key != "name" and cell:
                try:
                    given[key] = GIVEN[key](cell.strip())
                except (KeyError, ValueError, AttributeError, TypeError):
                    raise InputError(path, line, f"{key} = {cell!r:.80} cannot be read", fix) from None
        rows[name] = given
    return rows
