"""Picture of a scene with plan or sim labels: frame, outcome map, score map, grasps, numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from datagen.drawing.floor_plan import draw_camera, draw_house, draw_objects, draw_scores, frame_axes
from datagen.drawing.grasp_views import draw_grasps, support_sheet, used_grasps
from datagen.drawing.outcome_colours import LOOKS
from datagen.drawing.outcome_map import draw_outcome_legend, draw_outcomes, draw_pick, draw_reach
from datagen.drawing.scene_picture import best_clear, draw_frame, object_outlines, wrapped
from datagen.schemas.outcomes import OUTCOMES
from datagen.workers.rendering.frame import Frame
from datagen.workers.robots.robot import Robot
from datagen.workers.scenes.recall import RecalledScene

Columns = Mapping[str, Any]
_SUCCESS = tuple(OUTCOMES).index("success")
_ROBOTS = 4  # more would overlap
_BEST_COLOUR, _H_COLOUR = "gold", "#49c0f0"


def draw_arm_picture(
    title: str,
    recalled: RecalledScene,
    frame: Frame,
    record: Columns,
    samples: Columns,
    robots: Sequence[Robot],
    out: Path,
) -> None:
    """Write the picture of a scene with `plan` or `sim` labels; `robots` are the first of the scene."""
    figure = Figure(figsize=(20, 12.4), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=14)
    upper, lower = np.asarray(figure.subfigures(2, 1, height_ratios=(1.12, 1))).tolist()
    frame_ax, outcome_ax, score_ax = upper.subplots(1, 3, width_ratios=(1.0, 1, 1.12))
    draw_frame(frame_ax, frame)
    _draw_maps(upper, outcome_ax, score_ax, recalled, record, samples, robots)

    parts = np.asarray(lower.subfigures(1, 3, width_ratios=(1.75, 1.15, 1.25)))
    grasps, legend, numbers = parts.tolist()
    views = grasps.subplots(1, 2)
    used = used_grasps(samples["T_target_tcp"][samples["outcome"] == _SUCCESS])
    sheet = support_sheet(np.asarray(record["T_world_support"]), np.asarray(record["support_size_m"]))
    scale = draw_grasps((views[0], views[1]), recalled, sheet, robots[0].gripper, used)
    if scale is None:
        views[0].set_xlabel("no grasp succeeded")
    else:
        views[0].set_xlabel(f"{len(used.count)} different grasps in {int(used.count.sum())} successes")
        grasps.colorbar(
            scale,
            ax=views,
            location="bottom",
            shrink=0.5,
            label="successes with this grasp",
            ticks=MaxNLocator(integer=True),
        )
    draw_outcome_legend(legend.subplots(), samples["outcome"])
    _write_numbers(numbers.subplots(), recalled, record, samples, robots)
    figure.savefig(out)


def best_success(samples: Columns) -> int | None:
    """Row of the best success, or None: most lifts, then fewest grasps, then the widest clearance."""
    rows = np.flatnonzero(samples["outcome"] == _SUCCESS)
    if not len(rows):
        return None
    keys = [-samples["path_clearance_m"][rows]]
    if "trials" in samples:
        share = samples["successes"][rows] / np.maximum(samples["trials"][rows], 1)
        keys += [samples["attempts"][rows], -share]
    return int(rows[np.lexsort(keys)[0]])


def reach_radius_m(robot: Robot, target_height_m: float) -> float:
    """Largest horizontal distance (m) from mount to target within the arm's reach."""
    rise_m = target_height_m - robot.base_height_m - float(robot.shoulder_m[2])
    # The robot faces the target, so a shoulder in front of the mount adds to the reach.
    return float(np.sqrt(max(robot.reach_m**2 - rise_m**2, 0.0)) + robot.shoulder_m[0])


