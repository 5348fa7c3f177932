"""Read a robot from URDF and check every number; conversions to write one for physics engines."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from datagen.schemas.errors import InputError
from datagen.workers.geometry.mesh import F64
from datagen.workers.robots.resources import mesh_path, read_xml

_MAX_LINKS, _LONGEST, _LONGEST_PATH = 1000, 200, 1000
MOST = 1e6  # of a number, whose squares and products stay finite
FIX = "Correct the file, or install its package again"
_MOVING = ("revolute", "continuous", "prismatic")
_KINDS = (*_MOVING, "fixed", "planar", "floating")


@dataclass(frozen=True, eq=False)
class Inertial:
    """Mass, its centre in the link frame and the inertia about the centre, along the link's axes."""

    mass_kg: float
    centre_m: F64  # (3,)
    inertia_kgm2: F64  # (3, 3)


@dataclass(frozen=True, eq=False)
class Shape:
    """A box, a cylinder along z, a sphere or a mesh in the link frame."""

    T_link_shape: F64  # (4, 4)
    # Sizes of a box (3,), radius and length of a cylinder (2,), radius of a sphere (1,); of a mesh None.
    size_m: F64 | None
    mesh: Path | None
    scale: F64  # (3,) of the mesh
    path: Path  # of the URDF, and the shape in it
    where: str
    rgb: tuple[float, ...] | None = None  # of its material, 0 to 1


