"""A stored scene to draw, and its picture for heuristic labels: frame, depth, floor plans, cloud, numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from mpl_toolkits.mplot3d import Axes3D

from datagen.display.figures import draw_frame, new_sheet, save_sheet, write_facts
from datagen.display.styles import BEST_BY_SCORE, TARGET
from datagen.drawing.floor_plan import (
    draw_labels,
    draw_legend,
    draw_pick,
    draw_plan,
    draw_scores,
    half_width_m,
)
from datagen.schemas.fields import SceneRows
from datagen.schemas.identity import Stream, generator
from datagen.schemas.outcomes import REDRAW_CAUSES
from datagen.schemas.specification import Specification
from datagen.workers.rendering import Frame
from datagen.workers.scenes.generate import render_frame
from datagen.workers.scenes.reconstruct import ReconstructedScene

Columns = Mapping[str, Any]
Lines = list[tuple[str, str]]  # printed next to a picture


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

    @cached_property
    def frame(self) -> Frame:
        """The RGB-D frame, rendered again."""
        rng = generator(self.spec.seed, Stream.NOISE, self.recalled.index, self.recalled.retry)
        return render_frame(self.spec.observation, self.recalled.geometry, self.recalled.camera, rng)

    def position_text(self, row: int) -> str:
        """Position of a candidate's base as text."""
        x, y = self.samples["base_xy_m"][row]
        return f"({x:.3f}, {y:.3f}) m"

    @property
    def target(self) -> str:
        record = self.rows.record
        return f"{self.recalled.models[0].name} on {record['support_type']}, {record['room_type']}"


def draw_scene_picture(shown: Shown, out: Path) -> Lines:
    """Write the picture of a scene; return its positives and its best base."""
    recalled, record, samples = shown.recalled, shown.rows.record, shown.samples
    tau = shown.spec.heuristic.tau
    figure = new_sheet(shown.title, 8.0)
    upper, lower = np.asarray(figure.subfigures(2, 1, height_ratios=(6.4, 1.6))).tolist()
    panels = upper.subplots(2, 3, width_ratios=(1.1, 1, 1))
    draw_frame(panels[0, 0], shown.frame.rgb, shown.frame.body == 1)
    _draw_depth(upper, panels[1, 0], shown.frame)

    xy = np.asarray(samples["base_xy_m"], np.float64)
    marks = draw_plan(panels[0, 1], recalled, half_width_m(recalled))
    draw_plan(panels[0, 2], recalled, half_width_m(recalled))
    score, clear = np.asarray(samples["heuristic_score"]), np.asarray(samples["base_is_clear"])
    legend = draw_labels(panels[0, 1], xy, np.asarray(samples["label"]), clear)
    panels[0, 1].set_title("candidates by label")
    scale = draw_scores(panels[0, 2], xy, score, tau)
    panels[0, 2].set_title("candidates by score H")
    upper.colorbar(scale, ax=panels[0, 1:].tolist(), shrink=0.75, label=f"H (good from {tau:.2g} on)")
    best = best_clear(score, clear)
    if best is not None:
        draw_pick(panels[0, 2], xy[best], BEST_BY_SCORE)

    panels[1, 1].remove()
    _draw_cloud(upper.add_subplot(2, 3, 5, projection="3d"), record)
    draw_legend(panels[1, 2], legend, "base poses", marks if best is None else [BEST_BY_SCORE, *marks])
    columns = lower.subplots(1, 2)
    write_facts(columns[0], _scene(shown))
    write_facts(columns[1], _candidates(samples))
    save_sheet(figure, out)
    words = "none is clear" if best is None else f"{shown.position_text(best)}, H = {score[best]:.3f}"
    return [positives(samples), ("best clear base", words)]


def positives(samples: Columns) -> tuple[str, str]:
    """The number of positive candidates, as (heading, text)."""
    return "positive", f"{int(samples['label'].sum())} of {len(samples['label'])} candidates"


