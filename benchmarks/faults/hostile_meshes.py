"""Hostile meshes: each is refused in one line, or becomes a finite object, in bounded time and memory.

    python -m benchmarks.faults.hostile_meshes [--only WORD] [--memory-gb 3] [--limit-s 120]

Each case is read in a process of its own: an object of a folder as `ycb:` reads it, with its hulls, its
gripper and its rays, or a binary glTF file with all that a house needs of it. Ends with 1 where one broke.
"""

from __future__ import annotations

import argparse
import json
import resource
import struct
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from datagen.schemas.errors import InputError
from tests.workers.objects.toy_set import CUBE_OBJ, write_bundle

Made = Callable[[], str]


def _obj(vertices: Any, faces: Any) -> str:
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    return (
        "\n".join([*lines, "vt 0 0", *(f"f {a}/1 {b}/1 {c}/1" for a, b, c in np.asarray(faces) + 1)]) + "\n"
    )


def _ball(count: int, rng: np.random.Generator, radius_m: float = 0.03) -> Any:
    points = rng.normal(size=(count, 3))
    return radius_m * points / np.linalg.norm(points, axis=1)[:, None]


def _soup(count: int, size_m: float = 0.05) -> str:
    rng = np.random.default_rng(0)
    return _obj(rng.uniform(0, size_m, (3 * count, 3)), np.arange(3 * count).reshape(-1, 3))


def _fan(count: int) -> str:
    vertices = np.vstack([[[0.0, 0.0, 0.05]], _ball(count, np.random.default_rng(1))])
    ring = np.arange(1, count)
    return _obj(vertices, np.stack([np.zeros_like(ring), ring, ring + 1], 1))


def _polygon(corners: int) -> str:
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    lines = [f"v {0.03 * np.cos(a):.9f} {0.03 * np.sin(a):.9f} 0" for a in angle] + ["v 0 0 0.04", "vt 0 0"]
    face = " ".join(f"{k}/1" for k in range(1, corners + 1))
    return "\n".join([*lines, f"f {face}", f"f 1/1 2/1 {corners + 1}/1"]) + "\n"


def _scaled(factor: str) -> str:
    return "\n".join(
        " ".join([line.split()[0], *(f"{word}{factor}" for word in line.split()[1:])])
        if line.startswith("v ") else line
        for line in CUBE_OBJ.splitlines()
    )  # fmt: skip


def _groups(count: int) -> str:
    tetrahedron = "v 0 0 0\nv 0.01 0 0\nv 0 0.01 0\nv 0 0 0.01\n"
    one = "f -4 -3 -2\nf -4 -2 -1\nf -4 -1 -3\nf -3 -1 -2\n"
    return "".join(f"o part_{k}\n{tetrahedron}{one}" for k in range(count))


OBJECTS: Mapping[str, Made] = {
    "cube": lambda: CUBE_OBJ,
    "one triangle": lambda: "v 0 0 0\nv 0.05 0 0\nv 0 0.05 0\nvt 0 0\nf 1/1 2/1 3/1\n",
    "flat": lambda: "v 0 0 0\nv 0.05 0 0\nv 0 0.05 0\nv 0.05 0.05 0\nvt 0 0\nf 1/1 2/1 3/1\nf 2/1 4/1 3/1\n",
    "a line": lambda: "v 0 0 0\nv 0.02 0 0\nv 0.05 0 0\nvt 0 0\nf 1/1 2/1 3/1\n",
    "a point": lambda: "v 0.01 0 0\nvt 0 0\nf 1/1 1/1 1/1\n",
    "the same corner thrice in every face": lambda: CUBE_OBJ.replace("f 4/4 3/3 2/2 1/1", "f 4/4 4/4 4/4"),
    "faces turned inside out": lambda: "\n".join(
        " ".join([line.split()[0], *line.split()[:0:-1]]) if line.startswith("f ") else line
        for line in CUBE_OBJ.splitlines()
    ),
    "each face 20,000 times": lambda: CUBE_OBJ + CUBE_OBJ[CUBE_OBJ.index("f ") :] * 20_000,
    "numbers near the largest": lambda: _scaled("e307"),
    "numbers of 1e38": lambda: _scaled("e39"),
    "denormal numbers": lambda: _scaled("e-310"),
    "numbers of 1,000 digits": lambda: _scaled("0" * 1000),
    "a vertex far away that no face uses": lambda: (
        "v 1e30 0 0\n" + CUBE_OBJ.replace("f ", "f ").replace("f 4/4 3/3 2/2 1/1", "f 5/4 4/3 3/2 2/1")
    ),
    "sliver": lambda: (
        "v 0 0 0\nv 0.05 0 0\nv 0.05 1e-9 0\nv 0 0 0.04\nvt 0 0\nf 1/1 2/1 3/1\nf 1/1 2/1 4/1\n"
    ),
    "300,000 loose triangles": lambda: _soup(300_000),
    "two million faces on one vertex": lambda: _fan(600_000),
    "a polygon of 100,000 corners": lambda: _polygon(100_000),
    "500,000 points on a ball": lambda: _fan(500_000),
    "1,024 parts": lambda: _groups(1024),
    "20,000 parts": lambda: _groups(20_000),
    "100,000 loose parts without a name": lambda: _groups(100_000).replace("o part_", "# part_"),
}


