"""RGB-D frames by SAPIEN's rasteriser. Needs a Vulkan device: a GPU, or Mesa's lavapipe."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datagen.schemas.errors import InputError
from datagen.workers.geometry.mesh import F64, Mesh, concatenate, face_normals, face_texture
from datagen.workers.geometry.transforms import quaternion_wxyz
from datagen.workers.rendering import Camera, Frame, SceneGeometry

with warnings.catch_warnings():
    # SAPIEN warns about a missing Vulkan loader at import; `_the_studio` checks whether one works.
    warnings.simplefilter("ignore")
    import sapien
    from sapien import render

_NEAR_M, _FAR_M = 0.02, 60.0
_BACKGROUND_RGB = (255, 255, 255)
_AMBIENT = [0.55, 0.55, 0.55]
_LIGHT_DIRECTION, _LIGHT_COLOUR = [-0.35, -0.25, -0.90], [1.2, 1.2, 1.2]
# Columns: SAPIEN's camera axes (x forward, y left, z up) in the OpenCV camera frame.
_T_CAMERA_SAPIEN = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


@dataclass(eq=False)
class _Studio:
    """The lit scene that a process keeps, with one camera as large as the last frame."""

    scene: sapien.Scene
    camera: render.RenderCameraComponent | None = None


# Making a scene compiles shaders (seconds), and it is never freed completely, so there is only one.
_studio: _Studio | None = None


def render_sapien(geometry: SceneGeometry, camera: Camera) -> Frame:
    """The whole frame of a scene. Raises InputError where this machine has no render device."""
    studio = _the_studio()
    meshes = [(concatenate([body.visual for body in geometry.house.bodies]), np.eye(4))]
    meshes += [(model.visual, T) for model, T in zip(geometry.objects, geometry.T_world_object, strict=True)]
    entities: list[sapien.Entity] = []
    try:
        for mesh, T in meshes:
            entities.append(_add_mesh(studio.scene, mesh, T))
        return _photograph(studio, camera, entities)
    finally:
        for entity in entities:
            studio.scene.remove_entity(entity)


def _the_studio() -> _Studio:
    global _studio
    if _studio is None:
        try:
            system = render.RenderSystem()
        except RuntimeError as error:
            raise InputError(
                "observation.renderer",
                "sapien",
                f"finds no render device ({error})",
                "See `datagen doctor`: install a GPU driver or Mesa 25 or newer with lavapipe, "
                "or choose embree",
            ) from error
        scene = sapien.Scene([system])
        scene.set_ambient_light(_AMBIENT)
        scene.add_directional_light(_LIGHT_DIRECTION, _LIGHT_COLOUR)
        _studio = _Studio(scene)
    return _studio


def _add_mesh(scene: sapien.Scene, mesh: Mesh, T_world_mesh: F64) -> sapien.Entity:
    uv, image = face_texture(mesh)
    # SAPIEN puts the origin of a texture made from an array at its upper left corner.
    uv = np.stack([uv[..., 0], 1 - uv[..., 1]], axis=-1)
    corners = np.ascontiguousarray(mesh.vertices_m[mesh.faces], np.float32)
    opaque = np.concatenate([image, np.full((*image.shape[:2], 1), 255, np.uint8)], axis=2)
    material = render.RenderMaterial(roughness=1.0, specular=0.0)
    material.set_base_color_texture(
        render.RenderTexture2D(opaque, "R8G8B8A8Unorm", filter_mode="nearest", srgb=True)
    )
    shape = render.RenderShapeTriangleMesh(
        corners.reshape(-1, 3),
        np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3),
        np.repeat(face_normals(corners), 3, axis=0),
        uv.reshape(-1, 2),
        material,
    )
    body = render.RenderBodyComponent()
    body.attach(shape)
    entity = sapien.Entity()
    entity.add_component(body)
    entity.set_pose(_sapien_pose(T_world_mesh))
    scene.add_entity(entity)
    return entity


def _photograph(studio: _Studio, camera: Camera, entities: list[sapien.Entity]) -> Frame:
    eye = _camera_of_size(studio, camera.width_px, camera.height_px)
    eye.set_perspective_parameters(
        _NEAR_M, _FAR_M, camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, 0.0
    )
    eye.entity.set_pose(_sapien_pose(camera.T_world_camera @ _T_CAMERA_SAPIEN))
    studio.scene.update_render()
    eye.take_picture()
    colour: npt.NDArray[np.float32] = eye.get_picture("Color")
    position_m: npt.NDArray[np.float32] = eye.get_picture("Position")
    scene_ids: npt.NDArray[np.int64] = eye.get_picture("Segmentation")[..., 1].astype(np.int64)

    known = np.array([entity.per_scene_id for entity in entities])
    order = np.argsort(known)
    rows = np.minimum(np.searchsorted(known, scene_ids, sorter=order), len(known) - 1)
    body = np.where(known[order[rows]] == scene_ids, order[rows], -1).astype(np.int16)
    rgb = np.round(np.clip(colour[..., :3], 0.0, 1.0) * 255).astype(np.uint8)
    rgb[body < 0] = _BACKGROUND_RGB
    # Positions are in the OpenGL camera frame, whose z points backward.
    depth_m = np.where(body < 0, np.float32(0), -position_m[..., 2]).astype(np.float32)
    return Frame(camera, rgb, depth_m, body)


def _camera_of_size(studio: _Studio, width_px: int, height_px: int) -> render.RenderCameraComponent:
    old = studio.camera
    if old is not None and (old.width, old.height) == (width_px, height_px):
        return old
    if old is not None:
        studio.scene.remove_entity(old.entity)
    studio.camera = render.RenderCameraComponent(width_px, height_px)
    entity = sapien.Entity()
    entity.add_component(studio.camera)
    studio.scene.add_entity(entity)
    return studio.camera


def _sapien_pose(T_world_body: F64) -> sapien.Pose:
    position_m: list[float] = T_world_body[:3, 3].tolist()
    wxyz: list[float] = quaternion_wxyz(T_world_body[:3, :3]).tolist()
    return sapien.Pose(position_m, wxyz)
