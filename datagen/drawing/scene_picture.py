"""One picture that explains a scene: frame, depth, floor plans, cloud and numbers."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from datagen.drawing.floor_plan import (
    draw_camera,
    draw_house,
    draw_labels,
    draw_objects,
    draw_scores,
    frame_axes,
)
from datagen.schemas.outcomes import REDRAW_CAUSES
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.planar import convex_hull
from datagen.workers.rendering.frame import Frame
from datagen.workers.scenes.recall import RecalledScene

Columns = Mapping[str, Any]


def draw_scene_picture(
    title: str, recalled: RecalledScene, frame: Frame, record: Columns, samples: Columns, out: Path
) -> None:
    """Write the picture of a scene; `samples` are its candidates, one row each."""
    figure = Figure(figsize=(19, 11), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3, width_ratios=(1.3, 1, 1.12))
    figure.suptitle(title, fontsize=14)
    draw_frame(axes[0, 0], frame)
    _draw_depth(figure, axes[1, 0], frame)

    centre = np.asarray(record["target_center_m"], np.float64)
    outlines = object_outlines(recalled)
    xy = np.asarray(samples["base_xy_m"], np.float64)
    camera_gap = np.abs(recalled.camera.T_world_camera[:2, 3] - centre[:2]).max()
    half = max(1.35, float(camera_gap) + 0.3)
    for ax in (axes[0, 1], axes[0, 2]):
        draw_house(ax, recalled.house.house)
        draw_objects(ax, outlines)
        draw_camera(ax, recalled.camera)
        frame_axes(ax, centre, half)
    clear = np.asarray(samples["base_is_clear"])
    draw_labels(axes[0, 1], xy, np.asarray(samples["label"]), clear)
    axes[0, 1].set_title("candidates by label")
    axes[0, 1].legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3, fontsize=8, frameon=False)
    score = np.asarray(samples["heuristic_score"])
    scale = draw_scores(axes[0, 2], xy, score, best_clear(score, clear))
    axes[0, 2].set_title("candidates by score H, best clear one in gold")
    figure.colorbar(scale, ax=axes[0, 2], shrink=0.7, label="H")

    axes[1, 1].remove()
    cloud_axes = figure.add_subplot(2, 3, 5, projection="3d")
    _draw_cloud(cloud_axes, record)
    _write_numbers(axes[1, 2], recalled, record, samples)
    figure.savefig(out)


def best_clear(score: Any, clear: Any) -> int | None:
    """Row of the highest score among clear candidates, or None when none is clear."""
    rows = np.flatnonzero(clear)
    return int(rows[np.argmax(score[rows])]) if len(rows) else None


def object_outlines(recalled: RecalledScene) -> list[F64]:
    """Outlines (K, 2) of the placed objects seen from above, world; the first is the target."""
    outlines = []
    for model, T in zip(recalled.models, recalled.T_world_object, strict=True):
        points = np.concatenate(model.convex_parts_m).astype(np.float64)
        outlines.append(convex_hull((points @ T[:3, :3].T + T[:3, 3])[:, :2]))
    return outlines


def draw_frame(axes: Axes, frame: Frame) -> None:
    """The RGB image with the target outlined."""
    axes.imshow(frame.rgb)
    target = frame.body == 1
    if target.any():
        axes.contour(target, levels=[0.5], colors=["#ff2d6f"], linewidths=1.6)
    axes.set_title("RGB frame, target outlined")
    axes.set_axis_off()


def _draw_depth(figure: Figure, axes: Axes, frame: Frame) -> None:
    depth = np.where(frame.depth_m > 0, frame.depth_m, np.nan)
    image = axes.imshow(depth, cmap="magma_r")
    axes.set_title("depth")
    axes.set_axis_off()
    figure.colorbar(image, ax=axes, shrink=0.7, label="m")


def _draw_cloud(axes: Any, record: Columns) -> None:
    n = int(record["n_points"])
    points = np.asarray(record["points_m"][:n], np.float64)
    colours = np.asarray(record["rgb"][:n], np.float64) / 255
    colours[np.asarray(record["target_mask"][:n])] = (0.84, 0.13, 0.31)
    axes.scatter(*points.T, c=colours, s=2, depthshade=False)
    axes.set_box_aspect((1, 1, 1))
    for setter in (axes.set_xlim, axes.set_ylim, axes.set_zlim):
        setter(-1, 1)
    camera = np.asarray(record["T_world_camera"])[:3, 3] - np.asarray(record["target_center_m"])
    axes.view_init(elev=30, azim=float(np.degrees(np.arctan2(camera[1], camera[0]))))
    axes.set_title(f"cloud around the target, {n} points, target in red")


def _write_numbers(axes: Axes, recalled: RecalledScene, record: Columns, samples: Columns) -> None:
    axes.set_axis_off()
    rho, label = np.asarray(samples["visibility"]), np.asarray(samples["label"])
    clear = np.asarray(samples["base_is_clear"])
    counts = np.asarray(record["redraws"])
    redraws = ", ".join(f"{c} {n}" for c, n in zip(REDRAW_CAUSES, counts, strict=True) if n) or "none"
    clutter = ", ".join(m.name for m in recalled.models[1:])
    target, height_m = recalled.models[0], float(np.asarray(record["T_world_support"])[2, 3])
    speed_mm, depth_mm = (1000 * float(record[k]) for k in ("residual_speed_mps", "penetration_m"))
    positive, both = int(label.sum()), int((label * clear).sum())
    low, high = 100 * (rho < 0.04).mean(), 100 * (rho > 0.8).mean()
    lines = [
        f"house      {record['house_id']}",
        f"room       {record['room_type']} ({record['room_id']})",
        f"support    {record['support_type']}, {height_m:.3f} m high",
        f"target     {target.name}, {1000 * target.mass_kg:.0f} g",
        *wrapped("clutter    ", clutter),
        f"settled    {int(record['settle_steps'])} steps, then {speed_mm:.2f} mm/s, {depth_mm:.2f} mm deep",
        f"redraws    {redraws}",
        f"frame      sees {100 * float(record['target_visible_fraction']):.0f}% of the target",
        "",
        f"candidates {len(label)}, of them {int(clear.sum())} clear",
        f"positive   {positive} ({100 * label.mean():.0f}%), clear and positive {both}",
        f"rho        below 0.04: {low:.0f}%   0.04-0.8: {100 - low - high:.0f}%   above 0.8: {high:.0f}%",
        *_robots(samples),
    ]
    axes.text(0.0, 1.0, "\n".join(lines), va="top", family="monospace", fontsize=10, transform=axes.transAxes)


def wrapped(head: str, text: str, width: int = 62) -> list[str]:
    """Text in lines of about `width` characters behind a head."""
    indent = " " * len(head)
    return textwrap.wrap(text, width, initial_indent=head, subsequent_indent=indent, break_on_hyphens=False)


def _robots(samples: Columns) -> list[str]:
    robots, rows = np.unique(np.asarray(samples["robot_index"]), return_index=True)
    lines = [
        f"robot {robot:<4} camera {samples['camera_height_m'][row]:.2f} m, "
        f"mount {samples['base_height_m'][row]:.2f} m, reach {samples['arm_reach_m'][row]:.2f} m"
        for robot, row in zip(robots[:6], rows[:6], strict=True)
    ]
    return lines + ([f"... and {len(robots) - 6} more robots"] if len(robots) > 6 else [])
