"""Plan the union of runs: which source has each shard, and which scenes of each part count.

No file is written, and rows are read only where two sources have the same scenes in different bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.schemas.errors import InputError
from datagen.schemas.fields import RecordSchema, SceneRows
from datagen.schemas.record_files import different_fields, encode_record
from datagen.schemas.run import Run
from datagen.schemas.run_records import OPEN_END, Commit, Layout, Manifest, MergedPart, Plan
from datagen.schemas.shard_ranges import ShardRanges
from datagen.schemas.shard_reading import read_scenes

# Fields that may differ between merged runs: they give other samples of the same kind.
FREE_FIELDS = ("seed", "split", "houses", "objects", "scenes_from")
_SHOWN = 5

Tick = Callable[[], None]
Key = tuple[str, int]  # specification hash and scenes per shard: what the runs of a part have in common


@dataclass(frozen=True, eq=False)
class Part:
    """The union of runs of one specification and layout.

    `kept` has the source (its index in `runs`) and the commit of every shard; `spare` those of duplicates,
    which have equal rows and may be of one attempt.
    """

    runs: tuple[Run, ...]
    kept: Mapping[int, tuple[int, Commit]]
    spare: Sequence[tuple[int, Commit]]

    @property
    def layout(self) -> Layout:
        return self.runs[0].layout

    @property
    def key(self) -> Key:
        return key_of(self.runs[0])

    @property
    def folder(self) -> str:
        """Its folder in merged runs."""
        return f"parts/{self.key[0][:16]}-{self.key[1]}"

    @property
    def scenes(self) -> ShardRanges:
        """The scenes of its committed shards."""
        return ShardRanges.of(self.kept).times(self.layout.scenes_per_shard)

    @property
    def manifest(self) -> Manifest:
        """One of the sources' manifests, independent of their order."""
        return min((run.manifest for run in self.runs), key=encode_record)


def key_of(run: Run) -> Key:
    """What a run has in common with the others of its part."""
    return run.manifest.spec_hash, run.layout.scenes_per_shard


def plan_part(runs: Sequence[Run], is_first_kept: bool, tick: Tick) -> Part:
    """The union of runs of one specification and layout; `tick` is called for every commit that was read.

    Shards of the first are kept where `is_first_kept`; else names decide, not the order of the sources.
    InputError when two have different rows for a scene.
    """
    held: dict[int, list[tuple[int, Commit]]] = {}
    for source, run in enumerate(runs):
        for commit in run.commits():
            held.setdefault(commit.shard, []).append((source, commit))
            tick()
    kept: dict[int, tuple[int, Commit]] = {}
    spare: list[tuple[int, Commit]] = []
    for shard in sorted(held):
        best, *rest = sorted(held[shard], key=lambda h: (not is_first_kept or h[0] > 0, h[1].attempt, h[0]))
        for source, commit in rest:
            if commit.object.sha256 != best[1].object.sha256:
                refuse_different_rows(runs[best[0]], shard, runs[source], shard)
        kept[shard] = best
        spare += rest
    return Part(tuple(runs), kept, spare)


def largest_plan(parts: Iterable[Part]) -> Plan:
    """The largest plan of the sources of parts of one specification."""
    runs = [run for part in parts for run in part.runs]
    plans = [plan for run in runs if (plan := run.plan()) is not None]
    if not plans:
        problem = "has no plan with the number of samples wanted"
        raise InputError(runs[0].storage.url, "plans", problem, "Set it with `datagen resume RUN --n N`")
    return min(plans, key=lambda plan: (-plan.n, plan.created))


def divide_scenes(parts: Sequence[Part]) -> list[MergedPart]:
    """Which scenes count in each part, in order of specification and falling size of shards.

    A scene of several parts of one specification counts in the first that has it. Scenes that no part has
    belong to the first, which a resume extends, unless others have scenes of the same shard: then to the
    last, whose shards are the smallest. So those of each shard that count are consecutive. InputError where
    two parts have different rows for a scene.
    """
    found: list[MergedPart] = []
    ordered = sorted(parts, key=lambda part: (part.key[0], -part.key[1]))
    for spec_hash in dict.fromkeys(part.key[0] for part in ordered):
        group = [part for part in ordered if part.key[0] == spec_hash]
        counted, taken = list[ShardRanges](), ShardRanges.of(())
        for number, part in enumerate(group):
            _refuse_conflicts(group[:number], part)
            counted.append(part.scenes.without(taken))
            taken = taken.union(part.scenes)
        size = group[0].layout.scenes_per_shard
        missing, begun = ShardRanges.between([(0, OPEN_END)]).without(taken), taken.blocks(size).times(size)
        counted[0] = counted[0].union(missing.without(begun))
        counted[-1] = counted[-1].union(missing.within(begun))
        for part, scenes in zip(group, counted, strict=True):
            found.append(MergedPart(folder=part.folder, spec_hash=spec_hash, scenes=scenes.ranges))
    return found


