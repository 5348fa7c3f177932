"""The arrays that the runs at given paths store, known before any array is opened."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from datagen.schemas.errors import InputError, choices
from datagen.schemas.fields import SCHEMAS, Field, Table
from datagen.schemas.run import open_runs
from datagen.train.run_parts import is_sealed_store, open_sealed


def fields_of(paths: Sequence[str | Path], function: str) -> list[dict[str, tuple[Table, Field]]]:
    """The arrays of each path, by name: their table and description. InputError where there is no run."""
    if not paths:
        raise InputError(function, "paths", "no run is given", "Give the folder of at least one run")
    return [_fields_of(path) for path in paths]


def _fields_of(path: str | Path) -> dict[str, tuple[Table, Field]]:
    if is_sealed_store(path):
        name = open_sealed(path, ("scene_index", "sample_scene_index")).schema
    else:
        name = open_runs(str(path))[0].schema.name
    # Readers compute what stores of older versions lack.
    return {field.name: (table, field) for table, field in SCHEMAS[name].fields}


def refuse_unknown(names: Sequence[str], valid: Sequence[str], place: str) -> None:
    """Raise InputError, with the valid names, for a name that is not one of them."""
    for name in names:
        if name not in valid:
            raise InputError(place, f"columns: {name}", "is not a column of these runs", choices(valid))
