"""Which links of a robot touch each other, and which pairs are worth checking."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.kinematics.compiler import in_memory
from datagen.workers.kinematics.contacts import Parts, hits_itself, own_scratch, parts_of, touching_pairs
from datagen.workers.kinematics.inverse import TreePoses
from datagen.workers.kinematics.tree import Ints, KinematicTree

# Configurations in which pairs of links are checked, and the share of them in which a pair may touch.
_SAMPLES = 300
_MOST = 0.5


class SelfCollision:
    """Exact checks of pairs of links, each made of convex parts fixed to a frame of the tree.

    Links that are fixed to one another, links on both sides of one joint and the segments of one telescope
    may always touch. Other pairs that touch in most of 300 random configurations (fixed seed) are left out
    too: their coarse hulls overlap.
    """

    def __init__(self, tree: KinematicTree, poses: TreePoses, parts_m: Sequence[Sequence[F32 | F64]]) -> None:
        self.parts = parts_of(parts_m)
        joint = tree.frame_joint.tolist()
        rows = [
            (a, b)
            for a in range(len(parts_m))
            for b in range(a + 1, len(parts_m))
            if joint[a] != joint[b] and not _is_telescope(tree, joint[a], joint[b])
        ]
        self._compiled, self._poses = in_memory(self.parts), poses
        self._scratch = own_scratch(self._compiled)
        pairs = _part_pairs(self.parts, rows)
        link = self.parts.owner[pairs]  # (K, 2)
        rng, touches = np.random.Generator(np.random.PCG64(0)), np.empty((_SAMPLES, len(pairs)), np.bool_)
        T = np.stack([poses(q) for q in rng.uniform(tree.lower, tree.upper, (_SAMPLES, len(tree.lower)))])
        touching_pairs(self._compiled, pairs, T, self._scratch, touches)
        count = {pair: int(touches[:, (link == pair).all(axis=1)].any(axis=1).sum()) for pair in rows}
        self.pairs = tuple(pair for pair in rows if count[pair] <= _MOST * _SAMPLES)  # of links
        self.part_pairs = _part_pairs(self.parts, self.pairs)  # (K, 2)
        self._axes = np.zeros((len(self.part_pairs), 3))

    def touches(self, q_rad: F64) -> bool:
        """Whether any of `pairs` touch at the coordinates (A,)."""
        self._axes[:] = 0.0  # no answer depends on earlier ones
        return hits_itself(self._compiled, self.part_pairs, self._poses(q_rad), self._axes, self._scratch)


def _is_telescope(tree: KinematicTree, upper: int, lower: int) -> bool:
    """Whether one joint lies between two joints' bodies, or several that slide with one coordinate."""
    between = list[int]()
    while lower > upper:
        between.append(lower)
        lower = int(tree.parent[lower])
    is_one = len(set(tree.coordinate[between].tolist())) == 1 and bool(tree.slides[between].all())
    return lower == upper and (len(between) == 1 or is_one)


def _part_pairs(parts: Parts, links: Sequence[tuple[int, int]]) -> Ints:
    """Pairs (K, 2) of parts of the pairs of links."""
    of = [np.flatnonzero(parts.owner == link) for link in range(int(parts.owner.max(initial=-1)) + 1)]
    rows = [(i, j) for a, b in links if b < len(of) for i in of[a].tolist() for j in of[b].tolist()]
    return np.array(rows, np.int64).reshape(-1, 2)
