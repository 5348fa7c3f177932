"""Rigid objects of URDF, SDF and MJCF files: where their meshes and solids are, and their mass."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from datagen.schemas.errors import InputError
from datagen.workers.geometry.mesh import F64
from datagen.workers.robots.resources import mesh_path, read_xml
from datagen.workers.robots.urdf import MOST, read_urdf, rpy_rotation

_FIX = "Correct the file, or remove it"
_MOST_PIECES, _MOST_FILES, _DEEPEST = 1000, 100, 20
# MuJoCo shows the groups below this one.
_HIDDEN_GROUP = 3
_SDF_SOLIDS = {
    **{"box": [("size", 3)], "sphere": [("radius", 1)], "ellipsoid": [("radii", 3)]},
    **{kind: [("radius", 1), ("length", 1)] for kind in ("cylinder", "capsule")},
}
_SDF_OTHERS = {"mesh", "empty", "plane", "heightmap"}  # a mesh is read, and the others are no solids
_MJCF_OTHERS = ("attach", "composite", "flexcomp", "replicate")
_SOLIDS = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2, "ellipsoid": 3}


@dataclass(frozen=True, eq=False)
class Piece:
    """A mesh, or a solid about the origin: sides of a box or an ellipsoid, radius (and length)."""

    T: F64  # (4, 4), to the object's frame
    mesh: Path | None
    scale: F64  # (3,) of the mesh
    solid: str
    size_m: F64
    rgb: tuple[float, ...] | None  # 0 to 1, for what brings no colours
    image: Path | None = None


@dataclass(frozen=True, eq=False)
class Description:
    """One rigid object, z up. Without `collisions` its visible pieces collide."""

    visuals: list[Piece]
    collisions: list[Piece]
    mass_kg: float | None
    density_kg_m3: float | None = None


def read_description(path: Path, inside: Callable[[Path], Path]) -> Description:
    """The object of a file; `inside` returns the paths that it may include, and raises InputError for others.

    Raises InputError naming the file: broken, with joints that move, without shapes.
    """
    kind = path.suffix.lower()
    found = _urdf(path) if kind == ".urdf" else _sdf(path) if kind == ".sdf" else _mjcf(path, inside)
    if not found.visuals and not found.collisions:
        raise _wrong(path, "", "holds no shape of an object")
    if max(len(found.visuals), len(found.collisions)) > _MOST_PIECES:
        raise _wrong(path, "", f"has more than {_MOST_PIECES:,} shapes")
    for piece in (*found.visuals, *found.collisions):
        if piece.solid and not (piece.size_m > 0).all():
            raise _wrong(path, piece.solid, "has no volume")
    return found


def _urdf(path: Path) -> Description:
    tree = read_urdf(path)
    for joint in tree.joints.values():
        if joint.kind != "fixed":
            raise _wrong(path, f"joint {joint.name}", "moves: the object is not rigid")
    visuals, collisions, mass_kg = list[Piece](), list[Piece](), 0.0
    for link in tree.links.values():
        T, above = np.eye(4), tree.joint_above(link.name)
        while above is not None:
            T, above = above.T_parent_child @ T, tree.joint_above(above.parent)
        mass_kg += 0.0 if link.inertial is None else link.inertial.mass_kg
        for shapes, pieces in ((link.visuals, visuals), (link.collisions, collisions)):
            for s in shapes:
                size = np.zeros(0) if s.size_m is None else s.size_m
                solid = ("", "sphere", "cylinder", "box")[len(size)]
                pieces.append(Piece(T @ s.T_link_shape, s.mesh, s.scale, solid, size, s.rgb))
    return Description(visuals, collisions, mass_kg or None)


def _sdf(path: Path) -> Description:
    root = read_xml(path, _FIX)
    models = [*root.iter("model")]
    if root.tag != "sdf" or len(models) != 1:
        problem = f"is no SDF of one model, but of {len(models)}" if root.tag == "sdf" else "is not <sdf>"
        raise _wrong(path, root.tag[:80], problem)
    if models[0].find("include") is not None:
        raise _wrong(path, "include", "holds another model, which is not read")
    for joint in models[0].iter("joint"):
        if joint.get("type") != "fixed":
            raise _wrong(path, f"joint {joint.get('name')}", "moves: the object is not rigid")
    visuals, collisions, mass_kg = list[Piece](), list[Piece](), 0.0
    named = {str(e.get("name")): e for tag in ("joint", "frame", "link") for e in models[0].iterfind(tag)}
    for link in models[0].iter("link"):
        T_link = _sdf_pose(path, named, link)
        mass_kg += _text(path, link, "inertial/mass", 1, "0")[0]
        for tag, pieces in (("visual", visuals), ("collision", collisions)):
            for shape in link.iterfind(tag):
                T, rgb = _sdf_pose(path, named, shape, T_link), None
                for each in shape.iterfind("geometry/*"):
                    if each.tag not in _SDF_SOLIDS.keys() | _SDF_OTHERS:
                        raise _wrong(path, each.tag[:80], "is a shape that is not read")
                if shape.find("material/diffuse") is not None:
                    rgb = tuple(_text(path, shape, "material/diffuse", 4, "1 1 1 1")[:3])
                uri, image = (
                    mesh_path(text.strip(), path) if (text := shape.findtext(tag, "")) else None
                    for tag in ("geometry/mesh/uri", "material/pbr/metal/albedo_map")
                )
                scale = _text(path, shape, "geometry/mesh/scale", 3, "1 1 1")
                if uri is not None:
                    pieces.append(Piece(T, uri, scale, "", scale, rgb, image))
                for solid, keys in _SDF_SOLIDS.items():
                    if shape.find(f"geometry/{solid}") is not None:
                        sizes = [_text(path, shape, f"geometry/{solid}/{key}", n, "") for key, n in keys]
                        size = np.concatenate(sizes) * (2 if solid == "ellipsoid" else 1)
                        pieces.append(Piece(T, None, scale, solid, size, rgb, image))
    return Description(visuals, collisions, mass_kg or None)


def _sdf_pose(
    path: Path, named: Mapping[str, Element], element: Element, T: F64 | None = None, depth: int = 0
) -> F64:
    """The pose of an element in its model's frame; a shape has by default that of its link, `T`."""
    pose = element.find("pose")
    frame = "" if pose is None else pose.get("relative_to", "")
    if not frame and T is None:
        frame = element.get("attached_to", "") or element.findtext("child", "")  # of a frame, of a joint
    if frame not in ("", "__model__"):
        if frame not in named or depth > _DEEPEST:
            raise _wrong(path, f"pose relative_to {frame[:80]}", "is not known, or follows from itself")
        T = _sdf_pose(path, named, named[frame], None, depth + 1)
    elif frame or T is None:
        T = np.eye(4)
    if pose is None:
        return T
    numbers, T_own = _text(path, element, "pose", 6, "0 0 0 0 0 0"), np.eye(4)
    if pose.get("degrees") in ("true", "1"):
        numbers[3:] = np.radians(numbers[3:])
    T_own[:3, :3], T_own[:3, 3] = rpy_rotation(numbers[3:]), numbers[:3]
    return T @ T_own


