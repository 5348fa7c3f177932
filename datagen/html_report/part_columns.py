"""Short columns of a part: scenes and candidates of all its shards, or of a random share of a large part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.html_report.report_paths import ReportedPart

Array = npt.NDArray[Any]
F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

MOST_SHARDS, MOST_LABELS = 256, 400_000
_SCENE = (
    *("scene_index", "house_id", "room_type", "support_type", "object_name", "redraws"),
    *("settle_steps", "target_visible_fraction"),
    *("T_world_camera", "target_center_m"),
)
_SAMPLE = (
    *("sample_scene_index", "candidate_index", "base_xy_m", "base_height_m", "arm_reach_m"),
    *("distance_m", "mount_distance_m", "visibility", "base_is_clear", "label"),
)
_OF_ARMS = ("outcome", "heuristic_label")


@dataclass(frozen=True, eq=False)
class PartColumns:
    """S scenes and N candidates of some shards of a part, in stored order.

    `scenes` and `samples` hold the stored arrays by name; `shard` and `row` (S,) are a scene's shard and its
    row in it; `scene` (N,) is the row of a candidate's scene in these tables. `chosen` are the shards.
    """

    part: ReportedPart
    chosen: tuple[int, ...]
    scenes: dict[str, Array]
    samples: dict[str, Array]
    shard: I64
    row: I64
    scene: I64

    def __len__(self) -> int:
        return len(self.scene)

    @property
    def is_sampled(self) -> bool:
        """Whether shards were left out."""
        return len(self.chosen) < len(self.part.shards)

    @property
    def sample_words(self) -> str:
        """The labels read: all 120,000 labels, or a random 256 of 900 shards: 100,000 of 350,000 labels."""
        if not self.is_sampled:
            return f"all {len(self):,} labels"
        chosen, whole = len(self.chosen), len(self.part.shards)
        return f"a random {chosen:,} of {whole:,} shards: {len(self):,} of {self.part.labels:,} labels"

    @property
    def is_in_range(self) -> npt.NDArray[np.bool_]:
        """Mask (N,) of the candidates where the base fits and the target is within the arm's reach."""
        samples = self.samples
        return samples["base_is_clear"] & (samples["mount_distance_m"] <= samples["arm_reach_m"])

    def per_scene(self, values: Array) -> F64:
        """Sums (S,) of values of candidates (N,)."""
        return np.bincount(self.scene, values, len(self.shard)).astype(np.float64)


def chosen_shards(part: ReportedPart, seed: int) -> tuple[int, ...]:
    """All shards, or a random share of a part with many shards or labels, in order."""
    shards = np.array(part.shards, np.int64)
    most = MOST_SHARDS
    if part.labels > MOST_LABELS:
        most = min(most, max(1, MOST_LABELS * len(shards) // part.labels))
    if len(shards) > most:
        shards = np.sort(np.random.default_rng([seed, 0]).choice(shards, most, replace=False))
    return tuple(shards.tolist())


def read_columns(part: ReportedPart, seed: int, step: Callable[[], None]) -> PartColumns | None:
    """Read the short columns of `chosen_shards`; None without shards. `step` is called after each shard."""
    chosen = chosen_shards(part, seed)
    names = [*_SCENE, *_SAMPLE, *(name for name in _OF_ARMS if name in part.names)]
    read: list[dict[str, Array]] = []
    for shard in chosen:
        read.append(part.read(shard, names))
        step()
    if not read:
        return None
    counts = [len(shard["scene_index"]) for shard in read]
    first = np.cumsum([0, *counts[:-1]])
    owner = [
        np.searchsorted(shard["scene_index"], shard["sample_scene_index"]) + start
        for shard, start in zip(read, first, strict=True)
    ]
    joined = {name: np.concatenate([shard[name] for shard in read]) for name in names}
    return PartColumns(
        part,
        chosen,
        {name: joined[name] for name in _SCENE},
        {name: joined[name] for name in names if name not in _SCENE},
        np.repeat(np.array(chosen, np.int64), counts),
        np.concatenate([np.arange(n) for n in counts]),
        np.concatenate(owner),
    )
