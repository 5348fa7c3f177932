"""Baseline: among feasible candidates, the best detection of the target (the paper's third baseline)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from datagen.train.baselines.baseline import F64, best_cut, is_feasible, labels, observed_rho
from datagen.train.baselines.detector import Detector
from datagen.train.baselines.views import render_views
from datagen.train.inputs import Array, Batch, column
from datagen.train.observed_visibility import eyes
from datagen.train.scorers import scored

_VIEWS_AT_ONCE = 8


class Confidence(Protocol):
    """Confidence of a detector in the target, from each candidate's camera."""

    @property
    def name(self) -> str: ...

    def of(self, batch: Batch[Array], asked: Array) -> F64:
        """Confidences (N,) in [0, 1] of the selected candidates (N,) bool; 0 for others."""
        ...


@dataclass(frozen=True)
class VisibilityDetector:
    """Estimated rho in place of a detector's confidence."""

    name: str = field(default="threshold-visibility (stand-in for a detector)", init=False)

    def of(self, batch: Batch[Array], asked: Array) -> F64:
        return np.where(asked, observed_rho(batch), 0.0)


@dataclass(frozen=True, eq=False)
class ViewDetector:
    """A detector on views of the stored coloured cloud from each candidate's camera.

    Runs hold one frame a scene, and no picture from a candidate: its view is the cloud as points that
    are painted far to near. Confidence: that of the best box around the picture's middle, where the
    target's centre is.
    """

    detector: Detector

    name: str = field(default="threshold-detector", init=False)

    def of(self, batch: Batch[Array], asked: Array) -> F64:
        found = np.zeros(len(batch))
        eyes_m = eyes(batch.clouds, batch.robots, batch.candidates)
        cloud_row = batch.robots.cloud_row[batch.candidates.robot_row]
        names = column(batch, "object_name")[:, 0]
        for row in np.unique(cloud_row[asked]):
            n = int(batch.clouds.n_points[row])
            points_m, rgb = batch.clouds.points_m[row, :n], batch.clouds.rgb[row, :n]
            rows = np.flatnonzero(asked & (cloud_row == row))
            for start in range(0, len(rows), _VIEWS_AT_ONCE):
                some = rows[start : start + _VIEWS_AT_ONCE]
                frames = render_views(points_m, rgb, eyes_m[some])
                detections = self.detector.detect(frames, spoken_name(str(names[row])))
                found[some] = [d.best_at_middle(frames.shape[1:3]) for d in detections]
        return found


@dataclass(frozen=True, eq=False)
class ThresholdDetector:
    """Score: the confidence where the base fits and the target is within reach, else -1.

    Good from `threshold` on, which `fit` sets for the best balanced accuracy of feasible candidates.
    """

    confidence: Confidence = VisibilityDetector()
    threshold: float = 0.5

    needs_fit: bool = field(default=False, init=False)

    @property
    def name(self) -> str:
        return self.confidence.name

    def score(self, batch: Batch[Array]) -> F64:
        """Confidences (N,), and -1 for what is not feasible."""
        feasible = is_feasible(batch)
        return np.where(feasible, self.confidence.of(batch, feasible), -1.0)

    def fit(self, batches: Sequence[Batch[Array]]) -> ThresholdDetector:
        """With the best cut; where all feasible ones are alike there is none to find, and it stays."""
        label = labels(batches, self.name)
        score = np.concatenate([scored(self, b) for b in batches])
        feasible = score >= 0
        if label[feasible].all() or not label[feasible].any():
            return self
        return replace(self, threshold=best_cut(score[feasible], label[feasible]))

    def state(self) -> dict[str, Any]:
        return {"threshold": self.threshold}


def spoken_name(object_name: str) -> str:
    """What a person would call an object: `003_cracker_box` is a cracker box."""
    words = object_name.replace("-", "_").split("_")
    return " ".join(w for w in words if w and not w.isdigit()) or object_name
