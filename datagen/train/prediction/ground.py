"""Find the floor: the camera's pose in a world with the floor at z = 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from datagen.schemas.errors import InputError
from datagen.train.inputs import F32, F64, I64, Bools
from datagen.train.prediction.files import STEPS
from datagen.train.prediction.frames import SensorFrame, moved

_SAMPLE = 20_000  # points used
_MODES, _VOTERS = 200, 2500  # normals tried as the up direction, and normals that vote
# Points on this slope or less (cosine; 15 degrees) are level: stereo noise turns normals by as much.
_LIES_LEVEL = 0.966
_REFITS = 5
# Errors of neighbouring points are correlated: more points than this make a surface no more certain.
_INDEPENDENT = 400
_GIVEN_ERROR_M = 0.01  # error of the camera's height as measured by hand
# The floor's normal points to a side of the picture (cosine; 75 degrees), hardly turned from it (sine).
_LEAST_UP, _MOST_ROLL = 0.26, 0.25
# Sides of the picture (x, y) that may be up, and how the camera is rolled then; the upright one is preferred.
_SIDES = (
    (0, -1, "upright"),
    (1, 0, "90 degrees to the left"),
    (-1, 0, "90 degrees to the right"),
    (0, 1, "180 degrees"),
)
_BIN_M, _MOST_LEVELS = 0.02, 6
# Least share of all points on a level surface, and largest share below a floor.
_LEAST_SHARE, _MOST_BELOW = 0.008, 0.02
_LEAST_POINTS = 300  # points needed for a residual
_SURE_SHARE, _SURE_OFF_M = 0.03, 0.03
_NEIGHBOURS, _TREE_POINTS = 20, 20_000  # for normals of clouds without a picture
_FACES_UP = 0.8  # cosine to the vertical of surfaces that face up, where it is known roughly
# The axes of a body (x ahead, y left, z up) in those of its camera, and the highest camera.
_BODY_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_LOOKS_UP, _STEEPLY_UP, _MOST_UNDER, _HIGHEST_M = 0.26, 0.87, 0.3, 10.0
_FIX = "Give --gravity x,y,z (direction of gravity, camera frame) or the camera's pose"


@dataclass(frozen=True, eq=False)
class Ground:
    """The camera over the floor.

    `how` describes where the pose comes from. `residual_m` is the standard deviation of the floor's
    points about z = 0 (None where no floor was seen), `offset_m` their mean height. `doubt` is the
    reason why the detected floor may be another surface.
    """

    T_world_camera: F64  # (4, 4)
    how: str
    residual_m: float | None
    offset_m: float | None
    doubt: str | None = None


def depth_error_m(depth_m: F32 | F64) -> F64:
    """Standard deviation (m) of a stereo camera's depth (m); it grows with the depth's square."""
    return 0.0015 + 0.0026 * np.square(depth_m, dtype=np.float64)


def find_ground(frame: SensorFrame, camera_height_m: float | None, gravity: F64 | None) -> Ground:
    """The pose of a frame's camera: as given with the frame, else by gravity, else by the floor's plane.

    Without a pose, the world's origin is on the floor below the camera, x to the camera's right and y
    ahead of it, both level. InputError where arguments are missing or contradict each other.
    """
    if frame.T_world_camera is not None:
        T = frame.T_world_camera
        _refuse_pose(frame, T)
        if camera_height_m is not None and abs(T[2, 3] - camera_height_m) > _tolerance_m(camera_height_m):
            problem = f"is {T[2, 3]:.2f} m in the pose, but --camera-height is {camera_height_m:.2f} m"
            fix = "Correct one of them; the floor of the pose's world is at z = 0"
            raise InputError(frame.place, "camera height", problem, fix)
        return _with_residual(frame, T, "the pose given with the frame")
    if camera_height_m is None:
        fix = "Give --camera-height in metres above the floor, or the camera's pose"
        raise InputError(frame.place, "camera height", "is missing", fix)
    if gravity is not None:
        down = gravity / np.linalg.norm(gravity)
        if _points_up(frame, down, camera_height_m):
            fix = "Change its sign: gravity points down, an accelerometer at rest measures the opposite"
            raise InputError("--gravity", "", "points up, by the level surfaces in the image", fix)
        return _with_residual(frame, level_pose(-down, camera_height_m), "gravity and the camera's height")
    floor = _floor_plane(frame, camera_height_m)
    height_m, mean = floor.height_m, f"the mean of what was measured and the {camera_height_m:.3f} m given"
    how = f"the floor's plane in the depth, {height_m:.3f} m below the camera: {mean}"
    return replace(_with_residual(frame, level_pose(floor.up, height_m), how), doubt=floor.doubt)


def level_pose(up: F64, height_m: float) -> F64:
    """`T_world_camera` (4, 4) of a camera at a height, `up` (3,) being the unit normal in its frame.

    World x is the camera's right and world y ahead of it, made level; straight down, y is the
    picture's top.
    """
    ahead = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.99 else np.array([0.0, -1.0, 0.0])
    y = ahead - (ahead @ up) * up
    y /= np.linalg.norm(y)
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(y, up), y, up])
    T[2, 3] = height_m
    return T


def distances_m(points_m: F32 | F64, eye_m: F64) -> F64:
    """Distances (N,) of points (N, 3) from a camera at (3,)."""
    x, y, z = (points_m[:, k] - eye_m[k] for k in range(3))
    return np.sqrt(x * x + y * y + z * z)


def floor_points(points_m: F32 | F64, eye_m: F64) -> Bools:
    """Mask (N,) of world points (N, 3) on z = 0, within the error of a camera at `eye_m` (3,)."""
    far_m = distances_m(points_m, eye_m)
    slope = np.abs(eye_m[2]) / np.maximum(far_m, 1e-6)
    return np.abs(points_m[:, 2]) < 0.015 + 3 * depth_error_m(far_m) * np.minimum(slope, 1.0)


def _with_residual(frame: SensorFrame, T: F64, how: str) -> Ground:
    world = moved(frame.points_m, T)
    # Twice the tolerance of the floor, so that a floor with a small offset is reported.
    z = world[np.abs(world[:, 2]) < 0.1, 2]
    near = world[floor_points(world, T[:3, 3]), 2]
    if len(near) < _LEAST_POINTS:
        return Ground(T, how, None, float(np.median(z)) if len(z) >= _LEAST_POINTS else None)
    return Ground(T, how, float(near.std()), float(near.mean()))


def _refuse_pose(frame: SensorFrame, T: F64) -> None:
    """Raise InputError for a pose that what the frame shows contradicts: other axes, or another origin."""
    fix = (
        "Give T_world_camera of the camera's optical axes (x right, y down, z forward), in a world with z up "
        "and the floor at z = 0"
    )
    z = frame.points_m @ T[2, :3].astype(np.float32) + T[2, 3]
    under = float((z < -0.1 - 4 * depth_error_m(frame.points_m[:, 2])).mean())
    problem = ""
    if T[2, 2] > _STEEPLY_UP:
        problem = f"the camera looks up at {np.degrees(np.arcsin(min(T[2, 2], 1.0))):.0f} degrees"
    elif T[2, 2] > _LOOKS_UP:
        _, normals = _sample(frame)
        level, of_body = ((normals @ up > _LIES_LEVEL).mean() for up in (T[2, :3], T[2, :3] @ _BODY_AXES))
        if level < _LEAST_SHARE and of_body > _SURE_SHARE:
            problem = "no surface is level, but many are if its axes are those of a body (x forward, z up)"
    elif not 0 < T[2, 3] <= _HIGHEST_M:
        problem = f"the camera is {T[2, 3]:.2f} m above z = 0"
    elif under > _MOST_UNDER:
        problem = f"{under:.0%} of the points are below z = 0"
    if problem:
        raise InputError(frame.place, "T_world_camera", problem, fix)


def _points_up(frame: SensorFrame, down: F64, camera_height_m: float) -> bool:
    """Whether a direction of gravity (3,) has the wrong sign.

    It has where it shows no floor, fewer surfaces that face up than the opposite, and the opposite shows the
    floor; at the top of the picture also where neither shows a floor.
    """
    points, normals = _sample(frame)
    floors, facing = list[float](), list[float]()
    for up in (-down, down):
        T = level_pose(up, camera_height_m)
        on_floor = floor_points(moved(points, T), T[:3, 3]) & (normals @ up > _LIES_LEVEL)
        floors.append(float(on_floor.mean()))
        facing.append(float((normals @ up > _FACES_UP).mean()))
    if floors[0] >= _LEAST_SHARE or facing[0] > facing[1]:
        return False
    return floors[1] >= _LEAST_SHARE or bool(down[1] < -0.5)


def _sample(frame: SensorFrame) -> tuple[F64, F64]:
    """Some points (N, 3) of a frame, in random order, and their normals (N, 3), in its camera's frame."""
    rng = np.random.default_rng([0, len(frame.points_m)])
    rows = rng.choice(len(frame.points_m), min(_SAMPLE, len(frame.points_m)), replace=False)
    return frame.points_m[rows].astype(np.float64), _normals(frame, rows)


