"""A scene and a robot, prepared for planning from any base pose."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from datagen.schemas.specification import MotionParams
from datagen.workers.bases.clearance import STEP_M
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.transforms import yaw_pose
from datagen.workers.grasps.grasp_cache import GraspSet
from datagen.workers.houses.house import House
from datagen.workers.motion.collision import (
    Bools,
    Hulls,
    Ints,
    Placed,
    hits,
    hulls_of,
    joined,
    object_hulls,
    place,
    place_object,
)
from datagen.workers.motion.forward_kinematics import Kinematics, forward_kinematics
from datagen.workers.motion.grasp_filter import Hand, can_be_lifted, free_grasps, hand_of
from datagen.workers.motion.reach_table import ReachTable, reach_table
from datagen.workers.objects.model import ObjectModel
from datagen.workers.robots.robot import Robot
from datagen.workers.scenes import SettledScene

_PEDESTAL_SIDES = 16
_PEDESTAL_GAP_M = 0.02  # between the pedestal's top and the mount
ROOM_AROUND_M = 0.25  # how far elbows and the hand reach out beyond the TCP
# Penetration deeper than that of any settled object; settling allows 5 mm, by its own hulls.
_SUNK_M = 0.01
# Half the side of the cube of static parts, for arms that reach up to 1.25 m.
_AROUND_M = 3.0
# Largest distance of the hand or the lifted target from the target's middle, less pregrasp or lift.
_HAND_ROOM_M = 0.6
_MOVINGS_KEPT = 128
_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
_NOTHING = place([])


@dataclass(frozen=True, eq=False)
class Moving:
    """A robot's shape for planning, built once per robot.

    Owners of `arm` and `fixed` are the frames of `kinematics`. Neither contains the hand: `hand` has it, with
    its fingers as far apart as each grasp needs.
    """

    kinematics: Kinematics
    fixed: Hulls  # the links that no joint moves
    arm: Hulls  # the others
    arm_depth: Ints  # (P,), number of joints that move each part of `arm`
    stands: Bools  # (P,), parts of a base that turns on the floor
    hand: Hand
    table: ReachTable


class FreePoses:
    """Whether each of N poses is free; each is checked on first use."""

    def __init__(self, count: int, check: Callable[[Ints], Bools]) -> None:
        self._state = np.zeros(count, np.int8)  # 1 free, -1 not, 0 not known
        self._check = check

    def __call__(self, rows: Ints) -> Bools:
        """Whether the poses of some rows are free."""
        new = rows[self._state[rows] == 0]
        if len(new):
            self._state[new] = np.where(self._check(new), 1, -1)
        return self._state[rows] == 1


@dataclass(frozen=True, eq=False)
class HandScene:
    """A scene and a hand: the parts around the target, and its grasps that the hand without an arm can reach.

    It does not depend on the arm: all robots with the same hand share it. The K poses are those of the
    GraspSet, each as it is and turned by half a turn about its approach.
    """

    hand: Hand
    T_world_target: F64  # (4, 4)
    static: Placed  # convex parts of the house around the target
    near: Placed  # those that the hand can touch, and the other objects
    floor: Bools  # which static parts are low enough for a base to stand on
    objects: Placed  # the target's parts, then those of the other objects
    target_parts: int
    grasps: GraspSet
    grasp: Ints  # (K,), row of `grasps`
    T_world_tcp: F64  # (K, 4, 4)
    opening_m: F64  # (K,)
    is_free: FreePoses
    kept: Ints  # rows of the free poses among the grasps that are checked in every scene
    rest: Ints  # rows of the poses of all other grasps, checked on first use
    grasps_free: int  # grasps of `kept`


@dataclass(frozen=True, eq=False)
class PlanningScene:
    """A scene and a robot, ready for `plan_candidate`."""

    robot: Robot
    params: MotionParams
    moving: Moving
    around: HandScene
    pedestal_m: F32 | None  # corners of its convex body in the base frame

    @property
    def grasps_free(self) -> int:
        """Number of grasps of the target that the hand without an arm can reach."""
        return self.around.grasps_free


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
    around = _hand_scene(scene, robot, grasps, params, per_scene)
    pedestal_m = _pedestal_m(robot, base_radius_m) if robot.base_radius_m is None else None
    return PlanningScene(robot, params, moving_of(robot, draw), around, pedestal_m)


# By scene, for as long as it lives. The key holds the GraspSet, so that its id is not used again.
_HandSceneKey = tuple[str, GraspSet, MotionParams, int, float]
_hand_scenes: WeakKeyDictionary[SettledScene, dict[_HandSceneKey, HandScene]] = WeakKeyDictionary()


def _hand_scene(
    scene: SettledScene, robot: Robot, grasps: GraspSet, params: MotionParams, per_scene: int
) -> HandScene:
    around_m = max(_AROUND_M, 2 * (robot.reach_m + ROOM_AROUND_M))
    known = _hand_scenes.setdefault(scene, {})
    key = (robot.gripper.digest, grasps, params, per_scene, around_m)
    if key not in known:
        known[key] = hand_scene(scene, hand_of(robot.gripper), grasps, params, per_scene, around_m)
    return known[key]


def hand_scene(
    scene: SettledScene, hand: Hand, grasps: GraspSet, params: MotionParams, per_scene: int, around_m: float
) -> HandScene:
    """Place the scene's parts up to `around_m` from the target, and check the first `per_scene` grasps.

    Where none of them is free, all are checked.
    """
    target, T_world_target = scene.models[0], scene.T_world_object[0]
    static, floor = _static_around(scene, around_m)
    placed_target = place_object(target, T_world_target)
    others = [place_object(m, T) for m, T in zip(scene.models[1:], scene.T_world_object[1:], strict=True)]
    # The hand is never farther from the target than this: the other parts need no check.
    center, room_m = scene.target_center_m, _HAND_ROOM_M + max(params.pregrasp_m, params.lift_m)
    near = static.rows(static.within(center - room_m, center + room_m))
    around = joined([near, *others])
    hulls = object_hulls(target)
    # A target that penetrates another object has no grasp, even where the hand is free.
    is_sunk = (
        bool(hits(hulls, T_world_target[None, None], joined(others), -_SUNK_M).any()) if others else False
    )
    turned = _turned_grasps(hand, grasps, target, params)
    T_world_tcp = np.matmul(T_world_target, turned.T_object_tcp)

    def check(rows: Ints) -> Bools:
        free = turned.is_free(rows)
        some = rows[free]
        free[free] = free_grasps(hand, T_world_tcp[some], turned.opening_m[some], around, _NOTHING, params)
        return free

    is_free = FreePoses(len(T_world_tcp), check)
    every = np.arange(len(T_world_tcp))
    if is_sunk or not can_be_lifted(hulls, T_world_target, near, params.lift_m):
        every = every[:0]
    first, rest = every[: 2 * per_scene], every[2 * per_scene :]
    kept = first[is_free(first)]
    if len(kept) == 0:
        kept, rest = rest[is_free(rest)], rest[:0]
    return HandScene(
        hand,
        T_world_target,
        static,
        around,
        floor,
        joined([placed_target, *others]),
        len(placed_target),
        grasps,
        turned.grasp,
        T_world_tcp,
        turned.opening_m,
        is_free,
        kept,
        rest,
        len(np.unique(turned.grasp[kept])),
    )


@dataclass(frozen=True, eq=False)
class _TurnedGrasps:
    """Poses of a GraspSet, each as it is and turned by half a turn; free where the hand clears the target."""

    grasp: Ints  # (K,)
    T_object_tcp: F64  # (K, 4, 4)
    opening_m: F64  # (K,)
    is_free: FreePoses


_turned: WeakKeyDictionary[GraspSet, dict[tuple[str, MotionParams], _TurnedGrasps]] = WeakKeyDictionary()


def _turned_grasps(hand: Hand, grasps: GraspSet, target: ObjectModel, params: MotionParams) -> _TurnedGrasps:
    """Poses of the target's grasps, built once per object: they do not depend on the scene."""
    known, key = _turned.setdefault(grasps, {}), (hand.digest, params)
    if key not in known:
        grasp = np.repeat(np.arange(len(grasps)), 2)
        T = np.repeat(grasps.T_object_tcp, 2, axis=0)
        T[1::2] = T[1::2] @ _HALF_TURN
        opening_m = grasps.opening_m[grasp].astype(np.float64)
        placed = place_object(target, np.eye(4))

        def check(rows: Ints) -> Bools:
            return free_grasps(hand, T[rows], opening_m[rows], _NOTHING, placed, params)

        known[key] = _TurnedGrasps(grasp, T, opening_m, FreePoses(len(T), check))
    return known[key]


