"""Shaded frames: the geometry of other frames, shadows, ceilings and sky."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datagen.workers.rendering import Camera
from datagen.workers.rendering.embree import ray_scene, render_embree
from datagen.workers.rendering.shading import draw_light, render_shaded
from tests.workers.rendering.engines import cameras, mixed_stage
from tests.workers.worlds import box_body, box_model, camera_at, stage_with, table_house

ABOVE = camera_at((2.0, 1.49, 2.0), (2.0, 1.5, 0.75), 200, 160, 130.0)
FROM_THE_LEFT = np.array([-0.6, 0.0, 0.8], np.float32)  # towards the light: -x


@pytest.mark.parametrize("camera", cameras())
def test_light_changes_neither_depth_nor_bodies(camera: Camera) -> None:
    stage = mixed_stage()
    light = draw_light(camera, np.random.default_rng(0))
    shaded, plain = (
        render_shaded(ray_scene(stage), stage.house.rooms, camera, light),
        render_embree(stage, camera),
    )
    assert (shaded.depth_m == plain.depth_m).all() and (shaded.body == plain.body).all()
    assert np.linalg.norm(light) == pytest.approx(1) and light[2] > 0.7
    assert light[:2] @ camera.T_world_camera[:2, 2] < 0  # from behind the camera


def test_objects_and_furniture_cast_shadows_away_from_the_light() -> None:
    """A box of 10 cm on the table shadows 7.5 cm of it, on the side away from the light."""
    for objects, furniture in (
        ([box_model("box", (0.1, 0.1, 0.1))], []),
        ([], [box_body("box|1", "small", "Box", (0.1, 0.1, 0.1), (2.0, 1.5, 0.8))]),
    ):
        target, places = box_model("target", (0.02, 0.02, 0.02)), [(0.3, 0.3), (0.0, 0.0)]
        stage = stage_with([target, *objects], places[: 1 + len(objects)], table_house(furniture))
        bare = stage_with([target], places[:1], table_house())
        frames = [render_shaded(ray_scene(s), s.house.rooms, ABOVE, FROM_THE_LEFT) for s in (stage, bare)]
        height, width = frames[0].depth_m.shape
        v, u = np.mgrid[:height, :width]
        T, depth_m = ABOVE.T_world_camera, frames[1].depth_m
        rays = [
            (u + 0.5 - ABOVE.cx_px) / ABOVE.fx_px,
            (v + 0.5 - ABOVE.cy_px) / ABOVE.fy_px,
            np.ones(u.shape),
        ]
        x, y, z = np.moveaxis(np.stack(rays, 2) * depth_m[..., None] @ T[:3, :3].T + T[:3, 3], 2, 0)
        table = (frames[0].depth_m == depth_m) & (np.abs(z - 0.75) < 1e-3) & (np.abs(y - 1.5) < 0.03)
        ratio = frames[0].rgb[..., 0] / frames[1].rgb[..., 0]
        assert (shadow := table & (x > 2.06) & (x < 2.11)).sum() > 10 and (ratio[shadow] < 0.8).all()
        assert (lit := table & ((x > 2.14) | (x < 1.94))).sum() > 10 and (ratio[lit] == 1).all()


def test_rooms_have_ceilings_and_openings_show_sky_and_ground() -> None:
    house = table_house()
    house = replace(house, bodies=tuple(b for b in house.bodies if b.body_id != "wall|4"))
    scene = ray_scene(stage_with([box_model("box", (0.1, 0.1, 0.1))], [(0.0, 0.9)], house))
    camera = camera_at((1.0, 1.5, 1.5), (4.0, 1.5, 1.6), 120, 160, 60.0)  # through the missing wall
    frame = render_shaded(scene, house.rooms, camera, FROM_THE_LEFT)
    column = frame.rgb[:, 60].astype(int)
    empty = frame.body[:, 60] < 0
    assert not frame.depth_m[:, 60][empty].any()
    ceiling, ground = column[0], column[empty][-1]
    sky = column[np.flatnonzero(empty & (column != ceiling).any(1))[0]]
    assert np.ptp(ceiling) < 10 and ceiling.min() > 220
    assert sky[2] > sky[0] + 10 and ground[2] < ground[1] < 150
