"""Samples streamed from runs as batches of whole scenes, the same for one seed and epoch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from schemas.errors import InputError
from train.augment import Augmentation
from train.batching import SAMPLE_FIELDS, SCENE_FIELDS, candidate_rows, make_batch, stored_view
from train.inputs import Array, Batch
from train.reader import SampleReader


class SampleStream:
    """Epochs of batches from one or many runs, merged or not, sealed or not, local or on S3.

    A batch holds `scenes_per_batch` whole scenes with all their robots and candidates, or with a
    random `candidates_per_robot` of each robot. `houses` says which houses count (by house_id).
    `extra` names further columns. Of `world` ranks each gives its own batches, equally many.
    InputError names what is missing, foreign or damaged.
    """

    def __init__(
        self,
        places: Sequence[str | Path],
        *,
        scenes_per_batch: int = 16,
        candidates_per_robot: int | None = None,
        seed: int = 0,
        buffer_shards: int = 8,
        houses: Callable[[str], bool] | None = None,
        augment: Augmentation | None = None,
        extra: Sequence[str] = (),
        shuffle: bool = True,
        rank: int = 0,
        world: int = 1,
    ) -> None:
        self._options = (scenes_per_batch, candidates_per_robot, seed, shuffle, rank, world)
        probe = SampleReader(places, (), ())
        tables = {name: probe.dimension(name) for name in extra}
        self._extra_scene = [name for name in extra if tables[name] == "scene"]
        self._extra_sample = [name for name in extra if tables[name] == "sample"]
        reader = SampleReader(
            places,
            (*SCENE_FIELDS, "house_id", "object_digest", *self._extra_scene),
            (*SAMPLE_FIELDS, *self._extra_sample),
        )
        self._scenes: list[tuple[dict[str, Any], dict[str, Array]]] = []
        for shard in reader.shards():
            for row in range(len(shard["house_id"])):
                if houses is None or houses(str(shard["house_id"][row])):
                    mine = shard["scene_row"] == row
                    scene = {n: shard[n][row] for n, a in reader.fields.items() if a.dims[0] == "scene"}
                    samples = {n: shard[n][mine] for n, a in reader.fields.items() if a.dims[0] == "sample"}
                    self._scenes.append((scene, samples))
        if not self._scenes:
            raise InputError("training data", "", "no scene is left", "Choose other houses or runs")

    @property
    def batches_per_epoch(self) -> int:
        """Batches of one epoch of one rank; the same for all ranks."""
        scenes_per_batch, _, _, _, _, world = self._options
        return max(1, -(-len(self._scenes) // (scenes_per_batch * world)))

    @property
    def n_scenes(self) -> int:
        """Scenes of one epoch, of all ranks together."""
        return len(self._scenes)

    @property
    def n_samples(self) -> int:
        """Samples of one epoch, of all ranks together."""
        return sum(len(candidate_rows(s["robot_index"], None, None)) for _, s in self._scenes)

    def epoch(self, k: int, skip_batches: int = 0) -> Iterator[Batch[Array]]:
        """Batches of epoch k from batch `skip_batches` on, as they would have come without skipping."""
        scenes_per_batch, per_robot, seed, shuffle, rank, world = self._options
        order = np.arange(len(self._scenes))
        if shuffle:
            order = np.random.default_rng([seed, k]).permutation(len(order))
        mine = order[rank::world]
        for i in range(skip_batches, self.batches_per_epoch):
            views = []
            for scene in mine[i * scenes_per_batch : (i + 1) * scenes_per_batch]:
                rng = np.random.default_rng([seed, k, int(scene)])
                rows = candidate_rows(self._scenes[scene][1]["robot_index"], per_robot, rng)
                views.append(stored_view(*self._scenes[scene], rows))
            yield make_batch(views, self._extra_scene, self._extra_sample)

    def class_counts(self) -> tuple[int, int]:
        """(negatives, positives) of all samples that epochs draw from."""
        labels = np.concatenate([samples["label"] for _, samples in self._scenes])
        return int((labels == 0).sum()), int((labels == 1).sum())

    def house_ids(self) -> set[str]:
        """Houses of its scenes."""
        return {str(scene["house_id"]) for scene, _ in self._scenes}

    def object_digests(self) -> set[str]:
        """Digests of all objects in its scenes, targets and clutter."""
        return {str(d) for scene, _ in self._scenes for d in scene["object_digest"]}

    def origin(self) -> list[dict[str, Any]]:
        """What a checkpoint says of its data: specification hash, schema, samples, digest, cost."""
        return []
