"""Embree against another renderer: the same depth, the same bodies, the same hues and the same rho."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datagen.workers.geometry.mesh import Mesh, face_normals
from datagen.workers.rendering import Camera, Renderer, SceneGeometry
from datagen.workers.rendering.embree import nearest, ray_mesh, ray_scene, render_embree
from datagen.workers.rendering.visibility import visible_pixels
from tests.workers.rendering.engines import assert_same_hues, assert_same_view, cameras, mixed_stage
from tests.workers.worlds import box_body, box_model, camera_at, table_house


@pytest.fixture
def render() -> Renderer:
    pytest.importorskip("pybullet", reason="pybullet has no wheels from Python 3.12 on")
    from tests.workers.rendering.pybullet_renderer import render_pybullet

    return render_pybullet


@pytest.mark.parametrize("camera", cameras())
def test_frames_agree_with_embree(render: Renderer, camera: Camera) -> None:
    frame = render(mixed_stage(), camera)
    assert frame.rgb.shape == (camera.height_px, camera.width_px, 3)
    assert (frame.rgb.dtype, frame.depth_m.dtype, frame.body.dtype) == (np.uint8, np.float32, np.int16)
    assert_same_view(frame, render_embree(mixed_stage(), camera))


def test_textures_and_face_colours_are_where_they_belong(render: Renderer) -> None:
    stage, view = mixed_stage(), cameras()[0]
    above = camera_at((1.9, 1.6, 1.5), (1.9, 1.7, 0.75), 160, 120, 300.0)
    assert_same_hues(render(stage, above), render_embree(stage, above), 4)
    for frame in (render(stage, view), render_embree(stage, view)):
        for label, channel in ((1, 0), (2, 2), (3, 1)):
            assert frame.rgb[frame.body == label].mean(0).argmax() == channel


def test_earlier_frames_do_not_change_later_ones(render: Renderer) -> None:
    stage, camera = mixed_stage(), cameras()[0]
    first = render(stage, camera)
    render(SceneGeometry(stage.house, stage.objects[::-1], stage.T_world_object), camera)
    again = render(stage, camera)
    assert (first.body == again.body).all()
    assert (first.depth_m == again.depth_m).all()


@pytest.mark.parametrize("towards_m", [(2.0, 1.5, 0.8), (0.0, 0.2, 1.4)])
def test_an_eye_within_a_wall_sees_the_wall(render: Renderer, towards_m: tuple[float, float, float]) -> None:
    thick = box_body("wall|9", "wall", "Wall", (0.2, 1.0, 2.0), (1.0, 1.5, 1.0))
    stage = SceneGeometry(table_house([thick]), (), np.zeros((0, 4, 4)))
    camera = camera_at((1.02, 1.4, 1.2), towards_m, 80, 60, 60.0)
    assert_same_view(render(stage, camera), render_embree(stage, camera))


def test_empty_pixels_have_no_depth_and_no_body(render: Renderer) -> None:
    camera = camera_at((2.0, 1.5, 1.5), (2.1, 1.5, 9.0), 64, 48, 200.0)
    frame = render(mixed_stage(), camera)
    assert (frame.body == -1).all()
    assert not frame.depth_m.any()


def test_a_mesh_with_more_faces_than_bullet_takes_at_once_is_whole(render: Renderer) -> None:
    stage = mixed_stage()
    body = stage.house.bodies[-1]
    n = 45_000  # the table again, after many faces without area, lands in the second piece
    faces = np.concatenate([np.zeros((n, 3), np.int32), body.visual.faces])
    colours = np.concatenate([np.zeros((n, 3), np.uint8), body.visual.face_rgb])
    heavy = replace(body, visual=Mesh(body.visual.vertices_m, faces, colours))
    house = replace(stage.house, bodies=(*stage.house.bodies[:-1], heavy))
    camera = cameras()[0]
    whole, plain = (render(s, camera) for s in (replace(stage, house=house), stage))
    np.testing.assert_array_equal(whole.body, plain.body)
    np.testing.assert_array_equal(whole.depth_m, plain.depth_m)


def test_rho_agrees_with_embree_from_all_sides() -> None:
    pytest.importorskip("pybullet", reason="pybullet has no wheels from Python 3.12 on")
    from tests.workers.rendering.pybullet_visibility import PybulletScene

    stage = mixed_stage()
    rng = np.random.default_rng(3)
    angle = rng.uniform(0, 2 * np.pi, 40)
    eyes = np.stack([2 + 0.7 * np.cos(angle), 1.5 + 0.7 * np.sin(angle), rng.uniform(0.8, 1.4, 40)], axis=1)
    rays = ray_scene(stage)
    with PybulletScene(stage) as loaded:
        for target in (0, 1):
            ours_alone, ours_seen = loaded.visible_pixels(target, eyes, 48)
            alone, seen = visible_pixels(rays, target, eyes, 48)
            assert (ours_alone > 0).all()
            assert np.abs(ours_alone - alone).max() <= 0.01 * alone.max()
            gap = np.abs(ours_seen / ours_alone - seen / alone)
            assert gap.mean() < 0.005 and gap.max() < 0.03
        within = np.array([[2.0, -0.004, 1.0], [2.0, -0.05, 1.0], stage.T_world_object[0, :3, 3]])
        assert loaded.visible_pixels(0, within, 32)[1].tolist() == [0, 0, 0]  # a wall, or the target
    assert (seen / alone).min() < 0.9  # something was hidden, so that the comparison means something


def test_worlds_of_bullet_are_closed_at_the_end(render: Renderer) -> None:
    import pybullet

    free = pybullet.connect(pybullet.DIRECT)
    pybullet.disconnect(physicsClientId=free)
    stage = SceneGeometry(table_house(), (), np.zeros((0, 4, 4)))
    render(stage, cameras()[0])
    assert not pybullet.isConnected(physicsClientId=free)
    broken = replace(
        stage.house.bodies[0], visual=Mesh(np.zeros((0, 3)), np.ones((1, 3), int), np.zeros((1, 3), int))
    )
    with pytest.raises(IndexError):
        render(replace(stage, house=replace(stage.house, bodies=(broken,))), cameras()[0])
    assert not pybullet.isConnected(physicsClientId=free)


def test_normals_follow_the_corners_and_faces_without_area_have_none() -> None:
    corners = np.array([[[0, 0, 0], [2, 0, 0], [0, 3, 0]], [[1, 1, 1]] * 3], np.float32)
    np.testing.assert_array_equal(face_normals(corners), [[0, 0, 1], [0, 0, 0]])


def test_a_process_keeps_thousands_of_meshes_ready_for_rays() -> None:
    """Embree's device takes one of 1024 keys of thread-local storage: meshes share one."""
    box = box_model("box", (0.1, 0.1, 0.1)).visual
    kept = [ray_mesh(box) for _ in range(1500)]
    down = np.array([[0.0, 0.0, -1.0]], np.float32)
    assert nearest(kept[-1], -down, down) == pytest.approx(0.95)
