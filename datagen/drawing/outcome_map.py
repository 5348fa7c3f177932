"""Map of the outcomes of candidates around the target, with its legend."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from datagen.drawing.outcome_colours import LOOKS
from datagen.schemas.outcomes import OUTCOMES
from datagen.workers.geometry.mesh import F64

_DOT, _LEGEND_DOT = 34, 70  # areas in points^2
_RECEDING = {"out_of_reach": 12, "base_collision": 18}  # the most frequent and least informative outcomes
_REACH_COLOUR = "#1b3a6b"


def draw_outcomes(axes: Axes, base_xy_m: F64, outcome: Any, clear: Any) -> None:
    """Draw candidates (N, 2) by outcome code (N,): filled where the base is clear, else hollow."""
    _veil(axes)
    for code, name in enumerate(OUTCOMES):
        look = LOOKS[name]
        size = _RECEDING.get(name, _DOT)
        for fits, face in ((True, look.colour), (False, "none")):
            rows = (outcome == code) & (clear == fits)
            axes.scatter(
                *base_xy_m[rows].T,
                s=size,
                marker=look.marker,
                facecolors=face,
                edgecolors=look.colour,
                lw=1.0,
                zorder=8,
            )


def draw_reach(axes: Axes, target_xy_m: F64, radius_m: float) -> None:
    """Draw the circle around the target outside of which the arm is too short."""
    for width, colour in ((3.2, "white"), (1.6, _REACH_COLOUR)):
        circle = Circle(
            (float(target_xy_m[0]), float(target_xy_m[1])),
            radius_m,
            fill=False,
            ls=(0, (5, 3)) if colour != "white" else "-",
            lw=width,
            edgecolor=colour,
            alpha=0.9,
            zorder=7.5,
        )
        axes.add_patch(circle)


def draw_pick(axes: Axes, base_xy_m: F64, colour: str, label: str) -> None:
    """Draw a chosen candidate (2,) as a star."""
    axes.scatter(
        *base_xy_m, marker="*", s=280, color=colour, edgecolors="black", lw=0.9, zorder=9, label=label
    )


def draw_outcome_legend(axes: Axes, outcome: Any) -> None:
    """Draw the legend: outcomes by group, with marker, count and description."""
    axes.set_axis_off()
    counts = np.bincount(np.asarray(outcome, np.int64), minlength=len(OUTCOMES))
    axes.set_xlim(0, 1)
    axes.set_ylim(1.07, -0.04)
    groups = list(dict.fromkeys(look.group for look in LOOKS.values()))
    rows = len(LOOKS) + len(groups)
    y, group = 0.0, ""
    for count, name in zip(counts, OUTCOMES, strict=True):
        look = LOOKS[name]
        if look.group != group:
            group = look.group
            y += 0.35 / rows
            if group != "success":
                axes.text(0.0, y, f"decided by {group}", fontsize=8.5, color="#555555", va="center")
                y += 1 / rows
        tone = "black" if count else "#a0a0a0"
        axes.scatter(0.03, y, s=_LEGEND_DOT, marker=look.marker, color=look.colour)
        axes.text(0.19, y, f"{count}", fontsize=10, color=tone, va="center", ha="right")
        axes.text(0.22, y, name, fontsize=10, color=tone, va="center", weight="bold" if count else "normal")
        axes.text(0.53, y, look.words, fontsize=8.5, color=tone, va="center")
        y += 1 / rows
    axes.set_title("outcomes: filled where the robot's body fits, hollow where not", fontsize=11)


def _veil(axes: Axes) -> None:
    """Fade the floor plan, so that the colours of candidates stand out."""
    axes.add_patch(
        Rectangle((0, 0), 1, 1, transform=axes.transAxes, color="white", alpha=0.55, lw=0, zorder=4)
    )
