"""Clicks on a thing give its mask, and on a surface of the room are refused; boxes give what fills them."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.schemas.errors import InputError
from datagen.train.prediction.clicks import Box, box_mask, click_mask, refuse_large
from datagen.train.prediction.frames import Pinhole, RgbdImage
from datagen.train.prediction.ground import level_pose
from datagen.workers.geometry.transforms import look_at
from tests.train.prediction.seen_scenes import Seen, sensor_frame


def image_of(seen: Seen) -> RgbdImage:
    image = sensor_frame(seen).image
    assert image is not None
    return image


def level_pixels(seen: Seen, low_m: float, high_m: float) -> list[tuple[int, int]]:
    """Some pixels of the house, and not of objects, between two heights."""
    image, T = image_of(seen), seen.camera.T_world_camera
    z = image.world_grid(T)[..., 2]
    far = np.hypot(*(image.world_grid(T)[..., :2] - seen.scene.target_center_m[:2]).transpose(2, 0, 1))
    v, u = np.nonzero((z > low_m) & (z < high_m) & (seen.frame.body == 0) & (image.depth_m > 0) & (far < 2.5))
    rows = np.random.default_rng(0).choice(len(v), 12, replace=False)
    return [(int(u[k]), int(v[k])) for k in rows]


@pytest.mark.parametrize("noise", [False, True])
def test_a_click_on_the_floor_is_refused_with_what_it_found(noise: bool, seen: Seen) -> None:
    shot = seen.noisy() if noise else seen
    said: list[str] = []
    for pixel in level_pixels(seen, -0.01, 0.01):
        try:
            click_mask(image_of(shot), pixel, shot.camera.T_world_camera)
            said.append("grown")
        except InputError as refused:
            assert refused.field == f"{pixel[0]},{pixel[1]}"
            said.append(str(refused))
    assert sum("its box or mask" in words or "no depth" in words for words in said) >= len(said) - 1, said
    assert sum("lies on the floor" in words for words in said) > len(said) / 2, said


@pytest.mark.parametrize("noise", [False, True])
def test_a_click_on_the_target_grows_to_its_mask(noise: bool, seen: Seen) -> None:
    shot = seen.noisy() if noise else seen
    image = image_of(shot)
    assert image.mask is not None
    truth = image.mask & (image.depth_m > 0)
    v, u = np.nonzero(truth)
    k = int(np.argmin((v - v.mean()) ** 2 + (u - u.mean()) ** 2))
    grown = click_mask(image, (int(u[k]), int(v[k])), shot.camera.T_world_camera)
    assert grown.shape == truth.shape
    assert (grown & truth).sum() / (grown | truth).sum() > 0.7


def test_a_wall_and_a_table_are_named() -> None:
    """A picture of a wall ahead and of a table below, of flat depth."""
    pinhole = Pinhole(300.0, 300.0, 159.5, 119.5)
    down = (np.indices((240, 320))[0] - 119.5) / 300
    T = level_pose(np.array([0.0, -1.0, 0.0]), 1.2)
    # A table 0.4 m below the camera up to 1.5 m ahead, then a wall.
    depth = np.where(down > 0.4 / 1.5, 0.4 / np.maximum(down, 1e-6), 1.5).astype(np.float32)
    image = RgbdImage(np.zeros((240, 320, 3), np.uint8), depth, pinhole, None)
    with pytest.raises(InputError, match=r"an upright plane, as of a wall"):
        click_mask(image, (160, 80), T)
    with pytest.raises(InputError, match=r"a level surface 0\.80 m above the floor"):
        click_mask(image, (160, 225), T)


EYE_M = np.array([0.0, -0.75, 1.35])
SOLIDS = {  # low and high corners (m): a table, a block on a wider one, a block alone, and a block too large
    "table": ((-0.8, -0.5, 0.66), (0.8, 0.5, 0.70)),
    "lower": ((-0.22, -0.10, 0.70), (-0.04, 0.10, 0.78)),
    "upper": ((-0.17, -0.04, 0.78), (-0.09, 0.04, 0.88)),
    "alone": ((0.02, -0.05, 0.70), (0.09, 0.05, 0.79)),
    "large": ((0.00, 0.20, 0.70), (0.48, 0.45, 0.90)),
}


def table_top(kinect: bool) -> tuple[RgbdImage, np.ndarray, dict[str, np.ndarray]]:
    """The image of SOLIDS, the camera's pose, and the pixels of each."""
    pinhole, T = Pinhole(525.0, 525.0, 319.5, 239.5), look_at(EYE_M, np.array([0.0, 0.0, 0.75]))
    v, u = np.indices((480, 640))
    rays = np.stack([(u - 319.5) / 525, (v - 239.5) / 525, np.ones((480, 640))], axis=2) @ T[:3, :3].T
    depth, owner = np.full((480, 640), np.inf), np.full((480, 640), "", dtype="U5")
    for name, (low, high) in SOLIDS.items():
        sides = np.stack([(np.array(side) - EYE_M) / rays for side in (low, high)])
        enter, leave = sides.min(axis=0).max(axis=2), sides.max(axis=0).min(axis=2)
        first = (enter < leave) & (enter < depth)
        depth[first], owner[first] = enter[first], name
    depth[np.isinf(depth)] = 0
    if kinect:
        inverse = 1 / np.maximum(depth, 0.1) + np.random.default_rng(0).normal(0, 1.4e-3, depth.shape)
        depth = np.where(depth > 0, 1 / (np.round(inverse / 2.85e-3) * 2.85e-3), 0)
    image = RgbdImage(np.zeros((480, 640, 3), np.uint8), depth.astype(np.float32), pinhole, None)
    return image, T, {name: owner == name for name in SOLIDS}


