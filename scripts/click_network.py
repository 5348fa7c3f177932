"""Train the network that segments what is clicked, on rendered scenes, from nothing.

    python -m scripts.click_network FOLDER --houses procthor:DIR --objects ycb:DIR

Scenes with much clutter are drawn of the houses' training split, with the objects and with built-in ones.
They are seen three times each: by their camera and by others around it, as they settled or with objects of
other sizes, pushed together and stacked without physics, with the noise of various depth cameras. Crops at
two clicks on each of seven objects, and on planes of the room, whose mask is empty, are kept in FOLDER; a
finished part is not made again. The last crops with the objects are validation.
FOLDER/clicks.safetensors has the weights, in half precision, with the normalisation in them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import save_file
from scipy import ndimage
from torch import Tensor, nn
from torch.nn import functional as F

from benchmarks.clicks import ROOM, case_of, clicks_on
from datagen.schemas.run_records import StageClock
from datagen.schemas.specification import NoiseParams, Source, Specification
from datagen.train.inputs import F64
from datagen.train.prediction.click_network import CELLS, CHANNELS, channels, crop_at
from datagen.workers.geometry.transforms import look_at
from datagen.workers.houses import open_houses
from datagen.workers.objects import open_objects
from datagen.workers.rendering import Camera
from datagen.workers.rendering.embree import RayMesh, RayScene, ray_mesh, render_rays
from datagen.workers.rendering.noise import add_noise
from datagen.workers.scenes.generate import generate_scene
from datagen.workers.world import assemble_world

_CLUTTER = {"n_clutter": 14, "clutter_radius_m": 0.16, "decisive": 0.0}
_VIEWS, _OBJECTS, _CLICKS, _LEAST_PX = 3, 7, 2, 250
_WIDTHS = (24, 48, 80, 112)
_OF_BATCH, _RATE, _VALIDATION = (27, 5), 2e-3, 300  # crops of objects, and of the room
Crops = dict[str, Any]
Rng = np.random.Generator


def main() -> None:
    """Make the crops, train, and write the weights."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--houses", default="builtin")
    parser.add_argument("--objects", default="builtin")
    parser.add_argument(
        "--scenes", type=int, default=450, help="with these objects; 4/15 as many, built-in ones"
    )
    parser.add_argument("--steps", type=int, default=3200)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    parts = [
        _kept(options.folder / "objects.npz", options.houses, options.objects, options.scenes, seed=21),
        _kept(options.folder / "builtin.npz", options.houses, "builtin", 4 * options.scenes // 15, seed=31),
    ]
    crops = {name: np.concatenate([part[name] for part in parts[::-1]]) for name in parts[0]}
    torch.set_num_threads(1)
    network = _trained(crops, options.steps)
    save_file(folded(network), options.folder / "clicks.safetensors")


def _kept(file: Path, houses: str, objects: str, scenes: int, seed: int) -> Crops:
    if not file.exists():
        found = list(_crops(houses, objects, scenes, seed))
        np.savez(file, **{name: np.stack([each[name] for each in found]) for name in found[0]})
    return dict(np.load(file))


def _crops(houses: str, objects: str, scenes: int, seed: int) -> Iterator[Crops]:
    opened = open_houses(houses), open_objects(objects)
    house, thing = (Source(kind=source.kind, digest=source.digest) for source in opened)
    plain = Specification(seed=seed, split="train", houses=house, objects=thing).model_dump()
    spec = Specification.model_validate({**plain, "scene": {**plain["scene"], **_CLUTTER}})
    world = assemble_world(spec, *opened, houses, objects)
    began = time.monotonic()
    for index in range(scenes):
        rng = np.random.default_rng([seed, index])
        scene = generate_scene(world, index, StageClock())[0]
        for view in range(_VIEWS):
            rays = scene.rays if rng.random() < 0.35 else _pushed_together(scene.rays, rng)
            camera = scene.camera if view == 0 else _around(scene.camera, scene.target_center_m, rng)
            frame = render_rays(rays, camera)
            noise = NoiseParams(
                enabled=bool(rng.random() < 0.85),
                baseline_m=rng.uniform(0.04, 0.1),
                disparity_std_px=10 ** rng.uniform(-1.8, -0.8),
                hole_rate=rng.uniform(0, 0.01),
            )
            image, T, labels = case_of(add_noise(frame, noise, rng) if noise.enabled else frame)
            for label, (u, v) in _clicks(labels, image.depth_m > 0, rng):
                p, z = image.pinhole, image.depth_m[v, u]
                away_m, rgb, known = crop_at(image, (u, v))
                if label == ROOM and not _is_plane(z + away_m, known):
                    continue
                cut = replace(image, rgb=np.repeat((labels == label)[..., None], 3, axis=2).astype(np.uint8))
                yield {
                    "away_m": away_m.astype(np.float16),
                    "rgb": rgb.astype(np.uint8),
                    "known": np.packbits(known, axis=1),
                    "mask": np.packbits(crop_at(cut, (u, v))[1][..., 0] * (label != ROOM), axis=1),
                    "ray": np.array([(u - p.cx_px) / p.fx_px * z, (v - p.cy_px) / p.fy_px * z, z]),
                    "R": T[:3, :3],
                    "on_room": label == ROOM,
                }
        if index % 20 == 19:
            print(f"{objects}: scene {index + 1} of {scenes}, {time.monotonic() - began:.0f} s", flush=True)


def _pushed_together(rays: RayScene, rng: Rng) -> RayScene:
    """The scene with objects of other sizes nearer to the target, and up to three more on top of some."""
    poses, objects, radii_m = [T.copy() for T in rays.T_world_object], list[RayMesh](), list[float]()
    for T, shape, radius_m in zip(poses, rays.objects, rays.radii_m, strict=True):
        scale = rng.uniform(0.6, 1.6) * rng.uniform(0.7, 1.4, 3)
        corners_m = shape.mesh.vertices_m
        objects.append(ray_mesh(replace(shape.mesh, vertices_m=(corners_m * scale).astype(corners_m.dtype))))
        radii_m.append(float(radius_m * scale.max()))
        T[2, 3] += (corners_m @ T[2, :3]).min() - ((corners_m * scale) @ T[2, :3]).min()  # on the same height
    middle, nearer = poses[0][:2, 3], rng.uniform(0.25, 0.8)
    for T in poses[1:]:
        T[:2, 3] = middle + (T[:2, 3] - middle) * nearer
    ends = [
        _ends(mesh.mesh.vertices_m @ T[:3, :3].T + T[:3, 3]) for mesh, T in zip(objects, poses, strict=True)
    ]
    for _ in range(rng.integers(4)):
        below, above = rng.integers(len(poses), size=2)
        T, a = poses[above].copy(), rng.uniform(-np.pi, np.pi)
        T[:3, :3] = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]) @ T[:3, :3]
        low, high = _ends(objects[above].mesh.vertices_m @ T[:3, :3].T)
        under_low, under_high = ends[below]
        at = (under_low + under_high) / 2 + (under_high - under_low) * rng.uniform(-0.3, 0.3, 3)
        T[:2, 3] = at[:2] - (low + high)[:2] / 2
        T[2, 3] = under_high[2] - low[2] - rng.uniform(0, 0.004)
        poses.append(T)
        objects.append(objects[above])
        radii_m.append(radii_m[above])
        ends.append((low + T[:3, 3], high + T[:3, 3]))
    return replace(rays, objects=objects, radii_m=np.array(radii_m), T_world_object=np.array(poses))


