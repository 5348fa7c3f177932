"""Descriptions of robots and grippers: plain data, so that limits can be read without a simulator."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from datagen.schemas.errors import InputError
from datagen.workers.extras import how_to_get
from datagen.workers.geometry.mesh import F32, F64


@dataclass(frozen=True)
class RobotLimits:
    """Ranges that a robot supports. A range whose ends are equal is a single value."""

    reach_m: tuple[float, float]
    base_height_m: tuple[float, float] | None  # None: a pedestal of any height
    base_radius_m: float | None  # its own mobile base; None stands on a pedestal
    # Corners (x, y) of its base's outline in the base frame: origin below the mount, x to the front.
    footprint_m: tuple[tuple[float, float], ...] | None = None


@dataclass(frozen=True, eq=False)
class HandDescription:
    """A parallel hand: a palm and two fingers on prismatic joints, from a URDF."""

    name: str
    urdf: str  # below ManiSkill's folder of robots
    palm_link: str
    finger_joints: tuple[str, str]  # first the one on the +y side of the TCP
    T_palm_tcp: F64  # (4, 4)
    pad_size_m: tuple[float, float]  # along x and along z of the TCP


@dataclass(frozen=True)
class WristExtension:
    """A tube between flange and hand: full at the shortest reach, none from `none_from_reach_m` on."""

    longest_m: float
    radius_m: float
    none_from_reach_m: float


@dataclass(frozen=True)
class TorsoLift:
    """A prismatic joint that sets the height of the arm's mount."""

    joint: str
    mount_at_zero_m: float  # height of the mount above the floor with the joint at 0


@dataclass(frozen=True, eq=False)
class RobotDescription:
    """An arm from a URDF and the hand on its flange."""

    name: str
    urdf: str  # below ManiSkill's folder of robots
    root_link: str  # links above it in the URDF are left out
    arm_joints: tuple[str, ...]  # (A,), from the base on
    flange_link: str
    T_flange_palm: F64  # (4, 4)
    hand: HandDescription
    homes_rad: tuple[tuple[float, ...], ...]  # (H, A)
    stiffness: float
    damping: float
    force_limit_n: float
    limits: RobotLimits
    extension: WristExtension | None = None  # a robot that has one is scaled to its reach
    lift: TorsoLift | None = None
    # Meshes far from convex, by link: heights along z between which each slab gets a hull of its own.
    cuts_m: dict[str, tuple[float, ...]] = field(default_factory=dict[str, tuple[float, ...]])
    shapeless: tuple[str, ...] = ()  # links whose shapes are left out
    held: dict[str, float] = field(default_factory=dict[str, float])  # fixed positions of other joints


def turned_homes(
    folds_rad: tuple[tuple[float, ...], ...], turns_rad: tuple[float, ...]
) -> tuple[tuple[float, ...], ...]:
    """Every fold of the joints after the first, with the first joint at every turn; the first fold first."""
    return tuple((turn, *fold) for fold in folds_rad for turn in turns_rad)


def robots_folder() -> Path:
    """The folder of robots in the installed mani_skill package, which is found and not imported.

    Raises InputError where the package is missing.
    """
    spec = find_spec("mani_skill")
    folders = list(spec.submodule_search_locations or []) if spec else []
    if not folders:
        raise InputError("--robot", "mani_skill", "is not installed", how_to_get("sim"))
    return Path(folders[0]) / "assets" / "robots"


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
    digest: str  # digest of all other fields; a key of caches
    max_opening_m: float
    pad_size_m: tuple[float, float]  # rubber that touches: along x and along z
    palm_depth_m: float  # from the TCP back to the palm's surface, along -z
    palm_parts_m: Parts  # TCP frame
    finger_parts_m: tuple[Parts, Parts]  # TCP frame, fingers closed (opening 0)

    def parts_at(self, opening_m: float) -> Parts:
        """All convex parts of the hand, TCP frame, with the pads `opening_m` apart."""
        shift: F32 = (_Y * (opening_m / 2)).astype(np.float32)
        left, right = self.finger_parts_m
        return (*self.palm_parts_m, *(p + shift for p in left), *(p - shift for p in right))
