"""Numbers of an evaluation as text, for terminal and page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Report = Mapping[str, Any]

METRIC_WORDS = {
    "accuracy": "accuracy",
    "balanced_accuracy": "balanced accuracy",
    "area_under_roc": "AUC",
    "best_pick": "best choice positive",
    "good": "positive choices",
    "mean_average_precision": "mAP",
}
SET_WORDS = {
    "in-range": "clear and within reach",
    "clear": "clear",
    "grid": "all cells; methods know where the base collides",
}


def percent(value: float | None, signed: bool = False) -> str:
    """0.8413 as 84.1, or +84.1."""
    return "-" if value is None else f"{100 * value:{'+' if signed else ''}.1f}"


def with_interval(estimate: Report, signed: bool = False) -> str:
    """Percent with its interval: 84.1 [82.0, 86.2]."""
    if estimate["value"] is None:
        return "-"
    value, low, high = (percent(estimate[k], signed) for k in ("value", "low", "high"))
    return f"{value} [{low}, {high}]"


def metres_with_interval(estimate: Report) -> str:
    """Metres with their interval: 0.24 [0.20, 0.31]."""
    if estimate["value"] is None:
        return "-"
    low, high = (f"{e:.2f}" if (e := estimate[k]) is not None else "-" for k in ("low", "high"))
    return f"{estimate['value']:.2f} [{low}, {high}]"


def method_label(record: Report) -> str:
    """A method's name, with * where it has no threshold."""
    return record["name"] + (" *" if record["threshold"] is None else "")


def paper_accuracy(record: Report, paper: Report) -> float | None:
    """The paper's number for the same method or regime, if there is one."""
    return paper["accuracy"].get(record["regime"] or record["name"])


def models_first(records: Sequence[Report]) -> list[Report]:
    """Methods, models before baselines."""
    return sorted(records, key=lambda record: record["regime"] is None)


def compared(differences: Sequence[Report], metric: str, name: str) -> dict[str, list[str]]:
    """Methods that one is `above`, `below` and `open` to by a metric; + where intervals are disjoint."""
    found: dict[str, list[str]] = {"above": [], "open": [], "below": []}
    other_way = {"above": "below", "below": "above", "open": "open"}
    for d in differences:
        if d["metric"] != metric or name not in (d["first"], d["second"]):
            continue
        is_first = d["first"] == name
        said = d["verdict"] if is_first else other_way[d["verdict"]]
        found[said].append((d["second"] if is_first else d["first"]) + ("+" if d["disjoint"] else ""))
    return found


def candidates_line(told: Report) -> str:
    """Size of a set: 1,200 candidates of 80 scenes (clear), 31.0% positive."""
    share = percent(told["positives"] / told["count"])
    words = SET_WORDS[told["candidates"]]
    return f"{told['count']:,} candidates of {told['scenes']:,} scenes ({words}), {share}% positive"


def grids_line(grids: Report) -> str:
    """Number of whole grids, and the result of a random choice."""
    counted = grids["scenes"] - grids["scenes_without_positive"]
    return (
        f"{counted:,} whole grids with a positive candidate, {grids['scenes_without_positive']:,} without; "
        f"{percent(grids['any_clear'])}% of their clear candidates are positive"
    )
