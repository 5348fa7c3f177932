"""What carries an arm: its mount above the floor, and the outline of its base."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.planar import crosses_itself, inside_polygon, prism_corners, unit_circle
from datagen.workers.geometry.transforms import translation
from datagen.workers.robots.links import LinkBody
from datagen.workers.robots.robot_file import BaseKeys, RobotSource
from datagen.workers.robots.urdf import Joint

# A URDF whose links reach at least so far below the first joint that turns has a base of its own; the foot of
# an arm is smaller than this area and than this share of the base that it stands on.
_OWN_BASE_M, _LEAST_M2, _SHARE = 0.45, 0.05, 0.3
_LEAST_BASE_M2 = 1e-3
_WRONG_HEIGHT_M, _UNEVEN_M = 0.03, 0.02
_GAP_M = 0.005  # between a base that no URDF has and the arm on it
_CORNERS = 24

Outline = tuple[tuple[float, float], ...]


@dataclass(frozen=True, eq=False)
class Base:
    """A robot's base around its mount; without an outline it stands on a pedestal of any height."""

    T_root_mount: F64  # (4, 4), the base frame in the root link's
    height_m: float | None  # of the mount above the floor
    footprint_m: Outline | None  # around the mount, x to the front
    radius_m: float | None
    deck_m: F32 | None  # a body below the mount, root's frame, where the URDF has none


def base_of(source: RobotSource, body: LinkBody, joints: tuple[Joint, ...], turns: bool) -> Base:
    """The base of a robot. InputError naming the key where it does not fit the URDF.

    The mount is the origin of the first joint that turns, lifts at 0; where the URDF has no base, that of the
    root link. A base that turns does so about the mount.
    """
    keys, wrong = source.keys.base, source.wrong
    T_root_joint, found = np.eye(4), list[F64]()
    for joint in joints:
        T_root_joint = T_root_joint @ joint.T_parent_child
        found.append(T_root_joint)
    first = next((k for k in range(int(turns), len(joints)) if joints[k].kind == "revolute"), 0)
    shoulder_m = found[first][:3, 3].copy()
    # Links of a base that turns are given in the frame of its joint.
    axis_m = found[0][:3, 3] if turns else np.zeros(3)
    points = np.concatenate([*body.parts_m, np.zeros((0, 3), np.float32)]) + axis_m
    lowest_m = float(points[:, 2].min(initial=0.0))
    # The origin of a mobile base's URDF lies on the floor.
    floor_m = 0.0 if abs(lowest_m) < _UNEVEN_M else lowest_m
    given = (keys.footprint_m, keys.radius_m, keys.height_m, keys.mount_m)
    if keys.pedestal or (given == (None,) * 4 and not turns and shoulder_m[2] - lowest_m < _OWN_BASE_M):
        return Base(np.eye(4), None, None, None, None)
    radius_m, outline = keys.radius_m, keys.footprint_m
    if radius_m is not None:
        ring = radius_m * unit_circle(_CORNERS)
    else:
        ring = np.zeros((0, 2)) if outline is None else np.array(outline)
    x, y = ring.T
    ring_m2 = float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2
    if len(ring) and (crosses_itself(ring) or ring_m2 < _LEAST_BASE_M2):
        raise wrong("base.footprint_m", "crosses itself or has no area", "Give the corners in order")
    area_m2 = ConvexHull(points[:, :2]).volume if len(points) > 2 else 0.0
    is_in_urdf = area_m2 > (_SHARE * ring_m2 if len(ring) else _LEAST_M2)
    mount_m = shoulder_m if is_in_urdf else np.zeros(3)
    if keys.mount_m is not None or turns:
        mount_m[:2] = keys.mount_m or (0.0, 0.0)
    height_m = float(mount_m[2]) - floor_m
    if not is_in_urdf and keys.height_m is None:
        raise wrong("base.height_m", "is missing: the URDF has no base below the arm", "Give it in metres")
    if is_in_urdf and keys.height_m is not None and abs(keys.height_m - height_m) > _WRONG_HEIGHT_M:
        problem = f"is {keys.height_m:g} m, and in the URDF the mount is {height_m:.3f} m above the floor"
        raise wrong("base.height_m", problem, "Correct or omit it")
    height_m = keys.height_m if keys.height_m is not None else round(height_m, 3)
    if outline is None and radius_m is None:
        if not is_in_urdf:
            raise wrong(
                "base.footprint_m", "is missing: the URDF has no base", "Give its corners around the mount"
            )
        outline = _outline(points[points[:, 2] < floor_m + max(height_m, _OWN_BASE_M)][:, :2] - mount_m[:2])
    if outline is not None:
        ring = np.array(outline)
        if not inside_polygon(np.zeros((1, 2)), ring)[0]:
            raise wrong(
                "base.footprint_m", "does not hold the mount, its origin", "Correct it, or base.mount_m"
            )
    deck: F32 | None = None
    if not is_in_urdf and height_m > 2 * _GAP_M:
        corners = prism_corners(ring + mount_m[:2], -height_m, min(lowest_m, 0.0) - _GAP_M)
        deck = (corners - axis_m).astype(np.float32)
    outer = BaseKeys(footprint_m=outline, radius_m=radius_m).outer_radius_m
    return Base(translation(*mount_m), height_m, outline, outer, deck)


def _outline(flat: F64) -> Outline:
    """The hull of points (N, 2), of at most `_CORNERS` corners, rounded outwards to millimetres."""
    hull = flat[ConvexHull(flat).vertices]
    if len(hull) > _CORNERS:
        normals = unit_circle(_CORNERS)
        far = (hull @ normals.T).max(axis=0)
        following = np.roll(normals, -1, axis=0)
        hull = np.array(
            [
                np.linalg.solve(np.stack([n, m]), [a, b])
                for n, m, a, b in zip(normals, following, far, np.roll(far, -1), strict=True)
            ]
        )
    rounded = np.sign(hull) * np.ceil(np.abs(hull) * 1000 - 1e-6) / 1000
    return tuple((float(x), float(y)) for x, y in rounded)