def _ends(points_m: F64) -> tuple[F64, F64]:
    return points_m.min(axis=0), points_m.max(axis=0)


def _around(camera: Camera, target_m: F64, rng: Rng) -> Camera:
    """Another camera about the direction of this one, which sees the target."""
    away = camera.T_world_camera[:3, 3] - target_m
    azimuth = np.arctan2(away[1], away[0]) + rng.normal(0, 0.25)
    rise = np.clip(np.arctan2(away[2], np.hypot(away[0], away[1])) + rng.normal(0, 0.2), 0.15, 1.35)
    level = np.cos(rise)
    eye = target_m + rng.uniform(0.45, 1.7) * np.array(
        [np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(rise)]
    )
    T, roll, f = (
        look_at(eye, target_m + rng.normal(0, (0.08, 0.08, 0.024))),
        rng.normal(0, 0.06),
        rng.uniform(500, 640),
    )
    T[:3, :2] = T[:3, :2] @ np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
    return replace(camera, T_world_camera=T, fx_px=f, fy_px=f)


def _clicks(labels: Any, known: Any, rng: Rng) -> Iterator[tuple[int, tuple[int, int]]]:
    shown = [
        k for k in np.unique(labels) if k not in (0, ROOM) and ((labels == k) & known).sum() >= _LEAST_PX
    ]
    for label in rng.permutation(shown)[:_OBJECTS].tolist():
        places = clicks_on((labels == label) & known)
        yield from ((label, places[k]) for k in rng.choice(len(places), _CLICKS, replace=False))
    h, w = labels.shape
    room = (labels == ROOM) & known
    room[: h // 8] = room[-h // 8 :] = room[:, : w // 5] = room[:, -w // 5 :] = False
    v, u = np.nonzero(room)
    if len(v):
        yield from ((ROOM, (int(u[k]), int(v[k]))) for k in rng.choice(len(v), _CLICKS))


def _is_plane(depth_m: Any, known: Any) -> bool:
    """Whether a plane fills the middle of a crop: there the inverse of depth is linear."""
    half = 20
    cut = np.s_[CELLS // 2 - half : CELLS // 2 + half, CELLS // 2 - half : CELLS // 2 + half]
    row, column = np.mgrid[-half:half, -half:half][:, known[cut]]
    there_m = depth_m[cut][known[cut]]
    A = np.stack([row, column, np.ones(len(row))], axis=1)
    off_m = np.abs(1 / (A @ np.linalg.lstsq(A, 1 / there_m, rcond=None)[0]) - there_m)
    return len(row) > 2 * half**2 and bool(np.quantile(off_m, 0.95) < 0.015)


def _layer(before: int, after: int, size: int = 3, step: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(before, after, size, step, int(size > 1), bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(after), nn.ReLU(inplace=True))


class Network(nn.Module):
    """As `click_network` computes it."""

    def __init__(self) -> None:
        super().__init__()
        a, *_, d = _WIDTHS
        self.stem = nn.Sequential(_layer(CHANNELS, a, 4, 2), _layer(a, a))
        for k in (0, 1, 2):
            before, after = _WIDTHS[k : k + 2]
            self.add_module(f"down{k + 1}", nn.Sequential(_layer(before, after, 3, 2), _layer(after, after)))
            self.add_module(f"up{k}", _layer(after, before, 1))
            self.add_module(f"mixed{k}", _layer(before, before))
        self.down3.append(_layer(d, d))
        self.out = nn.Conv2d(a, 4, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Logits (B, N, N) of channels (B, CHANNELS, N, N)."""
        levels = [self.stem(x)]
        for k in (1, 2, 3):
            levels.append(self.get_submodule(f"down{k}")(levels[-1]))
        y = levels.pop()
        for k in (2, 1, 0):
            y = F.interpolate(self.get_submodule(f"up{k}")(y), scale_factor=2.0) + levels.pop()
            y = self.get_submodule(f"mixed{k}")(y)
        return F.pixel_shuffle(self.out(y), 2)[:, 0]


def _trained(crops: Crops, steps: int) -> Network:
    torch.manual_seed(0)
    rng, network = np.random.default_rng(0), Network()
    count = len(crops["ray"]) - _VALIDATION
    kinds = [np.flatnonzero(crops["on_room"][:count] == room) for room in (False, True)]
    optimizer = torch.optim.AdamW(network.parameters(), _RATE, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _RATE, total_steps=steps, pct_start=0.1)
    began, mean = time.monotonic(), 0.0
    for step in range(1, steps + 1):
        some = [rng.choice(rows, n, replace=False) for rows, n in zip(kinds, _OF_BATCH, strict=True)]
        x, y, on_room = _batch(crops, np.concatenate(some), rng)
        loss = _loss(network(x), y, on_room)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        mean += loss.item() / 100
        if step % 100 == 0:
            print(f"step {step} of {steps}, loss {mean:.4f}, {time.monotonic() - began:.0f} s", flush=True)
            mean = 0.0
    network.eval()
    print(_validated(network, crops, np.arange(count, count + _VALIDATION)))
    return network


def _batch(crops: Crops, rows: Any, rng: Rng | None) -> tuple[Tensor, Tensor, Tensor]:
    """Channels, masks and whether the room is clicked; with `rng` varied in colour, noise, holes and side."""
    known, mask = (np.unpackbits(crops[name][rows], axis=2).astype(bool) for name in ("known", "mask"))
    rgb, away_m, rays = crops["rgb"][rows], crops["away_m"][rows].astype(np.float32), crops["ray"][rows]
    if rng is not None:
        rgb = _recoloured(rgb, rng)
        measured = _as_measured(away_m, known, rng)
        as_is = rng.random((len(rows), 1, 1)) < 0.25
        away_m, known = (np.where(as_is, a, b) for a, b in zip((away_m, known), measured, strict=True))
    made = zip(away_m * known, rgb, known, rays, crops["R"][rows], strict=True)
    x, y = torch.from_numpy(np.stack([channels(*each) for each in made])), torch.from_numpy(mask)
    if rng is not None:
        mirrored = torch.from_numpy(rng.random(len(rows)) < 0.5)
        other = torch.roll(x.flip(-1), 1, -1)  # about the clicked cell
        other[:, 3] *= -1  # of the normal to the right
        x = torch.where(mirrored[:, None, None, None], other, x)
        y = torch.where(mirrored[:, None, None], torch.roll(y.flip(-1), 1, -1), y)
    return x, y.float(), torch.from_numpy(crops["on_room"][rows])


def _as_measured(away_m: Any, known: Any, rng: Rng) -> tuple[Any, Any]:
    """Depth as other cameras see it: with waves, blurred over edges, with holes beside edges and others."""
    n, middle = len(away_m), CELLS // 2
    away_m = away_m + _waves(n, 1, 12, rng)[:, 0] * rng.uniform(0, 0.004, (n, 1, 1))
    weight = ndimage.uniform_filter(known.astype(np.float32), (0, 3, 3))
    blurred = ndimage.uniform_filter(away_m * known, (0, 3, 3)) / np.maximum(weight, 0.1)
    away_m = np.where(rng.random((n, 1, 1)) < 0.4, blurred, away_m)
    behind_m = away_m - ndimage.minimum_filter(np.where(known, away_m, 3), (0, 3, 5))
    known = known & ~((behind_m > 0.015) & (rng.random((n, 1, 1)) < 0.5))
    known &= rng.random(known.shape) >= rng.uniform(0, 0.03, (n, 1, 1))
    row, column = np.mgrid[:CELLS, :CELLS]
    for k in np.flatnonzero(rng.random(n) < 0.4):
        for u, v in rng.integers(CELLS, size=(rng.integers(1, 4), 2)):
            known[k] &= (row - v) ** 2 + (column - u) ** 2 > rng.uniform(2, 8) ** 2
    known[:, middle - 1 : middle + 2, middle - 1 : middle + 2] |= True
    away_m[:, middle, middle] = 0
    return away_m, known


def _waves(n: int, channels: int, across: int, rng: Rng) -> Any:
    """Smooth noise (n, channels, CELLS, CELLS)."""
    coarse = torch.from_numpy(rng.standard_normal((n, channels, across, across)).astype(np.float32))
    return F.interpolate(coarse, size=(CELLS, CELLS), mode="bilinear").numpy()


def _recoloured(rgb: Any, rng: Rng) -> Any:
    n = len(rgb)
    found = rgb * rng.uniform(0.5, 1.6, (n, 1, 1, 1)) * rng.uniform(0.75, 1.3, (n, 1, 1, 3))
    found += rng.normal(0, 1, rgb.shape) * rng.uniform(0, 12, (n, 1, 1, 1)) + rng.uniform(
        -25, 25, (n, 1, 1, 1)
    )
    found += _waves(n, 3, 7, rng).transpose(0, 2, 3, 1) * rng.uniform(0, 35, (n, 1, 1, 1))
    for k in np.flatnonzero(rng.random(n) < 0.3):
        found[k] = found[k][..., rng.permutation(3)]
    for share, axes in ((0.2, 3), (0.08, (1, 2))):  # without colours, and of one colour
        some = rng.random(n) < share
        found[some] = found[some].mean(axis=axes, keepdims=True)
    return found.clip(0, 255)


def _loss(logits: Tensor, mask: Tensor, on_room: Tensor) -> Tensor:
    each = F.binary_cross_entropy_with_logits(logits, mask, reduction="none").mean((1, 2))
    share = torch.sigmoid(logits)
    dice = 1 - (2 * (share * mask).sum((1, 2)) + 1) / ((share + mask).sum((1, 2)) + 1)
    return torch.where(on_room, each, each + 0.5 * dice).mean()


def _validated(network: Network, crops: Crops, rows: Any) -> str:
    overlaps, taken = list[float](), list[bool]()
    for some in np.array_split(rows, max(len(rows) // 50, 1)):
        x, y, on_room = _batch(crops, some, None)
        with torch.inference_mode():
            found, mask = network(x) > 0, y > 0
        overlap = (found & mask).sum((1, 2)) / (found | mask).sum((1, 2)).clamp(min=1)
        overlaps += overlap[~on_room].tolist()
        taken += found[on_room, CELLS // 2, CELLS // 2].tolist()
    good, room = 100 * np.mean(np.array(overlaps) >= 0.5), 100 * np.mean(taken)
    return f"validation: {good:.1f}% of masks overlap by half, {room:.1f}% of clicks on the room give one"


def folded(network: Network) -> dict[str, Any]:
    """Weight and bias of each layer with its normalisation in them."""
    found: dict[str, Any] = {}
    for name, part in network.named_modules():
        if isinstance(part, nn.Sequential) and isinstance(part[0], nn.Conv2d):
            norm: Any = part[1]
            gain = norm.weight / torch.sqrt(norm.running_var + norm.eps)
            found[f"{name}.weight"] = part[0].weight * gain[:, None, None, None]
            found[f"{name}.bias"] = norm.bias - norm.running_mean * gain
    found |= {f"out.{name}": value for name, value in network.out.named_parameters()}
    return {name: value.detach().numpy().astype(np.float16) for name, value in found.items()}


if __name__ == "__main__":
    main()
