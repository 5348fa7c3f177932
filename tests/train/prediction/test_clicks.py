"""Clicks: on a thing they grow to its mask; on a surface of the room they are refused."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.schemas.errors import InputError
from datagen.train.prediction.frames import Pinhole, RgbdImage
from datagen.train.prediction.ground import level_pose
from datagen.train.prediction.region_growing import grow_mask
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
            grow_mask(image_of(shot), pixel, shot.camera.T_world_camera)
            said.append("grown")
        except InputError as refused:
            assert refused.field == f"{pixel[0]},{pixel[1]}"
            said.append(str(refused))
    assert sum("its box or mask" in words or "no depth" in words for words in said) >= len(said) - 1, said
    assert sum("the floor (at least 0." in words for words in said) > len(said) / 2, said


@pytest.mark.parametrize("noise", [False, True])
def test_a_click_on_the_target_grows_to_its_mask(noise: bool, seen: Seen) -> None:
    shot = seen.noisy() if noise else seen
    image = image_of(shot)
    assert image.mask is not None
    truth = image.mask & (image.depth_m > 0)
    v, u = np.nonzero(truth)
    k = int(np.argmin((v - v.mean()) ** 2 + (u - u.mean()) ** 2))
    grown = grow_mask(image, (int(u[k]), int(v[k])), shot.camera.T_world_camera)
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
    with pytest.raises(InputError, match=r"an upright plane \(at least 0\.\d\d x 0\.\d\d m\)"):
        grow_mask(image, (160, 80), T)
    with pytest.raises(InputError, match=r"a level surface 0\.80 m above the floor"):
        grow_mask(image, (160, 225), T)
