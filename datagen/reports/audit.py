"""The audit of runs as plain values: what was made, its cost and the waste; and as one table for a terminal.

CPU seconds are measured for a shard, not for a candidate. The whole cost of a run, waste included, is divided
by the number of labels of a kind: candidates whose base collides or that are beyond reach cost almost nothing
and say almost nothing, so labels within reach carry the whole cost.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import fsum
from typing import Any

from datagen.console.printing import counted, print_lines, print_rows, seconds
from datagen.reports.agreement import Labels, agreements, doubt, fidelity, read_labels
from datagen.schemas.record_files import is_guess
from datagen.schemas.run import MOST_SAMPLES, Run
from datagen.schemas.run_records import STAGES, Cost

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
    useful, wasted = spending.useful, spending.wasted
    near = sum(int(each.within_reach.sum()) for each in labels)
    near_positive = sum(int((each.within_reach & each.label).sum()) for each in labels)
    stages = {stage: useful.stage_s[stage] for stage in STAGES if stage in useful.stage_s}
    cost = {
        **stages,
        "other": useful.core_s - fsum(stages.values()),
        "waste": wasted.core_s,
        "scenes of other runs": scenes_s or 0.0,
        "relabelled files": useful.relabelled_s - _counted_twice_s([each.run for each in labels]),
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
        "outcomes_within_reach": dict(sum((Counter(each.outcomes()) for each in labels), Counter())),
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


def _counted_twice_s(group: Sequence[Run]) -> float:
    """Core seconds of files that were relabelled where the run that made them is in the group too."""
    made = {run.manifest.spec_hash for run in group}
    stored = ((run, run.manifest.spec.scenes_from) for run in group)
    again = (run for run, of in stored if of is not None and of.spec_hash in made)
    return fsum(account_for([run]).useful.relabelled_s for run in again)


def _scenes_s(group: Sequence[Labels], runs: Sequence[Run]) -> float | None:
    """Core seconds of the scenes that others of the runs made for these; None where no run made them."""
    total = 0.0
    for run in (each.run for each in group):
        if (stored := run.manifest.spec.scenes_from) is None:
            continue
        spending = account_for([run])
        if spending.useful.relabelled_s:
            continue  # its cost includes the scenes
        made_by = [other for other in runs if other.manifest.spec_hash == stored.spec_hash]
        if not made_by:
            return None
        if any(each.run is made_by[0] for each in group):
            continue  # counted with its own labels
        maker = account_for(made_by[:1])
        made_s = fsum(maker.useful.stage_s[stage] for stage in _SCENE_STAGES)
        total += made_s * spending.scenes / maker.scenes if maker.scenes else 0.0
    return total


def _plain(account: Account) -> dict[str, Any]:
    return {name: getattr(account, name) for name in ("attempts", "unknown", "wall_s", "core_s")}


QUARANTINED = "quarantined"


@dataclass
class Account:
    """Sums over attempts; seconds and bytes."""

    attempts: int = 0
    unknown: int = 0  # attempts without a recorded cost
    wall_s: float = 0.0
    core_s: float = 0.0  # CPU seconds; wall seconds of killed attempts, whose CPU time was lost with them
    stage_s: Counter[str] = field(default_factory=Counter)  # CPU seconds by stage
    relabelled_s: float = 0.0  # CPU seconds that another run spent on relabelled files
    written_bytes: int = 0
    peak_rss_bytes: int = 0

    def add(self, cost: Cost | None) -> None:
        self.attempts += 1
        if cost is None:
            self.unknown += 1
            return
        self.wall_s += cost.wall_s
        self.core_s += cost.cpu_s or cost.wall_s
        self.stage_s.update(cost.stage_cpu_s)
        self.relabelled_s += cost.source_s.get("cpu", 0.0)
        self.written_bytes += cost.written_bytes
        self.peak_rss_bytes = max(self.peak_rss_bytes, cost.peak_rss_bytes)


@dataclass
class Spending:
    """The cost of a set of runs: each attempt of the ledgers is either committed or waste."""

    labels: int = 0
    scenes: int = 0
    rejected: Counter[str] = field(default_factory=Counter)  # tries of scenes, by cause
    useful: Account = field(default_factory=Account)
    # By outcome; attempts at shards that are quarantined now are under QUARANTINED, whatever their outcome.
    waste: dict[str, Account] = field(default_factory=dict)
    causes: dict[str, Account] = field(default_factory=dict)  # failed attempts by their cause
    machines: Counter[str] = field(default_factory=Counter)  # attempts by processor
    contradictions: int = 0  # records of the ledger that do not fit the commits

    @property
    def wasted(self) -> Account:
        """The sum of the waste."""
        return Account(
            attempts=sum(each.attempts for each in self.waste.values()),
            unknown=sum(each.unknown for each in self.waste.values()),
            wall_s=fsum(each.wall_s for each in self.waste.values()),
            core_s=fsum(each.core_s for each in self.waste.values()),
        )


def account_for(runs: Iterable[Run]) -> Spending:
    """Add up commits and ledgers: each attempt has a commit, or an end in the ledger, which is waste."""
    spending = Spending()
    for run in runs:
        committed, quarantined = set[str](), run.quarantined()
        for commit in run.commits():
            committed.add(commit.attempt)
            spending.rejected.update(commit.redraws)
            spending.machines[f"{commit.host.cpu}, {commit.host.cores} cores"] += 1
            rows = run.rows_of(commit.shard, MOST_SAMPLES)
            if not rows.scenes:  # another part of these merged runs has its scenes
                spending.waste.setdefault("superseded", Account()).add(commit.cost)
                continue
            spending.labels += rows.samples
            spending.scenes += rows.scenes
            spending.useful.add(commit.cost)
        for end in run.ledger.ends():
            if end.attempt in committed:
                spending.contradictions += not is_guess(end)
            else:
                kind = QUARANTINED if end.shard in quarantined else end.outcome
                spending.waste.setdefault(kind, Account()).add(end.cost)
                if end.cause:
                    spending.causes.setdefault(end.cause, Account()).add(end.cost)
    return spending


Source = Mapping[str, Any]

# Costs that are no stages.
_ADDED = ("other", "waste", "scenes of other runs", "relabelled files")
_STAGES_SHOWN = (5, 5, 3)  # for one, two and more label sources, so that 25 lines suffice
# Rows that are printed without --full.
_ALWAYS = (
    "labels", "  positive", "  within reach", "core time", "core time of a label",
    "  of a label within reach", "wasted attempts",
)  # fmt: skip
_UNITS = {
    "label": "core time of a label",
    "label_within_reach": "  of a label within reach",
    "positive": "  of a positive",
}


def print_audit(report: Mapping[str, Any], full: bool = False) -> None:
    """Print what was made, its cost and the waste. `full` adds costs by stage and rejected scenes."""
    if not report["is_exact"]:
        print_lines(
            f"the ledger does not add up: {counted(report['contradictions'], 'record')} of committed"
            " attempts; `datagen verify RUN` names them"
        )
    sources: Sequence[Source] = report["sources"]
    title = "; ".join(dict.fromkeys(source["made_from"] for source in sources))
    rows = [row for row in (*_made(sources), *_cost(sources), *_waste(sources)) if full or row[0] in _ALWAYS]
    print_rows(title, rows, ("", *(source["label_source"] for source in sources)))
    notes = [
        f"{source['label_source']}: add the run that made its scenes, whose cost is missing here"
        for source in sources
        if not source["includes_scenes"]
    ]
    notes += [line for source in sources for line in source["doubts"]]
    causes = [item for source in sources for item in source["causes"].items()]
    notes += [
        f"{cause} ({counted(account['attempts'], 'attempt')}, {seconds(account['core_s'])})"
        for cause, account in sorted(causes, key=lambda item: -item[1]["core_s"])[:2]
    ]
    notes += [_agreement(pair) for pair in report["agreement"] if pair["candidates"]]
    print_lines("\n".join(notes))


def _row(name: str, sources: Sequence[Source], cell: Callable[[Source], str]) -> tuple[str, ...]:
    return (name, *(cell(source) for source in sources))


def _share(part: int, whole: int) -> str:
    return f"{part:,} ({100 * part / whole:.1f}%)" if whole else f"{part:,}"


def _made(sources: Sequence[Source]) -> list[tuple[str, ...]]:
    def cell(name: str, of: str) -> Callable[[Source], str]:
        return lambda source: _share(source["counts"][name], source["counts"][of])

    return [
        _row("labels", sources, lambda s: f"{s['counts']['label']:,} in {s['counts']['scene']:,} scenes"),
        _row("  positive", sources, cell("positive", "label")),
        _row("  within reach", sources, cell("label_within_reach", "label")),
        _row("    positive", sources, cell("positive_within_reach", "label_within_reach")),
    ]


def _cost(sources: Sequence[Source]) -> list[tuple[str, ...]]:
    """Core time by stage, which adds up to the total, and that of a label."""
    stages = list(dict.fromkeys(name for s in sources for name in s["core_s"] if name not in _ADDED))

    def share(name: str) -> float:
        return max(s["core_s"].get(name, 0.0) / (s["total_core_s"] or 1.0) for s in sources)

    shown = _STAGES_SHOWN[min(len(sources), 3) - 1]
    largest = sorted(stages, key=share, reverse=True)[:shown]
    small = [name for name in stages if name not in largest]

    def cell(*names: str) -> Callable[[Source], str]:
        def text(source: Source) -> str:
            spent = sum(source["core_s"].get(name, 0.0) for name in names)
            share = spent / source["total_core_s"] if source["total_core_s"] else 0.0
            return f"{seconds(spent)}  {100 * share:3.0f}%" if spent else "-"

        return text

    rows = [_row("core time", sources, lambda source: seconds(source["total_core_s"]))]
    rows += [_row(f"  {name}", sources, cell(name)) for name in stages if name in largest]
    rows.append(_row("  other", sources, cell("other", *small)))
    rows += [
        _row(f"  {name}", sources, cell(name))
        for name in _ADDED[1:]
        if any(source["core_s"][name] for source in sources)
    ]
    for unit, name in _UNITS.items():
        rows.append(_row(name, sources, lambda source, unit=unit: _short(source["core_s_per"][unit])))
    return rows


def _short(value_s: float | None) -> str:
    if value_s is None:
        return "-"
    return (
        f"{1000 * value_s:.3g} ms"
        if value_s < 0.1
        else f"{value_s:.3g} s"
        if value_s < 600
        else seconds(value_s)
    )


def _waste(sources: Sequence[Source]) -> list[tuple[str, ...]]:
    def attempts(source: Source) -> str:
        wasted = ", ".join(f"{account['attempts']:,} {kind}" for kind, account in source["waste"].items())
        return f"{wasted or 'none'} of {source['attempts']:,}"

    def scenes(source: Source) -> str:
        rejected = sum(source["rejected_scenes"].values())
        return f"{rejected:,} of {rejected + source['counts']['scene']:,} tries"

    rows = [_row("wasted attempts", sources, attempts), _row("rejected scenes", sources, scenes)]
    if any(source["rejected_scenes"] for source in sources):
        rows.append(_row("  most often", sources, _commonest))
    return rows


def _commonest(source: Source) -> str:
    found = sorted(source["rejected_scenes"].items(), key=lambda item: -item[1])[:2]
    return ", ".join(f"{cause} {count:,}" for cause, count in found) or "-"


def _agreement(pair: Mapping[str, Any]) -> str:
    percent = [100 * bound for bound in pair["interval"] or ()]
    bounds = f" [{percent[0]:.1f}, {percent[1]:.1f}]" if percent else ""
    share = f"{100 * pair['equal_share']:.1f}%{bounds} of {pair['candidates']:,} candidates within reach"
    return f"{pair['labels']} equals {pair['reference']} for {share}"
