"""The largest distance that a point of an arm can have from where it is measured."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256

import numpy as np

from datagen.workers.content_cache import CacheFolder, version_of
from datagen.workers.geometry.mesh import F64, transformed
from datagen.workers.kinematics.tree import KinematicTree, frame_poses

_STARTS = 32
_SWEEPS = 200
_SETTLED_M = 1e-9
_REACHES = CacheFolder("reaches", most_files=4096)  # less than 1 KB each


@dataclass(frozen=True, eq=False)
class Chain:
    """Revolute joints from a base to a point, the TCP."""

    T_parent_joint: F64  # (A, 4, 4), joint frames at zero in the frame before
    axis: F64  # (A, 3), unit, joint frame
    lower_rad: F64  # (A,)
    upper_rad: F64  # (A,)
    tcp_m: F64  # (3,), in the last joint's frame


def largest_reach_m(chain: Chain) -> float:
    """The largest distance from the first joint's origin to the TCP within the limits, metres.

    Coordinate ascent from 32 fixed starts. Turning one joint alone moves the TCP on a circle, and its
    squared distance to any fixed point is a + b cos(q - c), so each step is exact.
    """
    parts = (chain.T_parent_joint, chain.axis, chain.lower_rad, chain.upper_rad, chain.tcp_m)
    return _largest_reach_m(*(part.tobytes() for part in parts))


# Scaled arms need the same chains again: the bounds of the search for their scale, and its result.
@lru_cache(maxsize=256)
def _largest_reach_m(*parts: bytes) -> float:
    """That of a chain's arrays, computed once on a machine."""
    key = f"{sha256(b'-'.join(parts)).hexdigest()}-{version_of('numpy')}"
    stored = _REACHES.computed(key, lambda: {"reach_m": np.array(_ascended_m(*parts))})
    return float(stored["reach_m"])


def _ascended_m(*parts: bytes) -> float:
    T, axes, lower_rad, upper_rad, tcp_m = map(np.frombuffer, parts)
    chain = Chain(T.reshape(-1, 4, 4), axes.reshape(-1, 3), lower_rad, upper_rad, tcp_m)
    count = len(chain.axis)
    rng = np.random.Generator(np.random.PCG64(0))
    lower, upper = np.maximum(chain.lower_rad, -np.pi), np.minimum(chain.upper_rad, np.pi)
    q = rng.uniform(lower, upper, (_STARTS, count))  # (S, A)
    best = np.zeros(_STARTS)
    cross = [_cross_matrix(axis) for axis in chain.axis]
    for _ in range(_SWEEPS):
        # The TCP in each joint's own frame, before that joint turns: (S, 3) for every joint.
        points = [np.broadcast_to(chain.tcp_m, (_STARTS, 3))]
        for k in range(count - 1, 0, -1):
            turned = _turned(points[-1], chain.axis[k], cross[k], q[:, k])
            points.append(transformed(turned, chain.T_parent_joint[k]))
        points.reverse()
        shoulder = np.zeros((_STARTS, 3))  # in the frame of joint k, after it has turned
        for k in range(1, count):
            T = chain.T_parent_joint[k]
            seen = (shoulder - T[:3, 3]) @ T[:3, :3]  # in the frame of joint k before it turns
            axis, tcp = chain.axis[k], points[k]
            flat = tcp - (tcp @ axis)[:, None] * axis
            b = np.sum(flat * seen, axis=1)
            c = np.sum(flat @ cross[k] * seen, axis=1)
            # Distance^2 = const - 2 (b cos q + c sin q): largest opposite to the angle of (b, c).
            free = np.arctan2(-c, -b)
            ends = np.stack([np.full(_STARTS, lower[k]), np.full(_STARTS, upper[k])])
            near = [-(b * np.cos(e) + c * np.sin(e)) for e in ends]
            bound = np.where(near[0] >= near[1], lower[k], upper[k])
            q[:, k] = np.where((free >= lower[k]) & (free <= upper[k]), free, bound)
            shoulder = _turned(seen, axis, cross[k], -q[:, k])
        distance = np.linalg.norm(shoulder - chain.tcp_m, axis=1)
        if np.max(distance - best) < _SETTLED_M:
            break
        best = np.maximum(best, distance)
    return float(best.max())


def _turned(points: F64, axis: F64, cross: F64, angle_rad: F64) -> F64:
    """Points (S, 3) turned about an axis by an angle each (Rodrigues' formula)."""
    c, s = np.cos(angle_rad)[:, None], np.sin(angle_rad)[:, None]
    return points * c + points @ cross * s + (points @ axis)[:, None] * axis * (1 - c)


def _cross_matrix(axis: F64) -> F64:
    """(3, 3) that turns rows p into axis x p by p @ M."""
    x, y, z = axis
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])


_LOOKED_AT, _VALUES, _ROUNDS = 4096, 17, 12


def farthest_m(tree: KinematicTree, centre_m: F64) -> float:
    """The largest distance of the TCP from a point (3,) in the base frame, metres.

    For trees of any joints: coordinate ascent from the farthest of random positions over ever finer values.
    """
    rng = np.random.Generator(np.random.PCG64(0))

    def far(q: F64) -> F64:
        return np.linalg.norm(frame_poses(tree, q, tcp_only=True)[:, 0, :3, 3] - centre_m, axis=1)

    q = rng.uniform(tree.lower, tree.upper, (_LOOKED_AT, len(tree.lower)))
    q = q[np.argsort(-far(q))[:_STARTS]]
    width = tree.upper - tree.lower
    for _ in range(_ROUNDS):
        for k in range(q.shape[1]):
            tried = np.repeat(q[:, None], _VALUES, axis=1)
            tried[..., k] += width[k] * np.linspace(-1.0, 1.0, _VALUES)
            tried = np.clip(tried, tree.lower, tree.upper)
            best = far(tried.reshape(-1, q.shape[1])).reshape(_STARTS, _VALUES).argmax(axis=1)
            q = tried[np.arange(_STARTS), best]
        width = width / 2
    return float(far(q).max())
