"""Which pixels belong to the object at a clicked one: a small U-Net over a crop of metric scale, in NumPy.

The crop has 96 x 96 cells, each 4.5 mm wide at the clicked pixel's depth. It is turned by quarters until its
top is nearest to up. Its channels are depth, height and distance along the view relative to the clicked
point, normals, whether there is depth, colour, and how near a cell is to the click. Directions are those of
an upright frame that looks where the camera does.
`scripts/click_network.py` trains it on rendered scenes.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from safetensors.numpy import load_file
from scipy import ndimage

from datagen.released import released_click_network
from datagen.train.inputs import F32, F64, Bools
from datagen.train.prediction.frames import RgbdImage

CELLS, CELL_M, CHANNELS = 96, 0.0045, 12
_NEAR_M = 0.012  # standard deviation of the channel of nearness to the click
_UPRIGHT = 0.2  # least horizontal part of the view's direction; below it, that of the picture's top
Weights = Mapping[str, F32]


def crop_at(image: RgbdImage, pixel: tuple[int, int]) -> tuple[F32, npt.NDArray[np.uint8], Bools]:
    """Depth (N, N) less that of pixel (u, v) (m), colour (N, N, 3) and whether there is depth (N, N)."""
    (u, v), (h, w), p = pixel, image.depth_m.shape, image.pinhole
    columns, rows = (
        np.rint(at + _cells_m() / image.depth_m[v, u] * f).astype(int)
        for at, f in ((u, p.fx_px), (v, p.fy_px))
    )
    inside = ((rows >= 0) & (rows < h))[:, None] & ((columns >= 0) & (columns < w))
    seen = np.ix_(rows.clip(0, h - 1), columns.clip(0, w - 1))
    known = inside & (image.depth_m[seen] > 0)
    away_m = np.where(known, image.depth_m[seen] - image.depth_m[v, u], 0).clip(-1, 3)
    return away_m.astype(np.float32), image.rgb[seen] * inside[..., None], known


def _cells_m() -> F64:
    return np.arange(-CELLS // 2, CELLS - CELLS // 2).astype(np.float64) * CELL_M


def channels(away_m: F32, rgb: npt.NDArray[np.uint8], known: Bools, ray: F64, R: F64) -> F32:
    """Channels (CHANNELS, N, N) of a crop as `crop_at` returns it.

    `ray` (3,) is the clicked point (m) in the camera's frame (x right, y down, z ahead), `R` (3, 3) the
    rotation from it to a frame with z up.
    """
    cell, z = _cells_m(), ray[2]
    ahead, top = R[:2, 2], -R[:2, 1]
    ahead = ahead if np.hypot(*ahead) >= _UPRIGHT else top
    ahead = ahead / max(float(np.hypot(*ahead)), 1e-6)
    G = np.array([[ahead[1], -ahead[0], 0], [ahead[0], ahead[1], 0], [0, 0, 1]]) @ R  # right, ahead, up
    x, y = ((ray[k] + cell) / z for k in (0, 1))
    depth = z + away_m
    P = np.stack([x * depth - ray[0], y[:, None] * depth - ray[1], away_m])
    P = np.einsum("ij,jhw->ihw", G, P)
    beside = np.pad(P, ((0, 0), (1, 1), (1, 1)), mode="edge")
    normal = np.cross(
        beside[:, 2:, 1:-1] - beside[:, :-2, 1:-1], beside[:, 1:-1, 2:] - beside[:, 1:-1, :-2], axis=0
    )
    normal /= np.maximum(np.linalg.norm(normal, axis=0), 1e-9)
    normal *= ndimage.minimum_filter(known, 3, mode="constant", cval=False)
    near = np.exp(-(cell**2 + cell[:, None] ** 2) / (2 * _NEAR_M**2))
    apart = (5 * np.linalg.norm(P, axis=0)).clip(0, 2) * known + 2.0 * ~known
    measured = np.stack([away_m, P[2], P[1]])
    shape = (10 * measured).clip(-2, 2) * known
    colour = rgb.transpose(2, 0, 1) / 127.5 - 1
    return np.concatenate([shape, normal, known[None], colour, near[None], apart[None]]).astype(np.float32)


def object_logits(image: RgbdImage, pixel: tuple[int, int], T_world_camera: F64) -> F32:
    """Logits (H, W) that pixels belong to the object at (u, v), which has depth; -20 outside the crop."""
    (u, v), (h, w), p = pixel, image.depth_m.shape, image.pinhole
    z = float(image.depth_m[v, u])
    ray = np.array([(u - p.cx_px) / p.fx_px * z, (v - p.cy_px) / p.fy_px * z, z])
    R, quarter = T_world_camera[:3, :3], np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    turns = int(np.argmax((-R[2, 1], R[2, 0], R[2, 1], -R[2, 0])))
    away_m, rgb, known = (_turned(part, turns) for part in crop_at(image, pixel))
    turn = np.linalg.matrix_power(quarter, turns)
    logits = _turned(
        network_logits(channels(away_m, rgb, known, turn @ ray, R @ turn.T), _weights()), -turns % 4
    )
    at = [
        (np.arange(n) - k) * z / (CELL_M * f) + CELLS // 2 for n, k, f in ((h, v, p.fy_px), (w, u, p.fx_px))
    ]
    rows, columns = (np.flatnonzero((line >= 0) & (line <= CELLS - 1)) for line in at)
    found = np.full((h, w), -20, np.float32)
    places = np.meshgrid(at[0][rows], at[1][columns], indexing="ij")
    found[np.ix_(rows, columns)] = ndimage.map_coordinates(logits, places, order=1)
    return found


def _turned(part: npt.NDArray[Any], turns: int) -> npt.NDArray[Any]:
    """A crop (N, N, ...) after quarter turns, counterclockwise, about the clicked cell."""
    return np.roll(np.rot90(part, turns), (turns in (1, 2), turns in (2, 3)), (0, 1))


@lru_cache(maxsize=1)
def _weights() -> Weights:
    return {name: tensor.astype(np.float32) for name, tensor in load_file(released_click_network()).items()}


def network_logits(x: F32, weights: Weights) -> F32:
    """Logits (N, N) of channels (CHANNELS, N, N)."""

    def layer(name: str, x: F32, step: int = 1) -> F32:
        return np.maximum(_convolved(x, weights[f"{name}.weight"], weights[f"{name}.bias"], step), 0)

    levels = [layer("stem.1", layer("stem.0", x, 2))]
    for name in ("down1", "down2", "down3"):
        levels.append(layer(f"{name}.1", layer(f"{name}.0", levels[-1], 2)))
    y = layer("down3.2", levels.pop())
    for k in (2, 1, 0):
        y = layer(f"up{k}", y).repeat(2, axis=1).repeat(2, axis=2)
        y = layer(f"mixed{k}", y + levels.pop())
    four = _convolved(y, weights["out.weight"], weights["out.bias"], 1)
    n = four.shape[1]
    return four.reshape(2, 2, n, n).transpose(2, 0, 3, 1).reshape(2 * n, 2 * n)


def _convolved(x: F32, weight: F32, bias: F32, step: int) -> F32:
    """The convolution of x (C, N, N) with a kernel (D, C, k, k), padded to N / step cells a side."""
    size = weight.shape[2]
    if size > 1:
        x = np.pad(x, ((0, 0), (1, 1), (1, 1)))
        seen: npt.NDArray[Any] = np.lib.stride_tricks.sliding_window_view(x, (size, size), axis=(1, 2))
        x = seen[:, ::step, ::step].transpose(0, 3, 4, 1, 2)
    n = x.shape[-1]
    return (weight.reshape(len(weight), -1) @ x.reshape(-1, n * n) + bias[:, None]).reshape(-1, n, n)
