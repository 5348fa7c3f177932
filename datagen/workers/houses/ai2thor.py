"""AI2-THOR scenes as the habitat conversion lays them out on disk.

ROOT/ai2thor-hab/configs/scenes/SET/**/NAME.scene_instance.json   stage and object instances
ROOT/ai2thor-hab/assets/stages/**/NAME.glb                        walls and floors
ROOT/ai2thorhab-uncompressed/assets/objects/NAME.glb              furniture and things
ROOT/ai2thorhab-uncompressed/configs/objects/NAME.object_config.json   {semantic_id}
ROOT/ai2thor-hab/configs/object_semantic_id_mapping.json          {object type: semantic id}

Stages of the ProcTHOR set are stored turned by 90 degrees about the vertical.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.identity import digest_of
from datagen.schemas.safe_files import read_regular
from datagen.workers.furniture.assets import CARRYING_TYPES
from datagen.workers.geometry.mesh import F64
from datagen.workers.houses.habitat import SCENE, HabitatHouses, carrying_type
from datagen.workers.houses.habitat_files import AssetFiles, sizes
from datagen.workers.json_document import JsonNode, parse_json
from datagen.workers.source_statement import read_statement

_SCENES = Path("ai2thor-hab/configs/scenes")
_OBJECTS = Path("ai2thorhab-uncompressed/assets")
_CONFIGS = Path("ai2thorhab-uncompressed/configs")
_STAGES = Path("ai2thor-hab/assets")
_FIX = "Download the scenes again."
# The rotation of ProcTHOR stages back about the vertical.
_PROCTHOR_STAGE = np.array([[0, 0, -1.0, 0], [0, 1.0, 0, 0], [1.0, 0, 0, 0], [0, 0, 0, 1.0]])


def root_of(folder: Path) -> Path | None:
    """The folder of the data set at or below a folder; None where there is none."""
    below = (
        folder,
        folder / "ai2thor",
        folder / "scene_datasets/ai2thor",
        folder / "data/scene_datasets/ai2thor",
    )
    return next((root for root in below if (root / _SCENES).is_dir()), None)


def open_ai2thor(folder: str) -> HabitatHouses:
    """The scenes below a download folder (the one that holds ai2thor-hab, or one above it).

    Hashing every mesh would read many gigabytes, so the source's digest covers the object types and
    the names and sizes of all scenes, meshes and object configurations; each house's own digest
    covers the bytes of its scene and meshes and the types of its objects.
    """
    base = Path(folder)
    fix = "Name it as ai2thor:DIR, where DIR holds ai2thor-hab/ and ai2thorhab-uncompressed/."
    root = root_of(base) if folder else None
    if root is None:
        raise InputError(folder or "ai2thor", "", "has no folder ai2thor-hab/configs/scenes", fix)
    top = root / _SCENES
    found = {p.relative_to(top).as_posix().removesuffix(SCENE): n for p, n in sizes(top, f"*{SCENE}")}
    if not found:
        raise InputError(top, "", "has no scenes", fix)
    listing: list[object] = [[i, found[i]] for i in sorted(found)]
    patterns = ((_OBJECTS, "*.glb"), (_STAGES, "*.glb"), (_CONFIGS, "*.object_config.json"))
    files = sorted(file for part, pattern in patterns for file in sizes(root / part, pattern))
    listing += [[p.relative_to(root).as_posix(), n] for p, n in files]
    types = _types(root)
    scenes = {i: top / f"{i}{SCENE}" for i in sorted(found)}
    digest = digest_of([listing, sorted(types.items())])
    return HabitatHouses(
        *(root, digest, scenes, types, partial(_find, root), _stage_turn, carrying_type, CARRYING_TYPES),
        *(read_statement(root), "ai2thor"),
    )


def _find(root: Path, name: str, is_stage: bool) -> AssetFiles:
    if is_stage:
        return AssetFiles(root / _STAGES / f"{name}.glb")
    return AssetFiles(root / _OBJECTS / f"{name}.glb", root / _CONFIGS / f"{name}.object_config.json")


def _stage_turn(house_id: str) -> F64:
    return _PROCTHOR_STAGE if house_id.startswith("ProcTHOR/") else np.eye(4)


def _types(root: Path) -> dict[int, str]:
    path = root / "ai2thor-hab/configs/object_semantic_id_mapping.json"
    if not path.is_file():
        return {}
    place = str(path)
    value = parse_json(read_regular(path, 1 << 20, _FIX), place).value
    members = cast(dict[str, Any], value) if isinstance(value, dict) else {}
    return {
        int(JsonNode(place, f"$.{k}", v).number(-1, 1e9)): JsonNode(place, "$", k).text()
        for k, v in members.items()
    }
