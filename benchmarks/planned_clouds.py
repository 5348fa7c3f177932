"""Picks of a planner that sees only the stored cloud, beside the model's, as a table.

    python -m benchmarks.planned_clouds RUN... [--checkpoint CKPT] [--scenes 100]

What a robot without a model could do: take the points of one view as obstacles, lay grasps at the target
(`hand_poses`, with the target's back mirrored), and plan from every clear candidate within reach. What the
view does not show is free. Of the candidates with a plan it picks the one nearest to 0.75 of the reach, or
the one whose path keeps the largest distance. Rows are percent of scenes of a run of whole grids whose pick
is good, of those with a good cell and of the decisive ones; AUC and balanced accuracy are of all candidates
asked.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from datagen.schemas.run import Run
from datagen.schemas.specification import DECISIVE_SHARES, Specification
from datagen.train.dataset import SampleStream
from datagen.train.hands.poses import N_MEASURES, hand_poses
from datagen.train.hands.sizes import hand_size
from datagen.train.inputs import F32, F64, Array, Batch, Bools, is_clear
from datagen.train.metrics import area_under_roc
from datagen.train.prediction import load_scorer
from datagen.workers.geometry.transforms import yaw_pose
from datagen.workers.grasps.grasp_cache import GraspSet
from datagen.workers.kinematics.compiler import in_memory
from datagen.workers.motion.arm_model import arm_of, hand_of, on_pedestal
from datagen.workers.motion.hand_motion import FLOOR, OTHER, TARGET, Poses, Room, free_poses
from datagen.workers.motion.plan_candidate import plan_candidate
from datagen.workers.motion.planning_scene import HandScene, PlanningScene, limits_of, still_of
from datagen.workers.robots import open_robot
from datagen.workers.robots.robot import Robot

_POSES = 104  # all directions of `hand_poses`
_NEAR_M, _FINE_M, _COARSE_M = 0.3, 0.02, 0.05  # boxes around the target, and farther away
_FLOOR_M = 0.03  # points below are floor
_SHARE = 0.75  # of the reach


@dataclass(frozen=True, eq=False)
class Asked:
    """The N clear candidates within reach of one scene."""

    label: Bools  # (N,)
    score: F64  # (N,), the model's
    share: F64  # (N,), mount distance by reach
    clearance_m: F64  # (N,), of the plan's path; nan without a plan

    @property
    def planned(self) -> Bools:
        return ~np.isnan(self.clearance_m)


def main() -> None:
    """Plan and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="RUN")
    parser.add_argument("--checkpoint")
    parser.add_argument("--scenes", type=int, default=100)
    options = parser.parse_args()
    for run in options.runs:
        start_s = time.process_time()
        asked = list(_asked(run, options.checkpoint, options.scenes))
        _print(run, asked, time.process_time() - start_s)


def _asked(run: str, checkpoint: str | None, most: int) -> Iterator[Asked]:
    scorer, spec = load_scorer(checkpoint), Run.open(run).manifest.spec
    assert spec.arm is not None, f"{run} has no arm"
    more = ("base_is_clear", "mount_distance_m")
    stream = SampleStream([run], scenes_per_batch=8, shuffle=False, extra=more, allow_incomplete=False)
    found = 0
    for batch in stream.epoch(0):
        score, owner = scorer.score(batch), batch.robots.cloud_row[batch.candidates.robot_row]
        near = is_clear(batch) & (batch.extra["mount_distance_m"] <= _reach_m(batch))
        for k in range(len(batch.clouds)):
            rows = np.flatnonzero(near & (owner == k))
            if found < most and batch.label[rows].any():
                found += 1
                share = batch.extra["mount_distance_m"][rows] / _reach_m(batch)[rows]
                clearance_m = _planned(batch, k, rows, spec)
                yield Asked(batch.label[rows] == 1, score[rows].astype(np.float64), share, clearance_m)


def _reach_m(batch: Batch[Array]) -> F32:
    return batch.robots.arm_reach_m[batch.candidates.robot_row]


def _planned(batch: Batch[Array], k: int, rows: Array, spec: Specification) -> F64:
    """Clearances (N,) of the plans from candidates `rows` in the points of cloud `k`, nan without a plan."""
    assert spec.arm is not None
    robots, clouds = batch.robots, batch.clouds
    name, at = spec.arm.robot_key, int(batch.candidates.robot_row[rows[0]])
    reach_m, mount_m = float(robots.arm_reach_m[at]), float(robots.base_height_m[at])
    robot, floor_m = open_robot(name, reach_m, mount_m), -float(clouds.target_height_m[k])
    points, mask = (a[k, : clouds.n_points[k]] for a in (clouds.points_m, clouds.target_mask))
    limits, arm = limits_of(spec.arm.motion), arm_of(robot)
    if robot.base_radius_m is None:
        arm = on_pedestal(arm, mount_m, float(spec.candidates.radius_of_base_m(reach_m)))
    around = seen_world(points[~mask], points[mask], robot, name, floor_m, spec)
    scene = PlanningScene(
        robot, spec.arm.motion, limits, arm.weight, in_memory(arm), in_memory(limits), around
    )
    found = np.full(len(rows), np.nan)
    turn = batch.candidates.turn_rad
    for n, row in enumerate(rows.tolist()):
        x, y = (float(v) for v in batch.candidates.base_xy_m[row])
        yaw = float(np.arctan2(-y, -x)) + (0.0 if turn is None else float(turn[row]))
        pose = yaw_pose(x, y, mount_m + floor_m, yaw)
        plan = plan_candidate(scene, pose, np.random.default_rng([k, row])).plan
        found[n] = np.nan if plan is None else plan.clearance_m
    return found


