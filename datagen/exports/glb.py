"""Scenes as GLB: house, objects, and an arrow for each candidate, green where its label is 1."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from datagen.exports.export_run import ExportSource, NewFile, Step, scene_key
from datagen.schemas.fields import SceneRows
from datagen.schemas.run import Run
from datagen.workers.geometry.mesh import F64, U8, Mesh

# glTF has y up, ours z.
_T_GLTF_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_ARROW_M = np.array([[0.12, 0.0], [-0.06, 0.05], [-0.06, -0.05]])  # in a base's frame, x ahead
_ABOVE_FLOOR_M = 0.02
LABEL_RGB: U8 = np.array([[200, 60, 50], [40, 160, 80]], np.uint8)


def steps(source: ExportSource) -> Sequence[Step]:
    """A file for each scene."""

    def file(run: Run, rows: SceneRows) -> Iterator[NewFile]:
        scene, made = source.rebuilt(run, rows.record), trimesh.Scene()
        bodies = [(f"house/{body.body_id}", body.visual, np.eye(4)) for body in scene.house.house.bodies]
        models = enumerate(zip(scene.models, scene.T_world_object, strict=True))
        bodies += [(f"object/{k}/{model.name}", model.visual, T) for k, (model, T) in models]
        bodies.append(("candidates", arrows(rows), np.eye(4)))
        for name, mesh, T in bodies:
            made.add_geometry(_geometry(mesh), name, name, transform=_T_GLTF_WORLD @ T)
        made.metadata.update({key: source.about[key] for key in ("license", "acknowledgement")})
        data: Any = made.export(file_type="glb")
        yield NewFile(f"{scene_key(run.manifest.spec_hash, scene.index)}.glb", data)

    return source.each_scene(file)


def arrows(rows: SceneRows) -> Mesh:
    """A triangle on the floor for each candidate, which points along its heading, coloured by label."""
    yaw_rad = rows.samples["base_yaw_rad"].astype(np.float64)
    ahead = np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], axis=1)
    axes = np.stack([ahead, ahead[:, ::-1] * [-1, 1]], axis=1)  # (N, 2, 2), rows are the base's axes
    corners_m: F64 = np.full((len(yaw_rad), 3, 3), _ABOVE_FLOOR_M)
    corners_m[:, :, :2] = rows.samples["base_xy_m"][:, None] + _ARROW_M @ axes
    faces = np.arange(3 * len(yaw_rad), dtype=np.int32).reshape(-1, 3)
    return Mesh(corners_m.reshape(-1, 3).astype(np.float32), faces, LABEL_RGB[rows.samples["label"]])


def _geometry(mesh: Mesh) -> trimesh.Trimesh:
    if mesh.texture is not None:
        material = PBRMaterial(baseColorTexture=Image.fromarray(mesh.texture.image), doubleSided=True)
        visual = TextureVisuals(uv=mesh.texture.uv, material=material)
        return trimesh.Trimesh(mesh.vertices_m, mesh.faces, visual=visual, process=False)
    # A vertex for each corner, since colours are of faces.
    corners_m, faces = (
        mesh.vertices_m[mesh.faces].reshape(-1, 3),
        np.arange(3 * len(mesh.faces)).reshape(-1, 3),
    )
    visual = ColorVisuals(vertex_colors=np.repeat(mesh.face_rgb, 3, axis=0))
    made = trimesh.Trimesh(corners_m, faces, process=False)
    made.visual = visual
    return made