def _ply(vertices: Any, faces: Any, count: int | None = None) -> bytes:
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\nproperty float x\n"
        f"property float y\nproperty float z\nelement face {len(faces) if count is None else count}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    corners = b"".join(struct.pack("<Biii", 3, *map(int, face)) for face in faces)
    return head.encode() + np.asarray(vertices, "<f4").tobytes() + corners


_TETRAHEDRON = (
    np.array([[0, 0, 0], [0.04, 0, 0], [0, 0.04, 0], [0, 0, 0.04]]),
    [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
)
PLYS: Mapping[str, Callable[[], bytes]] = {
    "tetrahedron": lambda: _ply(*_TETRAHEDRON),
    "a face count of 10^15": lambda: _ply(*_TETRAHEDRON, count=10**15),
    "a face count of -1": lambda: _ply(*_TETRAHEDRON, count=-1),
    "cut off": lambda: _ply(*_TETRAHEDRON)[:-20],
    "NaN": lambda: _ply(np.full((4, 3), np.nan), _TETRAHEDRON[1]),
    "indices beyond": lambda: _ply(_TETRAHEDRON[0], [[0, 1, 9]]),
    "negative indices": lambda: _ply(_TETRAHEDRON[0], [[0, 1, -2]]),
    "no faces": lambda: _ply(_TETRAHEDRON[0], []),
    "a text of nothing": lambda: b"ply\nformat ascii 1.0\nend_header\n",
    "a header without end": lambda: b"ply\n" + b"comment a\n" * 1_000_000,
    "an element 100,000 times": lambda: (
        b"ply\nformat ascii 1.0\n" + b"element vertex 1\nproperty float x\n" * 100_000 + b"end_header\n"
    ),
    "a vertex count of 10^12 in text": lambda: (
        b"ply\nformat ascii 1.0\nelement vertex 1000000000000\nproperty float x\nend_header\n0\n"
    ),
}


def _glb(change: Callable[[dict[str, Any]], None] = lambda root: None, blob: bytes | None = None) -> bytes:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4").tobytes()
    indices = np.array([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3], "<u2").tobytes()
    data = blob if blob is not None else vertices + indices
    root: dict[str, Any] = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 24},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"},
        ],
    }  # fmt: skip
    change(root)
    text = json.dumps(root).encode()
    text += b" " * (-len(text) % 4)
    whole = (
        struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    )
    return b"glTF" + struct.pack("<II", 2, len(whole) + 12) + whole


def _set(path: str, value: Any) -> bytes:
    def change(root: dict[str, Any]) -> None:
        *parts, last = [int(part) if part.isdigit() else part for part in path.split(".")]
        at: Any = root
        for part in parts:
            at = at[part]
        at[last] = value

    return _glb(change)


def _circle(corners: int) -> bytes:
    """A cone, whose foot is one face for qhull."""
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    points = np.vstack([np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1), [[0, 0, 1]]]).astype("<f4")
    ring = np.arange(corners)
    faces = np.stack([ring, (ring + 1) % corners, np.full(corners, corners)], 1).astype("<u4")
    blob = points.tobytes() + faces.tobytes()

    def change(root: dict[str, Any]) -> None:
        root["bufferViews"][0]["byteLength"] = points.nbytes
        root["bufferViews"][1] |= {"byteOffset": points.nbytes, "byteLength": faces.nbytes}
        root["accessors"][0]["count"] = len(points)
        root["accessors"][1] |= {"count": faces.size, "componentType": 5125}

    return _glb(change, blob)


