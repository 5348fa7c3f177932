"""Meshes from glTF files, within limits, with textures reduced to one colour per face."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any, cast

import numpy as np
from PIL import Image

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular
from datagen.workers.foreign_files import refuse_other_kind
from datagen.workers.geometry.mesh import F64, U8, Mesh, MeshFile
from datagen.workers.json_document import parse_json
from datagen.workers.objects.texture import rgb_of

MAX_FILE_BYTES = 256 << 20
MAX_FACES = 500_000
_MAX_COUNT = 10_000_000  # positions, normals, colours and indices of MAX_FACES loose triangles are fewer
_MAX_JSON_BYTES = 16 << 20
_MAX_NODES = 10_000  # with primitives: trimesh looks for the way from the root to each
_MAX_TEXTURE_PX = 64_000_000
_FARTHEST = 1e6  # a scene may scale millimetres
_PLAIN = (180, 178, 174)
_FIX = "Download the asset again, or remove what uses it."
_COMPRESSED = {"KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_mesh_quantization"}
# Exceptions of trimesh, which checks little itself, for damaged files: dangling references, values of wrong
# types, short buffers, cyclic nodes, textures that Pillow cannot read (OSError) or refuses for their size,
# a stride of 0, numbers beyond 64 bits, compressed meshes (NotImplementedError).
DAMAGE = (
    ValueError, LookupError, TypeError, AttributeError, OSError, struct.error, RecursionError,
    NotImplementedError, ArithmeticError, AssertionError, Image.DecompressionBombError,
)  # fmt: skip


def read_glb(path: Path) -> Mesh:
    """All triangles of the file in its own frame (glTF: y up), vertices merged where they coincide.

    Raises InputError for files that are missing, damaged, empty or beyond the limits.
    """
    try:
        return _merged(path, read_pieces(path, "glb"))
    except DAMAGE as error:
        if isinstance(error, InputError):
            raise
        raise InputError(path, "", f"is a damaged glTF file ({type(error).__name__})", _FIX) from None


def read_pieces(path: Path, kind: str, resolver: Any = None) -> list[Any]:
    """The meshes of trimesh that a file of a kind ("glb", "gltf", ..) holds, each placed as in its scene.

    From memory: of other files only what `resolver` gives is read. Raises InputError as `read_glb` does, or
    one of `DAMAGE`.
    """
    # Imported here: only AI2-THOR houses, robots and some objects need it.
    import trimesh

    data, options = read_regular(path, MAX_FILE_BYTES, _FIX), dict[str, Any](process=False)
    if kind in ("glb", "gltf"):
        refuse_other_kind(path, data, "a binary glTF file" if kind == "glb" else "text", _FIX)
        _check_description(path, _description(path, data) if kind == "glb" else data)
        options = dict[str, Any](skip_materials=False)
    scene = cast(Any, trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=resolver, **options))
    placed = [scene.geometry[scene.graph[node][1]] for node in scene.graph.nodes_geometry]
    # Counted before meshes are copied for each instance.
    count = sum(len(m.faces) for m in placed if isinstance(m, trimesh.Trimesh))
    if 0 < count <= MAX_FACES:
        return [m for m in scene.dump() if isinstance(m, trimesh.Trimesh) and len(m.faces)]
    problem = "no triangles" if count == 0 else f"{count} triangles, more than {MAX_FACES}"
    raise InputError(path, "", problem, _FIX)


def _description(path: Path, data: bytes) -> bytes:
    if len(data) < 20 or data[:4] != b"glTF" or data[16:20] != b"JSON":
        raise InputError(path, "", "is not a binary glTF file", _FIX)
    return data[20 : 20 + int.from_bytes(data[12:16], "little")]


def _check_description(path: Path, text: bytes) -> None:
    """Raise InputError for counts beyond the limits, before anything is unpacked."""
    if len(text) > _MAX_JSON_BYTES:
        raise InputError(path, "", f"has a description of {len(text):,} bytes", _FIX)
    root = parse_json(text, str(path))
    try:
        if packed := _COMPRESSED.intersection(root.value.get("extensionsRequired", [])):
            fix = "Fetch uncompressed meshes, or decompress them, as gltf-transform does"
            raise InputError(path, "extensionsRequired", f"is compressed ({', '.join(sorted(packed))})", fix)
        primitives = [p for m in root.value.get("meshes", []) for p in m["primitives"]]
        parts = len(root.value.get("nodes", [])) + len(primitives)
        counts = [int(a["count"]) for a in root.value.get("accessors", [])]
        # Each primitive becomes its own mesh, even if several share accessors.
        for primitive in primitives:
            named = [
                *primitive["attributes"].values(),
                *[primitive[k] for k in ("indices",) if k in primitive],
            ]
            counts += [counts[k] for k in named]
    except InputError:
        raise
    except (ValueError, LookupError, TypeError, AttributeError, OverflowError):
        raise InputError(path, "", "has an invalid description", _FIX) from None
    if parts > _MAX_NODES:
        raise InputError(path, "", f"has more than {_MAX_NODES:,} nodes and primitives", _FIX)
    if counts and (min(counts) < 0 or sum(counts) > _MAX_COUNT):
        raise InputError(path, "accessors", "have impossible counts of vertices or indices", _FIX)


def _merged(path: Path, pieces: list[Any]) -> Mesh:
    vertices: list[F64] = []
    faces: list[Any] = []
    colours: list[U8] = []
    offset = 0
    for piece in pieces:
        vertices.append(np.asarray(piece.vertices, np.float64))
        faces.append(np.asarray(piece.faces, np.int64) + offset)
        colours.append(_face_rgb(piece))
        offset += len(piece.vertices)
    points = np.concatenate(vertices)
    if not np.isfinite(points).all() or np.abs(points).max() > _FARTHEST:
        raise ValueError("coordinates that are not finite or too large")
    keys, inverse = np.unique(np.round(points / 1e-5).astype(np.int64), axis=0, return_inverse=True)
    indices = inverse.reshape(-1)[np.concatenate(faces)]
    keep = (
        (indices[:, 0] != indices[:, 1]) & (indices[:, 1] != indices[:, 2]) & (indices[:, 0] != indices[:, 2])
    )
    if not keep.any():
        raise ValueError("no triangle with three different corners")
    rgb, file = np.concatenate(colours)[keep], MeshFile(path, np.flatnonzero(keep).astype(np.int32))
    return Mesh((keys * 1e-5).astype(np.float32), indices[keep].astype(np.int32), rgb, file=file)


def _face_rgb(piece: Any) -> U8:
    """Face colours (F, 3): vertex colours, the texture at the middle, or the material's factor."""
    count = len(piece.faces)
    visual = piece.visual
    if visual.kind == "vertex" or visual.kind == "face":
        return np.asarray(visual.face_colors)[:, :3].astype(np.uint8)
    material = getattr(visual, "material", None)
    factor = getattr(material, "baseColorFactor", None)
    rgb = np.array(_PLAIN if factor is None else np.asarray(factor)[:3], np.float64)
    if factor is not None and np.asarray(factor).dtype.kind == "f":
        rgb = rgb * 255
    image = getattr(material, "baseColorTexture", None)
    uv = getattr(visual, "uv", None)
    if image is None or uv is None or len(uv) != len(piece.vertices):
        return np.tile(np.clip(rgb, 0, 255).astype(np.uint8), (count, 1))
    if image.width * image.height > _MAX_TEXTURE_PX:
        raise ValueError("a texture of more than 64 million pixels")
    pixels = np.asarray(rgb_of(image))
    middle = np.asarray(uv, np.float64)[piece.faces].mean(1) % 1.0
    rows = np.clip(((1.0 - middle[:, 1]) * image.height).astype(int), 0, image.height - 1)
    columns = np.clip((middle[:, 0] * image.width).astype(int), 0, image.width - 1)
    tint = 1.0 if factor is None else np.clip(rgb, 0, 255) / 255
    return (pixels[rows, columns] * tint).astype(np.uint8)
