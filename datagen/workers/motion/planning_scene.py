"""A scene and a robot, prepared for planning from any base pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from weakref import WeakKeyDictionary

import numpy as np

from datagen.schemas.specification import MotionParams
from datagen.workers.bases.clearance import STEP_M
from datagen.workers.content_cache import CacheFolder
from datagen.workers.geometry.mesh import F32, F64, transformed
from datagen.workers.grasps.grasp_cache import GraspSet, content_digest, file_digest
from datagen.workers.kinematics.compiler import code_folder, in_memory
from datagen.workers.kinematics.contacts import Parts, Still, hit_any, parts_of
from datagen.workers.kinematics.tree import Ints
from datagen.workers.motion.arm_model import TOUCH_M, arm_of, core_of, hand_of, on_pedestal
from datagen.workers.motion.arm_motion import Arm
from datagen.workers.motion.hand_motion import (
    FLOOR,
    OTHER,
    TARGET,
    Hand,
    Limits,
    Poses,
    Room,
    clear_poses,
    free_poses,
)
from datagen.workers.objects.model import ObjectModel
from datagen.workers.robots.gripper import Gripper
from datagen.workers.robots.robot import Robot
from datagen.workers.scenes import SettledScene

ROOM_AROUND_M = 0.25  # how far elbows and the hand reach out beyond the TCP
# Half the side of the cube of static parts, for arms that reach up to 1.25 m.
_AROUND_M = 3.0
# Largest distance of the hand or the lifted target from the target's middle, less pregrasp or lift.
_HAND_ROOM_M = 0.6
# Largest error of poses by inverse kinematics: 0.5 mm, and 0.5 degrees at the palm.
_IK_SLACK_M = 0.0015
# Distance that the hand keeps from everything but the target while it is at the grasp.
_HAND_MARGIN_M = 0.002
LINE_STEP_M = 0.02
# Penetration deeper than that of any settled object; settling allows 5 mm, by its own hulls.
_SUNK_M = 0.01
_LIFT_OFF_M = 0.01  # the target leaves its support within this rise
_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class HandScene:
    """A scene and a hand: the parts around the target, and its grasps that the hand without an arm can reach.

    It does not depend on the arm: all robots with the same hand share it. The K poses are those of the
    GraspSet at which the hand clears the target, each as it is and turned by half a turn about its approach.
    """

    T_world_target: F64  # (4, 4)
    room: Room
    hand: Hand
    grasps: GraspSet
    grasp: Ints  # (K,), row of `grasps`
    arrays: Poses
    poses: Poses  # the same in memory
    low_m: F64  # (F, 3), boxes of the room's parts
    high_m: F64
    first: int  # poses that are checked in every scene
    grasps_free: int  # of those that are checked in every scene
    opening_m: F64  # (O,), of the hand


@dataclass(frozen=True, eq=False)
class PlanningScene:
    """A scene and a robot, ready for `plan_candidate`."""

    robot: Robot
    params: MotionParams
    limits: Limits
    weight: F64  # (A,), radians that a unit of each coordinate counts as
    arm: Arm  # in memory, as are these limits
    compiled_limits: Limits
    around: HandScene


def prepare(
    scene: SettledScene,
    robot: Robot,
    grasps: GraspSet,
    params: MotionParams,
    per_scene: int,
    base_radius_m: float,
    draw: int = 0,
) -> PlanningScene:
    """Prepare a scene and a robot for planning, with the grasps that the hand can reach.

    The hand's motion is checked for the first `per_scene` grasps, and for others when a candidate needs them.
    `base_radius_m` is the radius of the pedestal of a robot that has no base of its own.
    """
    limits, arm = limits_of(params), arm_of(robot, draw)
    if robot.base_radius_m is None:
        arm = on_pedestal(arm, robot.base_height_m, base_radius_m)
    around_m = max(_AROUND_M, 2 * (robot.reach_m + ROOM_AROUND_M))
    known = _hand_scenes.setdefault(scene, {})
    key = (robot.gripper.digest, grasps, params, per_scene, around_m)
    if key not in known:
        known[key] = hand_scene(scene, robot.gripper, grasps, limits, per_scene, around_m)
    return PlanningScene(robot, params, limits, arm.weight, in_memory(arm), in_memory(limits), known[key])


# By scene, for as long as it lives. The key holds the GraspSet, so that its id is not used again.
_HandSceneKey = tuple[str, GraspSet, MotionParams, int, float]
_hand_scenes: WeakKeyDictionary[SettledScene, dict[_HandSceneKey, HandScene]] = WeakKeyDictionary()


def limits_of(params: MotionParams) -> Limits:
    """The compiled search's parameters."""
    return Limits(
        params.ik_seeds,
        params.pregrasp_m,
        params.lift_m,
        LINE_STEP_M,
        params.max_joint_jump_rad,
        params.check_step_rad,
        params.margin_m,
        _HAND_MARGIN_M,
        _IK_SLACK_M,
    )


