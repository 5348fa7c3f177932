"""A prediction as text, and as a JSON document."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from datagen.train.prediction.base_cells import SEEN_SHARE, STATES
from datagen.train.prediction.floor_ways import WAYS
from datagen.train.prediction.predict import Prediction

_OWN_AXES = (
    "z up, floor at z = 0, origin on the floor below the first camera; x to its right, y ahead of it, level"
)
_GIVEN_AXES = "that of the given T_world_camera; z up, floor at z = 0"


def _world_axes(prediction: Prediction) -> str:
    return _OWN_AXES if prediction.frames[0].T_world_camera is None else _GIVEN_AXES


def report_rows(prediction: Prediction) -> list[tuple[str, str]]:
    """The answer as rows of a heading and a text."""
    p, robot = prediction, prediction.robot
    lines = [("best", "none"), ("sure", p.sure)]
    if p.best is not None:
        x, y = p.base_xy_m[p.best]
        margin = "" if p.margin is None else f", {p.margin:.3f} above the 10th"
        pose = f"({x:.3f}, {y:.3f}) m, yaw {np.degrees(p.yaw_rad[p.best]):.1f} deg"
        lines[0] = ("best", f"{pose}, score {p.score[p.best]:.3f}{margin}")
        lines += _arrival_lines(p)
    counts = [f"{len(p.rows(state))} {state}" for state in STATES]
    lines.append(("poses", ", ".join(counts)))
    unseen = p.rows("unseen")
    if len(unseen):
        x, y = p.base_xy_m[unseen[0]]
        hidden = int((p.cells.floor_seen[unseen] >= SEEN_SHARE).sum())
        way = f"; of {hidden} only the way there is not visible" if hidden else ""
        lines.append(("unseen", f"their best scores {p.score[unseen[0]]:.3f} at ({x:.3f}, {y:.3f}) m{way}"))
    x, y, z = p.target.center_m
    floor = p.grounds[0]
    residual = "not visible" if floor.residual_m is None else f"residual {1000 * floor.residual_m:.1f} mm"
    missing = "" if p.missing_depth is None else f", {p.missing_depth:.1%} of the depth missing"
    lines += [
        ("target", f"({x:.3f}, {y:.3f}, {z:.3f}) m, {p.target_points} points; {p.target.how}"),
        ("floor", f"{residual}; from {floor.how}"),
        ("cloud", f"{p.cloud.n} points, {p.crop_seen:.0%} of the surroundings observed{missing}"),
        (
            "robot",
            f"camera {robot.camera_height_m:.2f} m, mount {robot.base_height_m:.2f} m, "
            f"reach {robot.arm_reach_m:.2f} m, base {robot.outline}",
        ),
        ("world", _world_axes(p)),
    ]
    return lines + [("note", note) for note in p.notes]


def _arrival_lines(p: Prediction) -> list[tuple[str, str]]:
    """Rows on the effect of an arrival error, and on the distance by which the best may be missed."""
    lines = list[tuple[str, str]]()
    expected, at = p.choice.expected, p.choice.nominal
    if expected is not None and p.arrival is not None and p.best is not None and at is not None:
        best, nominal = expected[p.best], expected[at]
        text = f"{p.arrival.text}; expected success {best:.3f}"
        if p.best != at:
            x, y = p.base_xy_m[at]
            text += f", and {nominal:.3f} at the best score, ({x:.3f}, {y:.3f}) m"
        lines.append(("arrival", text))
    if p.choice.miss_m is not None:
        lines.append(("may miss", f"by {p.choice.miss_m:.2f} m in any direction with scores that stay good"))
    return lines


def document(prediction: Prediction) -> dict[str, Any]:
    """The answer as plain values: all base poses with scores; the best also in the camera frame."""
    p = prediction
    floor = p.grounds[0]
    return {
        "scorer": p.scorer,
        "sure": p.sure,
        "notes": list(p.notes),
        "world": _world_axes(p),
        "best": None if p.best is None else _pose(p, p.best),
        "best_unseen": None if not len(rows := p.rows("unseen")) else _pose(p, int(rows[0])),
        "best_score": None if (nominal := p.choice.nominal) is None else _pose(p, nominal),
        "arrival": None if p.arrival is None else p.arrival.text,
        "may_miss_m": p.choice.miss_m,
        "margin_to_10th": p.margin,
        "robot": {
            **{name: value for name, value in asdict(p.robot).items() if name != "footprint"},
            "base_radius_m": p.robot.outline.radius_m,
            "footprint_m": [list(corner) for corner in p.robot.outline.corners_m] or None,
        },
        "target": {
            **asdict(p.target),
            "center_m": list(p.target.center_m),
            "points": p.target_points,
            "mask_pixels": None if p.filled is None else p.filled.mask_pixels,
            "filled_pixels": None if p.filled is None else p.filled.missing_pixels,
        },
        "floor": {
            "how": floor.how,
            "residual_m": floor.residual_m,
            "offset_m": floor.offset_m,
            "doubt": floor.doubt,
            "camera_height_m": floor.camera_height_m,
        },
        "cloud": {"points": p.cloud.n, "crop_seen": p.crop_seen, "missing_depth": p.missing_depth},
        "T_world_camera": [ground.T_world_camera.tolist() for ground in p.grounds],
        "candidates": [_candidate(p, row) for row in range(len(p.score))],
    }


def _candidate(p: Prediction, row: int) -> dict[str, Any]:
    x, y = p.base_xy_m[row]
    return {
        "x_m": float(x),
        "y_m": float(y),
        "yaw_rad": float(p.yaw_rad[row]),
        "score": float(p.score[row]),
        "state": STATES[int(p.cells.state[row])],
        "floor_seen": float(p.cells.floor_seen[row]),
        "way": WAYS[int(p.cells.way[row])],
        "expected_success": None if p.choice.expected is None else float(p.choice.expected[row]),
    }


def _pose(p: Prediction, row: int) -> dict[str, Any]:
    return {
        "index": row,
        **_candidate(p, row),
        "T_world_base": p.T_world_base(row).tolist(),
        "T_camera_base": p.T_camera_base(row).tolist(),
    }
