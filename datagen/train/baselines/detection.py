"""Baseline: among feasible candidates, the best detection of the target (the paper's third baseline).

Runs hold one frame per scene and no picture from a candidate. A candidate's view is the stored coloured
cloud as seen from its camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from datagen.train.baselines.baseline import best_cut, is_feasible, labels, observed_rho
from datagen.train.baselines.detector import ZeroShotDetector
from datagen.train.inputs import F32, F64, U8, Array, Batch, Bools, column
from datagen.train.observed_visibility import eyes
from datagen.train.scorers import scored

_VIEWS_AT_ONCE = 8
_SIZE_PX = 256
# Covers about half a metre around the target from a metre away.
_HALF_ANGLE_RAD = 0.5
# Width of the square drawn for a point: stored clouds have a point every 2 to 3 cm.
_POINT_M = 0.025
_LARGEST_PX = 24
_NEAREST_M = 0.05
_BACKGROUND = 127


@dataclass(frozen=True, eq=False)
class ThresholdDetector:
    """Score: the confidence in the target where the base is clear and the target within reach, else -1.

    Without a detector the estimated rho takes the confidence's place. Positive from `threshold` on, which
    `fit` sets for the best balanced accuracy of feasible candidates.
    """

    detector: ZeroShotDetector | None = None
    threshold: float = 0.5
    needs_fit = False

    @property
    def name(self) -> str:
        return "threshold-detector" if self.detector else "threshold-visibility (stand-in for a detector)"

    def score(self, batch: Batch[Array]) -> F64:
        """Confidences (N,), and -1 for candidates that are not feasible."""
        feasible = is_feasible(batch)
        seen = _confidence(self.detector, batch, feasible) if self.detector else observed_rho(batch)
        return np.where(feasible, seen, -1.0)

    def fit(self, batches: Sequence[Batch[Array]]) -> ThresholdDetector:
        """A copy with the best cut; unchanged where all feasible candidates have the same label."""
        label = labels(batches, self.name)
        score = np.concatenate([scored(self, b) for b in batches])
        feasible = score >= 0
        if label[feasible].all() or not label[feasible].any():
            return self
        return replace(self, threshold=best_cut(score[feasible], label[feasible]))

    def state(self) -> dict[str, Any]:
        return {"threshold": self.threshold}


def _confidence(detector: ZeroShotDetector, batch: Batch[Array], chosen: Bools) -> F64:
    """Scores (N,) of the best boxes around the middle of the chosen candidates' views; 0 for others."""
    found = np.zeros(len(batch))
    eyes_m = eyes(batch.clouds, batch.robots, batch.candidates)
    cloud_row = batch.robots.cloud_row[batch.candidates.robot_row]
    names = column(batch, "object_name")[:, 0]
    for row in np.unique(cloud_row[chosen]):
        n = int(batch.clouds.n_points[row])
        points_m, rgb = batch.clouds.points_m[row, :n], batch.clouds.rgb[row, :n]
        rows = np.flatnonzero(chosen & (cloud_row == row))
        for start in range(0, len(rows), _VIEWS_AT_ONCE):
            some = rows[start : start + _VIEWS_AT_ONCE]
            frames = render_views(points_m, rgb, eyes_m[some])
            detections = detector.detect(frames, spoken_name(str(names[row])))
            found[some] = [d.best_at_middle(frames.shape[1:3]) for d in detections]
    return found


def spoken_name(object_name: str) -> str:
    """An object's name in words: `003_cracker_box` is a cracker box."""
    words = object_name.replace("-", "_").split("_")
    return " ".join(w for w in words if w and not w.isdigit()) or object_name


def render_views(points_m: F32, rgb: U8, eyes_m: F32, size_px: int = _SIZE_PX) -> U8:
    """Images (N, size, size, 3) from viewpoints (N, 3) that look at the origin, upright.

    Points (P, 3) with colours (P, 3) in the same frame are drawn from far to near as squares that shrink with
    distance; pixels without a point are grey.
    """
    return np.stack([_view(points_m, rgb, eye, size_px) for eye in eyes_m.astype(np.float64)])


def _view(points_m: Array, rgb: U8, eye_m: Array, size_px: int) -> U8:
    picture = np.full((size_px, size_px, 3), _BACKGROUND, np.uint8)
    forward = -eye_m / max(float(np.linalg.norm(eye_m)), 1e-6)
    right = np.array([forward[1], -forward[0], 0.0])
    length = float(np.linalg.norm(right))
    right = right / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    local = (points_m - eye_m) @ np.stack([right, np.cross(forward, right), forward]).T  # right, down, ahead
    ahead = local[:, 2] > _NEAREST_M  # also drops points that are not finite
    order = np.flatnonzero(ahead)[np.argsort(-local[ahead, 2], kind="stable")]
    x, y, depth_m = local[order].T
    focal_px = size_px / 2 / np.tan(_HALF_ANGLE_RAD)
    width = np.clip(np.ceil(focal_px * _POINT_M / depth_m), 1, _LARGEST_PX).astype(np.int64)
    left = np.floor(focal_px * x / depth_m + size_px / 2 - (width - 1) / 2).astype(np.int64)
    top = np.floor(focal_px * y / depth_m + size_px / 2 - (width - 1) / 2).astype(np.int64)
    seen = (left + width > 0) & (left < size_px) & (top + width > 0) & (top < size_px)
    for i in np.flatnonzero(seen):
        rows, columns = (slice(max(int(a[i]), 0), int(a[i] + width[i])) for a in (top, left))
        picture[rows, columns] = rgb[order[i]]
    return picture
