"""The floor of cameras in any position, and what contradicts a pose or a direction of gravity."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datagen.released import sample_frame
from datagen.schemas.errors import InputError
from datagen.train.baselines.rules import Analytic
from datagen.train.prediction import RobotSize, predict
from datagen.train.prediction.answer import Prediction
from datagen.train.prediction.frames import Pinhole, RgbdImage, SensorFrame, image_frame, read_place
from datagen.train.prediction.ground import find_ground, level_pose
from datagen.workers.geometry.mesh import F64
from tests.train.prediction.seen_scenes import Seen, sensor_frame

# A pixel on something that stands on a surface, and the camera's height, which is known from the depth alone.
FRAMES = {
    "sample": ((319, 170), 1.45),
    "tum-fr3-desk": ((148, 222), 1.711),
    "tum-fr1-desk": ((466, 325), 1.570),
    "icl-living-room": ((145, 240), 0.956),
}
AXES_OF_BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@pytest.fixture(params=FRAMES)
def real(request: pytest.FixtureRequest) -> Iterator[tuple[SensorFrame, float]]:
    """A frame without a pose, with a disc as the mask, and the camera's height."""
    name = request.param
    folder = sample_frame() if name == "sample" else request.getfixturevalue("assets") / "frames" / name
    (u, v), height_m = FRAMES[name]
    image = read_place(folder).image
    assert image is not None
    rows, columns = np.indices(image.depth_m.shape)
    mask = (rows - v) ** 2 + (columns - u) ** 2 < 15**2
    yield image_frame(replace(image, mask=mask), None, {}), height_m


def turned(frame: SensorFrame, quarters: int) -> SensorFrame:
    """The frame as a camera takes it that is rolled by quarter turns, as np.rot90 turns its picture."""
    image = frame.image
    assert image is not None
    p, width = image.pinhole, image.depth_m.shape[1]
    for k in range(quarters):
        p = Pinhole(p.fy_px, p.fx_px, p.cy_px, width - 1 - p.cx_px)
        width = image.depth_m.shape[k % 2]
    rgb, depth_m = np.rot90(image.rgb, quarters).copy(), np.rot90(image.depth_m, quarters).copy()
    mask = None if image.mask is None else np.rot90(image.mask, quarters).copy()
    return image_frame(RgbdImage(rgb, depth_m, p, mask), None, {})


def turned_axes(quarters: int) -> F64:
    """The camera's axes in those of the camera that is rolled."""
    return np.linalg.matrix_power(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), quarters)


def answer(frame: SensorFrame, height_m: float, gravity: F64 | None, seed: int = 0) -> Prediction:
    robot, rule = RobotSize(1.2, 0.7, 0.9), Analytic(only_clear=False)
    return predict(rule, [frame], robot, camera_height_m=height_m, gravity=gravity, seed=seed)


def test_rolled_cameras_have_the_answer_of_the_upright_one(real: tuple[SensorFrame, float]) -> None:
    frame, height_m = real
    upright = answer(frame, height_m, None)
    assert upright.grounds[0].doubt is None
    up = upright.grounds[0].T_world_camera[2, :3]
    sampled = [np.abs(answer(frame, height_m, None, k).score - upright.score).mean() for k in (1, 2, 3)]
    for quarters in (1, 2, 3):
        rolled = turned(frame, quarters)
        down = -turned_axes(quarters) @ up
        for gravity in (down, None):
            other = answer(rolled, height_m, gravity)
            ground = other.grounds[0]
            assert (ground.doubt is not None and "rolled by" in ground.doubt) == (gravity is None)
            tilt = np.degrees(np.arccos(min(1.0, float(ground.T_world_camera[2, :3] @ -down))))
            assert tilt < (0.2 if gravity is None else 1e-3)
            # World x and y are the camera's right and ahead, made level, whatever its roll.
            assert np.linalg.norm(other.center_m - upright.center_m) < 0.02
            assert np.abs(other.base_xy_m - upright.base_xy_m).max() < 0.02
            assert (other.cells.state == upright.cells.state).mean() > 0.95
            assert np.abs(other.score - upright.score).mean() < 2 * max(sampled)
        with pytest.raises(InputError, match="points up, by the level surfaces"):
            find_ground(rolled, height_m, -down)


def test_gravity_is_accepted_where_no_floor_is_seen(seen: Seen) -> None:
    """Neither sign shows a floor: the top of the picture decides, and no camera that is rolled is refused."""
    frame = sensor_frame(seen, posed=False)
    up, T = seen.camera.T_world_camera[2, :3], seen.camera.T_world_camera
    assert frame.image is not None
    z = frame.image.world_grid(T)[..., 2]
    high = replace(frame.image, depth_m=np.where(z > 0.3, frame.image.depth_m, np.float32(0)))
    for quarters in range(4):
        rolled = turned(image_frame(high, None, {}), quarters)
        ground = find_ground(rolled, seen.height_m, -turned_axes(quarters) @ up)
        assert ground.residual_m is None
    with pytest.raises(InputError, match="points up"):
        find_ground(image_frame(high, None, {}), seen.height_m, up)


