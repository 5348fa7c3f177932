"""Farthest-point sampling and ball queries in plain torch, for many clouds at once (Qi et al. 2017)."""

from __future__ import annotations

import torch
from torch import Tensor


def farthest_points(points: Tensor, valid: Tensor, count: int) -> Tensor:
    """Rows (B, count) of a farthest-point sample of each cloud (B, M, 3), beginning with the first row.

    Valid rows come first in a cloud. Where a cloud has fewer than `count` different points the last
    rows repeat earlier ones; what they are where nothing is valid means nothing.
    """
    chosen = torch.zeros((len(points), count), dtype=torch.int64, device=points.device)
    gap = torch.where(valid, torch.inf, -1.0).to(points.dtype)  # (B, M), to the nearest chosen point
    row = chosen[:, :1]
    for k in range(1, count):
        last = points.gather(1, row[..., None].expand(-1, -1, 3))
        gap = torch.minimum(gap, (points - last).square().sum(2))
        row = gap.argmax(1, keepdim=True)
        chosen[:, k : k + 1] = row
    return chosen


def ball_query(
    points: Tensor, valid: Tensor, centres: Tensor, radius: float, count: int
) -> tuple[Tensor, Tensor]:
    """The first `count` valid rows of each cloud (B, M, 3) within `radius` of its centres (B, J, 3).

    Returns rows (B, J, count), filled up with the first one found (0 where none is), and how many
    were found (B, J), at most `count`.
    """
    gap2 = (centres[:, :, None] - points[:, None]).square().sum(3)  # (B, J, M)
    inside = valid[:, None] & (gap2 <= radius**2)
    rank = inside.cumsum(2)
    slot = torch.where(inside & (rank <= count), rank, 0)
    rows = torch.zeros((*gap2.shape[:2], count + 1), dtype=torch.int64, device=points.device)
    rows.scatter_(2, slot, torch.arange(points.shape[1], device=points.device).expand(slot.shape))
    found = inside.sum(2).clamp(max=count)
    rows = rows[..., 1:]
    spare = torch.arange(count, device=points.device) >= found[..., None]
    return torch.where(spare, rows[..., :1], rows), found


def gather_rows(values: Tensor, rows: Tensor) -> Tensor:
    """Rows (B, ...) of values (B, M, F), as (B, ..., F)."""
    flat = rows.flatten(1)
    return values.gather(1, flat[..., None].expand(-1, -1, values.shape[2])).unflatten(1, rows.shape[1:])
