"""The interface of robots for planner and physics: an arm on a mount, with a parallel gripper."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from datagen.workers.geometry.mesh import F32, F64, Mesh

Parts = tuple[F32, ...]  # convex parts, each (V, 3)
_Y = np.array([0.0, 1.0, 0.0], np.float32)


@dataclass(frozen=True, eq=False)
class Gripper:
    """A parallel gripper in its TCP frame.

    The origin lies between the pads' centres, z is the direction of approach, out of the palm, and
    the fingers close along y. Finger 0 is on the side of +y, finger 1 on that of -y; both move by
    half the opening.
    """

    name: str
    digest: str  # of all that follows: grasps are kept by it
    max_opening_m: float
    pad_size_m: tuple[float, float]  # of the rubber that touches: along x and along z
    palm_depth_m: float  # from the TCP back to the palm's surface, along -z
    palm_parts_m: Parts  # TCP frame
    finger_parts_m: tuple[Parts, Parts]  # TCP frame, fingers closed (opening 0)

    def parts_at(self, opening_m: float) -> Parts:
        """All convex parts of the hand, TCP frame, with the pads `opening_m` apart."""
        shift: F32 = (_Y * (opening_m / 2)).astype(np.float32)
        left, right = self.finger_parts_m
        return (*self.palm_parts_m, *(p + shift for p in left), *(p - shift for p in right))


class Robot(Protocol):
    """A robot at one mount height. A joints move the arm; L links carry its shape.

    Base frame: the arm's mount, at (x, y, base_height_m) in the world, z up, x to the front. Equal
    arguments of `open_robot` give equal numbers on every machine of one platform.
    """

    name: str  # as the registry and the specification name it
    reach_m: float  # largest distance from the first joint that moves the TCP to the TCP
    shoulder_m: F64  # (3,), base frame: the point that reach_m is measured from; no TCP is ever farther
    base_height_m: float
    base_radius_m: float | None  # footprint of its own mobile base; None stands on a pedestal
    gripper: Gripper
    T_base_root: F64  # (4, 4), pose of the URDF's root link in the base frame
    joint_names: tuple[str, ...]  # (A,) of the arm, from the base on
    finger_joint_names: tuple[str, str]
    q_lower_rad: F64  # (A,)
    q_upper_rad: F64  # (A,)
    speed_limit_radps: F64  # (A,)
    homes_rad: F64  # (H, A), tucked, free of self-collision
    stiffness: float  # drives of the arm, as ManiSkill's agent has them
    damping: float
    force_limit_n: float
    link_names: tuple[str, ...]  # (L,)
    link_parts_m: tuple[Parts, ...]  # (L,) convex parts in link frames, fingers fully open
    self_pairs: tuple[tuple[int, int], ...]  # pairs of links that must not touch

    @property
    def urdf(self) -> Path:
        """For physics engines, with paths of meshes that resolve.

        The files are written when asked for and stay for an hour at least: read them soon, and ask again.
        """
        ...

    def T_base_link(self, q_rad: F64) -> F64:
        """Poses (L, 4, 4) of the links at the joints (A,)."""
        ...

    def T_base_tcp(self, q_rad: F64) -> F64:
        """Pose (4, 4) of the gripper's TCP at the joints (A,)."""
        ...

    def ik(self, T_base_tcp: F64, q_seed_rad: F64) -> F64 | None:
        """Joints (A,) within the limits that put the TCP at the pose (0.5 mm, 0.5 degrees), or None.

        Damped least squares from the seed, bounded in iterations; no draw of its own.
        """
        ...

    def collides_itself(self, q_rad: F64) -> bool:
        """Whether any of `self_pairs` touch at the joints (A,)."""
        ...

    def link_meshes(self) -> tuple[Mesh, ...]:
        """(L,) meshes to look at, link frames; loaded when first asked for."""
        ...
