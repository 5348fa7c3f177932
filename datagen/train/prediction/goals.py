"""A prediction as goals for a robot: base poses as messages of ROS 2, and the scores as a map of Nav2."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import yaml
from scipy.special import ndtr, ndtri

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import whole_file
from datagen.train.inputs import F64, Bools
from datagen.train.prediction.answer import Prediction
from datagen.train.prediction.base_cells import STATES, UNSEEN
from datagen.workers.geometry.transforms import inverse, translation
from datagen.workers.robots import ROBOTS, robot_source

ENDINGS = (".yaml", ".mcap", ".pgm")
# Mounts of registered robots in the frames of their bases (m), without their URDFs; (0, 0) of the others.
MOUNTS_M = {"fetch": (0.03265, 0.0), "pr2": (-0.05, -0.188), "tiago-pro": (0.06526, 0.15918)}
_MOST = 5
# Near base poses succeed and fail together: the correlation of what lies behind their outcomes is
# ALIKE * exp(-(d / ALIKE_M)^2 / 2) at a distance d (m), fitted by `python -m benchmarks.retries`.
ALIKE, ALIKE_M = 0.75, 0.4
_LATER = 1e6  # standard deviations; no chance is as small


def goal_files(file: Path) -> tuple[Path, ...]:
    """The files that `write_goal` writes for a name."""
    return (file, file.with_suffix(".yaml")) if file.suffix == ".pgm" else (file,)


def write_goal(file: Path, p: Prediction, frame_id: str, stamp_ns: int) -> bool:
    """Write the best pose of the robot's base with alternatives, or the scores; False where there is none.

    Poses are those of the base's frame on the floor (z = 0) of `frame_id`: of the link that the robot's file
    names, else below the arm's mount. A `.yaml` has them as text, an `.mcap` also the scores as nav_msgs/
    OccupancyGrid, and a `.pgm` with its `.yaml` the scores alone, as Nav2 reads a map. The scores are a cost
    in percent, 0 the best, -1 where no base may stand. Where there is no best pose, an older file is removed.
    """
    if any(frame.T_world_camera is None for frame in p.frames):
        fix = "Give the frame's pose in the robot's map: pose.json, T_world_camera or --bag"
        raise InputError("--goal", "", "needs frames with poses", fix)
    goal = goal_document(p, frame_id, stamp_ns)
    if goal is None:
        for each in goal_files(file):
            each.unlink(missing_ok=True)
        return False
    match file.suffix:
        case ".yaml":
            _write_text(file, goal)
        case ".mcap":
            _write_messages(file, p, goal, stamp_ns)
        case _:
            _write_map(file, p)
    return True


def alternatives(p: Prediction) -> list[int]:
    """Rows of up to five base poses to try in turn after the best, those on floor that was seen first."""
    assert p.best is not None
    chance = p.score if p.choice.expected is None else p.choice.expected
    rows = np.array([p.best, *p.choice.ranked[p.choice.ranked != p.best]])
    last = (p.cells.state[rows] == STATES.index(UNSEEN)) & (rows != p.best)
    chance = chance[rows]
    chance[0] = chance.max()  # the best comes first, and has about the highest
    return rows[in_turn(chance, p.base_xy_m[rows], 1 + _MOST, last)][1:].tolist()


def in_turn(chance: F64, base_xy_m: F64, most: int, last: Bools | None = None) -> list[int]:
    """Rows of up to `most` base poses (N, 2), m, to try in turn by their chances (N,), `last` (N,) ones last.

    Each is the likeliest to succeed if all before it fail. Behind each outcome is a normal variable that is
    positive for a success; given that some are negative, the others are taken as normal with the same means
    and covariances (assumed density filtering: Minka 2001).
    """
    mean, variance = ndtri(np.clip(chance, 1e-3, 1 - 1e-3)), np.ones(len(chance))
    chosen, failures = list[int](), list[tuple[float, F64]]()
    for _ in range(min(most, len(mean))):
        z = mean / np.sqrt(variance)
        left = z.copy() if last is None else np.where(last, z - _LATER, z)
        left[chosen] = -np.inf
        chosen.append(row := int(left.argmax()))
        far_m = np.linalg.norm(base_xy_m - base_xy_m[row], axis=1)
        covariance = np.where(far_m > 0, ALIKE, 1.0) * np.exp(-((far_m / ALIKE_M) ** 2) / 2)
        for factor, shift in failures:
            covariance -= factor * shift[row] * shift
        ratio = math.exp(-(z[row] ** 2) / 2) / math.sqrt(2 * math.pi) / ndtr(-z[row])
        shift = covariance / math.sqrt(variance[row])
        failures.append((ratio * (ratio - z[row]), shift))
        mean, variance = mean - ratio * shift, variance - failures[-1][0] * shift**2
    return chosen


def _base(p: Prediction) -> tuple[str, F64]:
    """The frame of the robot's base, and its pose (4, 4) in the frame of the arm's mount."""
    if not (name := p.robot.name):
        return "base_link", np.eye(4)
    base = robot_source(name).keys.arm.base
    if name in ROBOTS:
        return base, inverse(translation(*MOUNTS_M.get(name, (0.0, 0.0)), 0.0))
    # Imported here: reads the robot's URDF.
    from datagen.workers.robots.assembly import assemble

    return base, inverse(assemble(robot_source(name), None).base.T_root_mount)


def _pose(p: Prediction, row: int, T_mount_base: F64) -> dict[str, dict[str, float]]:
    """A geometry_msgs/Pose of the base."""
    T, half = p.T_world_base(row) @ T_mount_base, float(p.yaw_rad[row]) / 2
    return {
        "position": {"x": float(T[0, 3]), "y": float(T[1, 3]), "z": 0.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(half), "w": math.cos(half)},
    }


def goal_document(p: Prediction, frame_id: str, stamp_ns: int) -> dict[str, Any] | None:
    """What a goal's `.yaml` holds; None without a best pose or poses of the frames."""
    if p.best is None or any(frame.T_world_camera is None for frame in p.frames):
        return None
    base, T_mount_base = _base(p)

    def scored(row: int) -> dict[str, Any]:
        codes = [code for code, _ in p.doubts_about(row)]
        level = {"score": float(p.score[row]), "level": "doubtful" if codes else "good", "reasons": codes}
        return {"pose": _pose(p, row, T_mount_base)} | level

    header = {"frame_id": frame_id, "stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}}
    best, others = scored(p.best), [scored(row) for row in alternatives(p)]
    goal = {"goal": {"header": header, "pose": best.pop("pose")}, "child_frame_id": base}
    return {**goal, **best, "may_miss_m": p.choice.miss_m, "alternatives": others}


def _write_text(file: Path, document: dict[str, Any]) -> None:
    with whole_file(file, alone=True) as opened:
        opened.write(yaml.safe_dump(document, sort_keys=False).encode())


def _costs(p: Prediction) -> tuple[Any, float, list[float]]:
    """Costs (H, W), int8, lowest row first, with the size of a cell and the lower left corner (m)."""
    side = math.isqrt(len(p.score))
    cost = np.where(p.choice.can_stand, np.rint(100 * (1 - np.clip(p.score, 0, 1))), -1).astype(np.int8)
    low, high = p.base_xy_m.min(axis=0), p.base_xy_m.max(axis=0)
    cell_m = float(high[0] - low[0]) / (side - 1)
    column, row = np.rint((p.base_xy_m - low) / cell_m).astype(np.int64).T
    grid = np.full((side, side), -1, np.int8)
    grid[row, column] = cost
    return grid, cell_m, (low - cell_m / 2).tolist()


def _write_map(file: Path, p: Prediction) -> None:
    grid, cell_m, corner = _costs(p)
    with whole_file(file, alone=True) as opened:  # 255 is -1 in Nav2's raw maps
        opened.write(b"P5 %d %d 255\n" % grid.shape[::-1] + grid[::-1].astype(np.uint8).tobytes())
    numbers = {"resolution": cell_m, "origin": [*corner, 0.0], "negate": 0}
    thresholds = {"occupied_thresh": 0.65, "free_thresh": 0.25}
    _write_text(file.with_suffix(".yaml"), {"image": file.name, "mode": "raw", **numbers, **thresholds})


def _write_messages(file: Path, p: Prediction, goal: dict[str, Any], stamp_ns: int) -> None:
    # Imported here: of the extra `ros`.
    from rosbags.rosbag2 import StoragePlugin, Writer

    from datagen.train.prediction.bags import STORE

    (grid, cell_m, (x, y)), header = _costs(p), goal["goal"]["header"]
    others = [each["pose"] for each in goal["alternatives"]]
    corner = {"position": {"x": x, "y": y, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    size = {"resolution": cell_m, "width": grid.shape[1], "height": grid.shape[0], "origin": corner}
    info = {"map_load_time": header["stamp"], **size}
    messages = {
        "/goal": ("geometry_msgs/msg/PoseStamped", goal["goal"]),
        "/alternatives": ("geometry_msgs/msg/PoseArray", {"header": header, "poses": others}),
        "/scores": ("nav_msgs/msg/OccupancyGrid", {"header": header, "info": info, "data": grid.ravel()}),
    }
    with tempfile.TemporaryDirectory() as folder:
        with Writer(Path(folder) / "goal", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            for topic, (kind, fields) in messages.items():
                connection = writer.add_connection(topic, kind, typestore=STORE)
                writer.write(connection, stamp_ns, STORE.serialize_cdr(_attributes(fields), kind))
        with whole_file(file, alone=True) as opened:
            opened.write((Path(folder) / "goal" / "goal.mcap").read_bytes())


def _attributes(value: Any) -> Any:
    """The message of a document."""
    if isinstance(value, dict):
        return SimpleNamespace(**{name: _attributes(each) for name, each in value.items()})
    return [_attributes(each) for each in value] if isinstance(value, list) else value
