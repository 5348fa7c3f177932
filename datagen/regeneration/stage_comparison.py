"""The fields of each stage of a shard, and comparisons of stored rows with recomputed ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from datagen.schemas.fields import Field, RecordSchema, SceneRows
from datagen.schemas.specification import Specification
from datagen.workers.labels.distance_visibility_score import heuristic

Array = np.ndarray[Any, Any]

# Stage -> its fields, in the order in which stages run.
STAGES: dict[str, tuple[str, ...]] = {
    "draw": (
        "scene_index", "retry", "redraws", "house_id", "house_digest", "room_id", "room_type", "support_id",
        "support_type", "T_world_support", "support_size_m", "object_name", "object_digest", "object_mass_kg",
    ),
    "settle": (
        "T_world_object", "settle_steps", "residual_speed_mps", "penetration_m", "target_center_m",
        "target_radius_m",
    ),
    "observe": (
        "T_world_camera", "intrinsics_px", "image_size_px", "target_visible_fraction", "points_m", "rgb",
        "target_mask", "n_points",
    ),
    "candidates": (
        "sample_id", "sample_scene_index", "candidate_index", "robot_index", "base_xy_m", "camera_height_m",
        "base_height_m", "arm_reach_m", "base_clearance_m", "base_is_clear",
    ),
    "visibility": ("distance_m", "mount_distance_m", "target_px", "visible_px", "visibility"),
    "grasps": ("grasps_free",),
    "plan": (
        "grasps_tried", "T_target_tcp", "grasp_score", "q_grasp_rad", "path_length_rad", "path_clearance_m",
    ),
    "execute": (
        "attempts", "trials", "successes", "lift_m", "slip_m", "disturbed_m", "simulated_s", "retry_outcome",
    ),
    "labels": (
        "heuristic_score", "heuristic_label", "outcome", "label", "label_source", "label_version",
    ),
}  # fmt: skip
# Stages of sampling a scene; the others follow from it and its candidates.
DRAWN = ("draw", "settle", "observe", "candidates")
# Stages that are computed again from stored poses.
RECOMPUTED = ("candidates", "visibility", "grasps", "plan", "execute", "labels")

# Tolerances between platforms and versions (docs/explanation/determinism.md).
PX_TOLERANCE = 3
DISTANCE_TOLERANCE_M = 2e-6
SCORE_TOLERANCE = 2e-5


@dataclass(frozen=True)
class FieldDifference:
    """Difference of one field: the number of differing values and the largest; None for names."""

    field: str
    unit: str
    differing: int
    largest: float | None

    def __str__(self) -> str:
        if self.largest is None:
            return f"{self.field}: {self.differing} differ"
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        return f"{self.field}: {self.differing} differ, by up to {self.largest:.3g}{unit}"


@dataclass(frozen=True)
class StageComparison:
    """The comparison of one stage of stored rows with the recomputed one."""

    stage: str
    fields: int
    differences: tuple[FieldDifference, ...]

    @property
    def equal(self) -> bool:
        """Whether every value is equal, bit for bit."""
        return not self.differences


def compare_stages(
    schema: RecordSchema, stored: SceneRows, made: SceneRows, stages: Sequence[str] = tuple(STAGES)
) -> list[StageComparison]:
    """Compare stored rows with recomputed ones, stage by stage, bit for bit.

    Both hold the same samples in the same order. Stages without stored fields are omitted.
    """
    fields = {f.name: f for f in (*schema.scene_fields, *schema.sample_fields)}
    found: list[StageComparison] = []
    for stage in stages:
        names = [name for name in STAGES[stage] if name in fields]
        if not names:
            continue
        each = [_difference(fields[name], _values(stored, name), _values(made, name)) for name in names]
        found.append(StageComparison(stage, len(names), tuple(d for d in each if d is not None)))
    return found


def _values(rows: SceneRows, name: str) -> Array:
    return np.asarray(rows.samples[name] if name in rows.samples else rows.record[name])


def _difference(field: Field, stored: Array, made: Array) -> FieldDifference | None:
    """None where both are equal bit for bit."""
    if stored.shape != made.shape:
        return FieldDifference(field.name, field.unit, max(stored.size, made.size), None)
    if field.is_text:
        n = int((stored.astype(object) != made.astype(object)).sum())
        return FieldDifference(field.name, field.unit, n, None) if n else None
    differing = _bits(stored, field) != _bits(made, field)
    if not differing.any():
        return None
    with np.errstate(invalid="ignore", over="ignore"):
        gaps = np.abs(stored.astype(np.float64) - made.astype(np.float64))
    finite = gaps[np.isfinite(gaps)]
    if field.name == "sample_id":  # the size of a difference between hashes is meaningless
        finite = finite[:0]
    largest = float(finite.max()) if finite.size else None
    return FieldDifference(field.name, field.unit, int(differing.sum()), largest)


def _bits(values: Array, field: Field) -> Array:
    """The values' bytes as integers, so that 0 differs from -0 and NaN equals itself."""
    plain = np.ascontiguousarray(values, np.dtype(field.dtype).newbyteorder("="))
    return plain.view(f"u{plain.dtype.itemsize}").reshape(values.shape)


def beyond_tolerance(
    spec: Specification, stored: Mapping[str, Array], made: Mapping[str, Array]
) -> list[str]:
    """Return how samples exceed the tolerances between platforms and versions; empty where they do not.

    `stored` and `made` are columns of equal rows. Pixel counts, rho and distances are compared; score and
    heuristic label are computed from the stored columns, so that a rho that differs by a pixel does not hide
    a wrong score.
    """
    problems: list[str] = []

    def within(name: str, gap: Array, allowed: Any, unit: str) -> None:
        beyond = gap > allowed
        if beyond.any():
            problems.append(f"{name} differs by {float(gap[beyond].max()):.3g} {unit}".rstrip())

    for name in ("target_px", "visible_px"):
        gap = np.abs(stored[name].astype(np.int64) - made[name].astype(np.int64))
        within(name, gap, PX_TOLERANCE, "px")
    for name in ("distance_m", "mount_distance_m"):
        gap = np.abs(stored[name].astype(np.float64) - made[name].astype(np.float64))
        within(name, gap, DISTANCE_TOLERANCE_M, "m")
    rho = (stored["visible_px"] / np.maximum(stored["target_px"], 1)).astype(np.float32)
    within("visibility", np.abs(rho.astype(np.float64) - stored["visibility"]), 1e-7, "")
    score, _ = heuristic(
        stored["distance_m"],
        stored["mount_distance_m"],
        stored["arm_reach_m"],
        stored["visibility"],
        spec.heuristic,
    )
    gap = np.abs(score.astype(np.float64) - stored["heuristic_score"])
    within("heuristic_score", gap, SCORE_TOLERANCE, "")
    label = (stored["heuristic_score"] >= np.float32(spec.heuristic.tau)).astype(np.int64)
    name = "heuristic_label" if "heuristic_label" in stored else "label"
    if name != "label" or spec.label_source == "heuristic":  # other labels follow another rule
        within(name, np.abs(label - stored[name]), 0, "")
    return problems
