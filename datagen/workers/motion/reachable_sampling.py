"""Computation of reachable sets: once for a robot with its hand, then from the cache.

Random joint vectors mark the cells of their TCP. Joints that turn about the mount's vertical or slide along
it are not sampled: each sample marks all azimuths and heights to which they bring it, so that lifts and
turning bases cost no samples.
"""

from __future__ import annotations

import math
from functools import lru_cache
from hashlib import sha256

import numpy as np

from datagen.schemas.errors import InputError
from datagen.workers.content_cache import CacheFolder
from datagen.workers.geometry.mesh import F64
from datagen.workers.kinematics.compiler import compiled, in_memory
from datagen.workers.kinematics.inverse import joint_poses, one_turn, tcp_pose
from datagen.workers.kinematics.tree import Bools, KinematicTree
from datagen.workers.motion.reachable_set import AZIMUTHS, LEVELS, SECTORS, Bits, ReachableSet
from datagen.workers.robots import open_largest, robot_limits

VERSION = 1  # of the sets: candidates of runs follow from them
_CELLS_PER_REACH = 32
_SAMPLES, _AT_ONCE = 1 << 20, 1 << 16
_AT_LIMIT = 0.25  # share of each coordinate's samples that lie at a limit, where the set often ends
_CACHE = CacheFolder("reachable", 256)
_EDGE = 1e-6
_MOST_OF_A_TURN = 1.5 * np.pi


def reachable_set_of(name: str) -> ReachableSet:
    """The set of a robot, by its name or file. InputError as `open_robot`, and for a robot that is scaled."""
    low, high = robot_limits(name).reach_m
    if low < high:
        problem = f"is scaled to reaches from {low:g} to {high:g} m, each with a set of its own"
        raise InputError("candidates.in_range_by", name, problem, "Remove it, or choose another robot")
    robot = open_largest(name)
    return reachable_set(robot.tree, robot.shoulder_m, robot.reach_m)


def needs_set(name: str) -> bool:
    """Whether reach is more than a distance from the mount for a robot, by its name or file.

    A distance is right where an arm turns freely about the vertical through its mount, nothing slides, and
    the base faces the target. Scaled robots would need a set for each reach.
    """
    low, high = robot_limits(name).reach_m
    robot = open_largest(name)
    turn_rad = abs(_along_axis(robot.tree.along_z())[2])
    is_round = turn_rad >= _MOST_OF_A_TURN and not robot.slides.any() and robot.presents == "faces"
    return low == high and not is_round


def reachable_set(tree: KinematicTree, shoulder_m: F64, reach_m: float) -> ReachableSet:
    """The set of a tree's last frame, which is never farther than `reach_m` from `shoulder_m` (3,)."""
    tree = tree._replace(frame_joint=tree.frame_joint[-1:], T_joint_frame=tree.T_joint_frame[-1:]).along_z()
    fields = tuple((a.tobytes(), a.dtype.str, a.shape) for a in map(np.ascontiguousarray, tree))
    x, y, z = shoulder_m.tolist()
    return sampled_set(fields, math.hypot(x, y) + reach_m, z - reach_m, reach_m)


@lru_cache(maxsize=64)
def sampled_set(
    fields: tuple[tuple[bytes, str, tuple[int, ...]], ...], far_m: float, lowest_m: float, reach_m: float
) -> ReachableSet:
    """The set of a tree's fields: bytes, type, shape. No TCP is farther than `far_m` or below `lowest_m`."""
    cell_m = reach_m / _CELLS_PER_REACH
    shape = (math.ceil(far_m / cell_m + _EDGE), 2 * _CELLS_PER_REACH + 1, LEVELS * AZIMUTHS)
    key = sha256(repr((VERSION, fields, far_m, lowest_m, reach_m)).encode()).hexdigest()
    stored = (_CACHE.load(key) or {}).get("sectors")
    if stored is None or stored.shape != shape or stored.dtype != np.uint64:
        tree = KinematicTree(*(np.frombuffer(b, dtype).reshape(size).copy() for b, dtype, size in fields))
        stored = _sampled(tree, shape, cell_m, lowest_m)
        _CACHE.store(key, {"sectors": stored})
    return ReachableSet(stored.reshape(*shape[:2], LEVELS, AZIMUTHS), cell_m, lowest_m)


