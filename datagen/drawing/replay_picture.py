"""Picture of a stored and a replayed scene: frames, floor plans with candidates, differences."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from datagen.drawing.floor_plan import draw_camera, draw_house, draw_labels, draw_objects, frame_axes
from datagen.drawing.scene_picture import draw_frame, object_outlines
from datagen.schemas.fields import SceneRows
from datagen.schemas.identity import Stream, generator
from datagen.schemas.specification import Specification
from datagen.workers.scenes.draw import render_frame
from datagen.workers.scenes.recall import RecalledScene

Side = tuple[RecalledScene, SceneRows]


def draw_replay(
    report: dict[str, Any], spec: Specification, stored: Side, made: Side, row: int | None, out: Path
) -> None:
    """Write the picture. `report` comes from `datagen replay`; `row` is the marked candidate."""
    figure = Figure(figsize=(19, 11), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3, width_ratios=(1, 1, 0.9))
    verdict = "equal, bit for bit" if report["equal"] else "different"
    figure.suptitle(f"{report['run']}, scene {report['scene']}: {verdict}", fontsize=14)
    centre = np.asarray(stored[1].record["target_center_m"], np.float64)
    for column, (name, side) in enumerate((("stored", stored), ("replayed", made))):
        recalled, rows = side
        rng = generator(spec.seed, Stream.NOISE, recalled.index, recalled.retry)
        draw_frame(axes[0, column], render_frame(spec.observation, recalled.stage, recalled.camera, rng))
        axes[0, column].set_title(f"{name}: RGB frame, target outlined")
        _draw_plan(axes[1, column], recalled, rows, centre, row)
        axes[1, column].set_title(f"{name}: candidates by label")
    _draw_over(axes[0, 2], stored[0], made[0], centre)
    axes[1, 2].set_axis_off()
    axes[1, 2].text(
        0.0, 1.0, "\n".join(_lines(report)), va="top", family="monospace", fontsize=10,
        transform=axes[1, 2].transAxes,
    )  # fmt: skip
    figure.savefig(out)


def _draw_plan(axes: Axes, recalled: RecalledScene, rows: SceneRows, centre: Any, row: int | None) -> None:
    xy = np.asarray(rows.samples["base_xy_m"], np.float64)
    draw_house(axes, recalled.house.house)
    draw_objects(axes, object_outlines(recalled))
    draw_camera(axes, recalled.camera)
    draw_labels(axes, xy, np.asarray(rows.samples["label"]), np.asarray(rows.samples["base_is_clear"]))
    if row is not None:
        axes.plot(*xy[row], marker="*", ms=22, color="gold", mec="black", zorder=10, label="this sample")
    gap = np.abs(recalled.camera.T_world_camera[:2, 3] - centre[:2]).max()
    frame_axes(axes, centre, max(1.35, float(gap) + 0.3))
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, fontsize=8, frameon=False, markerscale=0.7
    )


def _draw_over(axes: Axes, stored: RecalledScene, made: RecalledScene, centre: Any) -> None:
    """Draw both on one plan: where they are equal, the dashes cover the blue."""
    for recalled, style, colour, name in (
        (stored, "-", "#2f6fdd", "stored"),
        (made, "--", "#d6204e", "replayed"),
    ):
        for k, outline in enumerate(object_outlines(recalled)):
            closed = np.vstack([outline, outline[:1]])
            label = name if k == 0 else None
            axes.plot(*closed.T, ls=style, color=colour, lw=1.8 if style == "-" else 1.4, label=label)
    frame_axes(axes, centre, 0.45)
    axes.set_title("objects from above: stored, and replayed over it")
    axes.legend(loc="upper right", fontsize=8)


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
    for title, key in (("replayed from seeds", "stages"), ("from stored poses", "recomputed")):
        lines.append(title)
        for stage in report[key]:
            names = ", ".join(d["field"] for d in stage["differences"])
            lines.append(f"  {stage['stage']:<12}{'equal' if stage['equal'] else f'differs: {names}'[:50]}")
        if not report[key]:
            lines.append("  not possible: the run of --scenes-from is missing")
    return lines
