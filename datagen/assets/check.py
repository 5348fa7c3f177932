"""What a folder of houses or objects gives: what is read, what is not and why, and its licences."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Any

from datagen.display.progress import Progress
from datagen.schemas.errors import InputError
from datagen.workers.houses import HOUSE_SOURCES, open_houses
from datagen.workers.houses.procthor import house_documents
from datagen.workers.objects import OBJECT_SOURCES, ObjectSource, open_objects
from datagen.workers.source_statement import STATEMENT
from datagen.workers.survey import Survey, survey_sources

_LICENCES = ("licen", "copying", STATEMENT)
_MOST_LICENCES = 20


def check_source(given: str, shown: Progress) -> tuple[str, Survey, list[str], ObjectSource | None]:
    """Open and examine `KIND:DIR`, or DIR, whose kind follows from its content. Raises InputError.

    Returns the reference, what was read, files that state licences, and the source; None for houses.
    """
    kind, _, text = given.partition(":")
    if kind not in HOUSE_SOURCES | OBJECT_SOURCES:
        text = given
        kind = _kind_of(Path(text).expanduser())
    ref, of_houses = f"{kind}:{text}", kind in HOUSE_SOURCES
    if not text:
        raise InputError(given, "", "has no files to check", "Name a folder of houses or objects")
    shown.phase("opening houses and objects")
    houses, objects = (
        open_houses(ref if of_houses else "builtin"),
        open_objects("builtin" if of_houses else ref),
    )
    surveys = survey_sources(houses, objects, shown.counter("houses examined"))
    folder = Path(text).expanduser()
    found = (str(p.relative_to(folder)) for p in folder.rglob("*") if p.name.lower().startswith(_LICENCES))
    licences = sorted(islice(found, _MOST_LICENCES))
    return ref, surveys["houses" if of_houses else "objects"], licences, None if of_houses else objects


def object_rows(source: ObjectSource) -> list[dict[str, Any]]:
    """Name, size, mass, number of parts and remarks of each usable object."""
    notes = getattr(source, "notes", {})
    return [
        {"name": m.name, "size_m": list(m.size_m), "mass_kg": m.mass_kg, "parts": len(m.convex_parts_m)}
        | {"can_be_target": m.can_be_target, "notes": notes.get(m.name, {})}
        for m in map(source.load, source.names())
    ]


def _kind_of(folder: Path) -> str:
    if not folder.is_dir():
        raise InputError(folder, "", "is not a folder", "Give a folder of houses or objects, or KIND:DIR")
    if any(path.name.endswith((".jsonl", ".jsonl.gz")) for path in folder.iterdir()):
        return "procthor"
    if any(path.with_suffix(".toml").exists() for path in folder.glob("*.yaml")):
        return "map"
    if any(folder.glob("*.scene_dataset_config.json")):
        return "habitat"
    if any(house_documents(folder)):
        return "procthor"
    return "ai2thor" if (folder / "configs" / "scenes").is_dir() else "folder"