@dataclass(frozen=True, eq=False)
class _Floor:
    """A floor: up (3,) in the camera's frame, its share of all points, and why it is doubted."""

    up: F64
    height_m: float
    share: float
    doubt: str | None


def _floor_plane(frame: SensorFrame, camera_height_m: float) -> _Floor:
    """The floor seen in the frame; of a rolled camera where an upright one does not see any.

    The floor of a rolled camera and a wall beside an upright one look alike: where both fit, or the rolled
    one alone, the floor is doubted.
    """
    points, normals = _sample(frame)
    found = [_floor_towards(frame, points, normals, np.array(side[:2]), camera_height_m) for side in _SIDES]
    rolled = [
        (floor, roll)
        for floor, (*_, roll) in zip(found[1:], _SIDES[1:], strict=True)
        if isinstance(floor, _Floor) and floor.doubt is None
    ]
    upright = found[0]
    if rolled:
        floor, roll = max(rolled, key=lambda each: each[0].share)
        if isinstance(upright, InputError):
            return replace(floor, doubt=f"it fits if the camera is rolled by {roll}")
        doubt = upright.doubt or f"another surface fits if the camera is rolled by {roll}"
        return replace(upright, doubt=doubt)
    if isinstance(upright, InputError):
        raise upright
    return upright


