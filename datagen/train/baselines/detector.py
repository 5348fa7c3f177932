"""Zero-shot object detectors. Only this module imports transformers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from datagen.schemas.errors import InputError
from datagen.train.baselines.baseline import best_cut, is_feasible, labels, observed_rho
from datagen.train.inputs import F32, F64, U8, Array, Batch, Bools, column
from datagen.train.observed_visibility import eyes
from datagen.train.scorers import scored
from datagen.workers.extras import how_to_get


@dataclass(frozen=True, eq=False)
class Detections:
    """K boxes of one image."""

    boxes_px: F64  # (K, 4) left, top, right, bottom
    scores: F64  # (K,) in [0, 1]

    def best_at_middle(self, shape: Sequence[int]) -> float:
        """The highest score of the boxes around the centre of an image (H, W), or 0."""
        y, x = shape[0] / 2, shape[1] / 2
        left, top, right, bottom = self.boxes_px.reshape(-1, 4).T
        holds = (left <= x) & (x <= right) & (top <= y) & (y <= bottom)
        return float(self.scores[holds].max(initial=0.0))


class ZeroShotDetector:
    """A zero-shot detector of transformers (OWL-ViT, OWLv2, Grounding DINO) from a local folder."""

    def __init__(self, folder: str | Path, device: str = "cpu") -> None:
        where = Path(folder)
        if not (where / "config.json").is_file():
            fix = "Name a folder that holds a detector's config.json, weights and processor"
            raise InputError(where, "config.json", "is not in the folder of a detector", fix)
        try:
            from transformers import AutoModelForZeroShotObjectDetection, AutoProcessor
        except ImportError as error:
            fix = how_to_get("detect")
            raise InputError("--detector", "transformers", f"not usable ({error})", fix) from None
        try:
            self._processor: Any = AutoProcessor.from_pretrained(where, local_files_only=True)
            model: Any = AutoModelForZeroShotObjectDetection.from_pretrained(
                where, local_files_only=True, use_safetensors=True
            )
        except (OSError, ValueError, KeyError, RuntimeError) as error:
            fix = "Save model and processor into it again with `save_pretrained`"
            raise InputError(where, "", f"is not a zero-shot detector: {error}", fix) from None
        self._model = model.to(device).eval()
        self._device = device

    def detect(self, frames: U8, label: str) -> list[Detections]:
        """All boxes of each frame (B, H, W, 3), whatever their score."""
        import torch

        # Grounding DINO was trained with lower case and a full stop; OWL-ViT accepts both forms.
        words = [[f"a photo of a {label.lower()}."]] * len(frames)
        with torch.inference_mode():
            inputs = self._processor(images=list(frames), text=words, return_tensors="pt", padding=True)
            inputs = inputs.to(self._device)
            outputs = self._model(**inputs)
        sizes = [frame.shape[:2] for frame in frames]
        ids = {"input_ids": inputs["input_ids"], "text_threshold": 0.0} if _needs_ids(self._processor) else {}
        found = self._processor.post_process_grounded_object_detection(
            outputs, threshold=0.0, target_sizes=sizes, **ids
        )
        return [
            Detections(f["boxes"].double().cpu().numpy(), f["scores"].double().cpu().numpy()) for f in found
        ]


def _needs_ids(processor: Any) -> bool:
    """Whether the processor needs the tokens: Grounding DINO's finds the words of a box in them."""
    from inspect import signature

    return "input_ids" in signature(processor.post_process_grounded_object_detection).parameters


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