GLBS: Mapping[str, Callable[[], bytes]] = {
    "tetrahedron": _glb,
    "positions of NaN": lambda: _glb(blob=np.full(12, np.nan, "<f4").tobytes() + bytes(24)),
    "positions of 3e38": lambda: _glb(blob=np.full(12, 3e38, "<f4").tobytes() + bytes(24)),
    "all in one point": lambda: _glb(blob=bytes(72)),
    "an index beyond": lambda: _glb(blob=bytes(48) + np.full(12, 65535, "<u2").tobytes()),
    "a view before the buffer": lambda: _set("bufferViews.0.byteOffset", -48),
    "a view beyond the buffer": lambda: _set("bufferViews.0.byteOffset", 10**12),
    "an accessor of no component": lambda: _set("accessors.0.componentType", 1),
    "an accessor of no type": lambda: _set("accessors.0.type", "MAT9"),
    "positions of one number": lambda: _set("accessors.0.type", "SCALAR"),
    "a count of 10^18": lambda: _set("accessors.0.count", 10**18),
    "a count that is true": lambda: _set("accessors.0.count", True),
    "a stride of 0": lambda: _set("bufferViews.0.byteStride", 0),
    "a stride of 2^31": lambda: _set("bufferViews.0.byteStride", 2**31),
    "a matrix of NaN": lambda: _set("nodes.0.matrix", [float("nan")] * 16),
    "a matrix of 15": lambda: _set("nodes.0.matrix", [1.0] * 15),
    "a scale of 0": lambda: _set("nodes.0.scale", [0, 0, 0]),
    "a scale of 1e300": lambda: _set("nodes.0.scale", [1e300] * 3),
    "a rotation of 0": lambda: _set("nodes.0.rotation", [0, 0, 0, 0]),
    "a node that is its own child": lambda: _set("nodes.0.children", [0]),
    "a chain of 5,000 nodes": lambda: _set(
        "nodes", [{"children": [k + 1]} for k in range(5_000)] + [{"mesh": 0}]
    ),
    "a chain of 60,000 nodes": lambda: _set(
        "nodes", [{"children": [k + 1]} for k in range(60_000)] + [{"mesh": 0}]
    ),
    "2^17 instances": lambda: _glb(
        lambda root: root.update(scenes=[{"nodes": list(range(2**17))}], nodes=[{"mesh": 0}] * 2**17)
    ),
    "2^24 instances in a tree": lambda: _glb(
        lambda root: root.update(nodes=[{"children": [k + 1] * 64} for k in range(4)] + [{"mesh": 0}])
    ),
    "100,000 primitives of one accessor": lambda: _set(
        "meshes.0.primitives", [{"attributes": {"POSITION": 0}, "indices": 1}] * 100_000
    ),
    "100,000 corners on a circle": lambda: _circle(100_000),
    "triangle strips": lambda: _set("meshes.0.primitives.0.mode", 5),
    "points": lambda: _set("meshes.0.primitives.0.mode", 0),
    "mode 99": lambda: _set("meshes.0.primitives.0.mode", 99),
    "sparse": lambda: _set(
        "accessors.0.sparse", {"count": 10**9, "indices": {"bufferView": 0}, "values": {"bufferView": 0}}
    ),
    "a buffer elsewhere": lambda: _set("buffers.0.uri", "file:///etc/passwd"),
    "a buffer of base64": lambda: _set("buffers.0.uri", "data:application/octet-stream;base64,AAAA"),
    "a mesh by a text": lambda: _set("nodes.0.mesh", "0"),
    "Draco": lambda: _set(
        "meshes.0.primitives.0.extensions", {"KHR_draco_mesh_compression": {"bufferView": 0}}
    ),
}


def read_object(folder: Path) -> None:
    """Open the folder as objects, and use the object as a scene does. Raises InputError."""
    from datagen.workers.objects import open_objects
    from datagen.workers.rendering.embree import object_rays

    source = open_objects(f"ycb:{folder}")
    for name in source.names():
        model = source.load(name)
        object_rays(model)
        numbers = [model.visual.vertices_m, *model.convex_parts_m, np.array([model.mass_kg, model.radius_m])]
        assert all(np.isfinite(array).all() for array in numbers), "a number is not finite"