def seen_world(
    others_m: F32, target_m: F32, robot: Robot, name: str, floor_m: float, spec: Specification
) -> HandScene:
    """The points of one view as obstacles, and grasps at the target's; all in the target's frame."""
    assert spec.arm is not None
    gripper, limits = robot.gripper, limits_of(spec.arm.motion)
    laid = hand_poses(others_m, target_m, _POSES, hand_size(name)).astype(np.float64)
    laid = laid[np.abs(laid[:, N_MEASURES:]).any(axis=1)]
    tcp, approach, closing = laid[:, N_MEASURES:].reshape(-1, 3, 3).swapaxes(0, 1)
    T = np.stack([np.cross(closing, approach), closing, approach, tcp], axis=2).repeat(2, axis=0)
    T[1::2, :, :2] *= -1  # each turned by half a turn about its approach
    grasp = np.arange(len(laid)).repeat(2)
    opening_m, rows = np.unique(
        np.round(laid[:, 2] / 10, 3).clip(0, gripper.max_opening_m), return_inverse=True
    )
    hand = in_memory(hand_of(gripper, opening_m))
    parts = _boxes(others_m[others_m[:, 2] > floor_m + _FLOOR_M].astype(np.float64))
    ground = _corners(np.array([[-5.0, -5.0, floor_m - 0.1], [5.0, 5.0, floor_m]]))
    still = still_of([*parts, ground, _hull(target_m)], [int(OTHER)] * len(parts) + [int(FLOOR), int(TARGET)])
    room = in_memory(Room(still, np.arange(len(still.kind))))
    poses = Poses.unknown(np.ascontiguousarray(T), rows.ravel()[grasp].astype(np.int64))
    poses.clears[:] = 1
    checked = in_memory(poses)
    free_poses(hand, room, in_memory(limits), checked, 0, len(grasp))
    one = np.ones(len(laid), np.float32)
    grasps = GraspSet(np.tile(np.eye(4), (len(laid), 1, 1)), one, one, pose_score=lambda T, opening_m: 1.0)
    free = int((poses.is_free > 0).sum())
    own = (grasps, grasp, poses, checked, still.low_m, still.high_m, len(grasp), free)
    return HandScene(np.eye(4), room, hand, *own, np.append(opening_m, gripper.max_opening_m))


def _boxes(points_m: F64) -> list[F64]:
    """Corners (8, 3) of the bounds of the points in each cell of a grid, finer near the origin."""
    is_near, found = np.linalg.norm(points_m, axis=1) < _NEAR_M, list[F64]()
    for some, cell_m in ((points_m[is_near], _FINE_M), (points_m[~is_near], _COARSE_M)):
        _, cell = np.unique(np.floor(some / cell_m), axis=0, return_inverse=True)
        order = np.argsort(cell.ravel(), kind="stable")
        first = np.flatnonzero(np.diff(cell.ravel()[order], prepend=-1))
        if len(first):
            low, high = (f.reduceat(some[order], first) for f in (np.minimum, np.maximum))
            found += [_corners(box) for box in np.stack([low - 0.002, high + 0.002], axis=1)]
    return found


def _corners(box: F64) -> F64:
    return np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)


def _hull(target_m: F32) -> F64:
    whole = np.concatenate([target_m, target_m * [-1, -1, 1]]).astype(np.float64)
    try:
        return whole[ConvexHull(whole).vertices]
    except QhullError:  # flat
        return whole[:4]


def _print(run: str, asked: list[Asked], cpu_s: float) -> None:
    label, score, planned, share = (
        np.concatenate([getattr(each, name) for each in asked])
        for name in ("label", "score", "planned", "share")
    )
    decisive = [each for each in asked if DECISIVE_SHARES[0] <= each.label.mean() <= DECISIVE_SHARES[1]]
    n, off = len(label), np.abs(share - _SHARE)
    print(f"{run}: {n:,} candidates of {len(asked)} scenes, of which {len(decisive)} are decisive")
    print(
        f"good: {100 * label.mean():.1f}%; {100 * label[planned].mean():.1f}% of the {planned.sum():,}",
        end=" ",
    )
    print(f"with a plan, {100 * label[~planned].mean():.1f}% of the others")
    print(f"{1000 * cpu_s / n:.1f} CPU ms a candidate")
    for name, value, yes in (("model", score, score >= 0.5), ("planned", planned - 0.1 * off, planned)):
        balanced = (yes[label].mean() + (~yes)[~label].mean()) / 2
        print(f"{name}: AUC {100 * area_under_roc(label, value):.1f}, balanced {100 * balanced:.1f}")
    print("\n| pick | all | decisive |\n| --- | --- | --- |")
    for name, rank in (
        ("nearest to 0.75 of the reach", lambda a: -np.abs(a.share - _SHARE)),
        ("planned, nearest to 0.75", lambda a: a.planned - np.abs(a.share - _SHARE)),
        ("planned, largest clearance", lambda a: np.nan_to_num(a.clearance_m, nan=-1.0)),
        ("model", lambda a: a.score),
        ("model, of the planned", lambda a: a.planned + a.score),
    ):
        good = ([bool(a.label[np.argmax(rank(a))]) for a in scenes] for scenes in (asked, decisive))
        print(f"| {name} | " + " | ".join(f"{100 * np.mean(g):.1f}" for g in good) + " |")
    print()


if __name__ == "__main__":
    main()
