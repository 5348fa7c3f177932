"""Read a robot from URDF and check every number; conversions to write one for physics engines."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular
from datagen.workers.geometry.mesh import F64

_MAX_BYTES = 8 << 20
_MAX_LINKS = 1000
_FIX = "Install mani_skill again, or correct the file"
_MOVING = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True, eq=False)
class Inertial:
    """Mass, its centre in the link frame and the inertia about the centre, along the link's axes."""

    mass_kg: float
    centre_m: F64  # (3,)
    inertia_kgm2: F64  # (3, 3)


@dataclass(frozen=True, eq=False)
class Shape:
    """A box or a mesh in the link frame."""

    T_link_shape: F64  # (4, 4)
    box_m: F64 | None  # (3,) full sizes
    mesh: Path | None
    scale: F64  # (3,) of the mesh


@dataclass(frozen=True, eq=False)
class Link:
    """A body of the robot."""

    name: str
    inertial: Inertial | None
    collisions: tuple[Shape, ...]
    visuals: tuple[Shape, ...]


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint at zero sits at `T_parent_child`. Joints without limits turn freely: (-inf, inf)."""

    name: str
    kind: str  # revolute, continuous, prismatic or fixed
    parent: str
    child: str
    T_parent_child: F64  # (4, 4)
    axis: F64  # (3,), unit
    lower: float
    upper: float
    speed: float
    effort: float


@dataclass(frozen=True, eq=False)
class UrdfTree:
    """A URDF's links and joints by name, in the file's order."""

    path: Path
    links: dict[str, Link]
    joints: dict[str, Joint]

    def joint(self, name: str) -> Joint:
        """The joint of that name. Raises InputError naming the file where it is missing."""
        if name not in self.joints:
            raise _wrong(self.path, f"joint {name}", "is missing")
        return self.joints[name]

    def link(self, name: str) -> Link:
        """The link of that name. Raises InputError naming the file where it is missing."""
        if name not in self.links:
            raise _wrong(self.path, f"link {name}", "is missing")
        return self.links[name]

    def children(self, link: str) -> list[Joint]:
        """Joints whose parent is the link."""
        return [joint for joint in self.joints.values() if joint.parent == link]

    def joint_above(self, link: str) -> Joint | None:
        """The joint whose child is the link; None for a root."""
        return next((joint for joint in self.joints.values() if joint.child == link), None)


def read_urdf(path: Path) -> UrdfTree:
    """All links and joints of a URDF; paths of meshes are resolved against its folder.

    Raises InputError naming the file and the element: unreadable, not XML, a number that is not
    finite, a joint between links that do not exist, two parents of one link, a loop.
    """
    try:
        root = ElementTree.fromstring(read_regular(path, _MAX_BYTES, _FIX))
    except ElementTree.ParseError as error:
        raise _wrong(path, "", f"is not XML ({error})") from error
    if root.tag != "robot":
        raise _wrong(path, root.tag, "is not <robot>")
    if max(len(root.findall("link")), len(root.findall("joint"))) > _MAX_LINKS:
        raise _wrong(path, "", f"has more than {_MAX_LINKS:,} links or joints")
    reader = _Reader(path)
    links = {link.name: link for link in map(reader.link, root.findall("link"))}
    joints = {joint.name: joint for joint in map(reader.joint, root.findall("joint"))}
    for joint in joints.values():
        for end in (joint.parent, joint.child):
            if end not in links:
                raise _wrong(path, f"joint {joint.name}", f"link {end!r} does not exist")
    if len({joint.child for joint in joints.values()}) < len(joints):
        raise _wrong(path, "joints", "a link has two parents")
    tree = UrdfTree(path, links, joints)
    for name in links:
        above, steps = tree.joint_above(name), 0
        while above is not None:
            above, steps = tree.joint_above(above.parent), steps + 1
            if steps > len(links):
                raise _wrong(path, f"link {name}", "its joints form a loop")
    return tree


class _Reader:
    def __init__(self, path: Path) -> None:
        self.path = path

    def name(self, element: ElementTree.Element) -> str:
        name = element.get("name", "")
        if not name:
            raise _wrong(self.path, element.tag, "has no name")
        return name

    def numbers(
        self, element: ElementTree.Element | None, key: str, count: int, where: str, default: str
    ) -> F64:
        text = default if element is None else element.get(key, default)
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            raise _wrong(self.path, where, f"{key}={text!r} is not {count} numbers") from None
        if len(values) != count or not np.isfinite(values).all():
            raise _wrong(self.path, where, f"{key}={text!r} is not {count} finite numbers")
        return values

    def origin(self, element: ElementTree.Element, where: str) -> F64:
        origin = element.find("origin")
        T = np.eye(4)
        T[:3, 3] = self.numbers(origin, "xyz", 3, where, "0 0 0")
        T[:3, :3] = rpy_rotation(self.numbers(origin, "rpy", 3, where, "0 0 0"))
        return T

    def link(self, element: ElementTree.Element) -> Link:
        name = self.name(element)
        where = f"link {name}"
        collisions = tuple(self.shape(e, f"{where} collision") for e in element.findall("collision"))
        visuals = tuple(self.shape(e, f"{where} visual") for e in element.findall("visual"))
        return Link(name, self.inertial(element.find("inertial"), where), collisions, visuals)

    def inertial(self, element: ElementTree.Element | None, where: str) -> Inertial | None:
        if element is None:
            return None
        mass = float(self.numbers(element.find("mass"), "value", 1, where, "0")[0])
        T = self.origin(element, where)
        keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        found = element.find("inertia")
        xx, xy, xz, yy, yz, zz = (float(self.numbers(found, k, 1, where, "0")[0]) for k in keys)
        if mass < 0:
            raise _wrong(self.path, where, f"mass {mass} is negative")
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        R = T[:3, :3]
        # A mass of 0 marks links that only carry frames.
        return Inertial(mass, T[:3, 3], R @ inertia @ R.T) if mass > 0 else None

    def shape(self, element: ElementTree.Element, where: str) -> Shape:
        T = self.origin(element, where)
        box, mesh = element.find("geometry/box"), element.find("geometry/mesh")
        if box is not None:
            return Shape(T, self.numbers(box, "size", 3, where, ""), None, np.ones(3))
        if mesh is None:
            raise _wrong(self.path, where, "has neither a box nor a mesh")
        return Shape(
            T,
            None,
            self.path.parent / mesh.get("filename", "").removeprefix("package://"),
            self.numbers(mesh, "scale", 3, where, "1 1 1"),
        )

    def joint(self, element: ElementTree.Element) -> Joint:
        name = self.name(element)
        where = f"joint {name}"
        kind = element.get("type", "")
        if kind not in (*_MOVING, "fixed"):
            raise _wrong(self.path, where, f"type {kind!r} is not one of {', '.join(_MOVING)}, fixed")
        parent, child = element.find("parent"), element.find("child")
        if parent is None or child is None:
            raise _wrong(self.path, where, "has no parent or no child")
        axis = np.array([1.0, 0.0, 0.0])
        lower, upper, speed, effort = -math.inf, math.inf, math.inf, math.inf
        if kind in _MOVING:
            axis = self.numbers(element.find("axis"), "xyz", 3, where, "1 0 0")
            if np.linalg.norm(axis) < 1e-6:
                raise _wrong(self.path, where, "its axis has no length")
            axis = axis / np.linalg.norm(axis)
            limit = element.find("limit")
            if limit is not None:
                speed = float(self.numbers(limit, "velocity", 1, where, "0")[0])
                effort = float(self.numbers(limit, "effort", 1, where, "0")[0])
            if kind != "continuous":
                if limit is None:
                    raise _wrong(self.path, where, "has no limit")
                lower = float(self.numbers(limit, "lower", 1, where, "0")[0])
                upper = float(self.numbers(limit, "upper", 1, where, "0")[0])
                if not lower < upper:
                    raise _wrong(self.path, where, f"its range {lower} to {upper} is empty")
        return Joint(
            name, kind, parent.get("link", ""), child.get("link", ""), self.origin(element, where),
            axis, lower, upper, speed, effort,
        )  # fmt: skip


def rpy_rotation(rpy_rad: F64) -> F64:
    """Rotation (3, 3) of URDF's roll, pitch and yaw about the fixed axes x, y and z, in this order."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy_rad), np.sin(rpy_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rotation_rpy(R: F64) -> F64:
    """Roll, pitch and yaw (3,) of a rotation (3, 3); at a pitch of 90 degrees the yaw is 0."""
    flat = math.hypot(R[0, 0], R[1, 0])
    pitch = math.atan2(-R[2, 0], flat)
    if flat < 1e-9:
        return np.array([math.atan2(-R[1, 2], R[1, 1]), pitch, 0.0])
    return np.array([math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])])


def scaled_inertial(inertial: Inertial, scale: float) -> Inertial:
    """The body `scale` times as long with the same mass: its inertia grows with the square of the scale.

    At equal density the hand would weigh many times what a short arm does, and PhysX's drives, solved in
    few iterations, would sag under it by degrees.
    """
    return replace(
        inertial, centre_m=inertial.centre_m * scale, inertia_kgm2=inertial.inertia_kgm2 * scale**2
    )


def _wrong(path: Path, field: str, problem: str) -> InputError:
    return InputError(path, field, problem, _FIX)
