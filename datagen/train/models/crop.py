"""Crop each robot's cloud to the points within its reach of the target; the input of all models."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor

from datagen.train.inputs import Clouds, RobotInputs

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


T = TypeVar("T")


def first_true(mask: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Rows (..., count) of the first true entries of (..., K), 0 beyond the last, and a mask."""
    rank = mask.cumsum(-1)  # 1 for the first one
    # Other entries go to slot 0, which is cut off.
    slot = torch.where(mask & (rank <= count), rank, 0)
    rows = torch.zeros((*mask.shape[:-1], count + 1), dtype=torch.int64, device=mask.device)
    rows.scatter_(-1, slot, torch.arange(mask.shape[-1], device=mask.device).expand(slot.shape))
    found = torch.arange(count, device=mask.device) < mask.sum(-1, keepdim=True)
    return rows[..., 1:], found


def farthest_points(points: Tensor, valid: Tensor, count: int) -> Tensor:
    """Rows (B, count) of a farthest-point sample of each cloud (B, M, 3), beginning with the first row.

    Valid rows come first in a cloud. Clouds with fewer than `count` different points repeat earlier rows.
    """
    chosen = torch.zeros((len(points), count), dtype=torch.int64, device=points.device)
    gap2 = torch.where(valid, torch.inf, -1.0).to(points.dtype)  # (B, M), to the nearest chosen point
    row = chosen[:, :1]
    for k in range(1, count):
        last = points.gather(1, row[..., None].expand(-1, -1, 3))
        gap2 = torch.minimum(gap2, (points - last).square().sum(2))
        row = gap2.argmax(1, keepdim=True)
        chosen[:, k : k + 1] = row
    return chosen


def ball_query(
    points: Tensor, valid: Tensor, centres: Tensor, radius: float, count: int
) -> tuple[Tensor, Tensor]:
    """The first `count` valid rows of each cloud (B, M, 3) within `radius` of its centres (B, J, 3).

    Rows (B, J, count), padded with the first one found (0 without one), and the number found (B, J), as in
    PointNet++ (Qi et al. 2017).
    """
    gap2 = (centres[:, :, None] - points[:, None]).square().sum(3)  # (B, J, M)
    rows, found = first_true(valid[:, None] & (gap2 <= radius**2), count)
    return torch.where(found, rows, rows[..., :1]), found.sum(2)


def gather_rows(values: Tensor, rows: Tensor) -> Tensor:
    """Rows (B, ...) of values (B, M, F), as (B, ..., F)."""
    flat = rows.flatten(1)
    return values.gather(1, flat[..., None].expand(-1, -1, values.shape[2])).unflatten(1, rows.shape[1:])


def take_rows(table: T, rows: Tensor | slice) -> T:
    """A dataclass of tensors, or of such dataclasses, with these rows of each tensor."""
    values: list[Any] = [getattr(table, f.name) for f in fields(table)]  # type: ignore[arg-type]
    return type(table)(*(take_rows(v, rows) if is_dataclass(v) else v[rows] for v in values))