def _sampled(tree: KinematicTree, shape: tuple[int, int, int], cell_m: float, lowest_m: float) -> Bits:
    rng = np.random.Generator(np.random.PCG64(VERSION))
    held, lift_m, turn_rad = _along_axis(tree)
    low, high = np.transpose([one_turn(*limits) for limits in zip(tree.lower, tree.upper, strict=True)])
    at_limit = np.where(high - low < 2 * np.pi - _EDGE, _AT_LIMIT / 2, 0.0)
    # Coordinates that are not sampled stand at their lower limits.
    low, high = np.where(held, tree.lower, low), np.where(held, tree.lower, high)
    sectors = np.zeros(shape, np.uint64)
    for _ in range(_SAMPLES // _AT_ONCE):
        q = rng.uniform(low, high, (_AT_ONCE, len(low)))
        at_end = rng.random(q.shape)
        q = np.where(at_end < at_limit, low, np.where(at_end > 1 - at_limit, high, q))
        _mark(in_memory(tree), q, cell_m, lowest_m, *lift_m, turn_rad, sectors)
    return sectors


def _along_axis(tree: KinematicTree) -> tuple[Bools, tuple[float, float], float]:
    """The first joints that slide along the base's z axis or, one of them, turn about it.

    Returns their coordinates (A,), and where they bring the hand from their lower limits: the lowest and the
    highest (m), and how far around (rad), clockwise below 0.
    """
    T, held, low_m, high_m, turn_rad = np.eye(4), np.zeros(len(tree.lower), np.bool_), 0.0, 0.0, 0.0
    for j in reversed(tree.hand_joints()):
        T = T @ tree.T_parent_joint[j]
        z, k = float(T[2, 2]), int(tree.coordinate[j])
        if abs(z) < 1 - 1e-9 or np.count_nonzero(tree.coordinate == k) > 1:
            break
        range_ = float(tree.ratio[j] * (tree.upper[k] - tree.lower[k])) * math.copysign(1.0, z)
        if tree.slides[j]:
            low_m, high_m = low_m + min(range_, 0.0), high_m + max(range_, 0.0)
        elif turn_rad == 0.0 and np.abs(T[:2, 3]).max() < 1e-6:
            turn_rad = range_
        else:
            break
        held[k] = True
    return held, (low_m, high_m), turn_rad


@compiled
def _mark(
    tree: KinematicTree,
    q: F64,
    cell_m: float,
    lowest_m: float,
    low_m: float,
    high_m: float,
    turn_rad: float,
    out: Bits,
) -> None:
    """Mark the cells of the TCP at joint vectors (N, A), and those that lift and turn bring it to."""
    joints, T, root = np.empty((len(tree.parent), 3, 4)), np.empty((3, 4)), np.zeros((3, 4))
    root[0, 0] = root[1, 1] = root[2, 2] = 1.0
    rings, layers = out.shape[0], out.shape[1]
    for n in range(len(q)):
        joint_poses(tree, root, q[n], joints)
        tcp_pose(tree, root, joints, T)
        x, y, z = T[0, 3], T[1, 3], T[2, 3]
        ring = int(math.sqrt(x * x + y * y) / cell_m)
        first = int(math.floor((z + low_m - lowest_m) / cell_m))
        last = int(math.floor((z + high_m - lowest_m) / cell_m))
        azimuth = math.atan2(y, x)
        level = min(int((T[2, 2] + 1) / 2 * LEVELS), LEVELS - 1)
        ahead = (math.atan2(T[1, 2], T[0, 2]) - azimuth) / (2 * math.pi)
        part = level * AZIMUTHS + min(int((ahead - math.floor(ahead)) * AZIMUTHS), AZIMUTHS - 1)
        a, b = azimuth, azimuth + turn_rad
        start = int(math.floor(min(a, b) / (2 * math.pi) * SECTORS))
        end = min(int(math.floor(max(a, b) / (2 * math.pi) * SECTORS)), start + SECTORS - 1)
        bits = np.uint64(0)
        for s in range(start, end + 1):
            bits |= np.uint64(1) << np.uint64(s % SECTORS)
        if ring >= rings:
            continue
        for layer in range(max(first, 0), min(last, layers - 1) + 1):
            out[ring, layer, part] |= bits