def hand_scene(
    scene: SettledScene, gripper: Gripper, grasps: GraspSet, limits: Limits, per_scene: int, around_m: float
) -> HandScene:
    """Place the scene's parts up to `around_m` from the target, and check the first `per_scene` grasps.

    Where none of them is free, all are checked.
    """
    target, T_world_target = scene.models[0], scene.T_world_object[0]
    static, floor = _static_around(scene, around_m)
    bodies = zip(scene.models, scene.T_world_object, strict=True)
    objects = [[transformed(part, T) for part in model.convex_parts_m] for model, T in bodies]
    others = [part for parts in objects[1:] for part in parts]
    kinds = [int(FLOOR if f else OTHER) for f in floor]
    kinds += [int(TARGET)] * len(objects[0]) + [int(OTHER)] * len(others)
    still = still_of([*static, *objects[0], *others], kinds)
    # The hand is never farther from the target than this: the other parts need no check.
    center, room_m = scene.target_center_m, _HAND_ROOM_M + max(limits.pregrasp_m, limits.lift_m)
    near = np.flatnonzero(
        ((still.low_m < center + room_m) & (still.high_m > center - room_m)).all(axis=1)
        | (np.arange(len(kinds)) >= len(static))
    )
    room = in_memory(Room(still, near))
    hand, grasp, T_object_tcp, opening = _clear_poses(gripper, grasps, target, limits)
    first = int(np.searchsorted(grasp, per_scene))
    of_others = np.arange(len(static) + len(objects[0]), len(still.kind))
    of_static = near[near < len(static)]
    # A target that penetrates another object has no grasp, even where the hand is free.
    parts, T_target = in_memory(still), np.ascontiguousarray(T_world_target[None, None, :3])
    is_sunk = hit_any(_core(target, _SUNK_M), T_target, parts, of_others)
    if is_sunk or not _can_be_lifted(target, T_world_target, parts, of_static, limits.lift_m):
        grasp, T_object_tcp, opening, first = grasp[:0], T_object_tcp[:0], opening[:0], 0
    T_world_tcp = np.ascontiguousarray(np.matmul(T_world_target, T_object_tcp)[:, :3])
    poses = Poses.unknown(T_world_tcp, opening)
    poses.clears[:] = 1
    checked = (hand, room, in_memory(limits), in_memory(poses))
    if free_poses(*checked, 0, first) == 0:
        free_poses(*checked, first, len(grasp))
    free = len(np.unique(grasp[poses.is_free > 0]))
    opening_m = np.append(np.unique(grasps.opening_m.astype(np.float64)), gripper.max_opening_m)
    return HandScene(
        T_world_target,
        room,
        hand,
        grasps,
        grasp,
        poses,
        checked[-1],
        still.low_m,
        still.high_m,
        first,
        free,
        opening_m,
    )


_CLEAR = CacheFolder("clear-poses", most_files=4096)  # about 2 KB each
_clear: WeakKeyDictionary[GraspSet, dict[tuple[str, Limits], tuple[Hand, Ints, F64, Ints]]] = (
    WeakKeyDictionary()
)


