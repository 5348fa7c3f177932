"""An estimation as tables for people."""

from __future__ import annotations

from typing import Any

from datagen.console.printing import counted, print_rows, seconds


def print_estimation(report: dict[str, Any]) -> None:
    """Print the tables of `estimation_report`."""
    dear = f"{report['dear_labels']:,} of {', '.join(report['dear_runs'])}"
    if report["selected"]:
        dear += ", counted 1/probability of their selection"
    print_rows(
        f"success rate by {report['dear']} labels",
        [
            ("population", f"{counted(report['scenes'], 'scene')} of {', '.join(report['cheap_runs'])}"),
            ("cheap labels", ", ".join(report["cheap"])),
            ("dear labels", dear),
            ("a dear label", f"{seconds(report['cpu_s_per_dear_label'])} of CPU time"),
        ],
    )
    known = [row for row in report["estimates"] if row["rate"] is not None]
    print_rows(
        "rates, with 95% intervals",
        [
            (
                row["population"],
                f"{row['candidates']:,.0f}",
                *(f"{100 * rate:.1f}%" for rate in row["cheap_rates"].values()),
                _rate(row),
                _rate(row["dear_alone"]),
                f"{row['dear_labels']:,}",
                f"{row['effective_labels']:,.0f}",
            )
            for row in known
        ],
        (
            "population",
            "candidates",
            *(f"{name} alone" for name in report["cheap"]),
            "all labels",
            f"{report['dear']} alone",
            f"{report['dear']} labels",
            "worth",
        ),
    )
    unknown = [row["population"] for row in report["estimates"] if row["rate"] is None]
    if unknown:
        print_rows("", [("not estimated", f"{', '.join(unknown)}: too few scenes with dear labels")])
    if report["half_width"] is not None:
        _print_further(report, known)


def _print_further(report: dict[str, Any], known: list[dict[str, Any]]) -> None:
    print_rows(
        f"further {report['dear']} labels for an interval of ±{100 * report['half_width']:g}%",
        [(row["population"], f"±{100 * row['half_width']:.1f}%", *_further(row)) for row in known],
        ("population", "now", "labels", "CPU time", "scenes"),
    )


def _further(row: dict[str, Any]) -> tuple[str, str, str]:
    if row["further_labels"] is None:
        return "no number", "-", "more cheap labels are needed first"
    scenes = "enough" if row["scenes_suffice"] else "more are needed"
    return f"{row['further_labels']:,}", seconds(row["further_cpu_s"]), scenes


def _rate(row: dict[str, Any]) -> str:
    return f"{100 * row['rate']:.1f}% [{100 * row['low']:.1f}, {100 * row['high']:.1f}]"
