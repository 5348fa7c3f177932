"""Cut the candidates of many robots into pieces that are scored together."""

from __future__ import annotations

import torch
from torch import Tensor


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
