"""Trials seen from recorded poses: moments, cameras, sheets and films."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from datagen.drawing.film import Film, filmstrip_moments, pictures
from datagen.drawing.filmstrip import Title, write_motion, write_sheet
from datagen.drawing.posed_robot import RobotBodies, robot_bodies
from datagen.workers.rendering.embree import RayScene, cast_pixels
from datagen.workers.scenes.reconstruct import ReconstructedScene
from datagen.workers.trials import Recording
from tests.datagen.drawing.trials_to_draw import base_pose, cut, recalled, recording_of, robot
from tests.workers.worlds import ROOM_M, TABLE_TOP_M, box_body, table_house

pytest.importorskip("pinocchio", reason="needs the extra `sim`")
SIZES = ((160, 120), (160, 96))
TITLE = Title("#0a9148", "candidate 3: success", ("a scene", "numbers"))


@pytest.fixture(scope="module")
def scene() -> ReconstructedScene:
    return recalled()


@pytest.fixture(scope="module")
def bodies() -> RobotBodies:
    return robot_bodies(robot(), 0.25)


@pytest.fixture(scope="module")
def recording(scene: ReconstructedScene, bodies: RobotBodies) -> Recording:
    return recording_of(bodies.robot, scene, base_pose())


@pytest.fixture(scope="module")
def film(scene: ReconstructedScene, bodies: RobotBodies, recording: Recording) -> Film:
    moments = filmstrip_moments(recording)
    return Film(scene, bodies, base_pose(), recording, moments, *SIZES)


def test_eight_moments_tell_a_trial(recording: Recording) -> None:
    moments = filmstrip_moments(recording)
    assert [recording.phase[row] for row, _ in moments] == [
        "reach", "reach", "reach", "approach", "close", "lift", "lift", "hold",
    ]  # fmt: skip
    assert moments[0][0] == 0 and moments[-1][0] == len(recording.phase) - 1


@pytest.mark.parametrize("rows", [1, 2, 5, 8, 13, 20])
def test_a_trial_that_ended_early_is_told_to_its_end(recording: Recording, rows: int) -> None:
    moments = filmstrip_moments(cut(recording, rows))
    shown = [row for row, _ in moments]
    assert len(moments) == min(rows, 8) and shown == sorted(set(shown))
    assert shown[0] == 0 and shown[-1] == rows - 1


def test_the_fingers_stand_as_far_apart_as_the_hand_is_open(bodies: RobotBodies) -> None:
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


def test_the_robot_stands_on_the_floor(bodies: RobotBodies) -> None:
    T = bodies.poses(base_pose(), bodies.robot.homes_rad[0], 0.08)
    lowest = min(
        float((rays.mesh.vertices_m @ pose[2, :3] + pose[2, 3]).min())
        for rays, pose in zip(bodies.rays, T, strict=True)
    )
    assert lowest == pytest.approx(0.0, abs=1e-6)


def test_both_views_show_target_and_hand(film: Film, bodies: RobotBodies) -> None:
    row = next(row for row, words in film.moments if words == "at the grasp")
    stage = film.stage(row)
    for shot in film.shots:
        full = RayScene(shot.house, stage.objects, stage.radii_m, stage.T_world_object)
        n = shot.camera.width_px * shot.camera.height_px
        body = cast_pixels(full, shot.camera, np.arange(n)).body - 1
        hand = [2 + k for k in bodies.hand]
        assert (body == 0).sum() > 30 and np.isin(body, hand).sum() > 10


def test_a_picture_is_what_the_renderer_shows(film: Film) -> None:
    """Casting body by body into its own window gives the frame of the whole stage."""
    stage = film.stage(0)
    (_, near), *_ = pictures(film, [0], 1)
    shot = film.shots[1]
    full = RayScene(shot.house, stage.objects, stage.radii_m, stage.T_world_object)
    whole = cast_pixels(full, shot.camera, np.arange(near.shape[0] * near.shape[1])).rgb
    assert (whole.reshape(near.shape) == near).all(axis=2).mean() > 0.9999


def test_walls_before_the_camera_are_left_out(bodies: RobotBodies) -> None:
    """In a closet no camera has room: it stands outside, and the walls before it are gone."""
    cx, cy = ROOM_M[0] / 2, ROOM_M[1] / 2
    sides = [((2.4, 0.1, 2.5), 0, s) for s in (-1.1, 1.1)] + [((0.1, 2.2, 2.5), s, 0) for s in (-1.1, 1.1)]
    closet = [
        box_body(f"closet|{k}", "wall", "Wall", size, (cx + dx, cy + dy, 1.25))
        for k, (size, dx, dy) in enumerate(sides)
    ]
    scene = recalled(table_house(closet))
    recording = recording_of(bodies.robot, scene, base_pose())
    film = Film(scene, bodies, base_pose(), recording, filmstrip_moments(recording), (96, 72), (96, 72))
    eye_m = film.shots[0].camera.T_world_camera[:2, 3]
    assert np.abs(eye_m - (cx, cy)).max() > 1.1  # outside
    stage = film.stage(len(recording.phase) - 1)
    full = RayScene(film.shots[0].house, stage.objects, stage.radii_m, stage.T_world_object)
    body = cast_pixels(full, film.shots[0].camera, np.arange(96 * 72)).body - 1
    assert (body == 0).any() and (body >= 2).sum() > 200


def test_nothing_before_the_lens_is_higher_than_the_ceiling(film: Film) -> None:
    for shot in film.shots:
        assert TABLE_TOP_M < shot.camera.T_world_camera[2, 3] < 3.5


def test_a_sheet_has_eight_moments(film: Film, tmp_path: Path) -> None:
    out = tmp_path / "sheet.png"
    write_sheet(film, TITLE, out)
    with Image.open(out) as image:
        assert image.format == "PNG" and image.size[0] == 10 + 4 * (SIZES[0][0] + 10)
        pixels = np.asarray(image.convert("RGB"))
    chip = pixels[20, 15]
    assert tuple(chip) == (0x0A, 0x91, 0x48)
    first, last = pixels[160:260, 10:170], pixels[-210:-110, -170:-10]
    assert (first != last).any()


def test_a_sheet_of_one_pose(
    scene: ReconstructedScene, bodies: RobotBodies, recording: Recording, tmp_path: Path
) -> None:
    still = cut(recording, 1)
    film = Film(scene, bodies, base_pose(), still, filmstrip_moments(still), *SIZES)
    write_sheet(film, TITLE, tmp_path / "one.png")
    with Image.open(tmp_path / "one.png") as image:
        assert image.size[0] == 10 + 2 * (SIZES[0][0] + 10)


def test_a_film_moves(
    scene: ReconstructedScene, bodies: RobotBodies, recording: Recording, tmp_path: Path
) -> None:
    moments = filmstrip_moments(recording)
    film = Film(scene, bodies, base_pose(), recording, moments, *SIZES)
    out = tmp_path / "film.gif"
    write_motion(film, TITLE, out)
    with Image.open(out) as image:
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(image)]
        assert image.info["loop"] == 0
    assert len(frames) == 16  # 1.5 s at ten a second, and the first
    assert all((a != b).any() for a, b in pairwise(frames))


def test_films_are_equal_again(film: Film, tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        write_sheet(film, TITLE, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
