"""Table of all scenes of a stream, made before a cloud is read: location, house, labels.

Read once, from a few short columns, so that sizes, splits and the order of an epoch need no cloud.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from datagen.schemas.errors import InputError
from datagen.train.inputs import I64, Ints
from datagen.train.reader import load_shard
from datagen.train.run_parts import JOIN_FIELDS, RunPart, refuse_twins

TABLE_FIELDS = (
    *JOIN_FIELDS,
    "house_id",
    "house_digest",
    "object_digest",
    "sample_id",
    "robot_index",
    "label",
)


@dataclass(frozen=True, eq=False)
class PartSummary:
    """Counts of one part. `samples_sha256` is over ids and labels of its samples, in stored order."""

    part: RunPart
    scenes: int
    negatives: int
    positives: int
    samples_sha256: str


@dataclass(frozen=True, eq=False)
class SceneTable:
    """One row per selected scene that has samples, in stored order."""

    shard: I64  # (S,), ascending, among all shards of all parts
    row: I64  # (S,), in the shard
    samples: I64  # (S,), in an epoch
    house_of_digest: Mapping[str, str]  # house_digest -> house_id
    house_ids: frozenset[str]
    object_digests: frozenset[str]  # targets and clutter
    parts: Sequence[PartSummary]

    def __len__(self) -> int:
        return len(self.shard)


def read_scene_table(
    parts: Sequence[RunPart], per_robot: int | None, houses: Callable[[str], bool] | None
) -> SceneTable:
    """The scenes of the selected houses. InputError where there is none, or a run is named twice."""
    refuse_twins(parts)
    rows: list[tuple[int, int, int]] = []  # shard, row, samples
    house_of_digest: dict[str, str] = {}
    house_ids: set[str] = set()
    objects: set[str] = set()
    summaries: list[PartSummary] = []
    number = 0
    for part in parts:
        digest, begun = hashlib.sha256(), len(rows)
        counts = np.zeros(2, np.int64)
        for place in part.shards:
            columns, bounds = load_shard(place, {name: part.arrays[name] for name in TABLE_FIELDS})
            for scene in range(len(bounds) - 1):
                first, past = bounds[scene], bounds[scene + 1]
                house = str(columns["house_id"][scene])
                if first == past or not (houses is None or houses(house)):
                    continue
                label = columns["label"][first:past]
                if label.max() > 1:
                    where, problem = place.url, f"a label of {label.max()}"
                    raise InputError(where, "label", problem, "Repair the run with `datagen verify --repair`")
                digest.update(columns["sample_id"][first:past].tobytes())
                digest.update(label.tobytes())
                counts += np.bincount(label, minlength=2)
                rows.append((number, scene, _taken(columns["robot_index"][first:past], per_robot)))
                house_ids.add(house)
                house_of_digest[str(columns["house_digest"][scene])] = house
                objects |= set(map(str, columns["object_digest"][scene])) - {""}  # places without clutter
            number += 1
        negatives, positives = counts.tolist()
        summaries.append(PartSummary(part, len(rows) - begun, negatives, positives, digest.hexdigest()))
    if not rows:
        place = ", ".join(dict.fromkeys(part.place for part in parts))
        problem = "has no scene in the selected houses"
        raise InputError(place, "house_id", problem, "Name more runs, or runs of more houses")
    shard, row, samples = np.array(rows, np.int64).T
    return SceneTable(
        shard, row, samples, house_of_digest, frozenset(house_ids), frozenset(objects), summaries
    )


def _taken(robot_index: Ints, per_robot: int | None) -> int:
    if per_robot is None:
        return len(robot_index)
    _, counts = np.unique(robot_index, return_counts=True)
    return int(np.minimum(counts, per_robot).sum())
