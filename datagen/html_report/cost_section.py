"""Cost and waste of a run, and agreement of runs, as tables of a page: the numbers of `datagen audit`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from datagen.console.printing import seconds, size
from datagen.train.html_page import escape, html_facts, html_table

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
    body = ["<p>Runs with labels of the same candidates. The reference is the source of higher fidelity.</p>"]
    rows = [
        (
            f"{_name(pair['said_by'])} against {_name(pair['true_by'])}", _set(pair), f"{pair['count']:,}",
            _percent(pair["accuracy"]), _percent(pair["balanced_accuracy"]),
            *(f"{pair['confusion'][key]:,}" for key in _CONFUSION),
        )
        for pair in pairs
    ]  # fmt: skip
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


def _groups(pair: Numbers) -> list[str]:
    title = f"{_name(pair['said_by'])} against {_name(pair['true_by'])}, {_set(pair)}"
    tables = [
        (
            key,
            [
                (name(g), f"{g['count']:,}", _percent(g["accuracy"]), _percent(g["balanced_accuracy"]))
                for g in pair[field]
            ],
        )
        for key, field, name in (
            ("distance (m)", "by_distance", _band),
            ("visibility", "by_visibility", _band),
            ("reach (m)", "by_reach", _band),
            ("object", "by_object", lambda g: str(g["object"])),
        )
    ]  # fmt: skip
    outcomes = [
        (o["outcome"], f"{o['count']:,}", _percent(o["said_positive"] / o["count"]))
        for o in pair["by_outcome"]
    ]
    inside = "".join(html_table((key, "count", "accuracy", "balanced"), rows) for key, rows in tables if rows)
    if outcomes:
        inside += html_table(("outcome of the reference", "count", "good by the first"), outcomes)
    return [f"<details><summary>{escape(title)}</summary>{inside}</details>"]


def _name(who: Numbers) -> str:
    return f"{who['label_source']} disturbed" if who["disturbed"] else str(who["label_source"])


def _set(pair: Numbers) -> str:
    return "all" if pair["candidates"] == "grid" else str(pair["candidates"])


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f}%"


def _band(group: Numbers) -> str:
    low, high = group["low"], group["high"]
    return f"{low:g} on" if high is None else f"{low:g} to {high:g}"
