"""Find URDFs and meshes: beside a file, or in an installed Python package, without importing it; read XML."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular
from datagen.workers.extras import EXTRAS, how_to_get

_PACKAGE = re.compile(r"package:([A-Za-z0-9_.-]{1,100})/(.+)", re.DOTALL)


def resource(text: str, folder: Path, place: str | Path, field: str) -> Path:
    """The path that a key names: from a folder, or `package:NAME/path` in an installed package.

    Raises InputError naming the key for a package that is not installed and a path that leaves it.
    """
    found = _PACKAGE.fullmatch(text)
    if found is None:
        if text.startswith("package:"):
            raise InputError(place, field, f"{text[:80]!r} names no package", "Write package:NAME/path/in/it")
        return folder / text
    name, rest = found[1], found[2]
    if ".." in PurePosixPath(rest).parts:
        raise InputError(place, field, f"{text[:80]!r} leaves its package", "Write package:NAME/path/in/it")
    folders = list(package_folders(name))
    if not folders:
        raise InputError(place, field, f"the package {name} is not installed", _install(name))
    return next((path for path in (each / rest for each in folders) if path.exists()), folders[0] / rest)


def mesh_path(text: str, urdf: Path) -> Path:
    """The mesh that a URDF names; where it is not found, the path at which it was expected.

    The first part of `package://NAME/path` is a ROS package: a folder above the URDF of that name or that
    holds it, or an installed Python package; `model://NAME/path` of Gazebo is searched alike.
    """
    kind, _, plain = text.rpartition("://")
    if kind not in ("package", "model"):
        return urdf.parent / (plain if kind == "file" else text)
    name, _, rest = plain.partition("/")
    near = [urdf.parent / name / rest]
    for folder in urdf.absolute().parents:
        near += [folder / rest] if folder.name == name else []
        near.append(folder / name / rest)
    installed = (folder / rest for folder in package_folders(name))
    # ManiSkill's files have no folder of the package's name.
    return next((path for path in (*near, *installed) if path.is_file()), urdf.parent / name / rest)


def package_folders(name: str) -> Iterator[Path]:
    """Folders of an installed package of this name: a Python package, or data below `share` of a wheel."""
    if name.isidentifier():
        try:
            spec = find_spec(name)
        except (ImportError, ValueError):
            spec = None
        yield from map(Path, (spec and spec.submodule_search_locations) or ())
    if re.fullmatch(r"[A-Za-z0-9_-]+", name):
        for root in map(Path, filter(None, sys.path)):
            for share in (root / "cmeel.prefix/share" / name, root / "share" / name):
                if share.is_dir():
                    yield share


def _install(name: str) -> str:
    for extra, brought in EXTRAS.items():
        if name in brought.brings or name in brought.brings.values():
            return how_to_get(extra)
    return "Install it with pip, or give a path"


_MAX_BYTES = 8 << 20
_PREFIX = re.compile(rb"<(/?)(\w+):")  # Drake's elements are written without their namespace


class _NoTypes(ElementTree.TreeBuilder):
    """Refuses a document type: its entities could multiply to any size, or name other files."""

    def doctype(self, *_: object) -> None:
        """Called where one begins, in any encoding."""
        raise ValueError("it declares a document type; such files have none")


def read_xml(path: Path, fix: str) -> ElementTree.Element:
    """The root element of a file. Raises InputError, with `fix`."""
    data = read_regular(path, _MAX_BYTES, fix).lstrip()
    try:
        try:
            return ElementTree.fromstring(data, ElementTree.XMLParser(target=_NoTypes()))
        except ElementTree.ParseError as error:
            if "unbound prefix" not in str(error):
                raise
        data = _PREFIX.sub(rb"<\1\2-", data)
        return ElementTree.fromstring(data, ElementTree.XMLParser(target=_NoTypes()))
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(path, "", f"is not XML ({error})", fix) from error
