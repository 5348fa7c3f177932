"""Make batches from scenes: one cloud per scene, rows per robot, candidates in the target's frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.schemas.errors import InputError
from datagen.schemas.fields import facing_rad
from datagen.train.inputs import (
    I64,
    Array,
    Batch,
    CandidateInputs,
    Clouds,
    Ints,
    RobotInputs,
)

Rows = npt.NDArray[np.intp]

# Fields of a batch, by table.
SCENE_FIELDS = ("points_m", "rgb", "target_mask", "n_points", "target_center_m", "target_radius_m")
ROBOT_FIELDS = ("camera_height_m", "base_height_m", "arm_reach_m")
SAMPLE_FIELDS = ("sample_id", "robot_index", "base_xy_m", "base_yaw_rad", *ROBOT_FIELDS, "label")


@dataclass(frozen=True, eq=False)
class StoredScene:
    """One scene's rows: one row of each scene field, and n rows of each sample field."""

    record: Mapping[str, Any]
    samples: Mapping[str, Array]  # (n, ...)
    robot: str = ""  # of the labels, as in `RobotInputs`

    @property
    def words(self) -> tuple[int, ...]:
        """Seed of the scene: its first sample's id, as four numbers."""
        return tuple(np.ascontiguousarray(self.samples["sample_id"][0]).view("<u4").tolist())


def stored_scenes(
    place: str,
    columns: Mapping[str, Array],
    dims: Mapping[str, str],
    bounds: I64,
    rows: I64,
    robot: str = "",
) -> list[StoredScene]:
    """The scenes of a shard at `rows`, with `robot` as in `RobotInputs`.

    InputError where samples of one robot have different robot values.
    """
    robots = np.repeat(np.arange(len(bounds) - 1), np.diff(bounds)), columns["robot_index"]
    order = np.lexsort(robots[::-1])
    same = (np.diff(robots[0][order]) == 0) & (np.diff(robots[1][order]) == 0)
    for name in ROBOT_FIELDS:
        if (np.diff(columns[name][order])[same] != 0).any():
            problem = "differs between samples of one robot"
            raise InputError(place, name, problem, "Repair the run with `datagen verify --repair`")
    if not np.isin(columns["n_points"], np.arange(columns["points_m"].shape[1] + 1)).all():
        problem = "is not between 0 and the size of the cloud"
        raise InputError(place, "n_points", problem, "Repair the run with `datagen verify --repair`")
    scene_columns = {name: columns[name] for name, dim in dims.items() if dim == "scene"}
    sample_columns = {name: columns[name] for name, dim in dims.items() if dim == "sample"}
    if 2 * len(rows) < len(bounds) - 1:  # few are used: copy them, to free the shard's arrays
        scene_columns = {name: a[rows] for name, a in scene_columns.items()}
        indices = range(len(rows))
    else:
        indices = rows.tolist()
    return [
        StoredScene(
            {name: a[index] for name, a in scene_columns.items()},
            {name: a[bounds[row] : bounds[row + 1]] for name, a in sample_columns.items()},
            robot,
        )
        for index, row in zip(indices, rows.tolist(), strict=True)
    ]


def candidate_rows(robot_index: Ints, per_robot: int | None, rng: np.random.Generator) -> Rows:
    """Rows by ascending robot, in stored order; at most `per_robot` random ones of each robot."""
    if per_robot is None:
        return np.argsort(robot_index, kind="stable")
    drawn = np.lexsort([rng.random(len(robot_index)), robot_index])
    ordered = robot_index[drawn]
    rank = np.arange(len(drawn)) - np.searchsorted(ordered, ordered)
    kept = drawn[rank < per_robot]
    return kept[np.lexsort([kept, robot_index[kept]])]


def make_batch(
    scenes: Sequence[StoredScene],
    chosen: Sequence[Rows],
    extra_scene: Sequence[str],
    extra_sample: Sequence[str],
) -> Batch[Array]:
    """Join scenes into one batch, in order, with the candidates at the chosen rows of their samples.

    Extra columns are as stored.
    """

    def stored(name: str) -> Array:
        return _native(np.stack([np.asarray(scene.record[name]) for scene in scenes]))

    def sampled(name: str) -> Array:
        return _native(
            np.concatenate([s.samples[name][rows] for s, rows in zip(scenes, chosen, strict=True)])
        )

    scene_row = np.repeat(np.arange(len(scenes)), [len(rows) for rows in chosen])
    robot_index = sampled("robot_index")
    new = np.ones(len(scene_row), np.bool_)
    new[1:] = (np.diff(scene_row) != 0) | (np.diff(robot_index) != 0)
    of_robots = scene_row[new].astype(np.int64), *(sampled(name)[new] for name in ROBOT_FIELDS)
    names = np.array([scene.robot for scene in scenes], np.str_)
    center_m, base_m = stored("target_center_m"), sampled("base_xy_m").astype(np.float64)
    target_m = center_m[scene_row, :2]
    turn_rad = sampled("base_yaw_rad") - facing_rad(target_m - base_m)
    return Batch(
        clouds=Clouds(
            points_m=stored("points_m").astype(np.float32),
            rgb=stored("rgb"),
            target_mask=stored("target_mask"),
            n_points=stored("n_points").astype(np.int64),
            target_height_m=center_m[:, 2].astype(np.float32),
            target_radius_m=stored("target_radius_m").astype(np.float32),
        ),
        robots=RobotInputs(*of_robots, name=names[of_robots[0]]),
        candidates=CandidateInputs(
            robot_row=(np.cumsum(new) - 1).astype(np.int64),
            base_xy_m=(base_m - target_m).astype(np.float32),
            turn_rad=((turn_rad + np.pi) % (2 * np.pi) - np.pi).astype(np.float32),
        ),
        label=sampled("label").astype(np.int64),
        sample_id=sampled("sample_id"),
        extra={name: stored(name) for name in extra_scene} | {name: sampled(name) for name in extra_sample},
    )


def _native(values: Array) -> Array:
    return values if values.dtype.kind == "O" else values.astype(values.dtype.newbyteorder("="), copy=False)
