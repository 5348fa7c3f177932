"""A robot as URDF and convex parts, for engines that read files."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.robots.hulls import hull_faces
from datagen.workers.robots.links import LinkBody
from datagen.workers.robots.robot import Robot
from datagen.workers.robots.urdf import Inertial, Joint, rotation_rpy

_EFFORT = 1e3  # URDF demands one; the agent's drives limit forces


def write_urdf(robot: Robot, folder: Path) -> Path:
    """Write `robot.urdf` and one convex STL file a part into a folder, and return the URDF's path.

    Visuals are left out, because building their materials needs a render device. Raises OSError.
    """
    root = ElementTree.Element("robot", name=robot.name)
    assembly = robot.assembly
    for body in assembly.bodies:
        _add_link(root, body, folder)
    for joint in (*assembly.arm, assembly.palm, *assembly.hand.joints):
        _add_joint(root, joint)
    path = folder / "robot.urdf"
    ElementTree.ElementTree(root).write(path)
    return path


def _add_link(root: ElementTree.Element, body: LinkBody, folder: Path) -> None:
    link = ElementTree.SubElement(root, "link", name=body.name)
    if body.inertial is not None:
        _add_inertial(link, body.inertial)
    for k, part in enumerate(body.parts_m):
        file = folder / f"{body.name}-{k}.stl"
        file.write_bytes(_stl(part))
        geometry = ElementTree.SubElement(ElementTree.SubElement(link, "collision"), "geometry")
        ElementTree.SubElement(geometry, "mesh", filename=str(file))


def _stl(corners_m: F32) -> bytes:
    faces, normals = hull_faces(corners_m)
    layout = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    record = np.zeros(len(faces), layout)
    record["normal"], record["corners"] = normals, corners_m[faces]
    return bytes(80) + np.uint32(len(record)).tobytes() + record.tobytes()


def _add_inertial(link: ElementTree.Element, inertial: Inertial) -> None:
    element = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(element, "origin", xyz=_text(inertial.centre_m), rpy="0 0 0")
    ElementTree.SubElement(element, "mass", value=repr(float(inertial.mass_kg)))
    M = inertial.inertia_kgm2
    keys = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    ElementTree.SubElement(element, "inertia", {key: repr(float(M[at])) for key, at in keys.items()})


def _add_joint(root: ElementTree.Element, joint: Joint) -> None:
    element = ElementTree.SubElement(root, "joint", name=joint.name, type=joint.kind)
    T = joint.T_parent_child
    ElementTree.SubElement(element, "origin", xyz=_text(T[:3, 3]), rpy=_text(rotation_rpy(T[:3, :3])))
    ElementTree.SubElement(element, "parent", link=joint.parent)
    ElementTree.SubElement(element, "child", link=joint.child)
    if joint.kind != "fixed":
        ElementTree.SubElement(element, "axis", xyz=_text(joint.axis))
        limits = {"lower": joint.lower, "upper": joint.upper, "velocity": joint.speed, "effort": _EFFORT}
        ElementTree.SubElement(element, "limit", {key: repr(float(value)) for key, value in limits.items()})


def _text(values: F64) -> str:
    return " ".join(repr(float(value)) for value in values)