def read_house_mesh(path: Path) -> None:
    """Read a binary glTF file, and derive all that a house needs of it. Raises InputError."""
    from datagen.workers.houses import mesh_geometry
    from datagen.workers.houses.glb import read_glb

    mesh = read_glb(path)
    parts = [*mesh_geometry.convex_parts(mesh), *mesh_geometry.slab_parts(mesh, 0.02, 3.0)]
    mesh_geometry.flat_tops(mesh, 0.3, 1.2)
    mesh_geometry.outlines(mesh, np.ones(len(mesh.faces), np.bool_))
    assert all(np.isfinite(array).all() for array in (mesh.vertices_m, *parts)), "a number is not finite"


def one(kind: str, path: Path) -> int:
    """Read one case in this process: 0 where it is used, 2 where it is refused in one line."""
    with warnings.catch_warnings():
        # Overflows and NaN on the way, except in libraries.
        warnings.filterwarnings("error", category=RuntimeWarning, module=r"datagen\b")
        try:
            (read_house_mesh if kind == "glb" else read_object)(path)
        except InputError as error:
            print(str(error))
            return 2
    return 0


def put(folder: Path, kind: str, name: str) -> Path:
    """Write the files of a case; what `one` reads."""
    if kind == "glb":
        (folder / "mesh.glb").write_bytes(GLBS[name]())
        return folder / "mesh.glb"
    home = write_bundle(folder / "objects", "box")
    if kind == "visual":
        (home / "box" / "textured.obj").write_text(OBJECTS[name]())
    elif kind == "collision":
        (home / "box" / "collision.obj").write_text(OBJECTS[name]())
    else:
        (home / "box" / "collision.obj").unlink()
        (home / "box" / "collision.ply").write_bytes(PLYS[name]())
        index = (home / "objects.json").read_text().replace("collision.obj", "collision.ply")
        (home / "objects.json").write_text(index)
    return home


def cases() -> list[tuple[str, str]]:
    """(kind, name) of every case."""
    kinds = {"visual": OBJECTS, "collision": OBJECTS, "ply": PLYS, "glb": GLBS}
    return [(kind, name) for kind, names in kinds.items() for name in names]


def try_case(kind: str, name: str, memory_gb: float, limit_s: float) -> tuple[str, float]:
    """(what broke, or "", and the seconds) of a case."""
    with tempfile.TemporaryDirectory() as folder:
        path = put(Path(folder), kind, name)
        limit = int(memory_gb * 2**30)
        began_s = time.monotonic()
        command = [
            sys.executable,
            "-m",
            "benchmarks.faults.hostile_meshes",
            "--one",
            kind,
            "--path",
            str(path),
        ]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, check=False, timeout=limit_s,
                env={"PATH": "/usr/bin", "DATAGEN_CACHE": f"{folder}/cache", "OMP_NUM_THREADS": "1"},
                preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return f"not within {limit_s:g} s", limit_s
    took_s = time.monotonic() - began_s
    if done.returncode not in (0, 2):
        return (done.stderr.strip().splitlines() or ["killed"])[-1], took_s
    if done.returncode == 2 and (len(done.stdout.splitlines()) != 1 or len(done.stdout) > 1000):
        return f"not one line: {done.stdout[:200]!r}", took_s
    return "", took_s


def main() -> int:
    """Print the table; 1 where a case broke."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", default="")
    parser.add_argument("--memory-gb", type=float, default=3.0)
    parser.add_argument("--limit-s", type=float, default=120.0)
    parser.add_argument("--one", default="")
    parser.add_argument("--path", type=Path)
    options = parser.parse_args()
    if options.one:
        return one(options.one, options.path)
    broken = count = 0
    for kind, name in cases():
        if options.only in f"{kind}: {name}":
            why, took_s = try_case(kind, name, options.memory_gb, options.limit_s)
            count, broken = count + 1, broken + bool(why)
            print(f"{took_s:6.1f} s  {kind}: {name}{f'  BROKEN: {why}' if why else ''}", flush=True)
    print(f"{count} meshes, {broken} broken")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
