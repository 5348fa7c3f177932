"""The audit of runs as plain values: what was made, its cost and the waste.

CPU seconds are measured for a shard, not for a candidate. The whole cost of a run, waste included, is divided
by the number of labels of a kind: candidates whose base collides or that are beyond reach cost almost nothing
and say almost nothing, so labels within reach carry the whole cost.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import fsum
from typing import Any

from datagen.reports.agreement import Labels, agreements, doubt, fidelity, read_labels
from datagen.reports.spending import Account, Spending, account_for
from datagen.schemas.run import Run
from datagen.schemas.run_records import STAGES

_SCENE_STAGES = ("draw", "settle", "observe")


def audit_runs(runs: Sequence[Run]) -> dict[str, Any]:
    """Return the audit of runs by label source, in ascending fidelity; times in core seconds, sizes in bytes.

    `is_exact` is False where an attempt has a commit and an end in the ledger. InputError for a damaged
    record or shard.
    """
    labels = [read_labels(run) for run in sorted(runs, key=lambda run: fidelity(run.manifest.spec))]
    by_source: dict[str, list[Labels]] = {}
    for each in labels:
        by_source.setdefault(each.run.manifest.spec.label_source, []).append(each)
    spent = {source: account_for(each.run for each in group) for source, group in by_source.items()}
    contradictions = sum(spending.contradictions for spending in spent.values())
    return {
        "is_exact": not contradictions,
        "contradictions": contradictions,
        "sources": [
            _source(source, group, spent[source], _scenes_s(group, runs))
            for source, group in by_source.items()
        ],
        "agreement": agreements(labels),
    }


def _source(
    source: str, labels: Sequence[Labels], spending: Spending, scenes_s: float | None
) -> dict[str, Any]:
    """The record of the runs of one label source; `scenes_s` is that of `_scenes_s`."""
    useful, wasted = spending.useful, spending.wasted
    near = sum(int(each.within_reach.sum()) for each in labels)
    near_positive = sum(int((each.within_reach & each.label).sum()) for each in labels)
    stages = {stage: useful.stage_s[stage] for stage in STAGES if stage in useful.stage_s}
    cost = {
        **stages,
        "other": useful.core_s - fsum(stages.values()),
        "waste": wasted.core_s,
        "scenes of other runs": scenes_s or 0.0,
        "relabelled files": useful.relabelled_s,
    }
    total = fsum(cost.values())
    counts = {
        "label": spending.labels,
        "label_within_reach": near,
        "positive": sum(int(each.label.sum()) for each in labels),
        "positive_within_reach": near_positive,
        "scene": spending.scenes,
    }
    return {
        "label_source": source,
        "made_from": "; ".join(dict.fromkeys(each.run.manifest.made_from for each in labels)),
        "counts": counts,
        "doubts": [line for each in labels if (line := doubt(each))],
        "outcomes_within_reach": _summed(each.outcomes() for each in labels),
        "core_s": cost,
        "total_core_s": total,
        "includes_scenes": scenes_s is not None,
        "wall_s": useful.wall_s + wasted.wall_s,
        "core_s_per": {name: total / count if count else None for name, count in counts.items()},
        "attempts": useful.attempts + wasted.attempts,
        "waste": {kind: _plain(account) for kind, account in sorted(spending.waste.items())},
        "causes": {
            cause: _plain(account)
            for cause, account in sorted(spending.causes.items(), key=lambda item: -item[1].core_s)
        },
        "rejected_scenes": dict(sorted(spending.rejected.items())),
        "stored_bytes": useful.written_bytes,
        "peak_rss_bytes": useful.peak_rss_bytes,
        "machines": dict(spending.machines),
    }


def _scenes_s(group: Sequence[Labels], runs: Sequence[Run]) -> float | None:
    """Core seconds of the scenes that others of the runs made for these; None where no run made them."""
    total = 0.0
    for run in (each.run for each in group if each.run.manifest.spec.scenes_from):
        spending = account_for([run])
        if spending.useful.relabelled_s:
            continue  # its cost includes the scenes
        made_by = [other for other in runs if other.manifest.spec_hash == run.manifest.spec.scenes_hash]
        if not made_by:
            return None
        maker = account_for(made_by[:1])
        made_s = fsum(maker.useful.stage_s[stage] for stage in _SCENE_STAGES)
        total += made_s * spending.scenes / maker.scenes if maker.scenes else 0.0
    return total


def _plain(account: Account) -> dict[str, Any]:
    return {name: getattr(account, name) for name in ("attempts", "unknown", "wall_s", "core_s")}


def _summed(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    total: dict[str, int] = {}
    for each in counts:
        for name, count in each.items():
            total[name] = total.get(name, 0) + count
    return total
