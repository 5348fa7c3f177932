"""RGB-D frames by pybullet's TinyRenderer, a software rasteriser, to hold those by Embree against."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pybullet  # pyright: ignore[reportMissingImports]  # no wheels from Python 3.12 on
from PIL import Image

from datagen.workers.geometry.mesh import F32, F64, U8, Mesh, concatenate, face_normals
from datagen.workers.geometry.transforms import inverse, quaternion_wxyz
from datagen.workers.rendering import Camera, Frame, SceneGeometry

# Clipping planes. A larger near distance gives more precise depth.
_NEAR_M, _FAR_M = 0.02, 60.0
# Bullet silently drops the vertices of a mesh beyond 131,072.
_MAX_FACES = 40_000
_LIGHT_DIRECTION = [0.35, 0.25, 0.90]
_AMBIENT, _DIFFUSE = 0.7, 0.3


def render_pybullet(scene: SceneGeometry, camera: Camera) -> Frame:
    """The whole frame of a scene, built from scratch."""
    with Drawing() as drawing:
        drawing.add_scene(scene)
        return drawing.render(camera)


class Drawing:
    """One Bullet world that holds visual meshes only, each with the number that pixels report.

    A context manager that frees the world at the end.
    """

    def __init__(self) -> None:
        self._world: int = pybullet.connect(pybullet.DIRECT)
        assert self._world >= 0, "Bullet cannot open another world"
        self._label_of_body: list[int] = []

    def __enter__(self) -> Drawing:
        return self

    def __exit__(self, *_: object) -> None:
        pybullet.disconnect(physicsClientId=self._world)

    def add_scene(self, scene: SceneGeometry) -> None:
        """Draw a house as 0 and its objects from 1 on."""
        # A camera within a wall or a cupboard sees it from inside.
        self.add(concatenate([body.visual for body in scene.house.bodies]), np.eye(4), 0, both_sides=True)
        for k, model in enumerate(scene.objects):
            self.add(model.visual, scene.T_world_object[k], 1 + k)

    def add(self, mesh: Mesh, T_world_mesh: F64, label: int, both_sides: bool = False) -> None:
        """Draw a mesh at a pose (4, 4); its pixels report `label`.

        TinyRenderer drops faces seen from behind whatever its flags say, so that `both_sides` adds
        each face a second time, turned.
        """
        uv, image = face_texture(mesh)
        with tempfile.TemporaryDirectory(prefix="datagen-bullet-") as folder:
            file = Path(folder) / "texture.bmp"
            Image.fromarray(image).save(file)
            texture = pybullet.loadTexture(str(file), physicsClientId=self._world)
        corners = mesh.vertices_m[mesh.faces]  # (F, 3, 3)
        if both_sides:
            corners, uv = (np.concatenate([rows, rows[:, ::-1]]) for rows in (corners, uv))
        normals = face_normals(corners)
        w, x, y, z = quaternion_wxyz(T_world_mesh[:3, :3]).tolist()
        for start in range(0, len(corners), _MAX_FACES):
            chunk = slice(start, start + _MAX_FACES)
            n = 3 * len(corners[chunk])
            shape = pybullet.createVisualShape(
                pybullet.GEOM_MESH,
                vertices=corners[chunk].reshape(-1, 3).tolist(),
                indices=list(range(n)),
                uvs=uv[chunk].reshape(-1, 2).tolist(),
                normals=np.repeat(normals[chunk], 3, axis=0).tolist(),
                rgbaColor=[1, 1, 1, 1],
                physicsClientId=self._world,
            )
            body: int = pybullet.createMultiBody(
                baseVisualShapeIndex=shape,
                basePosition=T_world_mesh[:3, 3].tolist(),
                baseOrientation=[x, y, z, w],
                physicsClientId=self._world,
            )
            pybullet.changeVisualShape(body, -1, textureUniqueId=texture, physicsClientId=self._world)
            self._label_of_body.append(label)

    def render(self, camera: Camera, near_m: float = _NEAR_M) -> Frame:
        """The frame that a camera sees; its bodies are the labels, -1 for none."""
        rgba, buffer, segments = self._image(camera, near_m)
        body = np.array([*self._label_of_body, -1], np.int16)[segments]  # -1 is the background
        # The buffer holds OpenGL's window depth, which is not linear in metres.
        depth_m = _FAR_M * near_m / (_FAR_M - (_FAR_M - near_m) * buffer.astype(np.float64))
        depth_m[body < 0] = 0.0
        return Frame(camera, np.ascontiguousarray(rgba[..., :3]), depth_m.astype(np.float32), body)

    def _image(self, camera: Camera, near_m: float) -> tuple[U8, F32, npt.NDArray[np.int32]]:
        h, w = camera.height_px, camera.width_px
        _, _, rgba, buffer, segments = pybullet.getCameraImage(
            w,
            h,
            _view_matrix(camera),
            _projection_matrix(camera, near_m),
            lightDirection=_LIGHT_DIRECTION,
            lightAmbientCoeff=_AMBIENT,
            lightDiffuseCoeff=_DIFFUSE,
            lightSpecularCoeff=0.0,
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self._world,
        )
        return (
            np.asarray(rgba, np.uint8).reshape(h, w, 4),
            np.asarray(buffer, np.float32).reshape(h, w),
            np.asarray(segments, np.int32).reshape(h, w),
        )


def _view_matrix(camera: Camera) -> list[float]:
    """T_camera_world in OpenGL's convention: y up and z backward in the camera frame, by columns."""
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    columns: list[float] = (flip @ inverse(camera.T_world_camera)).T.ravel().tolist()
    return columns


def _projection_matrix(camera: Camera, near_m: float) -> list[float]:
    """OpenGL's projection for a pinhole with any principal point, by columns."""
    w, h = camera.width_px, camera.height_px
    # TinyRenderer samples a pixel at its lower left corner, not at its centre (measured).
    cx_px, cy_px = camera.cx_px - 0.5, camera.cy_px + 0.5
    P = np.zeros((4, 4))
    P[0, 0], P[0, 2] = 2 * camera.fx_px / w, 1 - 2 * cx_px / w
    P[1, 1], P[1, 2] = 2 * camera.fy_px / h, 2 * cy_px / h - 1
    P[2, 2] = -(_FAR_M + near_m) / (_FAR_M - near_m)
    P[2, 3] = -2 * _FAR_M * near_m / (_FAR_M - near_m)
    P[3, 2] = -1.0
    columns: list[float] = P.T.ravel().tolist()
    return columns


_PALETTE_WIDTH = 256


def face_texture(mesh: Mesh) -> tuple[F32, U8]:
    """Texture coordinates (F, 3, 2) of the faces' corners and their image (H, W, 3).

    A textured mesh gives its own. Flat face colours become texels of a palette, with all three
    corners of a face in the middle of the same one. The origin is the image's lower left corner.
    """
    if mesh.texture is not None:
        return mesh.texture.uv[mesh.faces], mesh.texture.image
    colours, index = np.unique(mesh.face_rgb, axis=0, return_inverse=True)
    height = max(1, -(-len(colours) // _PALETTE_WIDTH))
    image = np.zeros((height * _PALETTE_WIDTH, 3), np.uint8)
    image[: len(colours)] = colours
    row, column = np.divmod(index.ravel(), _PALETTE_WIDTH)
    uv = np.stack([(column + 0.5) / _PALETTE_WIDTH, 1 - (row + 0.5) / height], axis=1).astype(np.float32)
    return np.repeat(uv[:, None], 3, axis=1), image.reshape(height, _PALETTE_WIDTH, 3)
