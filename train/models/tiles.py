"""Division of candidates: into tiles for one product each, and into parts for threads.

Torch divides each product among its threads; numpy and everything between products use one of them. Parts of
the candidates, each scored by a thread of its own, keep all cores busy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch
from torch import Tensor

# Candidates in one product: on a CPU their tokens stay in a core's cache.
TILE_CPU, TILE_CUDA = 64, 4096

Part = TypeVar("Part")
Result = TypeVar("Result")


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


def parts_for_threads(n: int, threads: int) -> list[slice]:
    """Rows 0 to n, cut into parts of whole tiles, one for each thread or fewer."""
    size = -(-n // (threads * TILE_CPU)) * TILE_CPU
    return [slice(start, min(start + size, n)) for start in range(0, n, size)]


def side_by_side(work: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
    """The results of `work`, in inference mode, in the order of the parts."""

    def inferring(part: Part) -> Result:
        with torch.inference_mode():  # the mode is per thread
            return work(part)

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # for the new threads
    try:
        with ThreadPoolExecutor(len(parts)) as pool:
            return list(pool.map(inferring, parts))
    finally:
        torch.set_num_threads(threads)
