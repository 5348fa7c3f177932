"""Success against arrival error as a picture: a panel for each kind of pick, a line for each method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from datagen.display.figures import new_figure, plain
from datagen.evaluation_report.figures import looks_of
from datagen.train.evaluation.arrival_success import PICKS
from datagen.train.evaluation.closed_loop import AT_RANDOM, BY_LABELS

_LOOKS: dict[str, dict[str, Any]] = {
    BY_LABELS: {"color": "#000000", "marker": "", "ls": ":", "lw": 1.6},
    AT_RANDOM: {"color": "#999999", "marker": "", "ls": ":", "lw": 1.6},
}
_TITLES = {
    "nominal": "pick with the best score",
    "smoothed": "pick with the best mean score on arrival",
}

_APART_CM = 0.12  # of two methods, so that their intervals do not hide each other


def draw_loop(record: Mapping[str, Any], file: Path) -> None:
    """Write the picture of all scenes; the ending of `file` chooses its format."""
    part = record["parts"][0]
    figure = new_figure(11, 5.6)
    panels = figure.subplots(1, len(PICKS), sharey=True)
    looks = looks_of(record["methods"]) | _LOOKS
    for ax, pick in zip(panels, PICKS, strict=True):
        for k, (name, look) in enumerate(looks.items()):
            # The random choice ignores scores: it is the same in both panels.
            rates = [row["methods"][name].get(pick, row["methods"][name]["nominal"]) for row in part["table"]]
            x_cm = [100 * row["distance_m"] + _APART_CM * (k - len(looks) / 2) for row in part["table"]]
            _draw_line(ax, x_cm, rates, look, name)
        ax.set(title=_TITLES[pick], xlabel="distance of the arrival from the pick (cm)", ylim=(-2, 102))
        ax.grid(color="#e4e4e4", lw=0.7)
        ax.set_axisbelow(True)
    trial = "planned" if record["mode"] == "plan" else "executed in a disturbed world"
    panels[0].set_ylabel(f"success, {trial} (%)")
    handles, words = panels[0].get_legend_handles_labels()
    level = f"{100 * record['bootstrap']['level']:g}% intervals over {part['scenes']} scenes"
    figure.legend(handles, words, loc="outside lower center", ncols=4, frameon=False, title=level)
    figure.savefig(file, metadata={"Date": None} if file.suffix == ".svg" else None)


def _draw_line(
    ax: Axes, x_cm: Sequence[float], rates: Sequence[Mapping[str, Any]], look: dict[str, Any], name: str
) -> None:
    order = np.argsort(x_cm, kind="stable")
    x, y = np.array(x_cm)[order], np.array([100 * rates[k]["value"] for k in order])
    bounds = np.array([[rates[k]["low"], rates[k]["high"]] for k in order], np.float64).T * 100
    bars = np.maximum([y - bounds[0], bounds[1] - y], 0)
    ax.errorbar(x, y, bars, **look, ms=6, mec="white", mew=0.5, elinewidth=0.8, capsize=2, label=plain(name))