@dataclass(frozen=True, eq=False)
class Link:
    """A body of the robot."""

    name: str
    inertial: Inertial | None
    collisions: tuple[Shape, ...]
    visuals: tuple[Shape, ...]


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint at zero sits at `T_parent_child`. Those without limits have (-inf, inf).

    A joint that mimics another stands at `multiplier` times its position plus `offset`.
    """

    name: str
    kind: str  # one of _KINDS
    parent: str
    child: str
    T_parent_child: F64  # (4, 4)
    axis: F64  # (3,), unit
    lower: float
    upper: float
    speed: float
    mimic: tuple[str, float, float] | None = None  # name, multiplier, offset


@dataclass(frozen=True, eq=False)
class UrdfTree:
    """A URDF's links and joints by name, in the file's order."""

    path: Path
    links: dict[str, Link]
    joints: dict[str, Joint]

    def joint(self, name: str) -> Joint:
        """The joint of that name. Raises InputError naming the file where it is missing."""
        if name not in self.joints:
            raise _wrong(self.path, f"joint {name:.80}", "is missing")
        return self.joints[name]

    def link(self, name: str) -> Link:
        """The link of that name. Raises InputError naming the file where it is missing."""
        if name not in self.links:
            raise _wrong(self.path, f"link {name}", "is missing")
        return self.links[name]

    def children(self, link: str) -> list[Joint]:
        return [joint for joint in self.joints.values() if joint.parent == link]

    def joint_above(self, link: str) -> Joint | None:
        """The joint whose child is the link; None for a root."""
        return next((joint for joint in self.joints.values() if joint.child == link), None)

    def chain(self, base: str, tip: str) -> list[Joint]:
        """All joints from one link down to another. InputError where the tip is not below the base."""
        self.link(base)
        self.link(tip)
        found: list[Joint] = []
        link = tip
        while link != base:
            joint = self.joint_above(link)
            if joint is None:
                raise InputError(
                    self.path, f"link {tip}", f"is not below link {base}", "Correct arm.base or arm.tip"
                )
            found.insert(0, joint)
            link = joint.parent
        return found

    def driver(self, joint: Joint) -> tuple[Joint, float, float]:
        """The joint that moves this one, itself where it mimics none, with multiplier and offset."""
        ratio, offset, seen = 1.0, 0.0, {joint.name}
        while joint.mimic is not None:
            name, multiplier, more = joint.mimic
            joint, ratio, offset = self.joint(name), ratio * multiplier, ratio * more + offset
            if name in seen:
                raise _wrong(self.path, f"joint {name}", "mimics itself")
            seen.add(name)
        if max(abs(ratio), abs(offset)) > MOST:
            raise _wrong(self.path, f"joint {joint.name}", f"is mimicked {ratio:.3g} times plus {offset:.3g}")
        return joint, ratio, offset

    def limits(self, joint: Joint) -> tuple[float, float]:
        """The range of a joint that moves; half a turn each way where it turns freely."""
        if joint.kind not in _MOVING:
            raise _wrong(self.path, f"joint {joint.name}", f"is {joint.kind}; joints of an arm turn or slide")
        if joint.kind == "continuous":
            return -np.pi, np.pi
        if math.isinf(joint.lower):
            raise _wrong(self.path, f"joint {joint.name}", "has no limit")
        lower, upper = joint.lower, joint.upper
        if joint.kind == "revolute":
            lower, upper = max(lower, -2 * np.pi), min(upper, 2 * np.pi)
        if not lower < upper:
            part = " within two turns each way" if joint.lower < joint.upper else ""
            problem = f"its range {joint.lower} to {joint.upper} is empty{part}"
            raise _wrong(self.path, f"joint {joint.name}", problem)
        return lower, upper


def read_urdf(path: Path) -> UrdfTree:
    """All links and joints of a URDF; paths of meshes are resolved against its folder.

    Raises InputError naming the file and the element: unreadable, not XML, a number that is not
    finite or too large, a joint between links that do not exist, two parents of one link, a loop.
    """
    root = read_xml(path, FIX)
    if any("ros.org/wiki/xacro}" in element.tag for element in root.iter()) or path.suffix == ".xacro":
        command = f"xacro {path.name} > {path.name.split('.')[0]}-expanded.urdf"
        raise InputError(path, "", "is a xacro file", f"Expand it, and name the result: {command}")
    if root.tag != "robot":
        raise _wrong(path, root.tag[:80], "is not <robot>")
    if max(len(root.findall("link")), len(root.findall("joint"))) > _MAX_LINKS:
        raise _wrong(path, "", f"has more than {_MAX_LINKS:,} links or joints")
    reader = _Reader(path, root)
    links = {link.name: link for link in map(reader.link, root.findall("link"))}
    joints = {joint.name: joint for joint in map(reader.joint, root.findall("joint"))}
    for kind in ("link", "joint"):
        names = Counter(element.get("name") for element in root.findall(kind))
        if repeated := next((name for name, count in names.items() if count > 1), None):
            raise _wrong(path, f"{kind} {repeated}", f"is the name of {names[repeated]} {kind}s")
    for joint in joints.values():
        for end in (joint.parent, joint.child):
            if end not in links:
                raise _wrong(path, f"joint {joint.name}", f"link {end!r:.80} does not exist")
    if len({joint.child for joint in joints.values()}) < len(joints):
        raise _wrong(path, "joints", "a link has two parents")
    tree = UrdfTree(path, links, joints)
    for name in links:
        above, steps = tree.joint_above(name), 0
        while above is not None:
            above, steps = tree.joint_above(above.parent), steps + 1
            if steps > len(links):
                raise _wrong(path, f"link {name}", "its joints form a loop")
    for joint in joints.values():
        tree.driver(joint)
    return tree


_SIZES = {"box": [("size", 3)], "cylinder": [("radius", 1), ("length", 1)], "sphere": [("radius", 1)]}


class _Reader:
    def __init__(self, path: Path, root: ElementTree.Element) -> None:
        self.path = path
        self.colours = {m.get("name"): m.find("color") for m in root.findall("material")}

    def name(self, element: ElementTree.Element) -> str:
        name = element.get("name", "")
        if not name:
            raise _wrong(self.path, element.tag, "has no name")
        if len(name) > _LONGEST:
            raise _wrong(self.path, f"{element.tag} {name[:40]}", f"has a name of {len(name):,} characters")
        return name

    def numbers(
        self,
        element: ElementTree.Element | None,
        key: str,
        count: int,
        where: str,
        default: str,
        most: float = MOST,
    ) -> F64:
        text = default if element is None else element.get(key, default)
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            raise _wrong(self.path, where, f"{key}={text!r:.80} is not {count} numbers") from None
        if len(values) != count or not np.isfinite(values).all():
            raise _wrong(self.path, where, f"{key}={text!r:.80} is not {count} finite numbers")
        if np.abs(values).max() > most:
            raise _wrong(self.path, where, f"{key}={text!r:.80} is beyond {most:,.0f}")
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
        T, rgb = self.origin(element, where), self.rgb(element.find("material"), where)
        for kind, keys in _SIZES.items():
            solid = element.find(f"geometry/{kind}")
            if solid is not None:
                size_m = np.concatenate([self.numbers(solid, key, n, where, "") for key, n in keys])
                if (size_m < 0).any():
                    raise _wrong(self.path, where, f"its {kind} has a negative size")
                return Shape(T, size_m, None, np.ones(3), self.path, where, rgb)
        mesh = element.find("geometry/mesh")
        if mesh is None:
            raise _wrong(self.path, where, f"has no {', '.join(_SIZES)} or mesh")
        text = mesh.get("filename", "")
        if len(text) > _LONGEST_PATH:
            raise _wrong(self.path, where, f"its mesh has a path of {len(text):,} characters")
        file = mesh_path(text, self.path)
        scale = self.numbers(mesh, "scale", 3, where, "1 1 1")
        return Shape(T, None, file, scale, self.path, where, rgb)

    def rgb(self, material: ElementTree.Element | None, where: str) -> tuple[float, ...] | None:
        colour = None if material is None else material.find("color")
        if colour is None and material is not None:
            colour = self.colours.get(material.get("name"))
        return None if colour is None else tuple(self.numbers(colour, "rgba", 4, where, "1 1 1 1")[:3])

    def joint(self, element: ElementTree.Element) -> Joint:
        name = self.name(element)
        where = f"joint {name}"
        kind = element.get("type", "")
        if kind not in _KINDS:
            raise _wrong(self.path, where, f"type {kind!r:.80} is not one of {', '.join(_KINDS)}")
        parent, child = element.find("parent"), element.find("child")
        if parent is None or child is None:
            raise _wrong(self.path, where, "has no parent or no child")
        axis = np.array([1.0, 0.0, 0.0])
        lower, upper, speed = -math.inf, math.inf, math.inf
        if kind in _MOVING:
            axis = self.numbers(element.find("axis"), "xyz", 3, where, "1 0 0")
            if np.linalg.norm(axis) < 1e-6:
                raise _wrong(self.path, where, "its axis has no length")
            axis = axis / np.linalg.norm(axis)
            limit = element.find("limit")
            if limit is not None:
                speed = float(self.numbers(limit, "velocity", 1, where, "0", math.inf)[0])
                most = MOST if kind == "prismatic" else math.inf  # turns are cut to two each way
                if kind != "continuous":
                    lower, upper = (
                        float(self.numbers(limit, key, 1, where, "0", most)[0]) for key in ("lower", "upper")
                    )
        mimic, found = element.find("mimic"), None
        if mimic is not None and kind in _MOVING:
            ratio, offset = (
                float(self.numbers(mimic, key, 1, where, default)[0])
                for key, default in (("multiplier", "1"), ("offset", "0"))
            )
            found = (mimic.get("joint", ""), ratio, offset)
        return Joint(
            name, kind, parent.get("link", ""), child.get("link", ""), self.origin(element, where),
            axis, lower, upper, speed, found,
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
    return InputError(path, field, problem, FIX)