def moving_of(robot: Robot, draw: int = 0) -> Moving:
    """The robot's kinematics, shape and reach table; built once for all mount heights of an arm."""
    # Copies of an arm at other heights share their parts. The stored robot keeps the id of its parts in use.
    key = (id(robot.link_parts_m), draw)
    if key in _movings:
        _movings.move_to_end(key)
        return _movings[key][1]
    kinematics = forward_kinematics(robot)
    hulls = hulls_of(robot.link_parts_m[: robot.first_hand_link])
    depth = kinematics.depth[hulls.owner]
    moving = Moving(
        kinematics,
        hulls.rows(np.flatnonzero(depth == 0)),
        hulls.rows(np.flatnonzero(depth > 0)),
        depth[depth > 0],
        robot.is_base[hulls.owner][depth > 0],
        hand_of(robot.gripper),
        reach_table(robot, kinematics, draw),
    )
    _movings[key] = (robot, moving)
    if len(_movings) > _MOVINGS_KEPT:
        _movings.popitem(last=False)
    return moving


_movings: OrderedDict[tuple[int, int], tuple[Robot, Moving]] = OrderedDict()


def pose_of_base(base_xy_m: F64, base_height_m: float, target_center_m: F64) -> F64:
    """World pose (4, 4) of the arm's mount at a base position (2,), its x axis turned to the target."""
    dx, dy = target_center_m[0] - base_xy_m[0], target_center_m[1] - base_xy_m[1]
    return yaw_pose(float(base_xy_m[0]), float(base_xy_m[1]), base_height_m, float(np.arctan2(dy, dx)))


