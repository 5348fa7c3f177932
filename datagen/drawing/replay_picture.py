"""A stored scene compared with its replay: frames, floor plans with the candidates, differences."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from datagen.display.figures import draw_frame, new_sheet, save_sheet
from datagen.display.styles import LABEL_STYLES, SAMPLE, Style
from datagen.drawing.floor_plan import (
    Handle,
    draw_labels,
    draw_legend,
    draw_pick,
    draw_plan,
    half_width_m,
    object_outlines,
)
from datagen.drawing.scene_picture import Shown
from datagen.workers.scenes.reconstruct import ReconstructedScene


def draw_replay(report: dict[str, Any], stored: Shown, made: Shown, row: int | None, out: Path) -> None:
    """Write the picture. `report` is that of `datagen replay`; `row` is the candidate to mark."""
    verdict = "equal bit for bit" if report["equal"] else "different"
    figure = new_sheet(f"Scene {report['scene']} of {report['run']} replayed: {verdict}", 8.2)
    panels = figure.subplots(2, 3, width_ratios=(1, 1, 1))
    handles: list[Handle] = []
    marks: list[Style] = []
    for column, (name, side) in enumerate((("stored", stored), ("replayed", made))):
        draw_frame(panels[0, column], side.frame.rgb, side.frame.body == 1, f"{name}: RGB frame")
        handles, marks = _draw_candidates(panels[1, column], side, row)
        panels[1, column].set_title(f"{name}: candidates by label")
    _draw_over(panels[0, 2], stored.recalled, made.recalled)
    draw_legend(panels[1, 2], handles, "base poses", marks)
    panels[1, 2].text(
        0, 0, "\n".join(_lines(report)), va="bottom", family="monospace", fontsize=9,
        transform=panels[1, 2].transAxes,
    )  # fmt: skip
    save_sheet(figure, out)


def _draw_candidates(axes: Axes, side: Shown, row: int | None) -> tuple[list[Handle], list[Style]]:
    xy = np.asarray(side.samples["base_xy_m"], np.float64)
    marks = draw_plan(axes, side.recalled, half_width_m(side.recalled))
    label, clear = (np.asarray(side.samples[key]) for key in ("label", "base_is_clear"))
    handles = draw_labels(axes, xy, label, clear)
    if row is not None:
        draw_pick(axes, xy[row], SAMPLE)
        marks = [SAMPLE, *marks]
    return handles, marks


def _draw_over(axes: Axes, stored: ReconstructedScene, made: ReconstructedScene) -> None:
    """Draw both on one plan: where they are equal, dashes cover the solid line."""
    for recalled, style, name in ((stored, "-", "stored"), (made, "--", "replayed")):
        for k, outline in enumerate(object_outlines(recalled)):
            closed = np.vstack([outline, outline[:1]])
            label = name if k == 0 else None
            colour = LABEL_STYLES[style == "-"].colour
            axes.plot(*closed.T, ls=style, color=colour, lw=2.4 if style == "-" else 1.4, label=label)
    x, y = stored.target_center_m[:2]
    axes.set(xlim=(x - 0.45, x + 0.45), ylim=(y - 0.45, y + 0.45), xlabel="x [m]", ylabel="y [m]")
    axes.set_aspect("equal")
    axes.set_title("objects from above")
    axes.legend(loc="upper right")


def _lines(report: dict[str, Any]) -> list[str]:
    lines: list[str] = []
    if report["sample"] is not None:
        sample = report["sample"]
        x, y = sample["base_xy_m"]
        lines += [
            f"sample {sample['id']}",
            f"candidate {sample['candidate']} at ({x:.3f}, {y:.3f}) m",
            f"label {sample['label']}, H = {sample['heuristic_score']:.4f}",
            "",
        ]
    for title, key in (("replayed from seeds", "stages"), ("recomputed from poses", "recomputed")):
        lines.append(title)
        for stage in report[key]:
            names = ", ".join(d["field"] for d in stage["differences"])
            lines.append(f"  {stage['stage']:<12}{'equal' if stage['equal'] else f'differs: {names}'[:50]}")
        if not report[key]:
            lines.append("  not checked: the source run is missing")
    return lines
