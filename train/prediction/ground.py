"""Where the floor is and which way is up: the camera's pose in a world whose floor is z = 0."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from schemas.errors import InputError
from train.prediction.files import Bools
from train.prediction.frames import SensorFrame
from workers.geometry.mesh import F32, F64

_TRIES = 800
_SAMPLE = 6000  # points on which planes are tried; the fit takes all
_REFITS = 4
# Errors of neighbouring points are alike: more points than this make a floor no more certain.
_INDEPENDENT = 400
_GIVEN_ERROR_M = 0.01  # of the camera's height as people measure it
# The floor's normal points up in the picture (cosine; 75 degrees), and cameras are hardly rolled (sine).
_LEAST_UP, _MOST_ROLL = 0.26, 0.25
# A plane of fewer points, or with more than this share of all points below it, is no floor.
_LEAST_POINTS, _LEAST_SHARE, _MOST_BELOW = 300, 0.015, 0.02
# A plane that cuts through things passes many points, whose surfaces run another way (cosine; 15 degrees).
_LIES_FLAT = 0.966
_MEND = "Give --gravity x,y,z (camera frame: where things fall) or --camera-pose pose.json"


@dataclass(frozen=True, eq=False)
class Ground:
    """The camera over the floor.

    `how` says in words where it comes from. `residual_m` is the standard deviation of the floor's
    points about z = 0 (None where no floor was seen), `offset_m` their mean height.
    """

    T_world_camera: F64  # (4, 4)
    how: str
    residual_m: float | None
    offset_m: float | None

    @property
    def camera_height_m(self) -> float:
        """The camera's height above the floor."""
        return float(self.T_world_camera[2, 3])


def depth_error_m(depth_m: F32 | F64) -> F64:
    """What a stereo camera's depth may be off by, one standard deviation: it grows with its square."""
    return 0.0015 + 0.0026 * np.square(depth_m, dtype=np.float64)


def find_ground(frame: SensorFrame, camera_height_m: float | None, gravity: F64 | None) -> Ground:
    """The pose of a frame's camera: as given with the frame, else by gravity, else by the floor's plane.

    Without a pose, the world's origin is on the floor below the camera, x to the camera's right and y
    ahead of it, both level. InputError where what is given does not suffice or does not agree.
    """
    if frame.T_world_camera is not None:
        T = frame.T_world_camera
        if camera_height_m is not None and abs(T[2, 3] - camera_height_m) > _tolerance_m(camera_height_m):
            problem = (
                f"the pose has the camera at {T[2, 3]:.2f} m, --camera-height says {camera_height_m:.2f} m"
            )
            mend = "Correct one; the pose's world has its floor at z = 0"
            raise InputError(frame.place, "camera height", problem, mend)
        return _with_residual(frame, T, "the pose given with the frame")
    if camera_height_m is None:
        mend = "Give --camera-height in metres above the floor, or --camera-pose pose.json"
        raise InputError(frame.place, "camera height", "missing", mend)
    if gravity is not None:
        down = gravity / np.linalg.norm(gravity)
        if down[1] < 0 and abs(down[2]) < 0.95:
            mend = "Turn its sign: it says where things fall, an accelerometer at rest shows the opposite"
            raise InputError("--gravity", "", "points up in the picture", mend)
        return _with_residual(frame, level_pose(-down, camera_height_m), "gravity and the camera's height")
    normal, height_m = _floor_plane(frame, camera_height_m)
    how = f"the floor's plane in the depth, {height_m:.3f} m below the camera ({camera_height_m:.3f} m given)"
    return _with_residual(frame, level_pose(normal, height_m), how)


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


def floor_points(points_m: F32 | F64, eye_m: F64) -> Bools:
    """Which of world points (N, 3) lie on z = 0 as far as a camera at `eye_m` (3,) can tell."""
    far_m = np.linalg.norm(points_m - eye_m, axis=1)
    slope = np.abs(eye_m[2]) / np.maximum(far_m, 1e-6)
    return np.abs(points_m[:, 2]) < 0.015 + 3 * depth_error_m(far_m) * np.minimum(slope, 1.0)


def _with_residual(frame: SensorFrame, T: F64, how: str) -> Ground:
    world = frame.points_m @ T[:3, :3].T + T[:3, 3]
    # Twice as wide as what counts as floor, so that a floor that lies a little off is told of.
    z = world[np.abs(world[:, 2]) < 0.1, 2]
    near = world[floor_points(world, T[:3, 3]), 2]
    if len(near) < _LEAST_POINTS:
        return Ground(T, how, None, float(np.median(z)) if len(z) >= _LEAST_POINTS else None)
    return Ground(T, how, float(near.std()), float(near.mean()))