def _refuse_conflicts(before: Sequence[Part], part: Part) -> None:
    """Compare the rows of scenes that a part has in common with those before it, each pair of shards once."""
    for other in before:
        sizes = part.layout.scenes_per_shard, other.layout.scenes_per_shard
        common = part.scenes.within(other.scenes)
        for shard, its in sorted({(scene // sizes[0], scene // sizes[1]) for scene in common}):
            runs = other.runs[other.kept[its][0]], part.runs[part.kept[shard][0]]
            refuse_different_rows(runs[0], its, runs[1], shard)


def refuse_incompatible(runs: Sequence[Run]) -> None:
    """Raise InputError where two runs are of different kinds, with the differing fields of both."""
    first = runs[0]
    for run in runs[1:]:
        rows = different_fields(_kind(first), _kind(run))
        if rows:
            shown = "; ".join(
                f"{path}: {ours!r:.80} and {theirs!r:.80}" for path, ours, theirs in rows[:_SHOWN]
            )
            more = f"; and {len(rows) - _SHOWN} more" if len(rows) > _SHOWN else ""
            raise InputError(
                f"{first.storage.url} and {run.storage.url}",
                rows[0][0],
                f"differs in kind ({shown}{more})",
                f"Merge runs that differ only in {', '.join(FREE_FIELDS[:-1])} or {FREE_FIELDS[-1]}",
            )


def _kind(run: Run) -> dict[str, object]:
    manifest = run.manifest
    return {
        "schema_name": manifest.schema_name,
        "schema_version": manifest.schema_version,
        "candidates_per_scene": manifest.layout.candidates_per_scene,
        **manifest.spec.model_dump(mode="json", exclude=set(FREE_FIELDS)),
    }


def group_runs(runs: Iterable[Run]) -> dict[Key, list[Run]]:
    """Runs by what those of a part have in common, each storage once."""
    groups: dict[Key, list[Run]] = {}
    for run in runs:
        group = groups.setdefault(key_of(run), [])
        if identity(run) not in map(identity, group):
            group.append(run)
    return groups


def identity(run: Run) -> str:
    """The address of a run, without links."""
    storage = run.storage
    return storage.url if storage.folder is None else str(storage.folder.resolve())


def refuse_different_rows(one: Run, shard_one: int, other: Run, shard_other: int) -> None:
    """Raise InputError where two committed shards have different rows for a common scene.

    It names both runs, the shard, and the first differing sample and field. InputError also for a damaged
    object.
    """
    size, size_other = one.layout.scenes_per_shard, other.layout.scenes_per_shard
    first = max(size * shard_one, size_other * shard_other)
    scenes = range(first, min(size * (shard_one + 1), size_other * (shard_other + 1)))
    for ours, theirs in zip(read_scenes(one, scenes), read_scenes(other, scenes), strict=True):
        found = _first_difference(one.schema, ours, theirs)
        if found is None:
            continue
        field, row = found
        sample = bytes(ours.samples["sample_id"][row]).hex()
        problem = f"{other.storage.url} has other rows, first in sample {sample}, in {field}"
        fix = "Run `datagen verify` on both, and merge without the wrong one"
        raise InputError(one.storage.url, f"shard {shard_one}", problem, fix)


def _first_difference(schema: RecordSchema, ours: SceneRows, theirs: SceneRows) -> tuple[str, int] | None:
    """The first field and sample row that differ in a scene; row 0 where the scene's record differs."""
    for field in schema.scene_fields:
        if not _equal(np.asarray(ours.record[field.name]), np.asarray(theirs.record[field.name])):
            return field.name, 0
    found: list[tuple[int, int, str]] = []
    for position, field in enumerate(schema.sample_fields):
        a, b = ours.samples[field.name], theirs.samples[field.name]
        if not _equal(a, b):
            row = next(k for k in range(len(a)) if not _equal(a[k : k + 1], b[k : k + 1]))
            found.append((row, position, field.name))
    return (min(found)[2], min(found)[0]) if found else None


def _equal(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> bool:
    """Whether two arrays are equal bit for bit."""
    if a.dtype.kind == "O":
        return bool(np.array_equal(a, b))
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
