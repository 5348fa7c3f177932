"""Candidates of another run that a run labels: a record, which the specification names by digest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import Field

from datagen.schemas.errors import InputError
from datagen.schemas.fields import SELECTION_PROBABILITY, SceneRows
from datagen.schemas.identity import digest_of
from datagen.schemas.keys import SELECTION
from datagen.schemas.record_files import read_record
from datagen.schemas.run import Run
from datagen.schemas.run_records import StoredRecord
from datagen.schemas.scene_rows import read_scenes

# The selection that was read last: a worker makes one run, and needs it for every scene.
_READ: dict[tuple[str, str], Selection] = {}

Index = Annotated[int, Field(ge=0, lt=2**31)]
Probability = Annotated[float, Field(gt=0, le=1)]


class Selection(StoredRecord):
    """selection.json: the selected scenes, ascending, and equally many candidates of each.

    `probability` is the probability of selecting each candidate, including that of its scene.
    """

    scenes: tuple[Index, ...]
    candidates: tuple[tuple[Index, ...], ...]
    probability: tuple[tuple[Probability, ...], ...]

    def digest(self) -> str:
        """sha256 of the record's content, as in the specification."""
        return digest_of(self.model_dump(mode="json"))


def misfit(run: Run, selection: Selection) -> str:
    """The problem of a selection that is not the run's own; "" where there is none."""
    wanted = run.manifest.spec.selection
    if wanted is None or selection.digest() != wanted.sha256:
        return "is not the selection that the specification names"
    each, scenes = run.layout.candidates_per_scene, len(selection.scenes)
    sizes = {len(rows) for rows in (*selection.candidates, *selection.probability)}
    if sizes != {each} or {len(selection.candidates), len(selection.probability)} != {scenes}:
        return f"does not have {each} candidates for each scene"
    return ""


def selection_of(run: Run) -> Selection | None:
    """The run's selection; None where it labels every candidate. InputError where its record is missing."""
    wanted = run.manifest.spec.selection
    return None if wanted is None else _read(run, wanted.sha256)


def _read(run: Run, digest: str) -> Selection:
    key = (run.storage.url, digest)
    if key not in _READ:
        place = f"{run.storage.url}/{SELECTION}"
        selection = read_record(run.storage, SELECTION, Selection)
        fix = "Repair it with `datagen repair`, or restore the file from a copy"
        if selection is None:
            raise InputError(place, "", "no such file", fix)
        if problem := misfit(run, selection):
            raise InputError(place, "", problem, fix)
        _READ.clear()
        _READ[key] = selection
    return _READ[key]


def keys_of(run: Run, scene: int) -> tuple[int, npt.NDArray[np.int32]]:
    """Return the scene's index and those of its candidates, for the scene at this position of the run."""
    selection = selection_of(run)
    if selection is None:
        return scene, np.arange(run.layout.candidates_per_scene, dtype=np.int32)
    if scene >= len(selection.scenes):
        problem = f"has {len(selection.scenes)} scenes"
        raise InputError(f"{run.storage.url}/{SELECTION}", "scenes", problem, "Do not extend a selection")
    return selection.scenes[scene], np.array(selection.candidates[scene], np.int32)


def rows_to_label(run: Run, source: Run, scenes: Sequence[int]) -> Iterator[tuple[int, SceneRows]]:
    """Yield the index and the rows of the scenes at these positions of `run`, from the run that stores them.

    Rows of a selection have their probability as a further column. A source of the same selection has it
    already. InputError for a scene that is not committed, or damaged.
    """
    selection = selection_of(run)
    if selection is None or source.manifest.spec.selection == run.manifest.spec.selection:
        indices = [keys_of(run, scene)[0] for scene in scenes]
        yield from zip(indices, read_scenes(source, scenes), strict=True)
        return
    indices = [keys_of(run, scene)[0] for scene in scenes]
    for scene, index, rows in zip(scenes, indices, read_scenes(source, indices), strict=True):
        chosen = list(selection.candidates[scene])
        samples: dict[str, np.ndarray[Any, Any]] = {name: a[chosen] for name, a in rows.samples.items()}
        samples[SELECTION_PROBABILITY.name] = np.array(selection.probability[scene], np.float64)
        yield index, SceneRows(rows.record, samples)
