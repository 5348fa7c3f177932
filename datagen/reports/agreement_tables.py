"""Agreement of runs as tables for people."""

from __future__ import annotations

from typing import Any

from datagen.console.printing import print_lines, print_rows

_GROUPS = {
    "distance": ("by distance", "m"),
    "distance_over_reach": ("by distance from the mount, in reaches", "reaches"),
    "visibility": ("by visibility", "rho"),
    "reach": ("by reach", "m"),
    "height": ("by height of the mount", "m"),
}
_NAMED = {
    "object": ("by object", "target"),
    "furniture": ("by furniture", "support"),
    "side": ("by side of the target", "side"),
}


def print_agreement(report: dict[str, Any]) -> None:
    """Print the agreement of each run with its reference, on whole grids and within reach."""
    compared = [one for one in report["correct_labels"] if not one["is_truth"]]
    rows = [
        (
            f"{name_of(one)} ({'within reach' if name == 'in-range' else 'whole grids'})",
            f"{found['count']:,}",
            percent(found["accuracy"], found["accuracy_interval"]),
            percent(found["balanced_accuracy"], found["balanced_accuracy_interval"]),
            _number(found["kappa"], found["kappa_interval"]),
        )
        for one in compared
        for name, found in one["sets"].items()
        if found["count"]
    ]
    if rows:
        truth = ", ".join(dict.fromkeys(name_of(one["truth"]) for one in compared))
        heads = ("", "count", "accuracy", "balanced", "kappa")
        print_rows(f"agreement with {truth}", rows, heads)
        print_lines(report["intervals"], "  ")


def print_pair(pair: dict[str, Any]) -> None:
    """Print the agreement of two runs with labels of the same candidates."""
    source, reference = (name_of(pair[side]) for side in ("said_by", "true_by"))
    if source == reference:
        source, reference = "first", "second"
    print_rows(
        f"{source} against {reference}",
        [
            (source, pair["said_by"]["run"]),
            (reference, pair["true_by"]["run"]),
            ("candidates", f"{pair['count']:,} ({set_name(pair['candidates'])})"),
        ],
    )
    if not pair["count"]:
        return
    counts = pair["confusion"]
    print_rows(
        "confusion",
        [
            (f"{source} 1", f"{counts['true_positive']:,}", f"{counts['false_positive']:,}"),
            (f"{source} 0", f"{counts['false_negative']:,}", f"{counts['true_negative']:,}"),
        ],
        ("", f"{reference} 1", f"{reference} 0"),
    )
    costs = pair["wall_s_per_correct_label"]
    spent = [
        (f"cost of a correct label, {side}", f"{1000 * cost:.3f} ms wall" if cost is not None else "-")
        for side, cost in ((source, costs["said_by"]), (reference, costs["true_by"]))
    ]
    print_rows(
        "agreement",
        [
            ("accuracy", percent(pair["accuracy"], pair["accuracy_interval"])),
            ("balanced accuracy", percent(pair["balanced_accuracy"], pair["balanced_accuracy_interval"])),
            ("Cohen's kappa", _number(pair["kappa"], pair["kappa_interval"])),
            *(spent if pair["candidates"] == "grid" else []),
        ],
    )
    for key, (title, unit) in _GROUPS.items():
        _print_groups(title, unit, [(band_name(g), g) for g in pair[f"by_{key}"]], source, reference)
    for key, (title, unit) in _NAMED.items():
        _print_groups(title, unit, [(g[key], g) for g in pair[f"by_{key}"]], source, reference)
    rows = [
        (
            o["outcome"],
            f"{o['count']:,}",
            f"{o['said_positive']:,}",
            percent(o["accuracy"], o["accuracy_interval"]),
        )
        for o in pair["by_outcome"]
    ]
    print_rows(f"by outcome of {reference}", rows, ("outcome", "count", f"{source} 1", "accuracy"))


def _print_groups(
    title: str, unit: str, groups: list[tuple[str, dict[str, Any]]], source: str, reference: str
) -> None:
    rows = [
        (
            name,
            f"{g['count']:,}",
            percent(g["said_positive"] / g["count"]),
            percent(g["true_positive_share"]),
            percent(g["accuracy"], g["accuracy_interval"]),
            percent(g["balanced_accuracy"], g["balanced_accuracy_interval"]),
            _number(g["kappa"], None),
        )
        for name, g in groups
    ]
    print_rows(title, rows, (unit, "count", f"{source} 1", f"{reference} 1", "accuracy", "balanced", "kappa"))


def name_of(record: dict[str, Any]) -> str:
    """The label source of a run, with `disturbed`."""
    return f"{record['label_source']} disturbed" if record["disturbed"] else record["label_source"]


def set_name(candidates: str) -> str:
    """A set of candidates in words."""
    return "all" if candidates == "grid" else candidates


def percent(share: float | None, interval: list[float] | None = None) -> str:
    """A share in percent, with its interval: 81.2% [78.0, 84.1]."""
    if share is None:
        return "-"
    bounds = "" if interval is None else f" [{100 * interval[0]:.1f}, {100 * interval[1]:.1f}]"
    return f"{100 * share:.1f}%{bounds}"


def _number(value: float | None, interval: list[float] | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2f}" + ("" if interval is None else f" [{interval[0]:.2f}, {interval[1]:.2f}]")


def band_name(band: dict[str, Any]) -> str:
    """A band of a quantity: 0.3 to 0.4, 1 on."""
    return f"{band['low']:g} on" if band["high"] is None else f"{band['low']:g} to {band['high']:g}"
