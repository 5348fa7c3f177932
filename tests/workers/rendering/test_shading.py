"""Shaded frames: the geometry of other frames, shadows, ceilings and sky."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from datagen.workers.houses import open_houses
from datagen.workers.houses.glb import read_glb
from datagen.workers.houses.house import House
from datagen.workers.rendering import Camera, Frame
from datagen.workers.rendering.embree import ray_scene, render_embree
from datagen.workers.rendering.shading import draw_light, render_shaded
from tests.workers.houses.house_files import two_rooms, write_houses
from tests.workers.rendering.engines import cameras, mixed_stage
from tests.workers.worlds import box_body, box_model, camera_at, stage_with, table_house

ABOVE = camera_at((2.0, 1.49, 2.0), (2.0, 1.5, 0.75), 200, 160, 130.0)
FROM_THE_LEFT = np.array([-0.6, 0.0, 0.8], np.float32)  # towards the light: -x


@pytest.mark.parametrize("camera", cameras())
def test_light_changes_neither_depth_nor_bodies(camera: Camera) -> None:
    stage = mixed_stage()
    light = draw_light(camera, np.random.default_rng(0))
    shaded, plain = (
        render_shaded(ray_scene(stage), stage.house, camera, light),
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
        frames = [render_shaded(ray_scene(s), s.house, ABOVE, FROM_THE_LEFT) for s in (stage, bare)]
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
    frame = render_shaded(scene, house, camera, FROM_THE_LEFT)
    column = frame.rgb[:, 60].astype(int)
    empty = frame.body[:, 60] < 0
    assert not frame.depth_m[:, 60][empty].any()
    ceiling, ground = column[0], column[empty][-1]
    sky = column[np.flatnonzero(empty & (column != ceiling).any(1))[0]]
    assert np.ptp(ceiling) < 10 and ceiling.min() > 220
    assert sky[2] > sky[0] + 10 and ground[2] < ground[1] < 150


def seen(house: House, camera: Camera) -> Frame:
    stage = stage_with([box_model("box", (0.02, 0.02, 0.02))], [(0.0, 0.0)], house)
    return render_shaded(ray_scene(stage), house, camera, FROM_THE_LEFT)


def test_floors_have_the_pattern_of_their_material_in_pictures_alone(tmp_path: Path) -> None:
    """The first room has a floor of wood, the second of carpet: joints of planks are dark lines."""
    source = open_houses(f"procthor:{write_houses(tmp_path, [two_rooms()])}")
    house = source.load("two-rooms")
    assert set(house.materials.values()) == {"OakWood", "Carpet", "PureWhite"}
    for x, is_wood in (3.3, True), (7.5, False):
        camera = camera_at((x, 1.5, 1.6), (x, 1.9, 0.0), 200, 150, 260.0)
        frame, plain = seen(house, camera), seen(replace(house, materials={}), camera)
        assert (frame.depth_m == plain.depth_m).all() and (frame.body == plain.body).all()
        floor = (plain.rgb == plain.rgb[75, 100]).all(2)
        shares = frame.rgb[floor].mean(1) / plain.rgb[floor].mean(1)
        assert floor.sum() > 5000 and shares.mean() == pytest.approx(1, abs=0.1)
        assert (np.percentile(shares, 1) < 0.8 and shares.std() > 0.03) if is_wood else (shares == 1).all()
        assert (seen(source.load("two-rooms"), camera).rgb == frame.rgb).all()


def test_patterns_follow_the_name_and_the_house_and_far_joints_fade() -> None:
    def bricks(camera: Camera, **more: object) -> np.ndarray:
        house = replace(table_house(), **{"materials": {(230, 225, 210): "RedBrick"}, **more})
        frame = seen(house, camera)
        return frame.rgb[20:60, 60:140].astype(float)

    near = camera_at((2.0, 1.2, 1.9), (2.0, 0.0, 1.9), 200, 150, 260.0)
    far = camera_at((2.0, 2.9, 1.9), (2.0, 0.0, 1.9), 200, 150, 30.0)
    wall = bricks(near)
    assert (bricks(near) == wall).all() and (bricks(near, digest="cd" * 32) != wall).any()
    assert bricks(near, materials={(230, 225, 210): "Drywall"}).std(axis=(0, 1)).max() < 1
    assert wall.std() > 4 * bricks(far).std() > 0


TURN = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # to z up
RED, BLUE, GREEN = (200, 40, 30), (30, 60, 200), (40, 180, 60)


def box_with(material: PBRMaterial, x_m: float) -> Any:
    """A box above the table, in a frame with y up; each face shows the whole image of the material."""
    box: Any = trimesh.creation.box(extents=(0.2, 0.2, 0.2))
    box.unmerge_vertices()
    sides = np.argmax(np.abs(box.face_normals), axis=1).repeat(3)
    others = np.array([[2, 1], [0, 2], [0, 1]])[sides]
    uv = np.take_along_axis(box.vertices, others, axis=1) / 0.2 + 0.5
    box.apply_translation((x_m, 0.85, -1.5))
    box.visual = TextureVisuals(uv=uv, material=material)
    return box


def has_hue(rgb: np.ndarray, hue: tuple[int, int, int]) -> np.ndarray:
    """Whether each pixel (H, W) has the hue, in any light."""
    units = [c / np.linalg.norm(c, axis=-1, keepdims=True) for c in (rgb.astype(float), np.array(hue))]
    return np.linalg.norm(units[0] - units[1], axis=-1) < 0.03


def house_with(tmp_path: Path, boxes: list[Any]) -> House:
    """A plain box, and the boxes as one body, read from a link to a file elsewhere, as of a download."""
    for name in "downloaded", "scenes":
        (tmp_path / name).mkdir()
    (tmp_path / "downloaded/a").write_bytes(trimesh.Scene(boxes).export(file_type="glb"))
    (file := tmp_path / "scenes/a.glb").symlink_to("../downloaded/a")
    plain = box_body("plain", "small", "Box", (0.1, 0.1, 0.1), (1.2, 1.5, 0.8))
    return table_house([plain, replace(plain, visual=read_glb(file).transformed(TURN))])


def test_textures_of_meshes_appear_by_pixel_in_pictures_alone(tmp_path: Path) -> None:
    """The left half of an image is red, the right half blue; boxes beside it have a colour, and no image."""
    image = Image.new("RGB", (8, 8), RED)
    image.paste(BLUE, (4, 0, 8, 8))
    green, halves = PBRMaterial(baseColorFactor=[*GREEN, 255]), PBRMaterial(baseColorTexture=image)
    house = house_with(tmp_path, [box_with(green, 1.5), box_with(halves, 2.0), box_with(green, 2.5)])
    red, blue, plain = (has_hue(seen(house, ABOVE).rgb, hue) for hue in (RED, BLUE, GREEN))
    assert red.sum() > 100 and blue.sum() > 100 and plain.sum() > 300
    assert np.flatnonzero(red.any(0)).max() < np.flatnonzero(blue.any(0)).min()
    stage = stage_with([box_model("box", (0.02, 0.02, 0.02))], [(0.0, 0.0)], house)
    red, blue = (has_hue(render_embree(stage, ABOVE).rgb, hue) for hue in (RED, BLUE))
    assert np.flatnonzero(red.any(0)).max() > np.flatnonzero(blue.any(0)).min()  # a colour for each triangle


def test_a_material_tints_its_texture(tmp_path: Path) -> None:
    white = Image.new("RGB", (8, 8), (255, 255, 255))
    material = PBRMaterial(baseColorTexture=white, baseColorFactor=[*RED, 255])
    house = house_with(tmp_path, [box_with(material, 2.0)])
    assert has_hue(seen(house, ABOVE).rgb, RED).sum() > 200


def test_coordinates_far_off_the_image_are_somewhere_on_it(tmp_path: Path) -> None:
    box = box_with(PBRMaterial(baseColorTexture=Image.new("RGB", (8, 8), RED)), 2.0)
    box.visual.uv = np.where(box.visual.uv > 0.5, 3e38, -3e38)
    assert has_hue(seen(house_with(tmp_path, [box]), ABOVE).rgb, RED).sum() > 200
