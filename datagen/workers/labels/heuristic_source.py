"""Label source `heuristic`: distance and visibility, by ray casting."""

from __future__ import annotations

import numpy as np

from datagen.schemas.run_records import StageClock
from datagen.schemas.specification import Specification
from datagen.workers.bases.candidates import SceneCandidates, distances
from datagen.workers.labels import Columns, LabelSource
from datagen.workers.labels import distance_visibility_score as formula
from datagen.workers.rendering.visibility import visible_pixels
from datagen.workers.scenes import SettledScene


def label(
    scene: SettledScene, candidates: SceneCandidates, spec: Specification, clock: StageClock
) -> Columns:
    """Distances, pixel counts, rho, H and the label of every candidate."""
    with clock.stage("visibility"):
        eyes_m = np.column_stack([candidates.base_xy_m, candidates.camera_height_m]).astype(np.float64)
        target_px, visible_px = visible_pixels(scene.rays, 0, eyes_m, spec.visibility.window_px)
        visibility = (visible_px / np.maximum(target_px, 1)).astype(np.float32)
        distance_m, mount_distance_m = distances(candidates, scene.target_center_m)
        score, decision = formula.heuristic(
            distance_m, mount_distance_m, candidates.arm_reach_m, visibility, spec.heuristic
        )
    return {
        "distance_m": distance_m,
        "mount_distance_m": mount_distance_m,
        "target_px": target_px,
        "visible_px": visible_px,
        "visibility": visibility,
        "heuristic_score": score,
        "label": decision,
    }


HEURISTIC = LabelSource("heuristic", formula.VERSION, "heuristic", label)