def _floor_towards(
    frame: SensorFrame, points: F64, normals: F64, side: F64, camera_height_m: float
) -> _Floor | InputError:
    """The floor if a side (2,) of the picture is up, or why there is none.

    Up is the common normal of level surfaces. The floor is the level surface nearest to the given height
    below the camera: neither a table's top nor the board of a low shelf.
    """
    place, up = frame.place, _way_up(normals, side)
    levels = [] if up is None else _levels(points, normals, up)
    if up is None or not levels:
        return InputError(place, "floor", "is not in the depth image: no level surface", _FIX)
    for _ in range(_REFITS):
        up = _common_up(points, levels, up)
        levels = _levels(points, normals, up) or levels
    below_m = [-float(np.median(points[level] @ up)) for level in levels]
    k = int(np.argmin(np.abs(np.array(below_m) - camera_height_m)))
    share = len(levels[k]) / len(points)
    if abs(below_m[k] - camera_height_m) > _tolerance_m(camera_height_m):
        lowest = max(below_m)
        problem = (
            f"is not in the depth image: the lowest level surface is {lowest:.2f} m below the camera, "
            f"{camera_height_m:.2f} m given"
        )
        x, y, z = np.round(-up, 3)
        hint = f"level surfaces suggest {x:g},{y:g},{z:g}"
        fix = f"Correct --camera-height, or, if that surface is not the floor: {_FIX}; {hint}"
        step_m = 0.0 if frame.image is None else frame.image.step_m
        for steps in STEPS if step_m else ():
            scaled_m = np.array(below_m) / (steps * step_m)
            if np.abs(scaled_m - camera_height_m).min() < _SURE_OFF_M:
                fix = f"Give --depth-scale {steps}, with which one is at that height. Else: {fix}"
        return InputError(place, "floor", problem, fix)
    error_m = depth_error_m(points[levels[k], 2])
    # The points' height is a mean of many measurements, the given height is one more.
    weights = 1 / np.array([(error_m.mean() ** 2) / 25 + 0.004**2, _GIVEN_ERROR_M**2])
    height_m = float(np.average([below_m[k], camera_height_m], weights=weights))
    below = float((points @ up + height_m < -0.03 - 4 * depth_error_m(points[:, 2])).mean())
    if below > _MOST_BELOW:
        problem = f"{below:.0%} of all points are below the plane {height_m:.2f} m under the camera"
        return InputError(place, "floor", problem, f"Correct --camera-height, or: {_FIX}")
    doubts = [f"it has only {share:.1%} of the points"] if share < _SURE_SHARE else []
    if abs(below_m[k] - camera_height_m) > _SURE_OFF_M:
        doubts.append(f"{below_m[k]:.3f} m below the camera were measured, {camera_height_m:.3f} m given")
    return _Floor(up, height_m, share, ", and ".join(doubts) or None)


