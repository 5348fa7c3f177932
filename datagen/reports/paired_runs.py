"""Runs with labels of the same candidates: their agreement, and the cost of a correct label."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

from datagen.reports.agreement import Labelled, common_candidates, compare, confusion
from datagen.reports.label_costs import RunCost
from datagen.reports.prices import Prices
from datagen.reports.scene_intervals import estimates_by_group
from datagen.reports.specification_summary import is_disturbed
from datagen.schemas.run import Run
from datagen.schemas.specification import Specification

# In ascending fidelity: the later of two is the reference for the earlier.
_FIDELITY = ("heuristic", "plan", "sim")


@dataclass(frozen=True, eq=False)
class AuditedRun:
    """A run with its labels (None: no shard is committed) and its cost."""

    run: Run
    labelled: Labelled | None
    cost: RunCost
    wall_s_per_label: float | None  # without borrowed scenes


def fidelity(spec: Specification) -> tuple[int, bool]:
    """Rank of a specification's labels: heuristic, plan, sim, disturbed sim."""
    known = spec.label_source in _FIDELITY
    return (_FIDELITY.index(spec.label_source) if known else 0, is_disturbed(spec))


def run_record(run: Run) -> dict[str, Any]:
    """Address, label source and disturbance of a run."""
    spec = run.manifest.spec
    return {"run": run.storage.url, "label_source": spec.label_source, "disturbed": is_disturbed(spec)}


def _labels_same(first: Run, second: Run) -> bool:
    specs = first.manifest.spec, second.manifest.spec
    return specs[0].scenes_hash == specs[1].scenes_hash and specs[0] != specs[1]


def pairs(runs: Sequence[AuditedRun], candidates: str) -> list[dict[str, Any]]:
    """Return the agreement of every two runs with labels of the same candidates; the later is the reference.

    The cost of a correct label of the first run is its cost per label divided by its accuracy.
    """
    found: list[dict[str, Any]] = []
    for first, second in combinations(runs, 2):
        if not _labels_same(first.run, second.run) or first.labelled is None or second.labelled is None:
            continue
        predicted, true = common_candidates(first.labelled, second.labelled)
        rows = true.is_in(candidates)
        compared = compare(predicted.at(rows), true.at(rows))
        accuracy = compared["accuracy"]
        costs_s = first.wall_s_per_label, second.wall_s_per_label
        found.append(
            {
                "said_by": run_record(first.run),
                "true_by": run_record(second.run),
                "candidates": candidates,
                **compared,
                "wall_s_per_correct_label": {
                    "said_by": costs_s[0] / accuracy if costs_s[0] and accuracy else None,
                    "true_by": costs_s[1],
                },
            }
        )
    return found


def correct_labels(runs: Sequence[AuditedRun], prices: Prices) -> list[dict[str, Any]]:
    """For each run, its cost per correct label; the truth is the run of highest fidelity over its candidates.

    Whole grids and candidates within reach are separate sets. The cost of a label of a set is the run's whole
    cost over its labels in the set; a correct label costs that over the accuracy in the set. The truth's own
    labels count as correct. Runs without another over the same candidates are left out.
    """
    found: list[dict[str, Any]] = []
    for run in runs:
        same = [one for one in runs if one is run or _labels_same(run.run, one.run)]
        labelled = [one for one in same if one.labelled is not None]
        if run.labelled is None or len(labelled) < 2:
            continue
        # The last of several runs of the same fidelity, as in `pairs`.
        truth = max(reversed(labelled), key=lambda one: fidelity(one.run.manifest.spec))
        assert truth.labelled is not None
        predicted, true = common_candidates(run.labelled, truth.labelled)
        found.append(
            run_record(run.run)
            | {"truth": run_record(truth.run), "is_truth": truth is run}
            | {"sets": {name: _correct(run, predicted, true, name, prices) for name in ("grid", "in-range")}}
        )
    return found


def _correct(
    run: AuditedRun, predicted: Labelled, true: Labelled, candidates: str, prices: Prices
) -> Mapping[str, Any]:
    assert run.labelled is not None
    rows = true.is_in(candidates)
    group = rows[rows].astype(int) * 0
    (estimate,) = estimates_by_group(predicted.label[rows], true.label[rows], true.scene[rows], group, 1)
    accuracy, labels = estimate["accuracy"], int(run.labelled.is_in(candidates).sum())
    total, correct = run.cost.total, labels * (accuracy or 0.0)
    return {
        **estimate,
        "confusion": confusion(predicted.label[rows], true.label[rows]),
        "core_s_per_label": total.core_s / labels if labels else None,
        "core_s_per_correct_label": total.core_s / correct if correct else None,
        "wall_s_per_correct_label": total.wall_s / correct if correct else None,
        "money_per_correct_label": total.money(prices) / correct if correct else None,
    }
