"""Tokens of all robots of runs in one memory-mapped file, with the columns that training needs.

A folder `<key>` holds `tokens.f16` (R, J, F) and `columns.npz`. The key is the digest of its origin: ids and
labels of the samples, and the sizes of the tokens. Tokens have no parameters, so a training from them
has the same inputs up to half precision.
"""

from __future__ import annotations

import os
import shutil
import uuid
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from datagen.schemas.errors import InputError
from datagen.schemas.identity import digest_of
from datagen.train.dataset import SampleStream
from datagen.train.inputs import I64, Array, Batch, RobotInputs
from datagen.train.models.shared import SharedModel
from datagen.train.models.tokens import EncodedCandidates, EncodedClouds, pack, packed_width, token_sizes
from datagen.train.tensors import to_torch

# Raise it when the same run would give other tokens or columns.
_VERSION = 4
# Fields of a model's configuration that do not decide its tokens.
_OF_NETWORK = ("width", "embedding", "head", "dropout", "mirrored")
_TOKENS, _COLUMNS = "tokens.f16", "columns.npz"


@dataclass(frozen=True, eq=False)
class EncodedRuns:
    """S scenes, R robots and N candidates; robots are sorted by scene, candidates by robot."""

    key: str
    tokens: Array  # (R, J, F) float16, in a file
    columns: Mapping[str, Array]

    @cached_property
    def houses(self) -> Array:
        """House (S,) of each scene, as text."""
        return self.columns["house"]

    @cached_property
    def robot_bounds(self) -> I64:
        """Bounds (S + 1,) of each scene's robots."""
        return np.searchsorted(self.columns["scene_of_robot"], np.arange(len(self.houses) + 1))

    @cached_property
    def candidate_bounds(self) -> I64:
        """Bounds (R + 1,) of each robot's candidates."""
        robots = len(self.columns["scene_of_robot"])
        return np.searchsorted(self.columns["robot_of_candidate"], np.arange(robots + 1))

    def batch(self, scenes: I64) -> Batch[Array]:
        """A batch of these scenes, in their order."""
        robots, cloud_row = _ranges(self.robot_bounds, scenes)
        rows, robot_row = _ranges(self.candidate_bounds, robots)
        c, n = self.columns, len(scenes)
        return Batch(
            clouds=EncodedClouds(
                points_m=np.zeros((n, 0, 3), np.float32),
                rgb=np.zeros((n, 0, 3), np.uint8),
                target_mask=np.zeros((n, 0), np.bool_),
                n_points=np.zeros(n, np.int64),
                target_height_m=c["target_height_m"][scenes],
                target_radius_m=c["target_radius_m"][scenes],
                tokens=np.asarray(self.tokens[robots]),
                targets=c["targets"][robots],
                hand_poses=c["hand_poses"][scenes],
            ),
            robots=RobotInputs(
                cloud_row, c["camera_height_m"][robots], c["base_height_m"][robots], c["arm_reach_m"][robots]
            ),
            candidates=EncodedCandidates(
                robot_row,
                c["base_xy_m"][rows],
                c["visible_share"][rows],
                reach=c["reach"][rows] if "reach" in c else None,
            ),
            label=c["label"][rows].astype(np.int64),
            sample_id=c["sample_id"][rows],
        )