def _clear_poses(
    gripper: Gripper, grasps: GraspSet, target: ObjectModel, limits: Limits
) -> tuple[Hand, Ints, F64, Ints]:
    """The hand at the grasps' openings; grasps (K,), poses (K, 4, 4) and openings (K,) that clear the target.

    Computed once per object, in its own frame, and cached: they do not depend on the scene.
    """
    known, key = _clear.setdefault(grasps, {}), (gripper.digest, limits)
    if key not in known:
        opening_m, rows = np.unique(grasps.opening_m.astype(np.float64), return_inverse=True)
        hand = in_memory(hand_of(gripper, opening_m))
        grasp = np.repeat(np.arange(len(grasps)), 2)
        T = np.repeat(grasps.T_object_tcp, 2, axis=0)
        T[1::2] = T[1::2] @ _HALF_TURN
        opening = rows[grasp].astype(np.int64)
        at = sha256(grasps.T_object_tcp.tobytes() + grasps.opening_m.tobytes()).hexdigest()
        place = file_digest([code_folder().name, content_digest(target, gripper), [*limits], at])
        if (stored := _CLEAR.load(place)) is None:
            still = still_of(target.convex_parts_m, [int(TARGET)] * len(target.convex_parts_m))
            room = in_memory(Room(still, np.arange(len(still.kind))))
            ok = clear_poses(hand, room, in_memory(limits), np.ascontiguousarray(T[:, :3]), opening)
            _CLEAR.store(place, stored := {"ok": ok})
        ok = stored["ok"]
        known[key] = (hand, grasp[ok], T[ok], opening[ok])
    return known[key]


_CORES = CacheFolder("cores", most_files=4096)  # about 10 KB each
_cores: WeakKeyDictionary[ObjectModel, dict[float, Parts]] = WeakKeyDictionary()


def _core(model: ObjectModel, depth_m: float) -> Parts:
    """What lies deeper than `depth_m` in an object's parts; computed once, and cached."""
    known = _cores.setdefault(model, {})
    if depth_m not in known:
        parts = [sha256(part.tobytes()).hexdigest() for part in model.convex_parts_m]
        place = file_digest([code_folder().name, depth_m, *parts])
        if (stored := _CORES.load(place)) is None:
            cores = [core_of(part, depth_m) for part in model.convex_parts_m]
            ends = np.cumsum([len(core) for core in cores])
            _CORES.store(place, stored := {"points_m": np.concatenate(cores), "ends": ends})
        known[depth_m] = in_memory(parts_of([np.split(stored["points_m"], stored["ends"][:-1].tolist())]))
    return known[depth_m]


def _can_be_lifted(
    target: ObjectModel, T_world_target: F64, still: Still, static: Ints, lift_m: float
) -> bool:
    """Whether the target, moved straight up, stays clear of the house.

    The check leaves out the first `_LIFT_OFF_M`, in which the target leaves its support, and the other
    objects, which it may push aside.
    """
    rises = np.linspace(0.0, lift_m, 1 + int(np.ceil(lift_m / LINE_STEP_M - 1e-9)))
    rises = rises[rises > _LIFT_OFF_M]
    T = np.repeat(T_world_target[None, None, :3], len(rises), axis=0)
    T[:, 0, 2, 3] += rises
    return not hit_any(_core(target, TOUCH_M), T, still, static)


def still_of(parts_m: Sequence[F32 | F64], kinds: Sequence[int]) -> Still:
    """Parts that do not move, each (V, 3)."""
    points = np.concatenate([np.zeros((0, 3)), *parts_m], dtype=np.float64)
    first = np.cumsum([0, *map(len, parts_m)])
    if len(parts_m) == 0:
        return Still(points, first, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64))
    low, high = (f.reduceat(points, first[:-1]) for f in (np.minimum, np.maximum))
    return Still(points, first, low, high, np.array(kinds, np.int64))


def _static_around(scene: SettledScene, around_m: float) -> tuple[list[F32], list[bool]]:
    """The house's parts within a cube around the target, and which of them a base can stand on."""
    center, house = scene.target_center_m, scene.house.house
    low_m, high_m = house.part_boxes_m
    near = ((low_m < center + around_m) & (high_m > center - around_m)).all(axis=1)
    rows = np.flatnonzero(near)
    return [house.parts_m[k] for k in rows.tolist()], (high_m[rows, 2] <= STEP_M).tolist()