def test_a_wall_that_may_be_the_floor_of_a_rolled_camera_is_doubted() -> None:
    """The floor 1.2 m below an upright camera, and a wall 1.2 m to its left."""
    v, u = np.indices((240, 320))
    x, y = (u - 159.5) / 200, (v - 119.5) / 200
    with np.errstate(divide="ignore"):
        depth = np.minimum(np.where(y > 0, 1.2 / y, np.inf), np.where(x < 0, -1.2 / x, np.inf))
    depth = np.where(depth < 4, depth, 4).astype(np.float32)
    image = RgbdImage(np.zeros((240, 320, 3), np.uint8), depth, Pinhole(200.0, 200.0, 159.5, 119.5), None)
    ground = find_ground(image_frame(image, None, {}), 1.2, None)
    assert ground.T_world_camera[2, 1] < -0.99
    assert ground.doubt is not None and "90 degrees to the left" in ground.doubt


def pose(seen: Seen, rotation: F64 | None = None, position: F64 | None = None) -> F64:
    T = seen.camera.T_world_camera.copy()
    T[:3, :3] = T[:3, :3] if rotation is None else rotation
    T[:3, 3] = T[:3, 3] if position is None else position
    return T


@pytest.mark.parametrize("noise", [False, True])
def test_poses_of_other_axes_or_another_origin_are_refused(noise: bool, seen: Seen) -> None:
    shot, T = seen.noisy() if noise else seen, seen.camera.T_world_camera
    find_ground(sensor_frame(shot), None, None)
    body = T[:3, :3] @ AXES_OF_BODY.T
    wrong = {
        "looks up at 90 degrees": [np.eye(4), pose(seen, np.eye(3))],
        r"body \(x forward, z up\)|looks up": [pose(seen, body)],
        "below z = 0": [pose(seen, position=T[:3, 3] - [0, 0, 0.7])],
        "m above z = 0": [pose(seen, position=T[:3, 3] * 1000), pose(seen, position=np.zeros(3))],
    }
    for words, poses in wrong.items():
        for each in poses:
            with pytest.raises(InputError, match=rf"({words}).*x right, y down, z forward"):
                find_ground(sensor_frame(shot, each), None, None)


@pytest.mark.parametrize("pitch_deg", [0, 15, 30, 45, 60, 70])
def test_axes_of_a_body_are_recognised_at_each_pitch(pitch_deg: float) -> None:
    """A floor 1 m below and a wall 2 m ahead; the true pose is accepted, also where it looks up."""
    for sign in (1, -1):
        pitch = np.radians(sign * pitch_deg)
        T = level_pose(np.array([0.0, -np.cos(pitch), -np.sin(pitch)]), 1.0)
        v, u = np.indices((120, 160))
        rays = np.stack([(u - 79.5) / 100, (v - 59.5) / 100, np.ones(u.shape)], axis=2)
        world = rays @ T[:3, :3].T
        with np.errstate(divide="ignore"):
            floor = np.where(world[..., 2] < 0, -1 / world[..., 2], np.inf)
            wall = np.where(world[..., 1] > 0, 2 / world[..., 1], np.inf)
            side = np.where(world[..., 0] < 0, -1 / world[..., 0], np.inf)
        depth = np.minimum(np.minimum(floor, wall), side)
        image = RgbdImage(
            np.zeros((120, 160, 3), np.uint8),
            np.where(depth < 8, depth, 0).astype(np.float32),
            Pinhole(100.0, 100.0, 79.5, 59.5),
            None,
        )
        if sign > 0 or pitch_deg < 60:
            find_ground(image_frame(image, T, {}), None, None)
        if sign > 0:
            T = T.copy()
            T[:3, :3] = T[:3, :3] @ AXES_OF_BODY.T
            with pytest.raises(InputError, match="optical axes"):
                find_ground(image_frame(image, T, {}), None, None)


def test_a_floor_at_another_scale_of_depth_names_the_scale(assets: Path) -> None:
    image = read_place(assets / "frames" / "tum-fr3-desk").image
    assert image is not None
    five = image_frame(replace(image, depth_m=image.depth_m * 5), None, {})
    with pytest.raises(InputError, match="Give --depth-scale 5000, with which one is at that height"):
        find_ground(five, 1.711, None)
