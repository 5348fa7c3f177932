"""What a folder of houses or objects gives: what is read, what is not and why, and its licences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.display.progress import Progress
from datagen.schemas.errors import InputError
from datagen.workers.houses import HOUSE_SOURCES, open_houses
from datagen.workers.objects import OBJECT_SOURCES, ObjectSource, open_objects
from datagen.workers.source_statement import STATEMENT
from datagen.workers.survey import Survey, survey_sources

_LICENCES = ("licen", "copying")
_MOST_LICENCES = 20


@dataclass(frozen=True)
class Checked:
    """A source that was opened; `objects` is None for houses."""

    ref: str
    survey: Survey
    licences: list[str]
    objects: ObjectSource | None

    def rows(self) -> list[dict[str, Any]]:
        """Name, size, mass and remarks of each usable object."""
        if self.objects is None:
            return []
        notes: Mapping[str, Mapping[str, str]] = getattr(self.objects, "notes", {})
        models = [self.objects.load(name) for name in self.objects.names()]
        return [
            {
                "name": m.name,
                "size_m": list(m.size_m),
                "mass_kg": m.mass_kg,
                "parts": len(m.convex_parts_m),
                "can_be_target": m.can_be_target,
                "notes": dict(notes.get(m.name, {})),
            }
            for m in models
        ]


def check_source(given: str, shown: Progress) -> Checked:
    """Open and examine `KIND:DIR`, or DIR, whose kind follows from its content. Raises InputError."""
    ref, kind = given, given.partition(":")[0]
    if kind not in HOUSE_SOURCES and kind not in OBJECT_SOURCES:
        kind = _kind_of(Path(given).expanduser())
        ref = f"{kind}:{given}"
    shown.phase("opening houses and objects")
    houses = open_houses(ref if kind in HOUSE_SOURCES else "builtin")
    objects = open_objects(ref if kind in OBJECT_SOURCES else "builtin")
    surveys = survey_sources(houses, objects, shown.counter("houses examined"))
    survey = surveys.get("houses" if kind in HOUSE_SOURCES else "objects")
    if survey is None:
        raise InputError(given, "", "has no files to check", "Name a folder of houses or objects")
    folder = Path(ref.partition(":")[2]).expanduser()
    return Checked(ref, survey, _licences(folder), objects if kind in OBJECT_SOURCES else None)


def _kind_of(folder: Path) -> str:
    if not folder.is_dir():
        raise InputError(folder, "", "is not a folder", "Give a folder of houses or objects, or KIND:DIR")
    if any(path.name.endswith((".jsonl", ".jsonl.gz")) for path in folder.iterdir()):
        return "procthor"
    return "ai2thor" if (folder / "configs" / "scenes").is_dir() else "folder"


def _licences(folder: Path) -> list[str]:
    """Files that state a licence, by their paths below the folder."""
    found = (
        path
        for path in folder.rglob("*")
        if path.name.lower().startswith(_LICENCES) or path.name == STATEMENT
    )
    return sorted(
        str(path.relative_to(folder)) for path, _ in zip(found, range(_MOST_LICENCES), strict=False)
    )
