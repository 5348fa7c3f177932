"""A stored scene to draw, and its picture: frame, floor plans by label or outcome and by score, numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from datagen.display.figures import draw_frame, new_sheet, save_sheet, write_facts
from datagen.display.styles import BEST, BEST_BY_SCORE
from datagen.drawing.floor_plan import (
    draw_base,
    draw_candidates,
    draw_legend,
    draw_pick,
    draw_plan,
    draw_scores,
)
from datagen.schemas.fields import OUTCOMES, REDRAW_CAUSES, SceneRows
from datagen.schemas.specification import Specification
from datagen.workers.bases.candidates import footprint_of
from datagen.workers.geometry.mesh import F64
from datagen.workers.rendering import Frame
from datagen.workers.scenes.generate import noise_of, render_frame
from datagen.workers.scenes.reconstruct import ReconstructedScene

Columns = Mapping[str, Any]
Lines = list[tuple[str, str]]  # printed next to a picture

# Where the target is, by the code of its place.
_WHERE = ("on", "on a board of", "inside", "on", "on the floor by", "in")
_MOST_ROBOTS = 4
_SIDES = 49  # of a drawn circle
_PLANS_IN = 3.7  # height of the upper half


@dataclass(frozen=True, eq=False)
class Shown:
    """A scene of a run: its rows, and the scene reconstructed from them."""

    run: str
    spec: Specification
    rows: SceneRows
    recalled: ReconstructedScene

    @property
    def samples(self) -> Columns:
        """The candidates, one row each."""
        return self.rows.samples

    @property
    def title(self) -> str:
        return f"Scene {self.recalled.index} of {self.run}: {self.target}"

    @property
    def target(self) -> str:
        record = self.rows.record
        where = _WHERE[int(record.get("place", 0))]
        return f"{self.recalled.models[0].name} {where} {record['support_type']}, {record['room_type']}"

    @cached_property
    def frame(self) -> Frame:
        """The RGB-D frame, rendered again."""
        rng = noise_of(self.recalled, str(self.rows.record["room_id"]), self.spec)
        return render_frame(self.spec.observation, self.recalled.geometry, self.recalled.camera, rng)

    def position_text(self, row: int) -> str:
        x, y = self.samples["base_xy_m"][row]
        return f"({x:.3f}, {y:.3f}) m"

    def base_polygon_m(self, row: int) -> F64:
        """Outline (K, 2) of a candidate's base around its mount, x ahead."""
        footprint, angle = footprint_of(self.spec.candidates), np.linspace(0, 2 * np.pi, _SIDES)
        if footprint is not None:
            return footprint.polygon_m
        radius_m = float(self.spec.candidates.radius_of_base_m(self.samples["arm_reach_m"][row]))
        return radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def draw_scene_picture(shown: Shown, out: Path) -> Lines:
    """Write the picture of a scene; return its positives and its best base poses."""
    samples, tau = shown.samples, shown.spec.heuristic.tau
    xy, score = np.asarray(samples["base_xy_m"], np.float64), np.asarray(samples["heuristic_score"])
    figure = new_sheet(shown.title, 2 * _PLANS_IN)
    grid = figure.add_gridspec(2, 1)
    upper, lower = (figure.add_subfigure(grid[k]) for k in range(2))
    frame_ax, label_ax, score_ax = upper.subplots(1, 3, width_ratios=(1.05, 1, 1))
    draw_frame(frame_ax, shown.frame.rgb, shown.frame.body == 1)
    marks = draw_plan(label_ax, shown.recalled, xy)
    draw_plan(score_ax, shown.recalled, xy)
    legend = draw_candidates(label_ax, samples)
    scale = draw_scores(score_ax, xy, score, tau)
    upper.colorbar(scale, ax=[label_ax, score_ax], shrink=0.8, label=f"H (good from {tau:.2g} on)")
    picks = [(row, style) for row, style in _picks(samples).values() if row is not None]
    for row, style in picks:
        draw_base(label_ax, shown.base_polygon_m(row), xy[row], float(samples["base_yaw_rad"][row]), style)
        draw_pick(label_ax, xy[row], style)
        legend.append(draw_pick(score_ax, xy[row], style))
    label_ax.set_title("candidates by outcome" if "outcome" in samples else "candidates by label")
    score_ax.set_title("candidates by score H")
    facts_ax, legend_ax = lower.subplots(1, 2, width_ratios=(1.15, 1))
    positive = f"{int(samples['label'].sum())} of {len(samples['label'])} candidates"
    best = [(head, _described(shown, row)) for head, (row, _) in _picks(samples).items()]
    texts_in = (
        write_facts(facts_ax, [*_facts(shown), ("positive", positive), *best]),
        draw_legend(legend_ax, [*legend, *marks]),
    )
    # As high as its longer text: four robots and a dozen outcomes need twice the room of a short list.
    grid.set_height_ratios((_PLANS_IN, max(texts_in)))
    figure.set_figheight(_PLANS_IN + max(texts_in))
    save_sheet(figure, out)
    return [("positive", positive), *best]


