"""How many planned scenes should have trials too: the interval that a budget of CPU seconds buys.

    datagen submit plan ... --out PLAN
    datagen submit sim --candidates-from PLAN --perturb 4 ... --out TRIALS
    python -m benchmarks.trial_share PLAN --with TRIALS

The variance of `datagen estimate` has a part that falls with scenes that have trials, and one that falls with
planned scenes. Both are extrapolated to other numbers of scenes that cost as much as these two runs, by their
ledgers. Trials alone are in scenes that are made for them.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
from scipy import stats

from datagen.estimation.mixed_labels import read_mixed
from datagen.estimation.rates import LEVEL, estimate_rate
from datagen.reports.label_costs import costs_of_runs
from datagen.reports.spending import account_for
from datagen.schemas.run import Run

SHARES = (0.03, 0.1, 0.2, 0.3, 0.5, 1.0)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("plan", nargs="+", metavar="PLAN", help="runs of cheap labels")
    parser.add_argument("--with", dest="trials", nargs="+", required=True, metavar="TRIALS")
    parser.add_argument("--candidates", default="in-range", help="candidate set [in-range]")
    given = parser.parse_args()
    labels = read_mixed(given.plan, given.trials).fitted()
    found = estimate_rate(labels.population, labels.member(given.candidates))
    if found is None:
        raise SystemExit("too few scenes with trials")
    planned_s, _ = _scene_s(labels.cheap_runs)
    trials_s, made_s = _scene_s([*labels.cheap_runs, *labels.dear_runs], len(labels.cheap_runs))
    budget_s = found.scenes * planned_s + found.dear_scenes * trials_s
    each = len(labels.population.label[labels.population.is_dear]) / found.dear_scenes
    print(
        f"{budget_s:.0f} CPU s; a planned scene {planned_s:.2f} s, {each:.0f} trials in it {trials_s:.2f} s"
    )
    print(f"{'share with trials':<20}{'planned scenes':>16}{'with trials':>13}{'half width':>12}")
    for share in SHARES:
        scenes = budget_s / (planned_s + share * trials_s)
        variance = found.dear_part / (share * scenes) + found.cheap_part * found.scenes / scenes
        print(f"{share:<20}{scenes:>16,.0f}{share * scenes:>13,.0f}{_half(variance):>12}")
    alone = budget_s / (trials_s + made_s)
    variance = found.dear_alone.variance * found.dear_scenes / alone
    print(f"{'trials alone':<20}{'':>16}{alone:>13,.0f}{_half(variance):>12}")


def _scene_s(runs: Sequence[Run], first: int = 0) -> tuple[float, float]:
    """CPU seconds of a scene of the runs from `first` on: their own, and of making it in another run."""
    costs = costs_of_runs(runs, [account_for([run]) for run in runs])[first:]
    scenes = sum(account_for([run]).scenes for run in runs[first:])
    own = sum(cost.own.core_s for cost in costs)
    borrowed = sum(cost.scenes.core_s for cost in costs if cost.scenes is not None)
    return own / scenes, borrowed / scenes


def _half(variance: float) -> str:
    return f"±{100 * float(stats.norm.ppf((1 + LEVEL) / 2)) * np.sqrt(variance):.1f}%"


if __name__ == "__main__":
    main()
