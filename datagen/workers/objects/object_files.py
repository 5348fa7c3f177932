"""Find the objects of a folder by content: descriptions, and meshes that none of them covers."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from datagen.schemas.errors import InputError, refuse_not_utf8
from datagen.schemas.identity import digest_of
from datagen.schemas.safe_files import open_regular
from datagen.workers.objects.surfaces import SUFFIXES

TABLE = "objects.csv"
DESCRIPTIONS = (".urdf", ".xml", ".sdf")
_HASHED = (*SUFFIXES, *DESCRIPTIONS, ".mtl", ".bin", ".png", ".jpg", ".jpeg", ".csv")
_MOST_FILES, _MOST_BYTES = 200_000, 512 << 20
_START_BYTES = 4096
# File names that say what a file is for; the object is named by its folder. The first is the best.
_ROLES = ("textured", "textured_simple", "visual", "model", "mesh", "object", "scene", "nontextured", "base")
# Folders that hold one object's files, or one of several scans of it; the first is the best.
_INNER = ("google_16k", "google_64k", "google_512k", "poisson", "tsdf", "meshes", "visual", "mesh", "models")
_COLLISION = re.compile(
    r"(?:^|[-_. ])(?:col|coll|collision|collider|convex|vhacd|coacd|hull|contact\d*)(?=$|[-_. ])", re.I
)
_NUMBER = re.compile(r"[-_. ]?\d+$")
# Of a description beside NAME: Gazebo's model for older versions of SDF, robosuite's marker of a goal.
_TWIN = re.compile(r"(?<=^model)-\d+_\d+$|[-_]visual$")


@dataclass(frozen=True)
class ObjectFiles:
    """An object's description, or its mesh and perhaps the meshes of its collision parts."""

    name: str
    path: Path
    collisions: tuple[Path, ...] = ()


def find_objects(root: Path) -> tuple[list[ObjectFiles], str]:
    """The objects of a folder by name, and the sha256 over the files that they may be made of.

    Raises InputError for a folder that is missing or has too many files, and for a name that is not UTF-8.
    """
    if not root.is_dir():
        raise InputError(root, "", "is not a folder", "Give a folder of objects")
    folders = list(_folders(root))
    digests = {str(path.relative_to(root)): _digest(path) for _, files in folders for path in files}
    covered: set[Path] = set()
    found: list[ObjectFiles] = []
    for folder, files in folders:
        described = [path for path in files if path.suffix.lower() in DESCRIPTIONS and _describes(path)]
        stems = {path.stem for path in described}
        described = [p for p in described if (own := _TWIN.sub("", p.stem)) == p.stem or own not in stems]
        if described:
            covered.add(folder)
            found += [ObjectFiles(_name(path, root), path) for path in described]
        elif not covered.intersection((folder, *folder.parents)):
            found += _meshes(root, [path for path in files if path.suffix.lower() in SUFFIXES])
    named: dict[str, list[ObjectFiles]] = {}
    for each in found:
        named.setdefault(each.name, []).append(each)
    objects = [entry for same in named.values() for entry in _distinct(root, same)]
    return sorted(objects, key=lambda entry: entry.name), digest_of(digests)


def _folders(root: Path) -> Iterator[tuple[Path, list[Path]]]:
    """Folders above their subfolders, each with the files that matter; links to folders are not followed."""
    count = 0
    for at, folders, files in os.walk(root):
        folders[:] = sorted(f for f in folders if not f.startswith((".", "__")) and f.lower() != "clouds")
        wanted = [Path(at, refuse_not_utf8(f)) for f in sorted(files) if f.lower().endswith(_HASHED)]
        count += len(wanted)
        if count > _MOST_FILES:
            fix = "Give a folder of objects alone"
            raise InputError(root, "", f"holds more than {_MOST_FILES:,} files", fix)
        yield Path(at), wanted


def _digest(path: Path) -> str:
    """sha256 of a file; its problem where it cannot be read, which reading it will report."""
    try:
        with open_regular(path, _MOST_BYTES, "") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except InputError as error:
        return error.problem


def _describes(path: Path) -> bool:
    """Whether a file describes an object: any URDF and SDF, and MJCF with bodies."""
    if path.suffix.lower() != ".xml":
        return True
    try:
        with open_regular(path, _MOST_BYTES, "") as file:
            text = file.read()
    except InputError:
        return False
    return b"<mujoco" in text[:_START_BYTES] and b"<mujocoinclude" not in text and b"<worldbody" in text


def _meshes(root: Path, meshes: list[Path]) -> list[ObjectFiles]:
    """Each mesh of a folder is an object, or one object, the best of them, where a name says a role."""
    collisions = [path for path in meshes if _COLLISION.search(path.stem) or path.parent.name == "collision"]
    visuals = sorted((path for path in meshes if path not in collisions), key=_rank)
    if visuals and visuals[0].stem.lower() in _ROLES:
        visuals = visuals[:1]
    objects: dict[str, ObjectFiles] = {}
    for path in visuals:
        own = [c for c in collisions if len(visuals) == 1 or _owner(c, visuals) == path.stem]
        # `NAME_collision_0` and `NAME_collision_1` are parts of one set, and `NAME_vhacd` is another set.
        own = [c for c in own if (_unnumbered(c.stem), c.suffix) == (_unnumbered(own[0].stem), own[0].suffix)]
        objects.setdefault(path.stem, ObjectFiles(_name(path, root), path, tuple(own)))
    return list(objects.values())


def _owner(collision: Path, visuals: list[Path]) -> str:
    """The name of the mesh that a collision mesh belongs to."""
    name = _COLLISION.sub("", collision.stem)
    return name if any(name == path.stem for path in visuals) else _unnumbered(name)


def _unnumbered(name: str) -> str:
    return _NUMBER.sub("", name)


def _rank(path: Path) -> tuple[int, int, str]:
    stem = path.stem.lower()
    role = _ROLES.index(stem) if stem in _ROLES else len(_ROLES)
    return role, SUFFIXES.index(path.suffix.lower()), path.name


def _name(path: Path, root: Path) -> str:
    """The file's name without its ending, or the name of its folder where that says more."""
    if path.stem.lower() not in _ROLES:
        return path.stem
    above = [folder for folder in path.parents if folder != root and folder.is_relative_to(root)]
    return next((f.name for f in above if f.name.lower() not in _INNER), root.name)


def _distinct(root: Path, same: list[ObjectFiles]) -> list[ObjectFiles]:
    """The best of an object's scans or formats in folders of its own; other files by their paths."""
    homes = {tuple(p for p in e.path.relative_to(root).parent.parts if p.lower() not in _INNER) for e in same}
    if len(homes) > 1:
        return [
            ObjectFiles(str(e.path.relative_to(root).with_suffix("")), e.path, e.collisions) for e in same
        ]
    return [min(same, key=_scan_rank)]


def _scan_rank(entry: ObjectFiles) -> tuple[int, int, str]:
    suffix, inner = entry.path.suffix.lower(), entry.path.parent.name.lower()
    kind = DESCRIPTIONS.index(suffix) if suffix in DESCRIPTIONS else len(DESCRIPTIONS)
    return kind, _INNER.index(inner) if inner in _INNER else len(_INNER), str(entry.path)
