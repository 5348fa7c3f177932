"""The robot as files for physics engines: URDF, SRDF and convex parts in a cache folder of the user."""

from __future__ import annotations

import atexit
import hashlib
import shutil
import tempfile
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial import ConvexHull

from datagen.schemas.identity import digest_of
from datagen.schemas.whole_files import whole_file
from datagen.workers.content_cache import alone_in, cache_folder, drop_unused, refresh
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.robots.assembly import Assembly, LinkBody
from datagen.workers.robots.description import Parts
from datagen.workers.robots.hulls import hull_faces
from datagen.workers.robots.urdf import Inertial, Joint, rotation_rpy

# Most files in the cache folder; a robot has two of its own and shares the others with its family.
_MOST_FILES = 8192
# Longer than any reader takes from getting the path to reading the files.
_IDLE_S = 3600.0
# Robots that a process writes from one removal of old files to the next; the first robot starts with one.
_WRITTEN_BETWEEN_PRUNINGS = 256


class RobotFiles:
    """The files of one robot, written on first use: planning needs none.

    Collision shapes are convex STL files, one a part; visuals are left out, because building their materials
    needs a render device. `disabled` are pairs of links that an engine must not let collide.
    """

    _n_written = 0  # by this process

    def __init__(self, name: str, assembly: Assembly, disabled: list[tuple[str, str]]) -> None:
        self._name = name
        self._assembly = assembly
        self._disabled = disabled
        self._paths: tuple[Path, ...] = ()  # the URDF last

    def urdf(self) -> Path:
        """Path of `<name>-<digest>.urdf`, stored with its `.srdf`; both stay for at least an hour.

        They lie in the cache, or else in a temporary folder of this process. Raises OSError where neither
        is writable.
        """
        try:
            return self._kept_in(cache_folder() / "robots")
        except OSError:
            return self._kept_in(_own_folder())

    def _kept_in(self, folder: Path) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        # Locked: no process removes a file between the check and the mark of its use.
        with alone_in(folder):
            known = bool(self._paths) and self._paths[-1].parent == folder
            if not (known and all(refresh(path) for path in self._paths)):
                self._paths = self._write(folder)
                if RobotFiles._n_written % _WRITTEN_BETWEEN_PRUNINGS == 0:
                    drop_unused(folder, _MOST_FILES, _IDLE_S)
                RobotFiles._n_written += 1
        return self._paths[-1]

    def _write(self, folder: Path) -> tuple[Path, ...]:
        root = ElementTree.Element("robot", name=self._name)
        paths: list[Path] = []
        for body in self._assembly.bodies:
            paths += _add_link(root, body, folder)
        for joint in (*self._assembly.arm, self._assembly.palm, *self._assembly.fingers):
            _add_joint(root, joint)
        semantic = ElementTree.Element("robot", name=self._name)
        for first, second in self._disabled:
            # SAPIEN disables collisions only for the reason "Default".
            pair = {"link1": first, "link2": second, "reason": "Default"}
            ElementTree.SubElement(semantic, "disable_collisions", pair)
        ElementTree.indent(root)
        ElementTree.indent(semantic)
        texts = [ElementTree.tostring(element, encoding="unicode") for element in (semantic, root)]
        stem = f"{self._name}-{digest_of(texts)[:16]}"
        for text, suffix in zip(texts, (".srdf", ".urdf"), strict=True):
            paths.append(_place(folder / f"{stem}{suffix}", text.encode()))
        return tuple(paths)


@cache
def _own_folder() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="datagen-robots-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _place(path: Path, content: bytes) -> Path:
    if not (refresh(path) and path.stat().st_size == len(content)):
        with whole_file(path) as file:
            file.write(content)
    return path


def hull_of(parts_m: Parts) -> F32:
    """Corners (V, 3) of the one hull around several parts."""
    points = np.concatenate(parts_m)
    return points[np.sort(ConvexHull(points).vertices)]


def _part_file(corners_m: F32, folder: Path) -> Path:
    faces, normals = hull_faces(corners_m)
    layout = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    record = np.zeros(len(faces), layout)
    record["normal"], record["corners"] = normals, corners_m[faces]
    content = bytes(80) + np.uint32(len(record)).tobytes() + record.tobytes()
    return _place(folder / f"{hashlib.sha256(content).hexdigest()[:16]}.stl", content)


def _add_link(root: ElementTree.Element, body: LinkBody, folder: Path) -> list[Path]:
    """Add the link and return the files of its parts."""
    link = ElementTree.SubElement(root, "link", name=body.name)
    if body.inertial is not None:
        _add_inertial(link, body.inertial)
    # Parts are written unscaled, so that a family of scaled arms shares them.
    files = [_part_file(part, folder) for part in body.unscaled_m]
    for file in files:
        geometry = ElementTree.SubElement(ElementTree.SubElement(link, "collision"), "geometry")
        ElementTree.SubElement(geometry, "mesh", filename=str(file), scale=_text(np.full(3, body.scale)))
    return files


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
