"""The robot as files for physics engines: URDF, SRDF and convex parts in a folder of the user's."""

from __future__ import annotations

import hashlib
import os
import tempfile
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial import ConvexHull

from schemas.identity import digest_of
from workers.content_cache import cache_folder
from workers.geometry.mesh import F32, F64
from workers.robots.assembly import Assembly, Body
from workers.robots.robot import Parts
from workers.robots.urdf import Inertial, Joint, rotation_rpy


def write_urdf(name: str, assembly: Assembly, disabled: list[tuple[str, str]]) -> Path:
    """Writes `<name>-<digest>.urdf` and `.srdf` and returns the first; files that exist are left alone.

    Collision shapes are convex STL files, one a part; visuals are left out, because building their materials
    needs a render device. `disabled` are pairs of links that an engine must not let collide.
    """
    folder = _folder()
    root = ElementTree.Element("robot", name=name)
    for body in assembly.bodies:
        _add_link(root, body, folder)
    for joint in (*assembly.arm, assembly.palm, *assembly.fingers):
        _add_joint(root, joint)
    ElementTree.indent(root)
    semantic = ElementTree.Element("robot", name=name)
    for first, second in disabled:
        # SAPIEN reads the reason: it honours "Default" alone.
        ElementTree.SubElement(semantic, "disable_collisions", link1=first, link2=second, reason="Default")
    ElementTree.indent(semantic)
    texts = [ElementTree.tostring(element, encoding="unicode") for element in (root, semantic)]
    stem = f"{name}-{digest_of(texts)[:16]}"
    # The SRDF first: who finds the URDF finds both.
    _place(folder / f"{stem}.srdf", texts[1].encode())
    return _place(folder / f"{stem}.urdf", texts[0].encode())


@lru_cache(maxsize=1)
def _folder() -> Path:
    try:
        folder = cache_folder() / "robots"
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="datagen-robots-"))


def _place(path: Path, content: bytes) -> Path:
    """Several workers write the same files at once; each sees nothing or a whole file."""
    if not path.exists():
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".", delete=False) as file:
            file.write(content)
        os.replace(file.name, path)
    return path


def hull_of(parts_m: Parts) -> F32:
    """Corners (V, 3) of the one hull around several parts."""
    points = np.concatenate(parts_m)
    return points[np.sort(ConvexHull(points).vertices)]


def _part_file(corners_m: F32, folder: Path) -> Path:
    hull = ConvexHull(corners_m)
    triangles = corners_m[hull.simplices]  # (F, 3, 3)
    normal = hull.equations[:, :3].astype(np.float32)
    turned = np.einsum(
        "fi,fi->f", np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), normal
    )
    triangles[turned < 0] = triangles[turned < 0][:, ::-1]
    record = np.zeros(
        len(triangles), np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    )
    record["normal"], record["corners"] = normal, triangles
    content = bytes(80) + np.uint32(len(record)).tobytes() + record.tobytes()
    return _place(folder / f"{hashlib.sha256(content).hexdigest()[:16]}.stl", content)


def _add_link(root: ElementTree.Element, body: Body, folder: Path) -> None:
    link = ElementTree.SubElement(root, "link", name=body.name)
    if body.inertial is not None:
        _add_inertial(link, body.inertial)
    for part in body.parts_m:
        geometry = ElementTree.SubElement(ElementTree.SubElement(link, "collision"), "geometry")
        ElementTree.SubElement(geometry, "mesh", filename=str(_part_file(part, folder)))


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
        limits = {"lower": joint.lower, "upper": joint.upper, "velocity": joint.speed, "effort": joint.effort}
        ElementTree.SubElement(element, "limit", {key: repr(float(value)) for key, value in limits.items()})


def _text(values: F64) -> str:
    return " ".join(repr(float(value)) for value in values)