def around(pixels: np.ndarray, margin_px: int = 3) -> Box:
    v, u = np.nonzero(pixels)
    left, top, right, bottom = u.min() - margin_px, v.min() - margin_px, u.max() + 1, v.max() + 1
    return int(left), int(top), int(right + margin_px), int(bottom + margin_px)


@pytest.mark.parametrize("kinect", [False, True])
@pytest.mark.parametrize("name", ["alone", "upper", "lower"])
def test_a_box_selects_its_object_without_its_support(name: str, kinect: bool) -> None:
    image, T, owners = table_top(kinect)
    left, top, right, bottom = around(owners[name])
    mask = box_mask(image, (left, top, right, bottom), T)
    assert (mask & owners[name]).sum() / (mask | owners[name]).sum() > 0.6
    assert (mask & owners["table"]).sum() < 0.1 * mask.sum()
    v, u = np.nonzero(mask)
    slack = 3 + 0.05 * max(right - left, bottom - top)
    assert u.min() > left - slack and u.max() < right + slack
    assert v.min() > top - slack and v.max() < bottom + slack


def test_boxes_without_one_object_are_refused() -> None:
    image, T, owners = table_top(False)
    for box, words in (
        ((10, 10, 700, 50), "no box of 3 pixels or more in the image of 640x480"),
        ((50, 50, 40, 90), "no box of 3 pixels or more"),
        (around(owners["large"]), "no object in it that fills it"),
        ((300, 380, 360, 420), "no object in it that fills it"),
    ):
        with pytest.raises(InputError, match=words):
            box_mask(image, box, T)
    image.depth_m[300:400, 250:400] = 0
    with pytest.raises(InputError, match="has no depth"):
        box_mask(image, (270, 320, 330, 380), T)


@pytest.mark.parametrize("seed", range(20))
def test_any_depth_gives_a_mask_or_one_line(seed: int) -> None:
    """Noise, stripes and holes at any distance: a mask with the click or in the box, or an InputError."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.05, 8) + rng.normal(0, 10 ** rng.uniform(-4, 0), (90, 120))
    depth[:, :: rng.integers(1, 9)] += rng.choice([0.0, 0.05, 1.0])
    depth = np.where(rng.random(depth.shape) < rng.uniform(0, 0.9), 0, depth.clip(0)).astype(np.float32)
    rgb = rng.integers(0, 255, (90, 120, 3), dtype=np.uint8)
    image = RgbdImage(rgb, depth, Pinhole(150.0, 150.0, 59.5, 44.5), None)
    T = look_at(EYE_M, np.array([0.0, 0.0, rng.uniform(-1, 3)]))
    u, v = int(rng.integers(120)), int(rng.integers(90))
    left, top = int(rng.integers(110)), int(rng.integers(80))
    box = left, top, int(rng.integers(left + 3, 121)), int(rng.integers(top + 3, 91))
    for select, place in ((click_mask, (u, v)), (box_mask, box)):
        try:
            mask = select(image, place, T)
        except InputError as refused:
            assert refused.field and refused.problem and "\n" not in str(refused)
            continue
        assert mask.any() and (depth[mask] > 0).all()
        if select is box_mask:
            assert not mask[:, :left].any() and not mask[:top].any()
            assert not mask[:, box[2] :].any() and not mask[box[3] :].any()


def test_a_region_that_no_hand_can_grasp_is_refused_with_its_size() -> None:
    """Of a plane 1 m ahead of a level camera, 300 pixels to the metre."""
    image = RgbdImage(
        np.zeros((240, 320, 3), np.uint8),
        np.ones((240, 320), np.float32),
        Pinhole(300.0, 300.0, 159.5, 119.5),
        None,
    )
    T, mask = level_pose(np.array([0.0, -1.0, 0.0]), 1.2), np.zeros((240, 320), np.bool_)
    mask[100:130, 100:220] = True
    refuse_large(image, mask, T, "--click", "160,115")
    mask[100:130, 80:240] = True
    with pytest.raises(
        InputError, match=r"--click: 160,115: selects a region 0\.5\d m wide and 0\.\d\d m high"
    ):
        refuse_large(image, mask, T, "--click", "160,115")
