"""Objects of the YCB set, as laser scans with convex collision parts, from a folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from datagen.schemas.errors import InputError
from datagen.schemas.identity import digest_of
from datagen.workers.objects.exclusions import reason_to_exclude
from datagen.workers.objects.model import ObjectModel
from datagen.workers.objects.scan import READER_VERSION, load_scan, model_of, volumes_m3
from datagen.workers.objects.ycb_layouts import Entry, read_layout
from datagen.workers.source_statement import read_statement


class YcbObjects:
    """The usable objects of one folder (see `ycb_layouts` for the layouts).

    Opening it hashes every object and reads each content once, so that damaged or implausible data
    is reported before a job starts. The content is cached; later openings take a fraction of a second.
    Masses above 50 kg are refused by the index's schema.
    """

    kind = "ycb"

    def __init__(self, folder: Path) -> None:
        """Raises InputError that names the file, the object and the field."""
        index, entries = read_layout(folder)
        self.statement = read_statement(folder)
        excluded: dict[str, str] = {}
        self._entries: dict[str, tuple[Entry, float]] = {}
        self._models: dict[str, ObjectModel] = {}
        volumes = volumes_m3([entry.files for entry in entries])
        for entry, volume_m3 in zip(entries, volumes, strict=True):
            measured = entry.mass_kg is not None
            mass_kg = entry.density_kg_m3 * volume_m3 if entry.mass_kg is None else entry.mass_kg
            reason = reason_to_exclude(entry.name, mass_kg, volume_m3, measured)
            if reason is not None:
                excluded[entry.name] = reason
            else:
                self._entries[entry.name] = (entry, mass_kg)
        self.excluded: Mapping[str, str] = excluded
        if not self._entries:
            raise InputError(
                index,
                "",
                "has no usable object: all were excluded",
                f"First reason: {next(iter(excluded.values()))}",
            )
        self.digest = digest_of({name: _digest(e, mass_kg) for name, (e, mass_kg) in self._entries.items()})

    def names(self) -> list[str]:
        """Usable objects, sorted."""
        return list(self._entries)

    def load(self, name: str) -> ObjectModel:
        """The model; the same object at every call. Raises InputError for an unknown name."""
        model = self._models.get(name)
        if model is None:
            if name not in self._entries:
                reason = self.excluded.get(name, "there is no such object")
                raise InputError("ycb objects", name, reason, "See `names()` for those that can be used")
            entry, mass_kg = self._entries[name]
            model = self._models[name] = model_of(
                name, _digest(entry, mass_kg), mass_kg, load_scan(entry.files)
            )
        return model


def _digest(entry: Entry, mass_kg: float) -> str:
    return digest_of([entry.files.digest, float(mass_kg).hex(), READER_VERSION])


def open_ycb(folder: str) -> YcbObjects:
    """The objects of a folder. Raises InputError if no folder is given, and as `YcbObjects` does."""
    if not folder:
        raise InputError("ycb", "", "has no folder", "Write `ycb:DIR`")
    return YcbObjects(Path(folder).expanduser())
