"""A robot's TOML file: what a user states of arm, hand and base; all else follows from the URDF."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import translation

_MAX_BYTES = 1 << 20
_FIX = "docs/guides/your-own-robot.md lists all keys"

Name = Annotated[str, Field(min_length=1, max_length=200)]
FileName = Annotated[str, Field(max_length=1000)]
Length = Annotated[float, Field(ge=-20.0, le=20.0, allow_inf_nan=False)]
Angle = Annotated[float, Field(ge=-100.0, le=100.0, allow_inf_nan=False)]
Gain = Annotated[float, Field(gt=0.0, le=1e9, allow_inf_nan=False)]
Point = tuple[Length, Length, Length]
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class PoseKeys(_Section):
    """A pose in the frame of another link: URDF's xyz and rpy."""

    xyz_m: Point = (0.0, 0.0, 0.0)
    rpy_rad: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)


class ArmKeys(_Section):
    """The chain of joints that the plan moves."""

    base: Name  # links above it in the URDF are left out
    tip: Name  # the link that carries the hand, or the hand's palm
    held: dict[Name, Angle] = {}  # joints that stay at a position, radians or metres
    coupled: tuple[tuple[Name, ...], ...] = ()  # sliding joints that share one coordinate, their sum
    ignore: tuple[Name, ...] = ()  # links whose shapes are left out
    # Meshes far from convex, by link: heights along z between which each slab gets a hull of its own.
    cuts_m: dict[Name, tuple[Length, ...]] = {}
    tucked: tuple[tuple[Angle, ...], ...] = ()  # poses from which paths start, one number a coordinate


class TcpKeys(_Section):
    """The frame between the pads: the axes along which the hand approaches and its fingers close."""

    link: Name | None = None  # the palm, where it is not given
    xyz_m: Point = (0.0, 0.0, 0.0)
    approach: Axis = "z"
    closing: Axis = "y"

    @model_validator(mode="after")
    def _perpendicular(self) -> TcpKeys:
        if self.approach[-1] == self.closing[-1]:
            raise ValueError(f"approach {self.approach} and closing {self.closing} are not perpendicular")
        return self

    def pose(self) -> F64:
        """(4, 4) in the link's frame."""
        z, y = (
            np.eye(3)["xyz".index(axis[-1])] * (-1.0 if axis.startswith("-") else 1.0)
            for axis in (self.approach, self.closing)
        )
        T = translation(*self.xyz_m)
        T[:3, :3] = np.column_stack([np.cross(y, z), y, z]) + 0.0  # no negative zero
        return T


class HandKeys(_Section):
    """The gripper."""

    name: str = ""
    urdf: FileName | None = None  # of its own, where the arm's does not hold it
    palm: Name | None = None  # the arm's tip, where it is not given
    mount: PoseKeys | None = None  # the palm in the frame of the arm's tip
    fingers: tuple[Name, ...] = ()  # joints that open it: all that move below the palm, if none is given
    range: dict[Name, tuple[Angle, Angle]] = {}  # of joints for which the URDF has none: closed, open
    tcp: TcpKeys | None = None
    pad_size_m: tuple[Annotated[float, Field(gt=0, le=0.5)], Annotated[float, Field(gt=0, le=0.5)]] | None = (
        None
    )


class BaseKeys(_Section):
    """What carries the arm: a pedestal of any height, or the robot's own base."""

    pedestal: bool | None = None
    # Outline of the base around the mount, x to the front; or its radius.
    footprint_m: tuple[tuple[Length, Length], ...] | None = Field(default=None, min_length=3, max_length=100)
    radius_m: Annotated[float, Field(gt=0, le=5)] | None = None
    height_m: Annotated[float, Field(ge=0, le=10)] | None = None  # of the mount above the floor
    # Where the base turns and (x, y) of candidates lies, in the frame of the arm's base link.
    mount_m: tuple[Length, Length] | None = None
    presents: Literal["faces", "turns", "side"] = "faces"
    # Of `side`: direction of the target seen from the base, counter-clockwise from x ahead; -90: its right.
    side_deg: Annotated[float, Field(ge=-180, le=180)] | None = None
    range_deg: tuple[Annotated[float, Field(ge=-360, le=0)], Annotated[float, Field(ge=0, le=360)]] = (
        -180.0,
        180.0,
    )

    @model_validator(mode="after")
    def _has_side(self) -> BaseKeys:
        if (self.presents == "side") != (self.side_deg is not None):
            raise ValueError('presents = "side" and side_deg need each other')
        return self

    @property
    def yaw_rad(self) -> float:
        """Heading of the base relative to the direction from it to the target."""
        return -math.radians(self.side_deg or 0.0)

    @property
    def outer_radius_m(self) -> float | None:
        """Radius around the mount that holds the base, in whole millimetres; None without an outline."""
        if self.footprint_m is None:
            return self.radius_m
        return math.ceil(1000 * max(math.hypot(x, y) for x, y in self.footprint_m) - 1e-9) / 1000


