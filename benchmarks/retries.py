"""How alike the outcomes of near base poses are, and what further poses bring where the first fails.

    python -m benchmarks.retries --fit VAL RUN...

VAL is a run in validation houses. By its labels and the model's scores the correlation of what lies behind
the outcomes of two base poses of a scene is fitted, ALIKE * exp(-(d / ALIKE_M)^2 / 2) at a distance d: by
the likelihood of all pairs, since that of a scene's labels together has no closed form. RUNs are whole grids
with several draws. The table has the percent of the scenes with a good clear candidate in which one of the
first candidates is good (for most draws), of those with such a score: by scores alone, 0.25 m or 30 degrees
apart, and as `predict` orders them; and in how many of the other scenes any candidate has such a score.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logit, ndtr, ndtri

from datagen.evaluation.runs import draws_of, stream_of
from datagen.schemas.run import Run
from datagen.train.inputs import F64, Array, Bools, is_clear
from datagen.train.prediction import load_scorer
from datagen.train.prediction.goals import ALIKE, ALIKE_M, in_turn
from datagen.train.scorers import scored

_TRIES, _LEVELS = 5, (0.5, 0.25)
_LEAST = 0.05  # pairs of which one scores less say little and are many
_APART_M, _APART_RAD = 0.25, np.radians(30)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


def main() -> None:
    """Fit, judge and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="+")
    parser.add_argument("--fit", required=True)
    parser.add_argument("--checkpoint")
    options = parser.parse_args()
    alike, alike_m = _fitted(list(_scenes(options.fit, options.checkpoint)))
    print(f"ALIKE {alike:.2f}, ALIKE_M {alike_m:.2f}; in use are {ALIKE:g} and {ALIKE_M:g}\n")
    found = [scene for run in options.runs for scene in _scenes(run, options.checkpoint)]
    feasible, others = ([each for each in found if each[2].any() == wanted] for wanted in (True, False))
    tries = " | ".join(f"{k + 1}" for k in range(_TRIES))
    print(f"| {len(feasible)} scenes | {tries} | answered of {len(others)} without a good candidate |")
    print("| --- " * (2 + _TRIES) + "|")
    for least in _LEVELS:
        answered = sum(bool((score >= least).any()) for score, *_ in others)
        for name, order in (("by scores", _apart), ("as predicted", in_turn)):
            within = 100 * np.mean([_within(order, *scene, least) for scene in feasible], axis=0)
            shares = " | ".join(f"{share:.1f}" for share in within)
            print(f"| {name}, from {least:g} | {shares} | {answered} |")


def _scenes(place: str, checkpoint: str | None) -> Iterator[tuple[F64, F64, Bools]]:
    """Scores (N,), positions (N, 2) and labels (N,) of each scene's clear candidates."""
    scorer, draws = load_scorer(checkpoint), draws_of(place, [Run.open(place).manifest.spec])
    for batch in stream_of([place]).epoch(0):
        label = 2 * batch.extra["successes"] > draws if draws else batch.label == 1
        score, scene = scored(scorer, batch), batch.robots.cloud_row[batch.candidates.robot_row]
        for k in range(len(batch.clouds)):
            rows = np.flatnonzero((scene == k) & is_clear(batch))
            yield score[rows], batch.candidates.base_xy_m[rows].astype(np.float64), label[rows]


def _within(order: Array, score: F64, xy_m: F64, label: Bools, least: float) -> Bools:
    """Whether one of the first 1, 2, ... candidates is good (_TRIES,)."""
    rows = np.flatnonzero(score >= least)
    good = label[rows[order(score[rows], xy_m[rows], _TRIES)]] if len(rows) else np.zeros(0, np.bool_)
    return np.array([good[: k + 1].any() for k in range(_TRIES)])


def _apart(score: F64, xy_m: F64, most: int) -> list[int]:
    chosen: list[int] = []
    bearing = np.arctan2(xy_m[:, 1], xy_m[:, 0])
    for row in np.argsort(-score, kind="stable").tolist():
        far = np.linalg.norm(xy_m[chosen] - xy_m[row], axis=1) >= _APART_M
        turned = np.abs((bearing[chosen] - bearing[row] + np.pi) % (2 * np.pi) - np.pi) >= _APART_RAD
        if len(chosen) < most and (far | turned).all():
            chosen.append(row)
    return chosen


def _fitted(scenes: list[tuple[F64, F64, Bools]]) -> tuple[float, float]:
    """ALIKE and ALIKE_M of the greatest likelihood."""
    pairs: list[F64] = []
    for score, xy_m, label in scenes:
        rows = np.flatnonzero(score >= _LEAST)
        i, j = (rows[each] for each in np.triu_indices(len(rows), 1))
        normal, sign = ndtri(np.clip(score, 1e-3, 1 - 1e-3)), np.where(label, 1.0, -1.0)
        far_m = np.linalg.norm(xy_m[i] - xy_m[j], axis=1)
        pairs.append(np.stack([far_m, sign[i] * normal[i], sign[j] * normal[j], sign[i] * sign[j]]))
    far_m, a, b, sign = np.concatenate(pairs, axis=1)

    def unlikely(x: F64) -> float:
        r = sign * expit(x[0]) * np.exp(-((far_m / np.exp(x[1])) ** 2) / 2)
        return -float(np.log(np.maximum(_both(a, b, r), 1e-12)).sum())

    found = minimize(unlikely, [logit(0.5), np.log(0.3)], method="Nelder-Mead").x
    return float(expit(found[0])), float(np.exp(found[1]))


def _both(a: F64, b: F64, r: F64) -> F64:
    """Chance (N,) that two normal variables correlated by r are below a and b (Drezner, Wesolowsky 1990)."""
    found = ndtr(a) * ndtr(b)
    for node, weight in zip((_NODES + 1) / 2, _WEIGHTS / 2, strict=True):
        t = r * node
        density = np.exp(-(a * a - 2 * t * a * b + b * b) / (2 * (1 - t * t)))
        found += weight * r * density / (2 * np.pi * np.sqrt(1 - t * t))
    return found


if __name__ == "__main__":
    main()
