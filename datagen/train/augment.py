"""Data augmentation of scenes, random for each epoch.

Labels and ids never change. Each effect is a frozen dataclass of numbers, None to disable it, with a random
generator of its own, so that disabling one does not change the others. Extra columns stay as stored, also
where the cloud is rotated.

The farthest-point order (train/inputs.py): rotation and colour keep it. Removed points leave the others in
order, so that a prefix is still well spread, with random points earlier. Noise moves points, not rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from math import cos, pi, sin
from typing import Any

import numpy as np

from datagen.schemas.errors import InputError
from datagen.train.batching import View
from datagen.train.inputs import F64, Bools


def _up_to(most: float, default: float) -> Any:
    return field(default=default, metadata={"most": most})


@dataclass(frozen=True)
class _Effect:
    """Numbers from 0 to the `most` of their field."""

    def __post_init__(self) -> None:
        for f in fields(self):
            value, most = getattr(self, f.name), f.metadata["most"]
            if not 0 <= value <= most:
                raise InputError(
                    "augmentation", f.name, f"{value} is not between 0 and {most:.4g}", "Correct it"
                )


@dataclass(frozen=True)
class SensorNoise(_Effect):
    """Depth noise: points move along the camera's ray by a normal error of std_at_1m_m * depth^2 (metres).

    This is the error of a stereo camera: sigma_z = depth^2 sigma_d / (fx baseline) (Khoshelham and Elberink
    2012, Sensors 12(2), eq. 10). The default is 0.08 px over 5 cm at fx = 615 px.
    """

    std_at_1m_m: float = _up_to(1, 0.0026)

    def apply(self, view: View, rng: np.random.Generator) -> View:
        n = view.n_points
        camera_m, sight_m = _sight_lines(view)
        depth_m = sight_m @ view.scene.record["T_world_camera"][:3, 2]
        # Along the ray, a relative error of depth is the same relative error of the distance.
        scale = np.maximum(1 + self.std_at_1m_m * depth_m * rng.standard_normal(n), 0)
        points_m = view.points_m.copy()
        points_m[:n] = camera_m + sight_m * scale[:, None]
        return replace(view, points_m=points_m)


@dataclass(frozen=True)
class DepthHoles(_Effect):
    """Round holes in the depth image: all points in one are removed.

    0 to `most` holes around points of the cloud, with half-angles up to `largest_rad` from the camera. A hole
    that would leave less than `target_kept` of the target's points, or none, is skipped.
    """

    most: int = _up_to(1000, 4)
    largest_rad: float = _up_to(pi / 2, 0.05)
    target_kept: float = _up_to(1, 0.5)

    def apply(self, view: View, rng: np.random.Generator) -> View:
        n = view.n_points
        _, sight_m = _sight_lines(view)
        toward = sight_m / np.maximum(np.linalg.norm(sight_m, axis=1, keepdims=True), 1e-9)
        target = view.target_mask[:n]
        least = max(self.target_kept * np.count_nonzero(target), 1.0)
        kept = np.ones(n, np.bool_)
        for _ in range(rng.integers(self.most + 1)):
            centre, half_rad = toward[rng.integers(n)], rng.uniform(0, self.largest_rad)
            left = kept & (toward @ centre < cos(half_rad))
            if not target.any() or np.count_nonzero(left & target) >= least:
                kept = left if left.any() else kept
        return _with_rows(view, kept)


@dataclass(frozen=True)
class PointDropout(_Effect):
    """A share of the points, uniform in [0, largest_share], is removed; one target point is always kept."""

    largest_share: float = _up_to(1, 0.3)

    def apply(self, view: View, rng: np.random.Generator) -> View:
        n = view.n_points
        kept = rng.random(n) >= rng.uniform(0, self.largest_share)
        target = view.target_mask[:n]
        if not (kept & target).any():
            kept[np.argmax(target)] = True  # the first target row, or the first row without one
        return _with_rows(view, kept)


@dataclass(frozen=True)
class ColourJitter(_Effect):
    """Colours are multiplied by a common gain and one per channel, uniform in 1 +- these shares."""

    brightness: float = _up_to(1, 0.2)
    channel: float = _up_to(1, 0.1)

    def apply(self, view: View, rng: np.random.Generator) -> View:
        gain = (1 + self.brightness * rng.uniform(-1, 1)) * (1 + self.channel * rng.uniform(-1, 1, 3))
        rgb = np.clip(np.rint(view.rgb * gain.astype(np.float32)), 0, 255).astype(np.uint8)
        return replace(view, rgb=rgb)


@dataclass(frozen=True)
class Rotation(_Effect):
    """Rotation of cloud and candidates about the vertical axis through the target, up to largest_rad."""

    largest_rad: float = _up_to(pi, pi)

    def apply(self, view: View, rng: np.random.Generator) -> View:
        angle = rng.uniform(-self.largest_rad, self.largest_rad)
        turn = np.array([[cos(angle), sin(angle)], [-sin(angle), cos(angle)]])  # for rows: x' = x R^T
        points_m = view.points_m.copy()
        points_m[:, :2] = view.points_m[:, :2] @ turn.astype(np.float32)
        return replace(view, points_m=points_m, base_xy_m=view.base_xy_m @ turn)


@dataclass(frozen=True)
class Augmentation:
    """The effects in order of application; None disables one."""

    noise: SensorNoise | None = None
    holes: DepthHoles | None = None
    dropout: PointDropout | None = None
    colour: ColourJitter | None = None
    rotation: Rotation | None = None

    @property
    def fields(self) -> tuple[str, ...]:
        """Further scene fields that the effects need."""
        return ("T_world_camera",) if self.noise or self.holes else ()

    def apply(self, view: View, seed: Sequence[int]) -> View:
        """Return the view after all effects; the given one is unchanged. `seed` is of scene and epoch."""
        if not view.n_points:
            return view
        effects = (self.noise, self.holes, self.dropout, self.colour, self.rotation)
        for number, effect in enumerate(effects):
            if effect is not None:
                view = effect.apply(view, np.random.default_rng([*seed, number]))
        return view


def _sight_lines(view: View) -> tuple[F64, F64]:
    """The camera's position (3,), and vectors from it to the points (n, 3); target frame."""
    camera_m = view.scene.record["T_world_camera"][:3, 3] - view.scene.record["target_center_m"]
    return camera_m, view.points_m[: view.n_points] - camera_m


def _with_rows(view: View, kept: Bools) -> View:
    """The cloud with only these points (n,), in order, padded with zeros."""
    rows = np.flatnonzero(kept)
    if len(rows) == view.n_points:
        return view
    cloud = {name: getattr(view, name) for name in ("points_m", "rgb", "target_mask")}
    moved = {name: np.zeros_like(values) for name, values in cloud.items()}
    for name, values in cloud.items():
        moved[name][: len(rows)] = values[rows]
    return replace(view, n_points=len(rows), **moved)