def _draw_maps(
    figure: Any,
    outcome_ax: Axes,
    score_ax: Axes,
    recalled: RecalledScene,
    record: Columns,
    samples: Columns,
    robots: Sequence[Robot],
) -> None:
    centre = np.asarray(record["target_center_m"], np.float64)
    xy = np.asarray(samples["base_xy_m"], np.float64)
    outlines = object_outlines(recalled)
    half = float(np.abs(xy - centre[:2]).max()) + 0.12
    for axes in (outcome_ax, score_ax):
        draw_house(axes, recalled.house.house)
        draw_objects(axes, outlines)
        draw_camera(axes, recalled.camera)
        frame_axes(axes, centre, half)
        axes.set_anchor("N")
    draw_outcomes(outcome_ax, xy, samples["outcome"], samples["base_is_clear"])
    scale = draw_scores(score_ax, xy, samples["heuristic_score"], None)
    best, by_h = best_success(samples), best_clear(samples["heuristic_score"], samples["base_is_clear"])
    for axes in (outcome_ax, score_ax):
        for robot in robots:
            draw_reach(axes, centre[:2], reach_radius_m(robot, float(centre[2])))
        if by_h is not None:
            draw_pick(axes, xy[by_h], _H_COLOUR, "highest H that is clear")
        if best is not None:
            draw_pick(axes, xy[best], _BEST_COLOUR, "best success")
        axes.plot([], [], ls=(0, (5, 3)), color="#1b3a6b", label="reach")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=4, fontsize=9, frameon=False)
    outcome_ax.set_title("candidates by outcome")
    score_ax.set_title("the same candidates by the heuristic's score H")
    figure.colorbar(scale, ax=score_ax, shrink=0.7, label="H")


def _write_numbers(
    axes: Axes, recalled: RecalledScene, record: Columns, samples: Columns, robots: Sequence[Robot]
) -> None:
    axes.set_axis_off()
    label, by_h = np.asarray(samples["label"]), np.asarray(samples["heuristic_label"])
    clear = np.asarray(samples["base_is_clear"])
    others = len(np.unique(samples["robot_index"])) - len(robots)
    called = by_h.astype(bool) & clear
    positive = int(label.sum())
    inside = samples["outcome"] != tuple(OUTCOMES).index("out_of_reach")
    near = clear & inside
    target, height_m = recalled.models[0], float(np.asarray(record["T_world_support"])[2, 3])
    lines = [
        f"house      {record['house_id']}",
        f"room       {record['room_type']} ({record['room_id']})",
        f"support    {record['support_type']}, {height_m:.3f} m high",
        f"target     {target.name}, {1000 * target.mass_kg:.0f} g",
        *wrapped("clutter    ", ", ".join(m.name for m in recalled.models[1:]), 56),
        *(f"robot      {r.name}, reach {r.reach_m:.2f} m, mount {r.base_height_m:.2f} m" for r in robots[:4]),
        *([f"           and {others} more"] if others else []),
        "",
        f"candidates {len(label)}, of them {int(clear.sum())} clear, {int(near.sum())} clear and in reach",
        f"positive   {positive} ({100 * label.mean():.1f}%)",
        f"           {100 * label[near].mean() if near.any() else 0:.0f}% of those clear and in reach",
        f"H calls    {int(called.sum())} clear ones good, right in {int((called & label).sum())}",
        f"           misses {int((label & ~called).sum())} of the {positive} positive",
        "",
        *_picked("best       ", best_success(samples), samples),
        *_picked("highest H  ", best_clear(samples["heuristic_score"], clear), samples),
    ]
    axes.text(0.0, 1.0, "\n".join(lines), va="top", family="monospace", fontsize=10, transform=axes.transAxes)


def _picked(head: str, row: int | None, samples: Columns) -> list[str]:
    """Lines on the outcome of one candidate."""
    if row is None:
        return [f"{head}none"]
    x, y = samples["base_xy_m"][row]
    name = tuple(OUTCOMES)[int(samples["outcome"][row])]
    lines = [f"{head}candidate {row} at ({x:.2f}, {y:.2f}) m, H {samples['heuristic_score'][row]:.2f}"]
    lines.append(f"           {name}: {LOOKS[name].words}")
    path_rad, clear_cm = samples["path_length_rad"][row], 100 * samples["path_clearance_m"][row]
    facts = [f"path {path_rad:.1f} rad long, {clear_cm:.1f} cm clear"]
    if "trials" in samples and samples["trials"][row]:
        facts.append(f"lifted {int(samples['successes'][row])} of {int(samples['trials'][row])} times")
        facts.append(
            f"lift {100 * samples['lift_m'][row]:.1f} cm, slip {100 * samples['slip_m'][row]:.1f} cm"
        )
    if path_rad > 0:
        lines += [f"           {fact}" for fact in facts]
    return lines


def robots_of(samples: Columns) -> list[tuple[float, float]]:
    """Reach and mount height of the first robots among the candidates, in the order of `robot_index`."""
    _, rows = np.unique(np.asarray(samples["robot_index"]), return_index=True)
    reach_m, height_m = samples["arm_reach_m"], samples["base_height_m"]
    return [(float(reach_m[row]), float(height_m[row])) for row in rows[:_ROBOTS]]
