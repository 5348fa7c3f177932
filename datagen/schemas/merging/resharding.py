"""Split shards: the common layout, and the names, costs and numbers of the pieces.

Splitting in two steps gives the same bytes as in one: every rule depends only on scenes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from hashlib import sha256

from datagen.schemas.run_records import Cost, Layout

_PIECE = re.compile(r"(.*)\.cut([0-9]+)")
_MAX_NAME = 100
_NS = 10**9


def common_layout(layouts: Iterable[Layout]) -> Layout:
    """The layout of the largest shards that divide those of every layout, for equal candidates per scene."""
    found = list(layouts)
    scenes = math.gcd(*(layout.scenes_per_shard for layout in found))
    return Layout(scenes_per_shard=scenes, candidates_per_scene=found[0].candidates_per_scene)


@dataclass(frozen=True)
class Cut:
    """Split of shards of `scenes` scenes into shards of `into` scenes, a divisor."""

    scenes: int
    into: int

    @property
    def pieces(self) -> int:
        """Pieces per shard; 1 without a split."""
        return self.scenes // self.into

    def first(self, shard: int) -> int:
        """The first piece of a shard, as a shard of the smaller layout."""
        return shard * self.pieces

    def shards(self, shard: int) -> range:
        """The pieces of a shard, as shards of the smaller layout."""
        return range(self.first(shard), self.first(shard + 1))

    def name(self, attempt: str, piece: int) -> str:
        """Name of the attempt of this piece, with the piece's first scene."""
        return attempt if self.pieces == 1 else f"{_fitting(base_name(attempt))}.cut{piece * self.into}"

    def cost(self, cost: Cost, piece: int) -> Cost:
        """The cost of a piece: equal shares per scene, to the nanosecond and byte; pieces sum to the whole.

        Remainders of nanoseconds and bytes go to the first scenes. Peak memory is that of the attempt.
        """
        if self.pieces == 1:
            return cost
        offset = piece % self.pieces * self.into

        def seconds(value: float) -> float:
            return _share(round(value * _NS), self.scenes, offset, self.into) / _NS

        by_name = {
            field: {name: seconds(value) for name, value in getattr(cost, field).items()}
            for field in ("stage_wall_s", "stage_cpu_s", "stage_gpu_s", "source_s")
        }
        written = _share(cost.written_bytes, self.scenes, offset, self.into)
        whole = {"wall_s": seconds(cost.wall_s), "cpu_s": seconds(cost.cpu_s), "written_bytes": written}
        return cost.model_copy(update=whole | by_name)


def base_name(attempt: str) -> str:
    """Name of the attempt that a piece comes from; its own where it is not split."""
    found = _PIECE.fullmatch(attempt)
    return found[1] if found else attempt


def rank(attempt: str) -> tuple[str, str]:
    """Sort key of equal attempts: the names of the unsplit attempts; the first is kept."""
    return _fitting(base_name(attempt)), attempt


def _share(total: int, scenes: int, first: int, count: int) -> int:
    """The share of `count` scenes from `first` on in a total over all scenes."""
    each, rest = divmod(total, scenes)
    return each * count + min(max(rest - first, 0), count)


def _fitting(name: str) -> str:
    # Names have at most 100 characters, and a piece's name is longer.
    return name if len(name) <= _MAX_NAME - 20 else sha256(name.encode()).hexdigest()[:32]
