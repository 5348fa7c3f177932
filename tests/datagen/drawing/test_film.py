"""Pictures of a trial from recorded poses: moments, views, sheets and animations."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from datagen.drawing import film as film_module
from datagen.drawing.film import Film, filmstrip_moments, write_animation, write_sheet
from datagen.drawing.posed_robot import RobotBodies, robot_bodies
from datagen.workers.rendering.embree import RayScene, cast_pixels
from datagen.workers.scenes.reconstruct import ReconstructedScene
from tests.datagen.drawing.trials_to_draw import base_pose, cut, recalled, recording_of, robot
from tests.workers.worlds import ROOM_M, box_body, table_house

pytest.importorskip("pinocchio", reason="needs the extra `sim`")
WIDE_PX, NEAR_PX = (160, 120), (160, 96)
COLOUR, LINES = "#0a9148", ("candidate 3: success", "a scene", "numbers")


@pytest.fixture(scope="module", autouse=True)
def small_views() -> object:
    """A tenth of the rays."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(film_module, "WIDE_PX", WIDE_PX)
        patch.setattr(film_module, "NEAR_PX", NEAR_PX)
        yield


@pytest.fixture(scope="module")
def bodies() -> RobotBodies:
    return robot_bodies(robot(), 0.25)


@pytest.fixture(scope="module")
def film(bodies: RobotBodies) -> Film:
    return film_of(recalled(), bodies)


def film_of(scene: ReconstructedScene, bodies: RobotBodies, rows: int | None = None) -> Film:
    """The film of a hand-made recording, or of its first rows."""
    recording = recording_of(bodies.robot, scene, base_pose())
    recording = recording if rows is None else cut(recording, rows)
    return Film(scene, bodies, base_pose(), recording, filmstrip_moments(recording))


def whole(film: Film, view: film_module.View, row: int) -> RayScene:
    """The stage of a moment in the house that the view shows."""
    stage = film.stage(row)
    return RayScene(view.house, stage.objects, stage.radii_m, stage.T_world_object)


def test_a_trial_has_eight_moments_in_order_from_its_first_row_to_its_last(film: Film) -> None:
    phases = [film.recording.phase[row] for row, _ in film.moments]
    assert phases == ["reach", "reach", "reach", "approach", "close", "lift", "lift", "hold"]
    for rows in (1, 2, 5, 13, 20):
        shown = [row for row, _ in filmstrip_moments(cut(film.recording, rows))]
        assert shown == sorted(set(shown)) and (shown[0], shown[-1]) == (0, rows - 1)


def test_the_robot_stands_on_the_floor_with_its_fingers_apart_by_the_opening(bodies: RobotBodies) -> None:
    q, T = bodies.robot.homes_rad[0], base_pose()
    left, right = bodies.hand
    gaps = []
    for opening_m in (0.08, 0.02):
        poses = bodies.poses(T, q, opening_m)
        gaps.append(np.linalg.norm(poses[left, :3, 3] - poses[right, :3, 3]))
        T_tcp = T @ bodies.robot.T_base_tcp(q)
        inside = (poses[left, :3, 3] - T_tcp[:3, 3]) @ T_tcp[:3, 1]
        assert inside >= -1e-9  # finger 0 is on the side of +y
    assert gaps[0] - gaps[1] == pytest.approx(0.06, abs=1e-9)
    heights = [rays.mesh.vertices_m @ T[2, :3] + T[2, 3] for rays, T in zip(bodies.rays, poses, strict=True)]
    assert min(float(z.min()) for z in heights) == pytest.approx(0.0, abs=1e-6)


def test_both_views_show_target_and_hand(film: Film, bodies: RobotBodies) -> None:
    row = next(row for row, words in film.moments if words == "at the grasp")
    for view, (w, h) in zip(film.views, (WIDE_PX, NEAR_PX), strict=True):
        body = cast_pixels(whole(film, view, row), view.camera(1), np.arange(w * h)).body - 1
        assert (body == 0).sum() > 30 and np.isin(body, [2 + k for k in bodies.hand]).sum() > 10


def test_a_picture_is_that_of_the_renderer(film: Film) -> None:
    view, (w, h) = film.views[1], NEAR_PX
    rendered = cast_pixels(whole(film, view, 0), view.camera(1), np.arange(w * h)).rgb.reshape(h, w, 3)
    assert (np.asarray(view.picture(film.stage(0), 1)) == rendered).all(axis=2).mean() > 0.9999


def test_walls_in_front_of_the_camera_are_left_out(bodies: RobotBodies) -> None:
    """No camera has room in a closet: it stands outside, and the walls in front of it are gone."""
    cx, cy = ROOM_M[0] / 2, ROOM_M[1] / 2
    sides = [((2.4, 0.1, 2.5), 0, s) for s in (-1.1, 1.1)] + [((0.1, 2.2, 2.5), s, 0) for s in (-1.1, 1.1)]
    closet = [
        box_body(f"closet|{k}", "wall", "Wall", size, (cx + dx, cy + dy, 1.25))
        for k, (size, dx, dy) in enumerate(sides)
    ]
    film = film_of(recalled(table_house(closet)), bodies)
    view, (w, h) = film.views[0], WIDE_PX
    assert np.abs(view.T[:2, 3] - (cx, cy)).max() > 1.1  # outside
    last = len(film.recording.phase) - 1
    body = cast_pixels(whole(film, view, last), view.camera(1), np.arange(w * h)).body - 1
    assert (body == 0).any() and (body >= 2).sum() > 200


def test_a_sheet_has_eight_moments_and_is_repeatable(film: Film, tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        write_sheet(film, COLOUR, LINES, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    with Image.open(tmp_path / "a.png") as image:
        assert image.size[0] == 10 + 4 * (WIDE_PX[0] + 10)
        pixels = np.asarray(image.convert("RGB"))
    assert tuple(pixels[20, 15]) == (0x0A, 0x91, 0x48)
    assert (pixels[-100:-20, 10:170] != pixels[-100:-20, -170:-10]).any()  # near views of moments 5 and 8


def test_a_sheet_of_one_pose_has_room_for_its_title(bodies: RobotBodies, tmp_path: Path) -> None:
    write_sheet(film_of(recalled(), bodies, rows=1), COLOUR, LINES, tmp_path / "one.png")
    with Image.open(tmp_path / "one.png") as image:
        pixels = np.asarray(image.convert("L"))
    assert (pixels[:, -10:] == 255).all() and (pixels[:, -60:-10] < 255).any()


def test_an_animation_moves(film: Film, tmp_path: Path) -> None:
    write_animation(film, COLOUR, LINES, tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as image:
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(image)]
        assert image.info["loop"] == 0
    assert len(frames) == 16  # 1.5 s at ten a second, and the first
    assert all((a != b).any() for a, b in pairwise(frames))