def _normals(frame: SensorFrame, rows: I64) -> F64:
    """Unit normals (N, 3), turned to the camera, at some of a frame's points, in its camera's frame."""
    if frame.image is not None:
        flat = np.flatnonzero(frame.image.depth_m.ravel() > 0)[rows]
        facets = frame.image.facets(np.eye(4)).reshape(-1, 3)[flat]
    else:
        points = frame.points_m.astype(np.float64)
        some = points[:: max(1, len(points) // _TREE_POINTS)]
        _, near = KDTree(some).query(points[rows], min(_NEIGHBOURS, len(some)))
        around = some[near] - some[near].mean(axis=1, keepdims=True)
        facets = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
        facets *= -np.sign(np.einsum("ij,ij->i", facets, points[rows]))[:, None]
    return facets / np.maximum(np.linalg.norm(facets, axis=1, keepdims=True), 1e-12)


def _way_up(normals: F64, side: F64) -> F64 | None:
    """The direction (3,) of most normals (N, 3) that point to a side (2,) of the picture, or None."""
    across = np.array([side[1], -side[0]])
    turned = np.abs(normals[:, :2] @ across) < _MOST_ROLL
    upward = normals[(normals[:, :2] @ side > _LEAST_UP) & turned]
    if len(upward) < _LEAST_SHARE * len(normals):
        return None
    # Normals of walls are perpendicular to it; they vote with less weight, since many are noisy.
    tried = upward[:_MODES]  # rows are in random order
    cosines = normals[:_VOTERS] @ tried.T
    votes = np.maximum(cosines - _LIES_LEVEL, 0).sum(axis=0) / (1 - _LIES_LEVEL)
    votes += 0.25 * (np.abs(cosines) < 0.05).sum(axis=0)
    up = tried[int(votes.argmax())]
    for _ in range(_REFITS):
        up = normals[normals @ up > _LIES_LEVEL].mean(axis=0)
        up /= np.linalg.norm(up)
    return up


def _levels(points: F64, normals: F64, up: F64) -> list[I64]:
    """Rows of the points (N, 3) on each of the largest level surfaces: where level points cluster."""
    level = np.flatnonzero(normals @ up > _LIES_LEVEL)
    z, error_m = points[level] @ up, depth_error_m(points[level, 2])
    found, free = list[I64](), np.ones(len(level), np.bool_)
    if not len(level):
        return found
    edges = np.arange(z.min() - _BIN_M, z.max() + 2 * _BIN_M, _BIN_M)
    while len(found) < _MOST_LEVELS:
        counted = np.convolve(np.histogram(z[free], edges)[0], np.ones(3), mode="same")
        k = int(counted.argmax())
        if counted[k] < _LEAST_SHARE * len(points):
            break
        middle = np.median(z[free & (np.abs(z - (edges[k] + edges[k + 1]) / 2) < 1.5 * _BIN_M)])
        on = free & (np.abs(z - middle) < 0.008 + 2 * error_m)
        if on.sum() >= _LEAST_SHARE * len(points):
            found.append(level[on])
        free &= np.abs(z - middle) >= 1.5 * _BIN_M
        free &= ~on
    return found


def _common_up(points: F64, levels: Sequence[I64], up: F64) -> F64:
    """The normal (3,) that level surfaces share, by least squares over all, each at its own height."""
    turn = level_pose(up, 0.0)[:3, :3]
    rows, wanted = list[F64](), list[F64]()
    for level in levels:
        some = points[level]
        xyz = some @ turn.T
        weight = 1 / depth_error_m(some[:, 2])
        centre = np.average(xyz, axis=0, weights=weight**2)
        weight *= np.sqrt(min(1.0, _INDEPENDENT / len(xyz)))
        rows.append((xyz[:, :2] - centre[:2]) * weight[:, None])
        wanted.append((xyz[:, 2] - centre[2]) * weight)
    (b, c), *_ = np.linalg.lstsq(np.concatenate(rows), np.concatenate(wanted), rcond=None)
    tilted = turn.T @ np.array([-b, -c, 1.0])
    return tilted / np.linalg.norm(tilted)


def _tolerance_m(camera_height_m: float) -> float:
    """Largest difference (m) between the measured and the given height of the camera."""
    return 0.03 + 0.02 * camera_height_m