def best_clear(score: Any, clear: Any) -> int | None:
    """Row of the highest score among clear candidates, or None when none is clear."""
    rows = np.flatnonzero(clear)
    return int(rows[np.argmax(score[rows])]) if len(rows) else None


def scene_facts(shown: Shown) -> Lines:
    """House, room, support and objects of a scene."""
    record, models = shown.rows.record, shown.recalled.models
    height_m = float(np.asarray(record["T_world_support"])[2, 3])
    return [
        ("house", str(record["house_id"])),
        ("room", f"{record['room_type']} ({record['room_id']})"),
        ("support", f"{record['support_type']}, {height_m:.3f} m high"),
        ("target", f"{models[0].name}, {1000 * models[0].mass_kg:.0f} g"),
        ("clutter", ", ".join(m.name for m in models[1:]) or "none"),
    ]


def _draw_depth(figure: Any, axes: Axes, frame: Frame) -> None:
    depth = np.where(frame.depth_m > 0, frame.depth_m, np.nan)
    image = axes.imshow(depth, cmap="magma_r")
    axes.set_title("depth")
    axes.set_axis_off()
    figure.colorbar(image, ax=axes, location="bottom", shrink=0.8, aspect=30, pad=0.03, label="depth [m]")


def _draw_cloud(axes: Axes3D, record: Columns) -> None:
    n = int(record["n_points"])
    points = np.asarray(record["points_m"][:n], np.float64)
    colours = np.asarray(record["rgb"][:n], np.float64) / 255
    mask = np.asarray(record["target_mask"][:n])
    axes.scatter(*points[~mask].T, c=colours[~mask], s=2, lw=0, depthshade=False)
    axes.scatter(*points[mask].T, c=TARGET.colour, s=2, lw=0, depthshade=False)
    low, high = points.min(axis=0), points.max(axis=0)
    axes.set_box_aspect(1.15 * (high - low))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axes.locator_params(nbins=4)
    camera = np.asarray(record["T_world_camera"])[:3, 3] - np.asarray(record["target_center_m"])
    axes.view_init(elev=30, azim=float(np.degrees(np.arctan2(camera[1], camera[0]))))
    axes.set_title(f"cloud around the target, {n:,} points")


def _scene(shown: Shown) -> Lines:
    record = shown.rows.record
    counts = zip(REDRAW_CAUSES, np.asarray(record["redraws"]), strict=True)
    speed_mm, depth_mm = (1000 * float(record[k]) for k in ("residual_speed_mps", "penetration_m"))
    steps, seen = int(record["settle_steps"]), float(record["target_visible_fraction"])
    return [
        *scene_facts(shown),
        ("settled", f"{steps} steps, then {speed_mm:.2f} mm/s, penetration {depth_mm:.2f} mm"),
        ("resampled", ", ".join(f"{cause} {n}" for cause, n in counts if n) or "never"),
        ("frame", f"{100 * seen:.0f}% of the target visible"),
    ]


def _candidates(samples: Columns) -> Lines:
    rho, label = np.asarray(samples["visibility"]), np.asarray(samples["label"])
    clear = np.asarray(samples["base_is_clear"])
    low, high = 100 * (rho < 0.04).mean(), 100 * (rho > 0.8).mean()
    good = f"{int(label.sum())} ({100 * label.mean():.0f}%), {int((label * clear).sum())} where the base fits"
    robots, rows = np.unique(np.asarray(samples["robot_index"]), return_index=True)
    return [
        ("candidates", f"{len(label)}, {int(clear.sum())} where the base fits"),
        ("good", good),
        ("visibility", f"< 0.04: {low:.0f}%, 0.04 to 0.8: {100 - low - high:.0f}%, > 0.8: {high:.0f}%"),
        *(
            (
                f"robot {robot}",
                f"camera {samples['camera_height_m'][row]:.2f} m, "
                f"mount {samples['base_height_m'][row]:.2f} m, reach {samples['arm_reach_m'][row]:.2f} m",
            )
            for robot, row in zip(robots[:5], rows[:5], strict=True)
        ),
        *([("", f"and {len(robots) - 5} more robots")] if len(robots) > 5 else []),
    ]
