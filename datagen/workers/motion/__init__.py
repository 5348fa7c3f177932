"""Motion planning of an arm to a grasp, without physics."""

from __future__ import annotations

from dataclasses import dataclass

from datagen.workers.geometry.mesh import F64


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """Joint paths from a tucked pose to a lifted object. Neighbouring rows are joined by straight lines."""

    grasp: int  # row of the scene's GraspSet, or -1 for a pose near one of its grasps
    home: int  # row of the robot's homes_rad
    q_reach_rad: F64  # (M, A), home to pregrasp
    q_approach_rad: F64  # (K, A), pregrasp to grasp, along a straight line of the TCP
    q_lift_rad: F64  # (J, A), grasp to lifted, straight up
    opening_m: float
    length_rad: float  # reach and approach, Euclidean in joint space
    clearance_m: float  # smallest distance of arm and scene over q_reach_rad
    grasp_score: float  # share of floating-hand pulls that held


@dataclass(frozen=True, eq=False)
class PlanReport:
    """`outcome` is a key of OUTCOMES: success with a plan, or the cause of the try that came furthest."""

    outcome: str
    plan: MotionPlan | None
    grasps_free: int  # grasps of the target that the hand without an arm can reach in this scene
    grasps_tried: int  # those for which IK was tried, and poses near them
