"""Cost and waste of a run, and agreement of runs, as tables of a page: the numbers of `datagen audit`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from datagen.console.printing import seconds, size
from datagen.display.html_page import escape, html_facts, html_table
from datagen.reports.agreement_tables import band_name, name_of, percent, set_name

Numbers = Mapping[str, Any]


def cost_section(cost: Numbers) -> list[str]:
    """Cost of one run: worker time, time by stage, waste by outcome. `cost` is that of `audit_report`."""
    labels, useful = cost["labels"], cost["useful"]
    if not labels:
        return [*_waste(cost), "<p>No label is committed.</p>"]
    projection = cost["projection"]
    facts = [
        ("worker time", f"{seconds(useful['wall_s'])} wall, {seconds(useful['cpu_s'])} CPU"),
        ("per label", f"{1000 * cost['wall_s_per_label']:.3g} ms wall, {cost['bytes_per_label']:,.0f} bytes"),
        ("waste", f"{100 * (cost['waste_share'] or 0):.1f}% of the worker time"),
        ("rejected tries", ", ".join(f"{k} {n:,}" for k, n in cost["redraws"].items()) or "none"),
        ("peak memory", size(useful["peak_rss_bytes"])),
        ("machines", "; ".join(f"{name} ({n:,} attempts)" for name, n in cost["machines"].items())),
        (
            f"{projection['labels']:,} labels",
            f"would take {projection['worker_days']:.3g} worker-days and {size(projection['bytes'])}",
        ),
    ]
    stages = [
        (
            stage,
            f"{1000 * spent['wall_s'] / labels:.3f}",
            f"{1000 * spent['cpu_s'] / labels:.3f}",
            f"{100 * spent['wall_s'] / useful['wall_s']:.1f}%" if useful["wall_s"] else "-",
        )
        for stage, spent in cost["stages"].items()
    ]
    heads = ("stage", "wall (ms a label)", "CPU (ms a label)", "share")
    return [html_facts(facts), html_table(heads, stages), *_waste(cost)]


def _waste(cost: Numbers) -> list[str]:
    rows = [
        (outcome, str(account["attempts"]), seconds(account["wall_s"]), str(account["without_account"]))
        for outcome, account in cost["waste"].items()
    ]
    return [html_table(("waste", "attempts", "wall time", "cost unknown"), rows)] if rows else []


def agreement_section(pairs: Sequence[Numbers]) -> list[str]:
    """Agreement of runs that labelled the same candidates, by candidate set. `pairs` are those of `audit`."""
    pairs = [pair for pair in pairs if pair["count"]]
    if not pairs:
        return []
    body = [
        "<p>Runs with labels of the same candidates. The reference is the source of higher fidelity. "
        "Intervals of 95% are by scene.</p>"
    ]
    rows = [
        (
            _against(pair),
            set_name(pair["candidates"]),
            *_agreed(pair),
            *(f"{pair['confusion'][key]:,}" for key in _CONFUSION),
        )
        for pair in pairs
    ]
    heads = ("labels", "candidates", "count", "accuracy", "balanced", *_CONFUSION.values())
    body.append(html_table(heads, rows))
    for pair in pairs:
        body += _groups(pair)
    return body


_CONFUSION = {
    "true_positive": "both good",
    "false_positive": "only the first",
    "false_negative": "only the reference",
    "true_negative": "both bad",
}


def _against(pair: Numbers) -> str:
    return f"{name_of(pair['said_by'])} against {name_of(pair['true_by'])}"


def _agreed(group: Numbers) -> tuple[str, str, str]:
    """Count, accuracy and balanced accuracy with their intervals."""
    names = ("accuracy", "balanced_accuracy")
    accuracy, balanced = (percent(group[name], group[f"{name}_interval"]) for name in names)
    return f"{group['count']:,}", accuracy, balanced


def _groups(pair: Numbers) -> list[str]:
    title = f"{_against(pair)}, {set_name(pair['candidates'])}"
    tables = [
        (key, [(name(g), *_agreed(g)) for g in pair[field]])
        for key, field, name in (
            ("distance (m)", "by_distance", band_name),
            ("mount distance / reach", "by_distance_over_reach", band_name),
            ("visibility", "by_visibility", band_name),
            ("reach (m)", "by_reach", band_name),
            ("mount height (m)", "by_height", band_name),
            ("furniture", "by_furniture", lambda g: str(g["furniture"])),
            ("object", "by_object", lambda g: str(g["object"])),
        )
    ]
    outcomes = [
        (o["outcome"], f"{o['count']:,}", percent(o["said_positive"] / o["count"]))
        for o in pair["by_outcome"]
    ]
    inside = "".join(html_table((key, "count", "accuracy", "balanced"), rows) for key, rows in tables if rows)
    if outcomes:
        inside += html_table(("outcome of the reference", "count", "good by the first"), outcomes)
    return [f"<details><summary>{escape(title)}</summary>{inside}</details>"]
