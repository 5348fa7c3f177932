"""Stream samples from runs as batches of whole scenes, reproducible by seed and epoch."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NotRequired

import numpy as np
from pydantic import Field
from typing_extensions import TypedDict  # pydantic reads typing's from Python 3.12 on

from datagen.schemas.errors import InputError
from datagen.schemas.specification import Specification
from datagen.schemas.storage import concurrent_map
from datagen.train.batching import (
    SAMPLE_FIELDS,
    SCENE_FIELDS,
    StoredScene,
    candidate_rows,
    make_batch,
    stored_scenes,
)
from datagen.train.headings import is_other_side, side_deg_of
from datagen.train.inputs import I64, Array, Batch
from datagen.train.reader import load_shard
from datagen.train.run_parts import JOIN_FIELDS, open_parts
from datagen.train.scene_table import TABLE_FIELDS, PartSummary, read_scene_table

_ORDER, _CANDIDATES = 0, 1  # independent streams of an epoch's generators
_CORE = (*SCENE_FIELDS, *SAMPLE_FIELDS, *JOIN_FIELDS)


@dataclass(frozen=True, eq=False)
class EpochPlan:
    """Batch i of a rank is `order[cuts[i]:cuts[i + 1]]`; scenes of one `buffer` are read together."""

    order: I64  # (n,)
    buffer: I64  # (n,)
    cuts: I64  # (batches + 1,)


def batches_of(n_scenes: int, scenes_per_batch: int, world: int) -> int:
    """Number of batches per rank: none is empty, and none larger than requested where scenes suffice."""
    largest_rank = -(-n_scenes // world)
    return max(1, min(-(-largest_rank // scenes_per_batch), n_scenes // world))


def plan_epoch(
    shard: I64,
    scenes_per_batch: int,
    buffer_shards: int,
    rng: np.random.Generator | None,
    rank: int,
    world: int,
) -> EpochPlan:
    """The order of one rank's scenes, given each scene's shard (S,), ascending.

    With `rng`, shards are permuted, and each rank gets an equal, contiguous part of the scenes (two ranks
    read a shard on a border). Scenes are shuffled within every `buffer_shards` shards of the part. Without
    `rng`, scenes keep their stored order. Batches differ by one scene at most.
    """
    n, batches = len(shard), batches_of(len(shard), scenes_per_batch, world)
    if rng is None:
        order, luck = np.arange(n), None
    else:
        kept, index = np.unique(shard, return_inverse=True)
        order = np.argsort(rng.permutation(len(kept))[index], kind="stable")
        luck = rng.random(n)
    first, past = rank * n // world, (rank + 1) * n // world
    order = order[first:past]
    buffer = np.cumsum(np.diff(shard[order], prepend=shard[order[0]]) != 0) // buffer_shards
    if luck is not None:
        order = order[np.lexsort([luck[first:past], buffer])]
    cuts = np.arange(batches + 1) * len(order) // batches
    return EpochPlan(order, buffer, cuts)


class DataOrigin(TypedDict):
    """Description of a run's data as JSON values.

    `samples_sha256` is over the ids and labels of the selected samples, in stored order: the same for a run,
    its copy and its sealed store. `cost` has the wall and CPU seconds of the whole run; None for a sealed
    store without its run. `robots` has the least and the largest value of `ROBOT_SIZES` in metres. `presents`
    is how their bases stand to the target, `faces` or `side`; those that turn in place face it at first.
    `side_deg` is the angle of the target from their front. Older checkpoints lack both.
    """

    spec_hashes: list[str]
    schema: str
    schema_version: int
    n_samples: int
    n_scenes: int
    samples_sha256: str
    cost: dict[str, float] | None
    robots: dict[str, Annotated[list[float], Field(min_length=2, max_length=2)]]
    presents: NotRequired[Literal["faces", "side"]]
    side_deg: NotRequired[Annotated[float, Field(ge=-180, le=180)]]


# Fields of a specification's candidates, in which the robots of a run differ.
ROBOT_SIZES = ("arm_reach_m", "base_height_m", "camera_height_m")


def robot_sizes(specs: Sequence[Specification]) -> dict[str, list[float]]:
    """The least and the largest of `ROBOT_SIZES` over the robots that specifications draw."""
    found: dict[str, list[float]] = {}
    for name in ROBOT_SIZES:
        ranges = [getattr(spec.candidates, name) for spec in specs]
        found[name] = [min(r.low for r in ranges), max(r.high for r in ranges)]
    return found


class SampleStream:
    """Epochs of batches from one or many runs, merged or not, sealed or not, local or on S3.

    A batch holds `scenes_per_batch` whole scenes (a few less where they do not divide evenly) with all
    their robots, and all candidates or `candidates_per_robot` random ones of each robot. `houses` selects
    houses by house_id. `extra` names further columns of the store. Each of `world` ranks gives the same
    number of batches; together they are the epoch. With `shuffle`, scenes are shuffled within
    `buffer_shards` shards; without, they keep their stored order. At most two such buffers are in memory.
    Runs that lack planned samples need `allow_incomplete`. docs/guides/read-data.md describes what the
    order of scenes depends on.

    InputError names the missing, foreign or damaged data, in the constructor or while reading.
    """

    def __init__(
        self,
        paths: Sequence[str | Path],
        *,
        scenes_per_batch: int = 16,
        candidates_per_robot: int | None = None,
        seed: int = 0,
        buffer_shards: int = 8,
        houses: Callable[[str], bool] | None = None,
        extra: Sequence[str] = (),
        shuffle: bool = True,
        rank: int = 0,
        world: int = 1,
        allow_incomplete: bool = False,
    ) -> None:
        _refuse_below("scenes_per_batch", scenes_per_batch, 1)
        _refuse_below("buffer_shards", buffer_shards, 1)
        _refuse_below("candidates_per_robot", 1 if candidates_per_robot is None else candidates_per_robot, 1)
        _refuse_below("seed", seed, 0)
        self.scenes_per_batch = scenes_per_batch
        self.candidates_per_robot = candidates_per_robot
        self.seed = seed
        self.buffer_shards = buffer_shards
        self.shuffle = shuffle

        names = list(dict.fromkeys([*_CORE, *extra]))
        uneven = tuple({"object_digest"} - set(names))
        parts = open_parts(paths, list(dict.fromkeys([*names, *TABLE_FIELDS])), allow_incomplete, uneven)
        self._extra = tuple(dict.fromkeys(extra))
        self._shards = [(s, {n: p.arrays[n] for n in names}, p.robot) for p in parts for s in p.shards]
        self._dims = {name: parts[0].arrays[name].dims[0] for name in names}
        self._scenes = read_scene_table(parts, candidates_per_robot, houses)
        if not 0 <= rank < world:
            raise InputError("training data", "rank", f"{rank} of {world}", "Number ranks from 0")
        if len(self._scenes) < world:
            place, problem = self.parts[0].part.place, f"has {len(self._scenes)} scenes for {world} processes"
            raise InputError(place, "", problem, "Name more runs, or train on fewer processes")
        self.rank, self.world = rank, world

    @property
    def batches_per_epoch(self) -> int:
        """Batches of one epoch of one rank; the same for all ranks."""
        return batches_of(len(self._scenes), self.scenes_per_batch, self.world)

    @property
    def n_scenes(self) -> int:
        """Scenes of one epoch, of all ranks together."""
        return len(self._scenes)

    @property
    def n_samples(self) -> int:
        """Samples of one epoch, of all ranks together."""
        return int(self._scenes.samples.sum())

    @property
    def parts(self) -> Sequence[PartSummary]:
        """The runs, with the selected samples of each."""
        return self._scenes.parts

    def class_counts(self) -> tuple[int, int]:
        """(negatives, positives) of all samples that epochs draw from."""
        return sum(p.negatives for p in self.parts), sum(p.positives for p in self.parts)

    def house_ids(self) -> set[str]:
        """Houses of its scenes."""
        return set(self._scenes.house_ids)

    def house_digests(self) -> Mapping[str, str]:
        """Digests of these houses, with the id of each."""
        return self._scenes.house_of_digest

    def object_digests(self) -> set[str]:
        """Digests of all objects in its scenes, targets and clutter."""
        return set(self._scenes.object_digests)

    def origin(self) -> list[DataOrigin]:
        """Records of the data for a checkpoint, one per run."""
        return [
            {
                "spec_hashes": list(summary.part.spec_hashes),
                "schema": summary.part.schema,
                "schema_version": summary.part.schema_version,
                "n_samples": summary.negatives + summary.positives,
                "n_scenes": summary.scenes,
                "samples_sha256": summary.samples_sha256,
                "cost": None if summary.part.cost is None else dict(summary.part.cost),
                "robots": robot_sizes(summary.part.specs),
                "presents": "side" if is_other_side(side_deg_of(summary.part.specs[0]), 0.0) else "faces",
                "side_deg": side_deg_of(summary.part.specs[0]),
            }
            for summary in self.parts
        ]

    def epoch(self, k: int, skip_batches: int = 0, every: int = 1) -> Generator[Batch[Array]]:
        """Batches of epoch k from batch `skip_batches` on, the same as without skipping.

        `every` selects each `every`-th of them, for processes that share an epoch. A thread reads the next
        shards while a batch is used. Close or exhaust the iterator to end the thread. Shards that are
        skipped as a whole are not read.
        """
        _refuse_below("epoch", k, 0)
        _refuse_below("skip_batches", skip_batches, 0)
        rng = np.random.default_rng([self.seed, k, _ORDER]) if self.shuffle else None
        plan = plan_epoch(
            self._scenes.shard, self.scenes_per_batch, self.buffer_shards, rng, self.rank, self.world
        )
        return self._batches(plan, k, range(skip_batches, len(plan.cuts) - 1, every))

    def _batches(self, plan: EpochPlan, k: int, batches: range) -> Generator[Batch[Array]]:
        if not batches:
            return
        with ThreadPoolExecutor(1, "read-ahead") as pool:
            ahead = max(2, self.buffer_shards)
            loaded = concurrent_map(pool, ahead, self._load, self._reads(plan, batches))
            try:
                held: dict[int, StoredScene] = {}
                for number in batches:
                    wanted = plan.order[plan.cuts[number] : plan.cuts[number + 1]].tolist()
                    while not all(scene in held for scene in wanted):
                        held.update(next(loaded))
                    yield self._batch([held.pop(scene) for scene in wanted], k)
            finally:
                loaded.close()

    def _reads(self, plan: EpochPlan, batches: range) -> list[tuple[int, I64]]:
        """(shard, its scenes in these batches), buffer by buffer."""
        wanted = np.repeat(np.isin(np.arange(len(plan.cuts) - 1), batches), np.diff(plan.cuts))
        scenes, buffer = plan.order[wanted], plan.buffer[wanted]
        by_shard = np.lexsort([scenes, self._scenes.shard[scenes], buffer])
        scenes = scenes[by_shard]
        shards = self._scenes.shard[scenes]
        starts = np.flatnonzero(np.diff(shards, prepend=-1))
        return [(int(shards[i]), some) for i, some in zip(starts, np.split(scenes, starts[1:]), strict=True)]

    def _load(self, wanted: tuple[int, I64]) -> dict[int, StoredScene]:
        shard, scenes = wanted
        place, arrays, robot = self._shards[shard]
        columns, bounds = load_shard(place, arrays)
        where = place.url
        stored = stored_scenes(where, columns, self._dims, bounds, self._scenes.row[scenes], robot)
        return dict(zip(scenes.tolist(), stored, strict=True))

    def _batch(self, scenes: Sequence[StoredScene], k: int) -> Batch[Array]:
        chosen = []
        for scene in scenes:
            rng = np.random.default_rng([self.seed, k, _CANDIDATES, *scene.words])
            chosen.append(candidate_rows(scene.samples["robot_index"], self.candidates_per_robot, rng))
        extra = {
            dim: [name for name in self._extra if self._dims[name] == dim] for dim in ("scene", "sample")
        }
        return make_batch(scenes, chosen, extra["scene"], extra["sample"])


def _refuse_below(field: str, value: int, least: int) -> None:
    if value < least:
        raise InputError("training data", field, f"{value} is below {least}", f"Give {least} or more")