class EncodedBatches:
    """Epochs of batches of some scenes, as `run_training` reads them."""

    def __init__(
        self, encoded: EncodedRuns, scenes: I64, scenes_per_batch: int, seed: int | None = None
    ) -> None:
        """With `seed` the scenes are shuffled in each epoch; without, they keep their order."""
        self._encoded, self._scenes, self._seed = encoded, scenes, seed
        self.batches_per_epoch = max(1, -(-len(scenes) // scenes_per_batch))

    def epoch(self, k: int, skip_batches: int = 0) -> Iterator[Batch[Array]]:
        order = self._scenes
        if self._seed is not None:
            order = np.random.default_rng([self._seed, k]).permutation(order)
        for some in np.array_split(order, self.batches_per_epoch)[skip_batches:]:
            yield self._encoded.batch(some)


def _ranges(bounds: I64, rows: I64) -> tuple[I64, I64]:
    """Numbers bounds[r] .. bounds[r + 1] of all rows r, and for each number its row's index in `rows`."""
    counts = bounds[rows + 1] - bounds[rows]
    owner = np.repeat(np.arange(len(rows)), counts)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    return bounds[rows][owner] + within, owner


def encode_runs(
    stream: SampleStream, model: SharedModel, folder: Path, seen: Callable[[int, int], None]
) -> EncodedRuns:
    """The scenes of a stream, read from `folder` or encoded into it.

    The stream is unshuffled and has all candidates. `seen(done, of)` is called while scenes
    are encoded.
    """
    decisive = {name: value for name, value in model.config.items() if name not in _OF_NETWORK}
    samples = [summary.samples_sha256 for summary in stream.parts]
    key = digest_of({"version": _VERSION, "tokens": decisive, "samples": samples})
    place = folder / key
    if not place.exists():
        draft = folder / f".{key}.{uuid.uuid4().hex}"
        draft.mkdir(parents=True)
        try:
            _write(stream, model, draft, seen)
            os.replace(draft, place)
        except OSError:
            if not place.exists():  # else another training has made it meanwhile
                raise
        finally:
            shutil.rmtree(draft, ignore_errors=True)
    return open_encoded(place)


def open_encoded(place: Path) -> EncodedRuns:
    """The encoded runs in a folder of `encode_runs`. InputError where a file is damaged."""
    try:
        with np.load(place / _COLUMNS, allow_pickle=False) as file:
            columns = {name: file[name] for name in file.files}
        shape = tuple(int(n) for n in columns.pop("shape"))
        tokens = np.memmap(place / _TOKENS, np.float16, mode="r", shape=shape)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, EOFError) as e:
        raise InputError(place, "", f"is damaged ({e!s:.200})", "Remove this folder; it is made again") from e
    return EncodedRuns(place.name, tokens, columns)


def _write(stream: SampleStream, model: SharedModel, place: Path, seen: Callable[[int, int], None]) -> None:
    parts: list[dict[str, Array]] = []
    scenes = robots = 0
    with open(place / _TOKENS, "wb") as file:
        for batch in stream.epoch(0):
            given = to_torch(batch, "cpu")
            with torch.inference_mode():
                made = model.encode(given.clouds, given.robots)
                tokens, targets = pack(made)
                share = np.zeros(len(batch), np.float32)
                if model.sizes.observed_visibility:
                    seen_by = (made, given.clouds, given.candidates, given.robots)
                    share = model.visible_share(*seen_by).numpy()
                reach = model.hand_reach(made, given.clouds, given.candidates, given.robots)
            file.write(tokens.numpy().tobytes())
            poses = made.hand_poses if made.hand_poses is not None else torch.zeros(len(batch.clouds), 0, 0)
            parts.append(_columns(batch, scenes, robots))
            parts[-1] |= {
                "targets": targets.numpy(),
                "visible_share": share,
                "hand_poses": poses.half().numpy(),
            }
            if reach is not None:
                parts[-1]["reach"] = reach.numpy()
            scenes, robots = scenes + len(batch.clouds), robots + len(batch.robots)
            seen(scenes, stream.n_scenes)
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    sizes = model.sizes
    shape = np.array([robots, sum(sizes.tokens), packed_width(token_sizes(len(sizes.scales_m)))])
    columns["shape"] = shape
    np.savez(place / _COLUMNS, **cast(Any, columns))


def _columns(batch: Batch[Array], scenes: int, robots: int) -> dict[str, Array]:
    owner = batch.candidates.robot_row
    return {
        "house": batch.extra["house_id"].astype(str),
        "target_height_m": batch.clouds.target_height_m,
        "target_radius_m": batch.clouds.target_radius_m,
        "scene_of_robot": scenes + batch.robots.cloud_row,
        "camera_height_m": batch.robots.camera_height_m,
        "base_height_m": batch.robots.base_height_m,
        "arm_reach_m": batch.robots.arm_reach_m,
        "robot_of_candidate": robots + owner,
        "base_xy_m": batch.candidates.base_xy_m,
        "label": batch.label.astype(np.uint8),
        "sample_id": batch.sample_id,
    }


def encoded_stream(paths: Sequence[str], allow_incomplete: bool) -> SampleStream:
    """The stream of these runs that `encode_runs` reads."""
    return SampleStream(
        paths, scenes_per_batch=16, shuffle=False, extra=("house_id",), allow_incomplete=allow_incomplete
    )
