"""Crop each robot's cloud to the points within its reach of the target; the input of all models."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from datagen.train.inputs import Clouds, RobotInputs
from datagen.train.models.grouping import first_true

# The colour that marks the target (GBPP, arXiv 2509.11594), of 255.
TARGET_RGB = (0.0, 77.0, 77.0)


@dataclass(frozen=True, eq=False)
class Crop:
    """K points for each of R robots; rows that are not `valid` are zero and come last.

    Frame: x and y of the target frame; z is the height above the arm's mount.
    """

    points_m: Tensor  # (R, K, 3) float32
    rgb: Tensor  # (R, K, 3) float32, 0 to 1, the target in TARGET_RGB
    target_mask: Tensor  # (R, K) bool
    valid: Tensor  # (R, K) bool
    target_rise_m: Tensor  # (R,) float32, of the target's centre above the mount


def crop_clouds(clouds: Clouds[Tensor], robots: RobotInputs[Tensor], n_points: int) -> Crop:
    """The first `n_points` stored points of each robot's cloud within `arm_reach_m` of the target, in 3D.

    They keep the stored order, in which the first are a farthest-point sample. Padding and points that are
    not finite are left out.
    """
    device = clouds.points_m.device
    stored = clouds.points_m[robots.cloud_row]  # (R, P, 3)
    n_stored = stored.shape[1]
    counts = torch.arange(n_stored, device=device) < clouds.n_points[robots.cloud_row, None]
    inside = counts & (torch.linalg.vector_norm(stored, dim=2) <= robots.arm_reach_m[:, None])
    source, valid = first_true(inside, n_points)

    rows = robots.cloud_row[:, None]
    if n_stored == 0:
        shape = (len(robots), n_points, 3)
        points = rgb = torch.zeros(shape, device=device)
        mask = torch.zeros(shape[:2], dtype=torch.bool, device=device)
    else:
        points = clouds.points_m[rows, source]
        rgb = clouds.rgb[rows, source].to(points.dtype)
        mask = clouds.target_mask[rows, source] & valid
    rgb = torch.where(mask[..., None], rgb.new_tensor(TARGET_RGB), rgb) / 255.0
    rise = clouds.target_height_m[robots.cloud_row] - robots.base_height_m
    points = points + torch.nn.functional.pad(rise[:, None, None], (2, 0))
    keep = valid[..., None]
    return Crop(torch.where(keep, points, 0.0), torch.where(keep, rgb, 0.0), mask, valid, rise)