class DriveKeys(_Section):
    """Drives of the joints; of those that slide in newtons and metres."""

    stiffness: Gain = 1e3
    damping: Gain = 1e2
    force_limit: Gain = 100.0
    slide_stiffness: Gain = 1e5
    slide_force_limit: Gain = 1000.0


class ScaleKeys(_Section):
    """A family of arms: links scaled to a reach, and a tube between flange and hand at the shortest ones."""

    reach_m: tuple[Annotated[float, Field(ge=0.05)], Annotated[float, Field(le=10)]]
    tube_m: Annotated[float, Field(ge=0, le=1)] = 0.0  # at the shortest reach
    tube_radius_m: Annotated[float, Field(gt=0, le=1)] = 0.02
    no_tube_from_m: Annotated[float, Field(gt=0, le=10)] = 0.5  # this reach on


class RobotFile(_Section):
    """All keys of a robot's file."""

    name: Annotated[str, Field(min_length=1, max_length=60, pattern=r"^[A-Za-z0-9][A-Za-z0-9._ -]*$")] = ""
    about: str = ""
    urdf: FileName  # path from this file's folder, or package:NAME/path
    reach_m: Annotated[float, Field(gt=0, le=20)] | None = None
    arm: ArmKeys
    hand: HandKeys = HandKeys()
    base: BaseKeys = BaseKeys()
    drive: DriveKeys = DriveKeys()
    scaled: ScaleKeys | None = None

    @model_validator(mode="after")
    def _consistent(self) -> RobotFile:
        base, own = self.base, (self.base.footprint_m, self.base.radius_m, self.base.height_m)
        if base.pedestal and any(value is not None for value in own):
            raise ValueError("base.pedestal excludes base.footprint_m, base.radius_m and base.height_m")
        if base.footprint_m is not None and base.radius_m is not None:
            raise ValueError("base has footprint_m and radius_m; give one")
        if self.scaled and (own != (None, None, None) or base.presents != "faces" or self.reach_m):
            raise ValueError("scaled arms stand on a pedestal and have no reach_m of their own")
        if any(len(row) != len(self.arm.tucked[0]) for row in self.arm.tucked):
            raise ValueError("arm.tucked has rows of different lengths")
        return self


class RobotSource:
    """A robot's file that was read, and the folder that its paths start from."""

    def __init__(self, path: Path, keys: RobotFile) -> None:
        self.path, self.keys, self.name = path, keys, keys.name or path.stem

    def wrong(self, field: str, problem: str, fix: str = "Correct the value") -> InputError:
        """The error for a key of this file."""
        return InputError(self.path, field, problem, fix)

    def refuse_unknown(self, field: str, link: str, links: Iterable[str]) -> None:
        """Raise InputError where a key names a link that is not among those of a URDF."""
        links = list(links)
        if link not in links:
            near = get_close_matches(link, links, n=3, cutoff=0.3) or links[:3] or ["none"]
            raise self.wrong(field, f"link {link} is not in the URDF", f"Did you mean {' or '.join(near)}?")


def read_robot(path: Path) -> RobotSource:
    """The keys of a robot's file. Raises InputError naming the file, the key and how to correct it."""
    try:
        stamp = path.stat().st_mtime_ns
    except (OSError, ValueError):
        stamp = 0  # the reader names what is wrong
    return _read(path, stamp)


@lru_cache(maxsize=64)
def _read(path: Path, _stamp: int) -> RobotSource:
    data = read_regular(path, _MAX_BYTES, "Give a robot's TOML file: " + _FIX)
    try:
        fields: dict[str, Any] = tomllib.loads(data.decode("utf-8-sig"))
        return RobotSource(path, RobotFile.model_validate(fields))
    except ValidationError as error:
        raise _first_of(error, path) from None
    except (ValueError, RecursionError) as error:
        raise InputError(path, "", f"is not TOML: {error}", _FIX) from None


def _first_of(error: ValidationError, path: Path) -> InputError:
    first = error.errors()[0]
    field = ".".join(map(str, first["loc"]))
    if first["type"] == "missing":
        return InputError(path, field, "is missing", f"Add it: {_FIX}")
    if first["type"] == "extra_forbidden":
        return InputError(path, field, "is no key of a robot's file", f"Remove or correct it: {_FIX}")
    problem = first["msg"].removeprefix("Value error, ")
    given = "" if first["type"] == "value_error" else f" (given: {str(first['input'])[:80]})"
    return InputError(path, field, problem + given, "Correct the value")
