"""How rules that use distance and visibility alone agree with a run of `plan` or `sim`, as tables.

    python -m benchmarks.agreement RUN

Rules are computed from the stored columns: the paper's heuristic with its absolute distance, the
same with the distance from mount to target divided by the arm's reach, "within reach", and both
joined. None of them checks whether the base fits; "and clear" adds that check.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping

import numpy as np

from datagen.reports.agreement import Labelled, agreement, confusion, read_labelled
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.specification import HeuristicParams
from datagen.workers.bases.candidate_sets import CANDIDATE_SETS, Bools
from datagen.workers.labels.distance_visibility_score import heuristic

# Distances in units of the arm's reach: nothing beyond 1 can be grasped.
OVER_REACH = HeuristicParams(
    distance="mount-over-reach", mu=0.7, sigma_l=0.3, sigma_r=0.15, d_min=0.0, d_max=1.0
)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", metavar="RUN", help="a run of plan or sim, with any number of labels")
    run = Run.open(parser.parse_args().run)
    labelled = read_labelled(run)
    if labelled is None:
        raise InputError(run.storage.url, "commits", "no labels yet", "Wait for its first shard")
    scenes = len(np.unique(labelled.scene))
    print(f"{len(labelled):,} {run.manifest.spec.label_source} labels of {scenes} scenes")
    rules = rules_of(labelled)
    for name in reversed(CANDIDATE_SETS):
        print_set(labelled, rules, name)


def rules_of(labelled: Labelled) -> Mapping[str, Bools]:
    """Predictions (N,) of each rule."""

    def by(params: HeuristicParams) -> Bools:
        distances = (labelled.distance_m, labelled.mount_distance_m)
        return heuristic(*distances, labelled.reach_m, labelled.visibility, params)[1] == 1

    within = labelled.mount_distance_m <= labelled.reach_m
    paper, over_reach = by(HeuristicParams()), by(OVER_REACH)
    return {
        "nothing is good": np.zeros(len(labelled), np.bool_),
        "the paper's": paper,
        "the paper's, and within reach": paper & within,
        "distance / reach": over_reach,
        "within reach": within,
    }


def print_set(labelled: Labelled, rules: Mapping[str, Bools], name: str) -> None:
    """Print a row per rule for one candidate set; where bases may collide, a second row with "and clear"."""
    rows = labelled.is_in(name)
    label = labelled.label[rows]
    if not len(label):
        print(f"\n{name}: no candidates")
        return
    print(f"\n{name}: {len(label):,} candidates, {100 * label.mean():.1f}% positive")
    print(f"{'rule':42}{'says good':>11}{'accuracy':>10}{'balanced':>10}{'found':>8}{'wrong':>8}")
    for rule, predicted in rules.items():
        print_rule(rule, predicted[rows], label)
        if name == "grid" and predicted.any():
            print_rule(f"{rule}, and clear", (predicted & labelled.is_clear)[rows], label)


def print_rule(rule: str, predicted: Bools, label: Bools) -> None:
    """Print a row. `found`: share of positives predicted; `wrong`: share of predictions that are negative."""
    scores, counts = agreement(predicted, label), confusion(predicted, label)
    balanced = scores["balanced_accuracy"]
    named, good = int(predicted.sum()), int(label.sum())
    cells = (
        f"{100 * predicted.mean():10.1f}%",
        f"{100 * scores['accuracy']:9.1f}%",
        "         -" if balanced is None else f"{100 * balanced:9.1f}%",
        f"{100 * counts['true_positive'] / good:7.1f}%" if good else "       -",
        f"{100 * counts['false_positive'] / named:7.1f}%" if named else "       -",
    )
    print(f"{rule:42}" + "".join(cells))


if __name__ == "__main__":
    main()