class _Mjcf:
    """One model with its includes: the compiler's settings, assets, and defaults by class."""

    def __init__(self, path: Path, inside: Callable[[Path], Path]) -> None:
        self.path, self.inside, self.files, self.free = path, inside, 0, 0
        self.root = self._included(path)
        self.compiler: dict[str, str] = {}
        self.defaults: dict[str, dict[str, Mapping[str, str]]] = {"": {}}
        self.assets: dict[tuple[str, str], Element] = {}
        for element in self.root.iter("compiler"):
            self.compiler |= element.attrib
        for element in self.root.iterfind("default"):
            self._default(element, "", self.defaults[""])
        for element in self.root.iterfind("asset/*"):
            name = element.get("name") or Path(element.get("file", "")).stem
            self.assets[element.tag, name] = element

    def _included(self, path: Path) -> Element:
        """The file's root; each <include> is replaced by what its file holds."""
        self.files += 1
        if self.files > _MOST_FILES:
            raise _wrong(self.path, "include", f"includes itself, or more than {_MOST_FILES} files")
        root = read_xml(self.inside(path), _FIX)
        for parent in list(root.iter()):
            for at in range(len(parent) - 1, -1, -1):
                if parent[at].tag == "include":
                    near = path.parent / parent[at].get("file", "")
                    file = near if near.is_file() else self.path.parent / parent[at].get("file", "")
                    parent[at : at + 1] = list(self._included(file))
        return root

    def _default(self, element: Element, name: str, inherited: dict[str, Mapping[str, str]]) -> None:
        own = {**inherited}
        for each in element:
            if each.tag != "default":
                own[each.tag] = {**own.get(each.tag, {}), **each.attrib}
        self.defaults[name] = own
        for each in element.iterfind("default"):
            self._default(each, each.get("class", ""), own)

    def attributes(self, element: Element, kind: str) -> dict[str, str]:
        """An element's attributes over those of its default class."""
        own = self.defaults.get(element.get("class", kind), self.defaults[""])
        return {**own.get(element.tag, {}), **element.attrib}

    def numbers(self, given: Mapping[str, str], key: str, count: int, default: str) -> F64:
        return _numbers(self.path, f"{given.get('name', 'geom')} {key}", given.get(key, default), count)

    def pose(self, given: Mapping[str, str]) -> F64:
        if unread := given.keys() & {"zaxis", "xyaxes", "fromto"}:
            raise _wrong(self.path, given.get("name", ""), f"uses {min(unread)}, which is not read")
        T, turn = np.eye(4), 1.0 if self.compiler.get("angle") == "radian" else math.pi / 180
        T[:3, 3] = self.numbers(given, "pos", 3, "0 0 0")
        if "quat" in given:
            T[:3, :3] = Rotation.from_quat(self.numbers(given, "quat", 4, ""), scalar_first=True).as_matrix()
        elif "axisangle" in given:
            *axis, angle = self.numbers(given, "axisangle", 4, "")
            rotation = Rotation.from_rotvec(np.array(axis) / np.linalg.norm(axis) * angle * turn)
            T[:3, :3] = rotation.as_matrix()
        elif "euler" in given:
            angles, axes = self.numbers(given, "euler", 3, "") * turn, self.compiler.get("eulerseq", "xyz")
            T[:3, :3] = Rotation.from_euler(axes.swapcase(), angles).as_matrix()
        return T

    def geoms(self, body: Element, T: F64, kind: str, depth: int = 0) -> Iterator[tuple[dict[str, str], F64]]:
        """The attributes of each geom below a body, and the pose of what holds it.

        Raises InputError for joints that move, a second free body, and elements that stand for geoms.
        """
        if depth > _DEEPEST:
            raise _wrong(self.path, "body", "bodies are nested too deeply")
        for element in body:
            if element.tag == "joint" and self.attributes(element, kind).get("type", "hinge") != "free":
                raise _wrong(self.path, f"joint {element.get('name', '')}", "moves: the object is not rigid")
            if element.tag in _MJCF_OTHERS:
                raise _wrong(self.path, element.tag, "stands for bodies or geoms and is not read")
            self.free += element.tag in ("joint", "freejoint")
            if self.free > 1:
                raise _wrong(self.path, "freejoint", "is one of several: the bodies are not one rigid object")
            if element.tag == "geom":
                yield self.attributes(element, kind), T
            elif element.tag in ("body", "frame"):
                T_body = T @ self.pose(element.attrib)
                yield from self.geoms(element, T_body, element.get("childclass", kind), depth + 1)

    def piece(self, given: Mapping[str, str], T: F64) -> Piece | None:
        """None for planes, height fields and meshes without a file."""
        rgb: tuple[float, ...] | None = None
        material = self.assets.get(("material", given.get("material", "")))
        image = None
        if material is not None:
            rgb = tuple(self.numbers(material.attrib, "rgba", 4, "1 1 1 1")[:3])
            texture = self.assets.get(("texture", material.get("texture", "")))
            if texture is not None and texture.get("file"):
                image = self._file(texture, "texturedir")
        if "rgba" in given:
            rgb = tuple(self.numbers(given, "rgba", 4, "")[:3])
        kind, one = given.get("type", "mesh" if "mesh" in given else "sphere"), np.ones(3)
        T = T @ self.pose(given)
        if kind == "mesh":
            mesh = self.assets.get(("mesh", given.get("mesh", "")))
            if mesh is None or not mesh.get("file"):
                raise _wrong(self.path, f"mesh {given.get('mesh', '')[:80]}", "is not among the assets")
            if moved := mesh.attrib.keys() & {"refpos", "refquat"}:
                raise _wrong(
                    self.path, f"mesh {mesh.get('name', '')[:80]}", f"uses {min(moved)}, which is not read"
                )
            scale = self.numbers(self.attributes(mesh, ""), "scale", 3, "1 1 1")
            return Piece(T, self._file(mesh, "meshdir"), scale, "", one, rgb, image)
        if kind not in _SOLIDS:
            return None
        half = self.numbers(given, "size", 0, "")[: _SOLIDS[kind]]
        if len(half) < _SOLIDS[kind]:
            raise _wrong(self.path, f"{kind} size", "has too few numbers")
        whole = np.array([half[0], 2 * half[1]]) if len(half) == 2 else half if len(half) == 1 else 2 * half
        return Piece(T, None, one, kind, whole, rgb, image)

    def _file(self, asset: Element, folder: str) -> Path:
        at = self.compiler.get(folder, self.compiler.get("assetdir", ""))
        return self.path.parent / at / asset.get("file", "").replace("\\", "/")


