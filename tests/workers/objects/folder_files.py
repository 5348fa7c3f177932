"""Small objects in the formats that a folder may hold, written by trimesh."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import trimesh

from tests.workers.objects.toy_set import texture_png

_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_PROFILE = [(0, 0), (0.036, 0), (0.036, 0.09), (0.03, 0.09), (0.03, 0.008), (0, 0.008)]


def cup() -> trimesh.Trimesh:
    """A closed cup that stands on z = 0: 72 mm wide, 90 mm high, with walls of 6 mm."""
    mesh = trimesh.creation.revolve(_PROFILE, sections=16)
    # On a grid, so that no format rounds a coordinate to another micrometre.
    return trimesh.Trimesh(np.round(mesh.vertices, 4), mesh.faces)


def box(*sides_m: float) -> trimesh.Trimesh:
    """A box that stands on z = 0."""
    mesh = trimesh.creation.box(sides_m)
    mesh.apply_translation((0, 0, sides_m[2] / 2))
    return mesh


def write_as(kind: str, mesh: trimesh.Trimesh, home: Path, mass_kg: float = 0.2) -> None:
    """Write a mesh as an object of a kind into a folder; descriptions state the mass."""
    home.mkdir(parents=True, exist_ok=True)
    stem = home.name
    if kind in ("obj", "ply", "stl"):
        mesh.export(home / f"{stem}.{kind}")
    elif kind == "mm.stl":
        (mesh.copy().apply_scale(1000)).export(home / f"{stem}.stl")
    elif kind == "glb":
        mesh.copy().apply_transform(_Y_UP).export(home / f"{stem}.glb")
    elif kind == "gltf":
        for name, data in mesh.copy().apply_transform(_Y_UP).export(file_type="gltf").items():
            (home / name).write_bytes(data)
    elif kind == "y.obj":
        mesh.copy().apply_transform(_Y_UP).export(home / f"{stem}.obj")
    elif kind == "msh":
        counts = struct.pack("<4i", len(mesh.vertices), 0, 0, len(mesh.faces))
        points, faces = mesh.vertices.astype("<f4"), mesh.faces.astype("<i4")
        (home / "body.msh").write_bytes(counts + points.tobytes() + faces.tobytes())
        write_mjcf(home / f"{stem}.xml", f'<inertial mass="{mass_kg}" pos="0 0 0"/>', "body.msh")
    elif kind == "urdf":
        (home / "meshes").mkdir(exist_ok=True)
        mesh.export(home / "meshes/body.stl")
        shape = f'<geometry><mesh filename="package://{stem}/meshes/body.stl"/></geometry>'
        (home / f"{stem}.urdf").write_text(
            f'<robot name="a"><link name="l"><visual>{shape}</visual><collision>{shape}</collision>'
            f'<inertial><mass value="{mass_kg}"/></inertial></link></robot>'
        )
    elif kind == "sdf":
        write_gso(home, mesh, f"<inertial><mass>{mass_kg}</mass></inertial>")
    elif kind == "mjcf":
        (home / "assets").mkdir(exist_ok=True)
        mesh.copy().apply_scale(100).export(home / "assets/body.obj")
        inertial = f'<inertial mass="{mass_kg}" pos="0 0 0"/>'
        write_mjcf(home / f"{stem}.xml", inertial, "body.obj", 'scale="0.01 0.01 0.01"')
    else:
        raise ValueError(kind)


def write_gso(home: Path, mesh: trimesh.Trimesh, inertial: str = "") -> None:
    """The layout of the Google Scanned Objects; the image is not where the material library says."""
    for folder in ("meshes", "materials/textures"):
        (home / folder).mkdir(parents=True)
    points = [f"v {x} {y} {z}" for x, y, z in mesh.vertices]
    faces = ["f " + " ".join(f"{k + 1}/1" for k in face) for face in mesh.faces]
    lines = ["mtllib model.mtl", *points, "vt 0.75 0.75", "usemtl material_0", *faces]
    (home / "meshes/model.obj").write_text("\n".join(lines) + "\n")
    (home / "meshes/model.mtl").write_text("newmtl material_0\nmap_Kd texture.png\n")
    (home / "materials/textures/texture.png").write_bytes(texture_png())
    shape = "<geometry><mesh><uri>meshes/model.obj</uri></mesh></geometry>"
    (home / "model.sdf").write_text(
        '<?xml version="1.0"?>\n<sdf version="1.6"><model name="a"><link name="l"><pose>0 0 1 0 0 0</pose>'
        f"{inertial}<visual name='v'>{shape}</visual><collision name='c'>{shape}</collision></link>"
        "</model></sdf>"
    )


def write_mjcf(path: Path, body: str, mesh: str, scale: str = "") -> None:
    """A MuJoCo model with one visible and one colliding geom of the same mesh, below a default class."""
    folder = "assets" if (path.parent / "assets").is_dir() else "."
    path.write_text(
        f'<mujoco model="a"><compiler meshdir="{folder}" angle="radian"/>'
        '<default><default class="seen"><geom type="mesh" contype="0" conaffinity="0" group="2"/></default>'
        "</default>"
        f'<asset><mesh name="m" file="{mesh}" {scale}/></asset>'
        f'<worldbody><body name="object" pos="0 0 0.3">{body}'
        '<freejoint/><geom class="seen" mesh="m" rgba="1 0 0 1"/><geom type="mesh" mesh="m" group="3"/>'
        "</body></worldbody></mujoco>"
    )
