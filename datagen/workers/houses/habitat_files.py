"""Files of a habitat dataset: its scenes, and the meshes and configurations that its templates name."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import open_regular, read_regular
from datagen.workers.furniture.asset_geometry import type_of_name
from datagen.workers.houses.glb import MAX_FILE_BYTES
from datagen.workers.json_document import JsonNode, parse_json

FIX = "Download the scenes again."
_MAX_FILES = 200_000  # files of one kind
_MAX_CLASSES = 10_000


@dataclass(frozen=True)
class AssetFiles:
    """The files of a stage or an object; `scale` (3,) is along the mesh's axes."""

    mesh: Path
    config: Path | None = None
    collision: Path | None = None
    scale: tuple[float, ...] = (1.0, 1.0, 1.0)


# The files of the template of a name, which may be a stage; None if there are none.
FindAsset = Callable[[str, bool], AssetFiles | None]


def scene_folders(dataset: Path) -> list[str]:
    """The folders of scenes that a dataset's configuration names, relative to it."""
    root = parse_json(read_regular(dataset, 1 << 20, FIX), str(dataset))
    paths = root.get("scene_instances").get("paths").get(".json")
    return [_below(node, node.text()) for node in paths.items(100)]


def semantic_classes(path: Path) -> list[tuple[int, str]]:
    """Ids and object types of a semantic lexicon. InputError that names the first wrong field."""
    root = parse_json(read_regular(path, 1 << 22, FIX), str(path))
    entries = list(root.get("classes").items(_MAX_CLASSES))
    return [(int(e.get("id").number(-1, 1e9)), type_of_name(e.get("name").text())) for e in entries]


def configured_files(config: Path, root: Path) -> AssetFiles:
    """The files that a configuration names. InputError for one outside the root, and a turned mesh."""
    node = parse_json(read_regular(config, 1 << 20, FIX), str(config))
    paths = list[Path | None]()
    for key in ("render_asset", "collision_asset"):
        named = node.find(key)
        path = None if named is None else (config.parent / named.text()).resolve()
        if named is not None and path is not None and not path.is_relative_to(root.resolve()):
            raise named.error(f"{named.text()!r} is not below {root}")
        paths.append(path)
    mesh, collision = paths[0] or config.with_name(config.name.split(".")[0] + ".glb"), paths[1]
    for key, axis in (("up", (0, 1, 0)), ("front", (0, 0, -1))):
        found = node.given(key, [*axis])
        if np.abs(np.subtract(found.numbers(3, -1.0, 1.0), axis)).max() > 1e-3:
            raise found.error(f"is not {str(axis)[1:-1]}", "Turn the mesh so that y is up and -z its front")
    if collision is not None and (collision.suffix != ".glb" or not collision.is_file()):
        collision = None
    factors = node.given("scale", [1, 1, 1]).numbers(3, 1e-3, 1e3)
    return AssetFiles(mesh, config, collision, tuple(factors))


def config_of(files: AssetFiles) -> JsonNode | None:
    """The configuration of a template, None where it has none."""
    path = files.config
    if path is None or not path.is_file():
        return None
    return parse_json(read_regular(path, 1 << 20, FIX), str(path))


def file_digest(path: Path) -> bytes:
    """sha256 of a file. InputError for one that is too large."""
    with open_regular(path, MAX_FILE_BYTES, FIX) as stream:
        return hashlib.file_digest(stream, "sha256").digest()


def sizes(folder: Path, pattern: str) -> list[tuple[Path, int]]:
    """The files below a folder with their sizes. Raises InputError for too many or unprintable names."""
    try:
        found = [(p, p.stat().st_size) for p in itertools.islice(folder.rglob(pattern), _MAX_FILES + 1)]
    except OSError as error:
        raise InputError(str(error.filename), "", f"cannot be read: {error.strerror}", FIX) from None
    odd = next((p for p, _ in found if not p.relative_to(folder).as_posix().isprintable()), None)
    if odd is not None:
        raise InputError(odd, "", "has a name with unprintable characters", "Rename the file.")
    if len(found) > _MAX_FILES:
        raise InputError(folder, "", f"has more than {_MAX_FILES:,} files", "Remove some.")
    return sorted(found)


def template_name(entry: JsonNode) -> str:
    """A template's path below the assets folder; it may not lead out of it."""
    node = entry.get("template_name")
    return _below(node, node.text())


def _below(node: JsonNode, name: str) -> str:
    pieces = PurePosixPath(name).parts
    if not pieces or name.startswith("/") or ".." in pieces or "\\" in name or "\0" in name:
        raise node.error(f"{name!r} is not a path below the assets folder")
    return name
