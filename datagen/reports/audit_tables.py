"""An audit as tables for people."""

from __future__ import annotations

from typing import Any

from datagen.console.printing import print_rows, seconds, size


def print_source(report: dict[str, Any], candidates: str) -> None:
    """Print the costs of one label source."""
    labels, useful, before = report["labels"], report["useful"], report["relabelled_from"]
    if not labels:
        print_rows(f"audit of {report['label_source']} labels", [("labels", "none committed")])
        return
    rejected = ", ".join(f"{cause} {count}" for cause, count in report["redraws"].items()) or "none"
    print_rows(
        f"audit of {report['label_source']} labels",
        [
            ("labels", f"{labels:,} in {report['scenes']:,} scenes"),
            ("made from", report["made_from"]),
            ("positive", f"{report['positives']:,} ({100 * report['positive_share']:.1f}%)"),
            ("rejected", rejected),
            ("worker time", _worker_time(useful)),
            *([("relabelled files", _worker_time(before))] if before["wall_s"] else []),
            (
                "per label",
                f"{1000 * report['wall_s_per_label']:.3f} ms, {report['bytes_per_label']:.0f} bytes",
            ),
            ("peak memory", size(useful["peak_rss_bytes"])),
            ("machines", "; ".join(report["machines"])),
        ],
    )
    whole = useful["wall_s"]
    print_rows(
        "time by stage",
        [
            (
                stage,
                f"{1000 * spent['wall_s'] / labels:.3f}",
                f"{1000 * spent['cpu_s'] / labels:.3f}",
                f"{100 * spent['wall_s'] / whole:.1f}%",
            )
            for stage, spent in report["stages"].items()
        ],
        ("stage", "wall (ms/label)", "CPU (ms/label)", "share"),
    )
    waste = [
        (outcome, str(account["attempts"]), seconds(account["wall_s"]), str(account["without_account"]))
        for outcome, account in report["waste"].items()
    ]
    print_rows("waste", waste, ("outcome", "attempts", "wall time", "cost unknown"))
    _print_projection(report["projection"], report["waste_share"])
    if "outcomes" in report:
        _print_outcomes(report["outcomes"], candidates)


def _worker_time(spent: dict[str, Any]) -> str:
    return f"{seconds(spent['wall_s'])} wall, {seconds(spent['cpu_s'])} CPU"


def _print_projection(projection: dict[str, Any], waste_share: float) -> None:
    days, paper_days = projection["worker_days"], projection["paper_days"]
    rows = [("this machine", f"{days:.4f} worker-days ({days / 7:.4f} weeks), {size(projection['bytes'])}")]
    if paper_days is not None:
        bound = "upper bound" if paper_days < 7 else "lower bound"
        rows += [
            ("the paper", f"{paper_days:.0f} GPU-days ({paper_days / 7:.1f} weeks; RTX A5000, {bound})"),
            ("ratio", f"{paper_days / days:.0f} times fewer days"),
        ]
    rows.append(("waste", f"{100 * waste_share:.1f}% of the worker time"))
    print_rows(f"projection to {projection['labels']:,} labels", rows)


def _print_outcomes(report: dict[str, Any], candidates: str) -> None:
    n = report["count"]
    if not n:
        print_rows("outcomes", [("candidates", f"none are {candidates}")])
        return
    title = f"outcomes of {n:,} candidates ({_set(candidates)})"
    rows = [(o["outcome"], o["stage"], f"{o['count']:,}", _percent(o["share"])) for o in report["outcomes"]]
    print_rows(title, rows, ("outcome", "decided by", "count", "share"))
    for name, bands in report["positive_by"].items():
        rows = [
            (_band(band), f"{band['count']:,}", _percent(band["positive"] / band["count"])) for band in bands
        ]
        print_rows(f"positive by {name}", rows, (f"{name} (m)", "count", "positive"))


def print_ratios(ratios: list[dict[str, Any]]) -> None:
    """Print the ratios of costs per label between label sources."""
    rows = [(f"{r['source']} / {r['over']}", f"{r['cost_ratio']:,.1f}") for r in ratios]
    print_rows("ratio of costs per label", rows)


def print_pair(pair: dict[str, Any]) -> None:
    """Print the agreement of two runs with labels of the same candidates."""
    said, true = (_name(pair[side]) for side in ("said_by", "true_by"))
    if said == true:
        said, true = "first", "second"
    print_rows(
        f"{said} against {true}",
        [
            (said, pair["said_by"]["run"]),
            (true, pair["true_by"]["run"]),
            ("candidates", f"{pair['count']:,} ({_set(pair['candidates'])})"),
        ],
    )
    if not pair["count"]:
        return
    counts = pair["confusion"]
    print_rows(
        "confusion",
        [
            (f"{said} 1", f"{counts['true_positive']:,}", f"{counts['false_positive']:,}"),
            (f"{said} 0", f"{counts['false_negative']:,}", f"{counts['true_negative']:,}"),
        ],
        ("", f"{true} 1", f"{true} 0"),
    )
    costs = pair["wall_s_per_correct_label"]
    spent = [
        (f"cost of a correct label, {side}", f"{1000 * cost:.3f} ms" if cost is not None else "-")
        for side, cost in ((said, costs["said_by"]), (true, costs["true_by"]))
    ]
    print_rows(
        "agreement",
        [
            ("accuracy", _percent(pair["accuracy"])),
            ("balanced accuracy", _percent(pair["balanced_accuracy"])),
            *spent,
        ],
    )
    for key, unit in (("distance", "m"), ("visibility", "rho"), ("reach", "m")):
        _print_groups(f"by {key}", unit, [(_band(g), g) for g in pair[f"by_{key}"]], said, true)
    _print_groups("by object", "target", [(g["object"], g) for g in pair["by_object"]], said, true)
    rows = [(o["outcome"], f"{o['count']:,}", f"{o['said_positive']:,}") for o in pair["by_outcome"]]
    print_rows(f"by outcome of {true}", rows, ("outcome", "count", f"{said} 1"))


def _print_groups(
    title: str, unit: str, groups: list[tuple[str, dict[str, Any]]], said: str, true: str
) -> None:
    rows = [
        (
            name,
            f"{g['count']:,}",
            _percent(g["said_positive"] / g["count"]),
            _percent(g["true_positive_share"]),
            _percent(g["accuracy"]),
            _percent(g["balanced_accuracy"]),
        )
        for name, g in groups
    ]
    print_rows(title, rows, (unit, "count", f"{said} 1", f"{true} 1", "accuracy", "balanced"))


def _name(who: dict[str, Any]) -> str:
    return f"{who['label_source']} disturbed" if who["disturbed"] else who["label_source"]


def _set(candidates: str) -> str:
    return "all" if candidates == "grid" else candidates


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f}%"


def _band(band: dict[str, Any]) -> str:
    return f"{band['low']:g} on" if band["high"] is None else f"{band['low']:g} to {band['high']:g}"
