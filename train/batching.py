"""Scenes to batches: clouds held once, robots told apart, candidates in the target's frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from train.inputs import Array, Batch, Candidates, Clouds, Robots

Rows = npt.NDArray[np.intp]

# What a batch is made of, by table.
SCENE_FIELDS = ("points_m", "rgb", "target_mask", "n_points", "target_center_m", "target_radius_m")
ROBOT_FIELDS = ("camera_height_m", "base_height_m", "arm_reach_m")
SAMPLE_FIELDS = ("sample_id", "robot_index", "base_xy_m", *ROBOT_FIELDS, "label")


@dataclass(frozen=True, eq=False)
class View:
    """A scene as one epoch shows it: its stored rows, the cloud and candidates that are given of them.

    `rows` are the candidates' rows in `samples`, those of one robot together.
    """

    scene: Mapping[str, Any]  # one row of each scene field
    samples: Mapping[str, Array]  # all its samples, (n, ...)
    rows: Rows  # (k,)
    points_m: npt.NDArray[np.floating[Any]]  # (P, 3), target frame
    rgb: npt.NDArray[np.uint8]  # (P, 3)
    target_mask: npt.NDArray[np.bool_]  # (P,)
    n_points: int
    base_xy_m: npt.NDArray[np.float64]  # (k, 2), target frame


def stored_view(scene: Mapping[str, Any], samples: Mapping[str, Array], rows: Rows) -> View:
    """The scene as it is stored."""
    base_xy_m = samples["base_xy_m"][rows].astype(np.float64) - scene["target_center_m"][:2]
    cloud = (scene["points_m"], scene["rgb"], scene["target_mask"], int(scene["n_points"]))
    return View(scene, samples, rows, *cloud, base_xy_m)


def candidate_rows(
    robot_index: npt.NDArray[np.integer[Any]], per_robot: int | None, rng: np.random.Generator | None
) -> Rows:
    """Rows of the candidates, robot by robot in ascending order; of each robot a random `per_robot` at most.

    Candidates of one robot keep their stored order.
    """
    order = np.argsort(robot_index, kind="stable")
    if per_robot is None or rng is None:
        return order
    luck = rng.random(len(order))
    drawn = np.lexsort([luck, robot_index])
    ordered = robot_index[drawn]
    rank = np.arange(len(drawn)) - np.searchsorted(ordered, ordered)
    kept = np.sort(drawn[rank < per_robot])
    return kept[np.argsort(robot_index[kept], kind="stable")]


def make_batch(
    views: Sequence[View], extra_scene: Sequence[str] = (), extra_sample: Sequence[str] = ()
) -> Batch[Array]:
    """The scenes as one batch, in their order. Extra columns are given as they are stored."""
    chosen = [{name: v.samples[name][v.rows] for name in (*SAMPLE_FIELDS, *extra_sample)} for v in views]
    samples = {name: np.concatenate([c[name] for c in chosen]) for name in chosen[0]}
    scene_row = np.repeat(np.arange(len(views)), [len(v.rows) for v in views])
    new = np.ones(len(scene_row), np.bool_)
    new[1:] = (np.diff(scene_row) != 0) | (np.diff(samples["robot_index"]) != 0)
    first = np.flatnonzero(new)
    extra = {name: np.stack([np.asarray(v.scene[name]) for v in views]) for name in extra_scene}
    return Batch(
        clouds=Clouds(
            points_m=np.stack([v.points_m for v in views]).astype(np.float32, copy=False),
            rgb=np.stack([v.rgb for v in views]),
            target_mask=np.stack([v.target_mask for v in views]),
            n_points=np.array([v.n_points for v in views], np.int64),
            target_height_m=np.array([v.scene["target_center_m"][2] for v in views], np.float32),
            target_radius_m=np.array([v.scene["target_radius_m"] for v in views], np.float32),
        ),
        robots=Robots(scene_row[first].astype(np.int64), *(samples[name][first] for name in ROBOT_FIELDS)),
        candidates=Candidates(
            robot_row=np.cumsum(new) - 1,
            base_xy_m=np.concatenate([v.base_xy_m for v in views]).astype(np.float32),
        ),
        label=samples["label"].astype(np.int64),
        sample_id=samples["sample_id"],
        extra={**extra, **{name: samples[name] for name in extra_sample}},
    )
