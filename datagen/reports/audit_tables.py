"""Costs of an audit as tables for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from datagen.console.printing import counted, print_lines, print_rows, seconds, size
from datagen.reports.agreement_tables import band_name, name_of, percent, set_name
from datagen.reports.prices import Prices
from datagen.schemas.errors import printable

_UNITS = {
    "label": "a label",
    "label_within_reach": "a label within reach",
    "positive": "a positive",
    "positive_within_reach": "a positive within reach",
    "accepted_scene": "an accepted scene",
}
# Label sources whose times the paper and the projections state in weeks; others are in days.
_WEEKS = ("sim",)
_SHOWN = 20


def print_costs(report: dict[str, Any], prices: Prices) -> None:
    """Print the most important numbers of an audit: sums that differ, costs by label source, projections."""
    _print_findings(report["balance"])
    sources = [source for source in report["sources"] if source["labels"]]
    if not sources:
        return
    heads = ("", *(source["label_source"] for source in sources))
    _print_unit_costs(sources, heads, report["correct_labels"])
    _print_money(sources, heads, prices)
    _print_projections(sources, report["paper"]["by_source"], prices)
    if report["ratios"]:
        print_ratios(report["ratios"])
    _print_balance(report["balance"])


def _print_findings(balance: dict[str, Any]) -> None:
    found = balance["findings"]
    if not found:
        return
    lines = [f"sums differ for {counted(len(found), 'record')}: the file, the problem, the fix"]
    for finding in found[:_SHOWN]:
        lines += [f"  {finding['file']}", f"      {printable(finding['problem'])}. {finding['fix']}"]
    if len(found) > _SHOWN:
        lines.append(f"  and {len(found) - _SHOWN:,} more: --json lists them")
    print_lines("\n".join(lines))


def _print_unit_costs(
    sources: Sequence[dict[str, Any]], heads: Sequence[str], correct: Sequence[dict[str, Any]]
) -> None:
    rows = [
        ("labels", *(f"{s['labels']:,}" for s in sources)),
        ("positive", *(percent(s["positive_share"]) for s in sources)),
        ("within reach", *(f"{s['counts']['in-range']['labels']:,}" for s in sources)),
        ("positive within reach", *(percent(s["counts"]["in-range"]["positive_share"]) for s in sources)),
    ]
    for unit, words in _UNITS.items():
        each = [source["cost_per"][unit] for source in sources]
        rows.append((words, *("-" if one is None else duration(one["core_s"]) for one in each)))
    for name, words in (("grid", "a correct label"), ("in-range", "a correct label within reach")):
        each = [_correct_of(source, correct, name) for source in sources]
        if any(each):
            rows.append((words, *("-" if one is None else one for one in each)))
    print_rows("cost in core time, waste included", rows, heads)
    notes = [
        f"{source['label_source']}: the scenes are of another run; name it too to include their cost"
        for source in sources
        if not source["includes_scenes"]
    ]
    truths = dict.fromkeys(f"{name_of(one['truth'])} ({one['truth']['run']})" for one in correct)
    if truths:
        notes.append(f"correct: as {', '.join(truths)} labels the same candidates")
    notes.append("a label within reach carries the run's whole cost; time is measured a shard, not a label")
    print_lines("\n".join(notes), "  ")


def _correct_of(source: dict[str, Any], correct: Sequence[dict[str, Any]], name: str) -> str | None:
    """The cost of a correct label of a source, where one of its runs is compared with a truth."""
    costs = [
        one["sets"][name]["core_s_per_correct_label"]
        for one in correct
        if one["label_source"] == source["label_source"]
    ]
    shown = [duration(cost) for cost in costs if cost is not None]
    return " / ".join(shown) or None


def _print_money(sources: Sequence[dict[str, Any]], heads: Sequence[str], prices: Prices) -> None:
    def row(words: str, key: str) -> tuple[str, ...]:
        return (words, *(prices.format(source["spent"][key]["money"]) for source in sources))

    def per(words: str, unit: str) -> tuple[str, ...]:
        each = [source["cost_per"][unit] for source in sources]
        return (words, *("-" if one is None else prices.format(1000 * one["money"]) for one in each))

    rows = [
        row("spent by these runs", "own"),
        *([row("  of it waste", "waste")] if any(s["waste"] for s in sources) else []),
        per("1,000 labels", "label"),
        per("1,000 labels within reach", "label_within_reach"),
        per("1,000 positives", "positive"),
    ]
    print_rows("money", rows, heads)
    core, gb = prices.core_hour, prices.gb_month
    print_lines(
        f"{core.price:g} {prices.currency} a core-hour ({core.date}), {gb.price:g} a GB-month ({gb.date}) for"
        f" {prices.months_kept:g} months; --json has the sources",
        "  ",
    )


def _print_projections(
    sources: Sequence[dict[str, Any]], paper: dict[str, dict[str, float]], prices: Prices
) -> None:
    rows: list[tuple[str, ...]] = []
    labels = 0
    for source in sources:
        name = source["label_source"]
        near, every = source["projections"]["label_within_reach"], source["projections"]["label"]
        labels = every["labels"]
        stated = paper.get(name)
        rows.append(
            (
                _day_name(name),
                _days(name, every["core_days"]),
                prices.format(every["money"]),
                size(source["projection"]["bytes"]),
                "-" if near is None else _days(name, near["core_days"]),
                "-" if near is None else prices.format(near["money"]),
                "-" if stated is None else _paper(name, stated["gpu_days"]),
                "-" if stated is None else prices.format(stated["money"]),
            )
        )
    heads = ("one core", "all", "money", "bytes", "in reach", "money", "paper", "money")
    print_rows(f"{labels:,} labels: of whole grids as audited, and within reach alone", rows, heads)
    print_lines(
        "paper: GPU-days or weeks on an RTX A5000, bounds as stated there; money at"
        f" {prices.gpu_hour.price:g} {prices.currency} a GPU-hour",
        "  ",
    )


def _day_name(source: str) -> str:
    return f"{source}-weeks" if source in _WEEKS else f"{source}-days"


def _days(source: str, days: float) -> str:
    return f"{days / 7:.3g}" if source in _WEEKS else f"{days:.3g}"


def _paper(source: str, days: float) -> str:
    return f"{'>' if source in _WEEKS else '<'} {_days(source, days)}"


def _print_balance(balance: dict[str, Any]) -> None:
    ledger, commits, waste = (balance[name] for name in ("ledger_s", "commits_s", "waste_s"))
    rows = [
        (
            clock if clock == "wall" else "CPU",
            f"{ledger[clock]:,.3f} s",
            f"{commits[clock]:,.3f} s",
            f"{waste[clock]:,.3f} s",
            f"{balance['difference_s'][clock]:g} s",
        )
        for clock in ("wall", "cpu")
    ]
    print_rows("sums", rows, ("", "ledger", "commits", "waste", "difference"))


def print_ratios(ratios: Sequence[dict[str, Any]]) -> None:
    """Print the ratios of costs per label between label sources."""
    rows = [
        (
            f"{r['source']} / {r['over']}",
            f"{r['cost_ratio']:,.1f}",
            "-" if r["cost_ratio_within_reach"] is None else f"{r['cost_ratio_within_reach']:,.1f}",
        )
        for r in ratios
    ]
    print_rows("ratio of costs per label", rows, ("", "a label", "within reach"))


def print_source(report: dict[str, Any], candidates: str, prices: Prices) -> None:
    """Print the details of one label source: stages, waste, and outcomes."""
    labels, useful, before = report["labels"], report["useful"], report["relabelled_from"]
    if not labels:
        print_rows(f"audit of {report['label_source']} labels", [("labels", "none committed")])
        return
    tries, gpu_s = report["scene_tries"], report["gpu_s"]
    borrowed = report["spent"]["scenes_of_other_runs"]
    print_rows(
        f"audit of {report['label_source']} labels",
        [
            ("labels", f"{labels:,} in {report['scenes']:,} scenes"),
            ("made from", report["made_from"]),
            ("worker time", _worker_time(useful)),
            *([("relabelled files", _worker_time(before))] if before["wall_s"] else []),
            *([("scenes of other runs", f"{seconds(borrowed['core_s'])} CPU")] if borrowed["core_s"] else []),
            ("GPU time", "none recorded" if gpu_s is None else seconds(gpu_s)),
            (
                "per label",
                f"{1000 * report['wall_s_per_label']:.3f} ms wall, {report['bytes_per_label']:.0f} bytes",
            ),
            ("peak memory", size(useful["peak_rss_bytes"])),
            ("machines", "; ".join(report["machines"])),
        ],
    )
    whole, projected = useful["wall_s"], report["projection"]["labels"]
    print_rows(
        "time by stage",
        [
            (
                stage,
                f"{1000 * spent['wall_s'] / labels:.3f}",
                f"{1000 * spent['cpu_s'] / labels:.3f}",
                f"{100 * spent['wall_s'] / whole:.1f}%",
                prices.format(projected * spent["money"] / labels),
            )
            for stage, spent in report["stages"].items()
        ],
        ("stage", "wall (ms/label)", "CPU (ms/label)", "share", f"{projected:,} labels"),
    )
    waste = [
        (
            kind,
            str(account["attempts"]),
            seconds(account["wall_s"]),
            prices.format(report["money_by_waste"][kind]),
            str(account["without_account"]),
        )
        for kind, account in report["waste"].items()
    ]
    print_rows("waste", waste, ("cause", "attempts", "wall time", "money", "cost unknown"))
    causes = [
        (f"{c['outcome']}: {c['cause'] or 'no cause recorded'}", str(c["attempts"]), seconds(c["core_s"]))
        for c in report["waste_causes"]
        if c["outcome"] not in ("superseded", "cancelled")
    ]
    print_rows("costliest causes of failed attempts", causes, ("cause", "attempts", "core time"))
    rejected = ", ".join(f"{cause} {count}" for cause, count in report["redraws"].items()) or "none"
    shown = f"{tries['rejected']:,} of {tries['rejected'] + tries['accepted']:,} tries"
    print_rows(
        "resampled scenes",
        [
            ("rejected", f"{shown} ({percent(tries['rejected_share'])}): {rejected}"),
            ("their time", "in draw, settle and observe; not recorded apart"),
        ],
    )
    if "outcomes" in report:
        _print_outcomes(report["outcomes"], candidates)


def duration(value: float) -> str:
    """A short duration with three digits: 2.31 ms, 0.31 s, 14.2 s."""
    return f"{1000 * value:.3g} ms" if value < 0.1 else f"{value:.3g} s" if value < 600 else seconds(value)


def _worker_time(spent: dict[str, Any]) -> str:
    return f"{seconds(spent['wall_s'])} wall, {seconds(spent['cpu_s'])} CPU"


def _print_outcomes(report: dict[str, Any], candidates: str) -> None:
    n = report["count"]
    if not n:
        print_rows("outcomes", [("candidates", f"none are {candidates}")])
        return
    title = f"outcomes of {n:,} candidates ({set_name(candidates)})"
    rows = [(o["outcome"], o["stage"], f"{o['count']:,}", percent(o["share"])) for o in report["outcomes"]]
    print_rows(title, rows, ("outcome", "decided by", "count", "share"))
    for name, bands in report["positive_by"].items():
        rows = [
            (band_name(band), f"{band['count']:,}", percent(band["positive"] / band["count"]))
            for band in bands
        ]
        print_rows(f"positive by {name}", rows, (f"{name} (m)", "count", "positive"))
