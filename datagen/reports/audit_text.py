"""An audit as one table for a terminal, a column for each label source."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from datagen.console.printing import counted, print_lines, print_rows, seconds

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
    rows = [row for row in (*_made(sources), *cost_rows(sources)) if full or row[0] in _ALWAYS]
    print_rows(title, rows, ("", *(source["label_source"] for source in sources)))
    notes = [
        f"{source['label_source']}: add the run that made its scenes, whose cost is missing here"
        for source in sources
        if not source["includes_scenes"]
    ]
    notes += [line for source in sources for line in source["doubts"]]
    notes += [f"{cause} ({_attempts(account)})" for cause, account in _costliest(sources)]
    notes += [_agreement(pair) for pair in report["agreement"] if pair["candidates"]]
    print_lines("\n".join(notes))


def cost_rows(sources: Sequence[Source]) -> list[tuple[str, ...]]:
    """Rows of a name and a cell for each label source: cost and waste."""
    return [*_cost(sources), *_waste(sources)]


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
    largest = sorted(stages, key=lambda name: -max(_part(s, name) for s in sources))[
        : _STAGES_SHOWN[min(len(sources), 3) - 1]
    ]
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


def _part(source: Source, name: str) -> float:
    return source["core_s"].get(name, 0.0) / (source["total_core_s"] or 1.0)


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


def _costliest(sources: Sequence[Source]) -> list[tuple[str, Mapping[str, Any]]]:
    causes = [item for source in sources for item in source["causes"].items()]
    return sorted(causes, key=lambda item: -item[1]["core_s"])[:2]


def _attempts(account: Mapping[str, Any]) -> str:
    return f"{counted(account['attempts'], 'attempt')}, {seconds(account['core_s'])}"


def _agreement(pair: Mapping[str, Any]) -> str:
    percent = [100 * bound for bound in pair["interval"] or ()]
    bounds = f" [{percent[0]:.1f}, {percent[1]:.1f}]" if percent else ""
    share = f"{100 * pair['equal_share']:.1f}%{bounds} of {pair['candidates']:,} candidates within reach"
    return f"{pair['labels']} equals {pair['reference']} for {share}"
