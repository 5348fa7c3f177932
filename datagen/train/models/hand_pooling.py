"""Pooled hand poses at the target for an arm at a candidate: reach is learned, clearance is measured.

Each pose of `hand_poses` is seen from the candidate's mount: where TCP and wrist are, in units of the arm's
reach, at the grasp, before it and above it. Poses to the right of the line to the target are mirrored to its
left, so the result does not change in a mirror.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from datagen.train.hands.poses import N_MEASURES
from datagen.train.models.crop import take_rows
from datagen.train.models.frames import Frames
from datagen.train.models.tokens import turned

_WRIST_M, _WAY_M = 0.2, 0.1  # from the TCP back to the wrist; before the grasp, and up
_CODE = 300.0  # of reach: brings its codes near 1
_NEAR = 0.05  # share of the reach; nearer to the mount a direction is noise
N_SEEN_FROM_MOUNT = 26


class HandPooling(nn.Module):
    """(N, 3 width) from the poses (S, K, HAND_WIDTH) of clouds: maximum, mean and attention over K."""

    def __init__(self, n_scalars: int, width: int, n_reach: int = 0) -> None:
        """`n_reach` is the number of codes of a robot's own reach (`hand_reach`); 0 without."""
        super().__init__()
        self.room = nn.Sequential(nn.Linear(N_MEASURES, width), nn.ReLU(), nn.Linear(width, width))
        self.seen = nn.Linear(N_SEEN_FROM_MOUNT + n_reach, width)
        self.condition = nn.Linear(n_scalars, width)
        self.joined = nn.Sequential(
            nn.LayerNorm(width),
            nn.ReLU(inplace=True),
            nn.Linear(width, width),
            nn.ReLU(inplace=True),
            nn.Linear(width, width),
        )
        self.attention = nn.Linear(width, 1)

    def forward(
        self,
        poses: Tensor,
        cloud_row: Tensor,
        frames: Frames,
        scalars: Tensor,
        reach: Tensor | None,
        at_once: int,
    ) -> Tensor:
        """`cloud_row` (N,) has the candidates' clouds, `scalars` (N, n_scalars) their features.

        `reach` (N, K, n_reach) are codes. `at_once` candidates are in one product.
        """
        room, axes = self.room(poses[..., :N_MEASURES]), poses[..., N_MEASURES:].unflatten(2, (3, 3))
        pooled: list[Tensor] = []
        for start in range(0, len(scalars), at_once):
            rows = slice(start, start + at_once)
            cloud = cloud_row[rows]
            seen = from_mount(axes[cloud], take_rows(frames, rows))
            if reach is not None:
                seen = torch.cat([seen, reach[rows].to(seen.dtype) / _CODE], dim=-1)
            hidden = self.seen(seen)
            hidden += room[cloud]
            hidden += self.condition(scalars[rows])[:, None]
            hidden = self.joined(hidden)
            share = torch.softmax(self.attention(hidden), dim=1)
            pooled.append(torch.cat([highest(hidden, 1), hidden.mean(1), (share * hidden).sum(1)], dim=1))
        return torch.cat(pooled)


def from_mount(axes: Tensor, frames: Frames) -> Tensor:
    """Features (N, K, N_SEEN_FROM_MOUNT) of TCP, approach and closing axis (N, K, 3, 3), target frame."""
    forward = frames.forward[:, None, None]
    level = turned(axes[..., :2], forward.expand(*axes.shape[:3], 2))
    left = level[..., 1]  # y of TCP, approach and closing axis; a mirror changes the sign of each
    x, z = level[:, :, 2, 0], axes[:, :, 2, 2]
    # By the approach; for an approach along the line, by the TCP, then by the closing axis.
    side = left[..., 1] + 0.1 * left[..., 0] + 0.01 * left[..., 2] * (x + z)
    level = torch.stack([level[..., 0], left * torch.where(side < 0, -1.0, 1.0)[..., None]], dim=-1)
    tcp, approach, closing = torch.cat([level, axes[..., 2:]], dim=-1).unbind(2)
    x, y, z = closing.unbind(-1)
    closing = torch.stack([x * x, y * y, x * y, x * z, y * z], dim=-1)  # the fingers are interchangeable
    reach = frames.arm_reach_m[:, None, None]
    away = torch.stack([frames.planar_m, torch.zeros_like(frames.planar_m), frames.target_rise_m], dim=-1)
    tip = (tcp + away[:, None]) / reach
    wrist = tip - approach * (_WRIST_M / reach)
    before = wrist - approach * (_WAY_M / reach)
    above = torch.cat([wrist[..., :2], wrist[..., 2:] + _WAY_M / reach], dim=-1)
    lengths = [torch.linalg.vector_norm(v, dim=-1, keepdim=True) for v in (tip, wrist, before, above)]
    planar = torch.linalg.vector_norm(wrist[..., :2], dim=-1, keepdim=True)
    outward = (approach * wrist).sum(-1, keepdim=True) / (lengths[1] + _NEAR)
    return torch.cat([tip, approach, closing, wrist, before, above, *lengths, planar, outward], dim=-1)


def highest(values: Tensor, dim: int) -> Tensor:
    """Maxima of `values` (...) over `dim`, without it.

    On a CPU by index where gradients are wanted: the gradient of `amax` compares all values again.
    """
    return values.max(dim).values if torch.is_grad_enabled() and not values.is_cuda else values.amax(dim)


def tiles(robot_row: Tensor, size: int) -> list[tuple[Tensor, Tensor]]:
    """Robots (r,) and rows (r, c) of candidates of each, r c <= size; together they hold every row once.

    `robot_row` (N,) has the candidates' robots. A robot's rows are cut into pieces of at most `size`, and
    pieces of equal length are joined, without padding.
    """
    order = torch.argsort(robot_row, stable=True)
    robots, counts = torch.unique_consecutive(robot_row[order], return_counts=True)
    pieces: dict[int, list[tuple[int, Tensor]]] = {}
    for robot, rows in zip(robots.tolist(), order.split(counts.tolist()), strict=True):
        for piece in rows.split(size):
            pieces.setdefault(len(piece), []).append((robot, piece))
    cut: list[tuple[Tensor, Tensor]] = []
    for length, equal in pieces.items():
        together = size // length
        for start in range(0, len(equal), together):
            some = equal[start : start + together]
            chosen = torch.tensor([robot for robot, _ in some], device=robot_row.device)
            cut.append((chosen, torch.stack([rows for _, rows in some])))
    return cut
