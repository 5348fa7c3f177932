"""Choose points of many clouds at once, in plain torch: first ones, farthest points, ball queries."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor

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


def take_rows(table: T, rows: Tensor) -> T:
    """A dataclass of tensors, or of such dataclasses, with these rows of each tensor."""
    values: list[Any] = [getattr(table, f.name) for f in fields(table)]  # type: ignore[arg-type]
    return type(table)(*(take_rows(v, rows) if is_dataclass(v) else v[rows] for v in values))