def _mjcf(path: Path, inside: Callable[[Path], Path]) -> Description:
    model, mass_kg = _Mjcf(path, inside), 0.0
    inertials = [*model.root.iterfind("worldbody//inertial")]
    for each in inertials:
        mass_kg += float(model.numbers(each.attrib, "mass", 1, "0")[0])
    seen: list[tuple[Piece, bool, bool]] = []  # collides, is hidden
    densities: set[float] = set()
    lacks_mass = False
    for body in model.root.iterfind("worldbody"):
        for given, T in itertools.islice(model.geoms(body, np.eye(4), ""), _MOST_PIECES + 1):
            piece = model.piece(given, T)
            if piece is None or (given.get("rgba", "1 1 1 1").split()[3:] == ["0"] and "mesh" not in given):
                continue
            collides = given.get("contype", "1") != "0" or given.get("conaffinity", "1") != "0"
            seen.append((piece, collides, float(model.numbers(given, "group", 1, "0")[0]) >= _HIDDEN_GROUP))
            if not inertials:
                mass_kg += float(model.numbers(given, "mass", 1, "0")[0])
                lacks_mass |= collides and "mass" not in given  # then the others' sum is not the whole
            if collides and "density" in given:
                densities.add(float(model.numbers(given, "density", 1, "")[0]))
    pure = [p for p, collides, hidden in seen if not collides and not hidden]
    shown = pure or [p for p, _, hidden in seen if not hidden] or [p for p, _, _ in seen]
    colliding = [p for p, collides, hidden in seen if collides and hidden]
    colliding = colliding or [p for p, collides, _ in seen if collides]
    density = densities.pop() if len(densities) == 1 else None
    return Description(shown, colliding, None if lacks_mass else mass_kg or None, density or None)


def _text(path: Path, element: Element, tag: str, count: int, default: str) -> F64:
    return _numbers(path, tag, element.findtext(tag) or default, count)


def _numbers(path: Path, where: str, text: str, count: int) -> F64:
    """Finite numbers within limits; any count for 0. Raises InputError."""
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.full(max(1, count), np.nan)
    if (count and len(values) != count) or not (np.abs(values) <= MOST).all():
        raise _wrong(path, where[:80], f"{text!r:.80} is not {count or 'a few'} finite numbers")
    return values


def _wrong(path: Path, field: str, problem: str) -> InputError:
    return InputError(path, field, problem, _FIX)
