"""Plain methods to compare models with; docs/explanation/baselines.md describes each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from datagen.schemas.errors import InputError, choices
from datagen.schemas.specification import HeuristicParams
from datagen.train.baselines.baseline import FIELDS, Baseline
from datagen.train.baselines.reachability import Reachability
from datagen.train.baselines.rules import (
    Analytic,
    DistanceBand,
    Proximity,
    ReachShare,
    Threshold,
    ThresholdVisibility,
)
from datagen.train.baselines.scalars import Scalars
from datagen.train.inputs import Array, Batch
from datagen.workers.robots import ROBOTS

# By the name on the command line.
BASELINES: dict[str, Callable[[], Baseline]] = {
    "proximity": Proximity,
    "reach-share": ReachShare,
    "threshold": Threshold,
    "threshold-visibility": ThresholdVisibility,
    "distance": DistanceBand,
    "analytic": Analytic,
    "reachability": Reachability,
    "scalars": Scalars,
}


def make_baselines(
    names: Sequence[str],
    heuristic: HeuristicParams | None = None,
    robots: Sequence[str] = tuple(ROBOTS),
) -> list[Baseline]:
    """Return unfitted baselines, `reachability` for these robots. InputError for other names."""
    for name in names:
        if name not in BASELINES:
            raise InputError("--baselines", name, "is not a baseline", choices(BASELINES, name))
    made: list[Baseline] = []
    for name in names:
        if name == "analytic" and heuristic is not None:
            made.append(Analytic(heuristic))
        elif name == "reachability":
            made.append(Reachability(tuple(robots)))
        else:
            made.append(BASELINES[name]())
    return made


def fit_baselines(baselines: Sequence[Baseline], batches: Iterable[Batch[Array]]) -> list[Baseline]:
    """Fit all baselines on the same batches, read with `FIELDS`; kept in memory, 15 MB for 100 scenes."""
    held = list(batches)
    return [baseline.fit(held) for baseline in baselines]


__all__ = ["BASELINES", "FIELDS", "Baseline", "fit_baselines", "make_baselines"]
