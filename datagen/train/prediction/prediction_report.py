"""A prediction as text, and as a JSON document."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from datagen.train.prediction.answer import Prediction
from datagen.train.prediction.base_cells import STATES

_OWN_AXES = (
    "z up, floor at z = 0, origin on the floor below the first camera; x to its right, y ahead of it, level"
)
_DECIDES = 0.6  # the largest share of good poses of decisive scenes
_GIVEN_AXES = "that of the given T_world_camera; z up, floor at z = 0"


def _world_axes(prediction: Prediction) -> str:
    return _OWN_AXES if prediction.frames[0].T_world_camera is None else _GIVEN_AXES


def report_rows(prediction: Prediction) -> list[tuple[str, str]]:
    """The answer as rows of a heading and a text."""
    p, robot, floor, unseen = prediction, prediction.robot, prediction.grounds[0], prediction.rows("unseen")
    rows = [
        ("best", "none" if p.best is None else _described(p, p.best)),
        ("answer", "; ".join((p.level, *p.reasons))),
    ]
    nominal = p.choice.nominal
    if p.choice.expected is not None and p.arrival is not None and p.best is not None and nominal is not None:
        text = f"{p.arrival.text}; expected success {p.choice.expected[p.best]:.3f}"
        if p.best != nominal:
            text += f", and {p.choice.expected[nominal]:.3f} at the best score, {_described(p, nominal)}"
        rows.append(("arrival", text))
    if p.choice.miss_m is not None:
        rows.append(("may miss", f"by {p.choice.miss_m:.2f} m in any direction with scores that stay good"))
    rows.append(("poses", ", ".join(f"{len(p.rows(state))} {state}" for state in STATES)))
    if p.good_share is not None:
        text = f"{p.good_share:.0%} of the clear poses within reach score good"
        if p.best is not None and p.good_share < _DECIDES:
            text += ": parking decides here"
        elif p.level == "good":  # else they may be few, in a gap that a robot misses by a centimetre
            text += ": parking decides little here"
        rows.append(("choice", text))
    if len(unseen):
        rows.append(("unseen", f"the best is {_described(p, int(unseen[0]))}"))
    if (look := p.look_next) is not None:
        pan, tilt = np.degrees(look)
        side = f"turned {abs(pan):.0f} deg to the {'left' if pan > 0 else 'right'}"
        rows.append(("look next", f"{side}, {tilt:.0f} deg below level: the floor of the best unseen pose"))
    x, y, z = p.target.center_m
    residual = "not visible" if floor.residual_m is None else f"residual {1000 * floor.residual_m:.1f} mm"
    missing = "" if p.missing_depth is None else f", {p.missing_depth:.1%} of the depth missing"
    lengths = f"mount {robot.base_height_m:.2f} m, reach {robot.arm_reach_m:.2f} m, base {robot.outline}"
    rows += [
        ("target", f"({x:.3f}, {y:.3f}, {z:.3f}) m, {p.target_points} points; {p.target.how}"),
        ("floor", f"{residual}; from {floor.how}"),
        ("cloud", f"{p.cloud.n} points, {p.crop_seen:.0%} of the surroundings observed{missing}"),
        ("robot", f"camera {robot.camera_height_m:.2f} m, {lengths}"),
        ("world", _world_axes(p)),
    ]
    return rows + [("note", note) for note in p.notes]


def _described(p: Prediction, row: int) -> str:
    x, y = p.base_xy_m[row]
    yaw_deg = round(float(np.degrees(p.yaw_rad[row])), 1) + 0.0  # no negative zero
    return f"({x:.3f}, {y:.3f}) m, yaw {yaw_deg:.1f} deg, score {p.score[row]:.3f}"


def document(prediction: Prediction) -> dict[str, Any]:
    """The answer as plain values: all base poses with scores; the best also in the camera frame."""
    p, floor, unseen = prediction, prediction.grounds[0], prediction.rows("unseen")
    robot = {name: value for name, value in asdict(p.robot).items() if name != "footprint"}
    pixels = {} if p.filled is None else asdict(p.filled)
    return {
        "scorer": p.scorer,
        "level": p.level,
        "reasons": list(p.reasons),
        "reason_codes": [code for code, _ in p.coded_reasons],
        "notes": list(p.notes),
        "world": _world_axes(p),
        "best": None if p.best is None else _pose(p, p.best),
        "look_next_deg": None if p.look_next is None else np.degrees(p.look_next).tolist(),
        "best_unseen": None if not len(unseen) else _pose(p, int(unseen[0])),
        "arrival": None if p.arrival is None else p.arrival.text,
        "may_miss_m": p.choice.miss_m,
        "good_share_in_reach": p.good_share,
        "robot": robot | {"base": str(p.robot.outline)},
        "target": asdict(p.target) | pixels | {"points": p.target_points},
        "floor": {"how": floor.how, "residual_m": floor.residual_m, "doubt": floor.doubt},
        "cloud": {"points": p.cloud.n, "crop_seen": p.crop_seen, "missing_depth": p.missing_depth},
        "T_world_camera": [ground.T_world_camera.tolist() for ground in p.grounds],
        "candidates": [_candidate(p, row) for row in range(len(p.score))],
    }


def _candidate(p: Prediction, row: int) -> dict[str, Any]:
    x, y = p.base_xy_m[row].tolist()
    expected = None if p.choice.expected is None else float(p.choice.expected[row])
    return {
        **{"x_m": x, "y_m": y, "yaw_rad": float(p.yaw_rad[row]), "score": float(p.score[row])},
        **{"state": STATES[int(p.cells.state[row])], "expected_success": expected},
    }


def _pose(p: Prediction, row: int) -> dict[str, Any]:
    poses = {"T_world_base": p.T_world_base(row).tolist(), "T_camera_base": p.T_camera_base(row).tolist()}
    return {"index": row} | _candidate(p, row) | poses
