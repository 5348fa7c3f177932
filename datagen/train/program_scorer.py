"""Score with a program: a model's network in NumPy, beside the parts of it that need no torch anyway."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from datagen.train.hands.poses import poses_of_clouds
from datagen.train.hands.reach import hand_reach, hands_of
from datagen.train.inputs import F32, F64, Array, Batch, CandidateInputs, is_clear
from datagen.train.observed_visibility import visible_share
from datagen.train.programs import read_program

ENCODE, SCORE = "encode", "score"  # functions of a program
POINTS = 4096  # of a cloud; those of shorter ones are padded
AT_ONCE = 125  # candidates in one call; 625 are a grid
CLOUD = ("points_m", "rgb", "mask", "count", "height_m", "base_height_m", "reach_m")
TOKENS = ("same", "left", "centres_m", "valid", "numbers", "vectors", "tensors", "radius_m", "rise_m")
TO_SCORE = ("camera_rise_m", "reach_m", "poses", "base_xy_m", "rho", "codes")
_MOST_KEPT = 7  # other batches
_MIN_REACH_M = np.float32(0.05)
T = TypeVar("T")
Arrays = Mapping[str, Array]


class ProgramScorer:
    """A scorer, as `ModelScorer` of the model of which the program was made. InputError for another file.

    With `only_clear` the score of a base that is not clear is 0, without computing it. The latest scores are
    kept: of the same frame, another arrival error may be asked for.
    """

    def __init__(self, path: Path, name: str = "", only_clear: bool = False) -> None:
        self.program = read_program(path)
        facts = self.program.facts
        self.name, self.threshold = f"{name}{facts['name']}", 0.5
        self.only_clear, self.weights_sha256 = only_clear, facts["weights_sha256"]
        self.robots: dict[str, tuple[float, float]] = {k: (v[0], v[1]) for k, v in facts["robots"].items()}
        self.side_deg: float | None = facts["side_deg"]
        self._kept = dict[bytes, F64]()

    def score(self, batch: Batch[Array]) -> F64:
        """Probabilities (N,)."""
        wanted = is_clear(batch) if self.only_clear else np.ones(len(batch), np.bool_)
        key = pickle.dumps((batch.clouds, batch.robots, batch.candidates, wanted))
        if (found := self._kept.get(key)) is None:
            found = np.zeros(len(batch))
            for k in range(len(batch.robots)):
                rows = np.flatnonzero(wanted & (batch.candidates.robot_row == k))
                if len(rows):
                    found[rows] = self._of_robot(batch, k, rows)
        self._kept = dict([*self._kept.items()][-_MOST_KEPT:]) | {key: found}
        return found.copy()

    def _of_robot(self, batch: Batch[Array], k: int, rows: Array) -> F64:
        robot = _rows(batch.robots, np.array([k]))
        cloud = _rows(batch.clouds, robot.cloud_row)
        robot = replace(robot, cloud_row=np.zeros(1, np.int64))
        candidates = replace(_rows(batch.candidates, rows), robot_row=np.zeros(len(rows), np.int64))
        camera_rise_m = robot.camera_height_m - cloud.target_height_m

        padded = [_of_length(each) for each in (cloud.points_m, cloud.rgb, cloud.target_mask)]
        sizes = (cloud.target_height_m, robot.base_height_m, robot.arm_reach_m)
        of_cloud: dict[str, Array] = dict(
            zip(CLOUD, (*padded, cloud.n_points.astype(np.int64), *sizes), strict=True)
        )
        tokens: dict[str, Array] = dict(zip(TOKENS, self.program.run(ENCODE, of_cloud), strict=True))
        n_poses, hands = int(self.program.facts["hand_poses"]), hands_of(robot, 1)
        poses = poses_of_clouds(cloud.points_m, cloud.target_mask, cloud.n_points, n_poses, hands)
        reach_m = np.maximum(robot.arm_reach_m, _MIN_REACH_M)
        shared = tokens | {"camera_rise_m": camera_rise_m, "reach_m": reach_m, "poses": poses}
        rho = _visible_share(of_cloud, tokens, candidates, float(camera_rise_m[0]))
        codes = hand_reach(poses, cloud, robot, candidates, tokens["rise_m"])
        logits: list[F32] = []
        for start in range(0, len(rows), AT_ONCE):
            some = np.minimum(np.arange(start, start + AT_ONCE), len(rows) - 1)
            own = {"base_xy_m": candidates.base_xy_m[some], "rho": rho[some], "codes": codes[some]}
            logits += self.program.run(SCORE, shared | own)
        bad, good = np.concatenate(logits)[: len(rows)].astype(np.float64).T
        return 1 / (1 + np.exp(bad - good))


def _rows(table: T, rows: Array) -> T:
    columns = {name: value[rows] for name, value in vars(table).items() if isinstance(value, np.ndarray)}
    return replace(table, **columns)  # type: ignore[type-var]


def _of_length(a: Array) -> Array:
    """An array (1, P, ...) with `POINTS` rows."""
    return np.pad(a[:, :POINTS], [(0, 0), (0, max(0, POINTS - a.shape[1])), *[(0, 0)] * (a.ndim - 2)])


def _visible_share(
    cloud: dict[str, Array],
    tokens: dict[str, Array],
    candidates: CandidateInputs[Array],
    camera_rise_m: float,
) -> F32:
    """Estimated rho (N,), from the points within reach, rounded as the model's crop does."""
    points, mask = cloud["points_m"][0], cloud["mask"][0]
    inside = np.arange(len(points)) < cloud["count"][0]
    inside &= np.sqrt((points * points).sum(axis=1)) <= cloud["reach_m"][0]
    points, mask = points[inside], mask[inside]
    points[:, 2] = (points[:, 2] + tokens["rise_m"][0]) - tokens["rise_m"][0]
    eyes_m = np.column_stack([candidates.base_xy_m, np.full(len(candidates), camera_rise_m)])
    radius_m = float(tokens["radius_m"][0])
    return visible_share(points[~mask], points[mask], radius_m, eyes_m.astype(np.float32)).astype(np.float32)
