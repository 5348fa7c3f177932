"""A small folder of objects in either layout, written by the tests: a textured 4 cm cube."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

CUBE_OBJ = """mtllib textured.mtl
usemtl material_0
v 0.01 0.02 0.00
v 0.05 0.02 0.00
v 0.05 0.06 0.00
v 0.01 0.06 0.00
v 0.01 0.02 0.04
v 0.05 0.02 0.04
v 0.05 0.06 0.04
v 0.01 0.06 0.04
vt 0.0 0.0
vt 0.5 0.0
vt 0.5 1.0
vt 0.0 1.0
vt 1.0 0.0
vt 1.0 1.0
f 4/4 3/3 2/2 1/1
f 5/2 6/5 7/6 8/3
f 1/1 2/2 6/3 5/4
f 2/1 3/2 7/3 6/4
f 3/1 4/2 8/3 7/4
f 4/1 1/2 5/3 8/4
"""
COLLISION_OBJ = "o convex_0\n" + "\n".join(
    line.split("/")[0]
    if line[0] != "f"
    else "f " + " ".join(corner.split("/")[0] for corner in line.split()[1:])
    for line in CUBE_OBJ.splitlines()
    if line.split()[0] in ("v", "f")
)


def texture_png() -> bytes:
    """8x8 pixels, the left half red, the right half blue."""
    image = np.zeros((8, 8, 3), np.uint8)
    image[:, :4, 0] = 255
    image[:, 4:, 2] = 255
    out = io.BytesIO()
    Image.fromarray(image).save(out, "PNG")
    return out.getvalue()


def write_bundle(folder: Path, *names: str, mass_kg: object = 0.05) -> Path:
    """`objects.json` and one folder an object; returns the folder."""
    index: list[dict[str, object]] = []
    for name in names or ("001_cube",):
        _files(folder / name)
        (folder / name / "collision.obj").write_text(COLLISION_OBJ)
        kinds = {"visual": "textured.obj", "texture": "texture.png", "collision": "collision.obj"}
        files = {kind: f"{name}/{file}" for kind, file in kinds.items()}
        index.append({"key": name, "name": name, "mass_kg": mass_kg, "files": files})
    (folder / "objects.json").write_text(json.dumps(index))
    return folder


def write_maniskill(folder: Path, *names: str, density: float = 1000.0, ply: bool = True) -> Path:
    """`info_pick_v0.json` and `models/`; returns the folder."""
    for name in names or ("001_cube",):
        home = folder / "models" / name
        _files(home)
        (home / "textured.mtl").write_text("newmtl material_0\nKd 1 1 1\nmap_Kd texture.png\n")
        if ply:
            halves = [trimesh.creation.box((0.02, 0.04, 0.04)) for _ in range(2)]
            for half, x in zip(halves, (0.02, 0.04), strict=True):
                half.apply_translation((x, 0.04, 0.02))
            trimesh.util.concatenate(halves).export(home / "collision.ply")
        else:
            (home / "collision.obj").write_text(COLLISION_OBJ)
    info = {
        name: {"bbox": {"min": [0, 0, 0], "max": [1, 1, 1]}, "scales": [0.7], "density": density}
        for name in names or ("001_cube",)
    }
    (folder / "info_pick_v0.json").write_text(json.dumps(info))
    return folder


def _files(home: Path) -> None:
    home.mkdir(parents=True)
    (home / "textured.obj").write_text(CUBE_OBJ)
    (home / "texture.png").write_bytes(texture_png())
