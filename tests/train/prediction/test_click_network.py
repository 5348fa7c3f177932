"""The network of clicks: NumPy computes what was trained, and a mirrored picture has mirrored channels."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from datagen.train.prediction.click_network import CELLS, CHANNELS, channels, network_logits, object_logits
from datagen.train.prediction.frames import Pinhole, RgbdImage
from scripts.click_network import Network, folded


def test_numpy_computes_the_network_that_was_trained() -> None:
    torch.manual_seed(0)
    network = Network().eval()
    for layer in network.modules():
        if isinstance(layer, nn.BatchNorm2d):
            assert layer.running_mean is not None and layer.running_var is not None
            layer.running_mean.normal_()
            layer.running_var.uniform_(0.5, 2)
            nn.init.uniform_(layer.weight, 0.5, 1.5)
            nn.init.normal_(layer.bias)
    x = torch.randn(1, CHANNELS, CELLS, CELLS)
    with torch.inference_mode():
        wanted = network(x)[0].numpy()
    weights = {name: value.astype(np.float32) for name, value in folded(network).items()}
    assert np.abs(network_logits(x[0].numpy(), weights) - wanted).max() < 0.005 * wanted.std()


def test_a_mirrored_picture_has_mirrored_channels() -> None:
    """About the clicked column, for a camera that looks down; the normal to the right changes its sign."""
    rng = np.random.default_rng(0)
    # An odd number of columns about the clicked one: the first has no counterpart.
    away_m = rng.uniform(-0.2, 0.2, (CELLS, CELLS)).astype(np.float32)
    rgb = rng.integers(0, 255, (CELLS, CELLS, 3), dtype=np.uint8)
    known = rng.random((CELLS, CELLS)) < 0.9
    down = 0.6
    R = np.array([[1, 0, 0], [0, -np.sin(down), np.cos(down)], [0, -np.cos(down), -np.sin(down)]])
    ray = np.array([0.0, 0.05, 1.1])

    def mirror(values: np.ndarray, axis: int) -> np.ndarray:
        return np.roll(np.flip(values, axis), 1, axis)

    wanted = mirror(channels(away_m, rgb, known, ray, R), 2)
    wanted[3] *= -1
    found = channels(mirror(away_m, 1), mirror(rgb, 1), mirror(known, 1), ray, R)
    inner = np.s_[:, 2:-2, 3:-3]
    assert np.allclose(found[inner], wanted[inner], atol=1e-5)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_turned_camera_sees_the_same_object(turns: int) -> None:
    rng, down, size = np.random.default_rng(0), 0.9, 161
    depth_m = rng.uniform(0.9, 1.1, (size, size)).astype(np.float32)
    rgb = rng.integers(0, 255, (size, size, 3), dtype=np.uint8)
    T = np.eye(4)
    T[:3, :3] = [[1, 0, 0], [0, -np.sin(down), np.cos(down)], [0, -np.cos(down), -np.sin(down)]]
    middle = size // 2
    pinhole = Pinhole(400.0, 400.0, middle, middle)
    wanted = object_logits(RgbdImage(rgb, depth_m, pinhole, None), (middle, middle), T)
    T[:3, :3] = T[:3, :3] @ Rotation.from_euler("z", 90 * turns, degrees=True).as_matrix()
    picture = RgbdImage(np.rot90(rgb, turns), np.rot90(depth_m, turns), pinhole, None)
    found = np.rot90(object_logits(picture, (middle, middle), T), -turns)
    assert np.median(np.abs(found - wanted)) < 0.02 * wanted.std()