def best_success(samples: Columns) -> int | None:
    """Row of the best success, or None: most lifts, then fewest grasps, then the widest clearance."""
    rows = np.flatnonzero(samples["outcome"] == tuple(OUTCOMES).index("success"))
    if not len(rows):
        return None
    keys = [-samples["path_clearance_m"][rows]]
    if "attempts" in samples:
        share = samples["successes"][rows] / np.maximum(samples["trials"][rows], 1)
        keys += [samples["attempts"][rows], -share]
    return int(rows[np.lexsort(keys)[0]])


def _picks(samples: Columns) -> dict[str, tuple[int | None, Any]]:
    """The clear candidate of the highest score and, of an arm's labels, the best success."""
    clear = np.flatnonzero(samples["base_is_clear"])
    highest = int(clear[np.argmax(np.asarray(samples["heuristic_score"])[clear])]) if len(clear) else None
    picks: dict[str, tuple[int | None, Any]] = {"highest H": (highest, BEST_BY_SCORE)}
    return picks | ({"best success": (best_success(samples), BEST)} if "outcome" in samples else {})


def _described(shown: Shown, row: int | None) -> str:
    if row is None:
        return "none"
    samples = shown.samples
    text = f"candidate {row} at {shown.position_text(row)}, H {samples['heuristic_score'][row]:.2f}"
    return f"{text}: {tuple(OUTCOMES)[samples['outcome'][row]]}" if "outcome" in samples else text


def _facts(shown: Shown) -> Lines:
    """House, objects, settling and robots of a scene."""
    record, models, samples = shown.rows.record, shown.recalled.models, shown.samples
    height_m = float(np.asarray(record["T_world_support"])[2, 3])
    rejected = zip(REDRAW_CAUSES, np.asarray(record["redraws"]), strict=True)
    sizes = zip(samples["arm_reach_m"], samples["base_height_m"], strict=True)
    robots = list(dict.fromkeys(f"reach {r:.2f} m, mount {h:.2f} m high" for r, h in sizes))
    more = [f"and {len(robots) - _MOST_ROBOTS} more"] if len(robots) > _MOST_ROBOTS else []
    return [
        ("house", f"{record['house_id']}, {record['room_type']}"),
        ("support", f"{record['support_type']}, {height_m:.2f} m high"),
        ("target", f"{models[0].name}, {100 * float(record['target_visible_fraction']):.0f}% visible"),
        ("clutter", ", ".join(m.name for m in models[1:]) or "none"),
        ("settled", f"in {int(record['settle_steps'])} steps"),
        ("rejected tries", ", ".join(f"{cause} {n}" for cause, n in rejected if n) or "none"),
        *(("" if k else "robot", text) for k, text in enumerate([*robots[:_MOST_ROBOTS], *more])),
    ]
