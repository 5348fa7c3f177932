"""Stages and measures with which all renderers are compared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import Mesh, Texture
from datagen.workers.objects.model import ObjectModel
from datagen.workers.rendering import Camera, Frame, SceneGeometry
from tests.workers.worlds import ball_model, box_model, camera_at, cylinder_model, stage_with

QUADRANTS = {"low_u_low_v": (200, 20, 20), "high_u_low_v": (20, 200, 20), "low_u_high_v": (20, 20, 200)}


def mixed_stage() -> SceneGeometry:
    """A box, a can, a ball and a textured card on the table, partly before one another."""
    models = [
        box_model("box", (0.08, 0.06, 0.2)),
        cylinder_model("can", 0.04, 0.12),
        ball_model("ball", 0.05),
        textured_card(),
    ]
    stage = stage_with(models, [(0.0, 0.0), (0.12, -0.12), (-0.2, -0.1), (-0.1, 0.2)])
    poses = stage.T_world_object.copy()
    c, s = np.cos(0.4), np.sin(0.4)
    poses[0, :2, :2] = [[c, -s], [s, c]]
    return replace(stage, T_world_object=poses)


def cameras() -> list[Camera]:
    """Views from both sides; one stands with its back to a wall, so that much lies behind it."""
    return [
        camera_at((0.6, 0.5, 1.4), (2.0, 1.5, 0.8), 200, 150, 260.0),
        camera_at((3.95, 2.9, 0.9), (2.0, 1.5, 0.8), 160, 120, 150.0),
        camera_at((2.0, 1.4, 1.8), (2.0, 1.5, 0.75), 121, 97, 130.0),
    ]


def textured_card() -> ObjectModel:
    """A thick card whose top shows one colour a quadrant of its texture (u along x, v along y)."""
    plain = box_model("card", (0.2, 0.16, 0.02), rgb=(90, 90, 90))
    image = np.full((32, 32, 3), 230, np.uint8)
    # Row 0 is the top of the image, where v is high.
    image[16:, :16] = QUADRANTS["low_u_low_v"]
    image[16:, 16:] = QUADRANTS["high_u_low_v"]
    image[:16, :16] = QUADRANTS["low_u_high_v"]
    mesh = plain.visual
    uv = (mesh.vertices_m[:, :2] / np.array([0.2, 0.16]) + 0.5).astype(np.float32)
    return replace(plain, visual=Mesh(mesh.vertices_m, mesh.faces, mesh.face_rgb, Texture(image, uv)))


def off_edges(frame: Frame) -> npt.NDArray[np.bool_]:
    """Pixels (H, W) whose four neighbours show the same body at nearly the same depth."""
    calm = np.ones(frame.body.shape, np.bool_)
    for axis in (0, 1):
        body, depth_m = np.moveaxis(frame.body, axis, 0), np.moveaxis(frame.depth_m, axis, 0)
        rim = (body[1:] != body[:-1]) | (np.abs(np.diff(depth_m, axis=0)) > 0.05)
        marks = np.moveaxis(calm, axis, 0)
        marks[1:] &= ~rim
        marks[:-1] &= ~rim
    return calm


def assert_same_view(ours: Frame, reference: Frame) -> None:
    """Depth within 3 mm on 99% of the pixels off edges, body masks with IoU above 0.97."""
    calm = off_edges(reference)
    assert calm.mean() > 0.8
    gap_m = np.abs(ours.depth_m - reference.depth_m)[calm]
    assert (gap_m < 3e-3).mean() >= 0.99
    for label in np.unique(reference.body):
        a, b = ours.body == label, reference.body == label
        if b.sum() > 30:
            assert (a & b).sum() / (a | b).sum() > 0.97, label
    assert set(np.unique(ours.body)) <= {-1, *range(len(mixed_stage().objects) + 1)}


def assert_same_hues(ours: Frame, reference: Frame, label: int) -> None:
    """The body's colours have the same strongest channel, so that a texture is not flipped."""
    rows = off_edges(reference) & (reference.body == label) & (ours.body == label)
    a, b = ours.rgb[rows].astype(int), reference.rgb[rows].astype(int)
    strong = np.sort(b, axis=1)
    clear = strong[:, 2] > 1.5 * strong[:, 1]
    assert clear.sum() > 100
    assert len(np.unique(b[clear].argmax(1))) >= 3
    assert (a[clear].argmax(1) == b[clear].argmax(1)).mean() > 0.97
