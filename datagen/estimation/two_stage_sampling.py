"""Choose scenes, and candidates in them, with known probabilities.

A two-stage design of fixed sizes: some scenes, and equally many candidates in each. Probabilities are a
mixture of those that a method wants and of equal ones, so that each is positive. Units are drawn
systematically from a random order with exactly these probabilities (Madow 1949; Cochran 1977, sec. 9A.11).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datagen.train.inputs import F64, I64


@dataclass(frozen=True, eq=False)
class Sample:
    """S scenes of M, ascending, with k candidates of each, ascending, and their probabilities."""

    scene: I64  # (S,)
    candidate: I64  # (S, k)
    probability: F64  # (S, k), of the scene and the candidate together


@dataclass(frozen=True, eq=False)
class Design:
    """The probabilities that a method wants: of scenes (M,), and of candidates in their scene (M, K)."""

    scene: F64
    candidate: F64


def all_alike(scenes: int, size: int, n_scenes: int, per_scene: int) -> Design:
    """Equal probabilities for M scenes and for the K candidates in each."""
    return Design(np.full(scenes, n_scenes / scenes), np.full((scenes, size), per_scene / size))


def first_of(score: F64, n_scenes: int, per_scene: int, rng: np.random.Generator) -> Design:
    """The k candidates of highest score (M, K) in each scene, in the S scenes where their mean is highest.

    Ties are broken at random.
    """
    candidate = np.stack([_first(row, per_scene, rng) for row in score])
    mean = (score * candidate).sum(axis=1) / per_scene
    return Design(_first(mean, n_scenes, rng), candidate)


def in_proportion(size: F64, n_scenes: int, per_scene: int) -> Design:
    """Probabilities in proportion to sizes (M, K) >= 0, as far as none is above 1."""
    return Design(
        _in_proportion(size.sum(axis=1), n_scenes), np.stack([_in_proportion(row, per_scene) for row in size])
    )


def draw_sample(
    design: Design, n_scenes: int, per_scene: int, random_share: float, rng: np.random.Generator
) -> Sample:
    """Draw S scenes of M and k candidates of K in each; `random_share` weights equal probabilities."""
    scenes, size = design.candidate.shape
    equal = n_scenes / scenes
    wanted = (1 - random_share) * design.scene
    of_scene = wanted + random_share * equal
    # The equal part of a scene's probability has equal candidates, the wanted part those wanted.
    within = wanted[:, None] * design.candidate + random_share * equal * per_scene / size
    within /= of_scene[:, None]
    chosen = _systematic(of_scene, n_scenes, rng)
    candidate = np.stack([_systematic(within[scene], per_scene, rng) for scene in chosen])
    probability = of_scene[chosen, None] * np.take_along_axis(within[chosen], candidate, axis=1)
    return Sample(chosen, candidate, np.minimum(probability, 1.0))


def _first(score: F64, n: int, rng: np.random.Generator) -> F64:
    """1 for the n of highest score (N,), else 0."""
    order = np.lexsort([rng.random(len(score)), -score])
    chosen = np.zeros(len(score))
    chosen[order[:n]] = 1.0
    return chosen


def _in_proportion(size: F64, n: int) -> F64:
    """Probabilities (N,) that sum to n <= N, in proportion to sizes where that is at most 1."""
    probability = np.zeros(len(size))
    # Units of size 0 share the remaining probability equally.
    positive = size > 0
    if positive.sum() <= n:
        probability[positive] = 1.0
        rest = ~positive
        probability[rest] = (n - positive.sum()) / max(rest.sum(), 1)
        return probability
    certain = np.zeros(len(size), np.bool_)
    while True:
        open_ = positive & ~certain
        probability[open_] = size[open_] * (n - certain.sum()) / size[open_].sum()
        above = open_ & (probability >= 1)
        if not above.any():
            return probability
        certain |= above
        probability[certain] = 1.0


def _systematic(probability: F64, n: int, rng: np.random.Generator) -> I64:
    """n units, ascending, each drawn with its probability (N,), which sum to n."""
    order = rng.permutation(len(probability))
    ends = np.cumsum(probability[order])
    ends *= n / ends[-1]
    # One unit at each of n equally spaced points.
    points = rng.random() + np.arange(n)
    drawn = order[np.searchsorted(ends, np.minimum(points, ends[-1]), side="left")]
    return np.sort(drawn)