def _floor_plane(frame: SensorFrame, camera_height_m: float) -> tuple[F64, float]:
    """(up normal (3,) in the camera's frame, height of the camera) of the floor seen in the frame.

    RANSAC (Fischler and Bolles 1981) over planes that face up, then least squares on what lies near.
    """
    rng = np.random.default_rng([0, len(frame.points_m)])
    points = frame.points_m.astype(np.float64)
    rows = rng.choice(len(points), min(_SAMPLE, len(points)), replace=False)
    some = _Some(points[rows], 0.008 + 2 * depth_error_m(points[rows, 2]), _normals(frame, rows))
    normals, heights = _tried_planes(some.points, rng)
    agrees = np.abs(heights - camera_height_m) < _tolerance_m(camera_height_m)
    found = _best(some, normals[agrees], heights[agrees])
    if found is None:
        other = _best(some, normals, heights)
        if other is not None and other[1] > 0.3:
            problem = f"the lowest plane is {other[1]:.2f} m below the camera, {camera_height_m:.2f} m given"
            mend = f"Correct --camera-height, or, if that plane is no floor: {_MEND}"
            raise InputError(frame.place, "floor", problem, mend)
        raise InputError(frame.place, "floor", "not seen in the depth picture", _MEND)
    return _fitted(points, *found, camera_height_m)


@dataclass(frozen=True, eq=False)
class _Some:
    """Points on which planes are tried, how near a plane passes them that they lie on, and normals."""

    points: F64  # (N, 3)
    band_m: F64  # (N,)
    normals: F64 | None  # (N, 3); None for clouds without a picture


def _normals(frame: SensorFrame, rows: npt.NDArray[np.int64]) -> F64 | None:
    """Unit normals (N, 3) at some of a frame's points, in its camera's frame."""
    if frame.image is None:
        return None
    facets = frame.image.facets(np.eye(4))[frame.image.depth_m > 0][rows]
    return facets / np.maximum(np.linalg.norm(facets, axis=1, keepdims=True), 1e-12)


def _fitted(points: F64, normal: F64, height_m: float, camera_height_m: float) -> tuple[F64, float]:
    """The plane by weighted least squares over the points near it, refound some times.

    A patch of floor far away says little about the height straight below the camera, so the height that
    was given counts as a measurement too.
    """
    error_m = depth_error_m(points[:, 2])
    for _ in range(_REFITS):
        near = np.abs(points @ normal + height_m) < 0.008 + 2 * error_m
        level = level_pose(normal, height_m)
        xyz = points[near] @ level[:3, :3].T + level[:3, 3]
        # z = a + b x + c y over the level floor found so far; the camera stands at x = y = 0.
        weight = 1 / error_m[near] * np.sqrt(min(1.0, _INDEPENDENT / len(xyz)))
        rows = np.column_stack([np.ones(len(xyz)), xyz[:, :2]]) * weight[:, None]
        prior = np.array([[1.0, 0.0, 0.0]]) / _GIVEN_ERROR_M
        wanted = np.append(xyz[:, 2] * weight, (height_m - camera_height_m) / _GIVEN_ERROR_M)
        (a, b, c), *_ = np.linalg.lstsq(np.concatenate([rows, prior]), wanted, rcond=None)
        tilted = np.array([-b, -c, 1.0]) / np.sqrt(b * b + c * c + 1)
        height_m = float((height_m - a) * tilted[2])
        normal = level[:3, :3].T @ tilted
    return normal, height_m


def _tolerance_m(camera_height_m: float) -> float:
    """By how much a measured height of the camera may differ from the one that was given."""
    return 0.05 + 0.03 * camera_height_m


def _tried_planes(points: F64, rng: np.random.Generator) -> tuple[F64, F64]:
    """Planes through three points each: normals (K, 3) that point up, and the camera's heights (K,)."""
    # Points on low sight lines are drawn more often: there a floor is.
    order = np.argsort(points[:, 1] / np.maximum(points[:, 2], 1e-6))[::-1]
    ranks = (len(points) * rng.random((_TRIES, 3)) ** 2).astype(np.int64)
    a, b, c = (points[order[ranks[:, k]]] for k in range(3))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    sound = lengths > 1e-6
    normals = normals[sound] / lengths[sound, None]
    normals[normals[:, 1] > 0] *= -1  # y points down in the picture
    heights = -np.einsum("ij,ij->i", normals, a[sound])
    good = (normals[:, 1] < -_LEAST_UP) & (np.abs(normals[:, 0]) < _MOST_ROLL) & (heights > 0.1)
    return normals[good], heights[good]


def _best(some: _Some, normals: F64, heights: F64) -> tuple[F64, float] | None:
    """The plane with most points on it, of those with next to nothing below; None where none serves."""
    if not len(normals):
        return None
    gaps = some.points @ normals.T + heights  # (N, K), height of each point over each plane
    on = np.abs(gaps) < some.band_m[:, None]
    if some.normals is not None:
        on &= some.normals @ normals.T > _LIES_FLAT
    below = (gaps < -0.03 - 2 * some.band_m[:, None]).mean(axis=0)
    share = np.where(below <= _MOST_BELOW, on.mean(axis=0), 0.0)
    k = int(share.argmax())
    return (normals[k], float(heights[k])) if share[k] >= _LEAST_SHARE else None