def _static_around(scene: SettledScene, around_m: float) -> tuple[Placed, Bools]:
    """The house's parts within a cube around the target, and which of them a base can stand on."""
    center = scene.target_center_m
    parts, low_m, high_m = _house_parts(scene.house.house)
    near = ((low_m < center + around_m) & (high_m > center - around_m)).all(axis=1)
    parts = [parts[k] for k in np.flatnonzero(near).tolist()]
    static = place(parts)
    return static, static.high_m[:, 2] <= STEP_M


_parts_of_houses: WeakKeyDictionary[House, tuple[list[F32], F32, F32]] = WeakKeyDictionary()


def _house_parts(house: House) -> tuple[list[F32], F32, F32]:
    """All convex parts of a house with their boxes, (P, 3) each."""
    if house not in _parts_of_houses:
        parts = [part for body in house.bodies for part in body.convex_parts_m]
        corners = np.concatenate(parts)
        first = np.cumsum([0, *map(len, parts[:-1])])
        low, high = (f.reduceat(corners, first) for f in (np.minimum, np.maximum))
        _parts_of_houses[house] = (parts, low, high)
    return _parts_of_houses[house]


def _pedestal_m(robot: Robot, radius_m: float) -> F32 | None:
    """Corners (32, 3), base frame, of a prism from the floor to just below the mount."""
    top_m, bottom_m = -_PEDESTAL_GAP_M, -robot.base_height_m
    if top_m <= bottom_m or radius_m <= 0:
        return None
    angles = 2 * np.pi * np.arange(_PEDESTAL_SIDES) / _PEDESTAL_SIDES
    ring = radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rows = [np.column_stack([ring, np.full(_PEDESTAL_SIDES, z)]) for z in (bottom_m, top_m)]
    return np.concatenate(rows).astype(np.float32)
