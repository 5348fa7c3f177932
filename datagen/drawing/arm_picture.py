"""One picture of a scene labelled by an arm: frame, maps of outcomes and of scores, grasps, numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from datagen.display.figures import draw_frame, new_sheet, save_sheet, write_facts
from datagen.display.styles import BEST, BEST_BY_SCORE, Style
from datagen.drawing.floor_plan import (
    Handle,
    draw_legend,
    draw_outcomes,
    draw_pick,
    draw_plan,
    draw_reach,
    draw_scores,
)
from datagen.drawing.grasp_views import draw_grasps, support_sheet, used_grasps
from datagen.drawing.scene_picture import Columns, Lines, Shown, best_clear, positives, scene_facts
from datagen.schemas.outcomes import OUTCOMES
from datagen.workers.robots import open_robot

if TYPE_CHECKING:  # the heuristic's pictures need no library of arms
    from datagen.workers.robots.robot import Robot

_SUCCESS = tuple(OUTCOMES).index("success")
_PICKS = ("highest H", "best")
_ROBOTS = 4  # more circles and lines would hide each other


def draw_arm_picture(shown: Shown, out: Path) -> Lines:
    """Write the picture of a scene of `plan` or `sim`; return its positives and its best success."""
    samples, robots = shown.samples, _robots_of(shown)
    figure = new_sheet(shown.title, 9.2)
    upper, lower, numbers = np.asarray(figure.subfigures(3, 1, height_ratios=(3.6, 3.7, 1.75))).tolist()
    frame_ax, outcome_ax, score_ax = upper.subplots(1, 3, width_ratios=(1.05, 1, 1))
    draw_frame(frame_ax, shown.frame.rgb, shown.frame.body == 1)
    handles, picks = _draw_maps(upper, outcome_ax, score_ax, shown, robots)
    views, legend = np.asarray(lower.subfigures(1, 2, width_ratios=(1.75, 1))).tolist()
    _draw_grasps(views, shown, robots[0])
    draw_legend(legend.subplots(), handles, "base poses: filled where the base fits", picks)
    columns = numbers.subplots(1, 2)
    write_facts(columns[0], scene_facts(shown) + _robots(samples, robots))
    write_facts(columns[1], _candidates(samples))
    save_sheet(figure, out)
    best = best_success(samples)
    words = "none" if best is None else f"candidate {best} at {shown.position_text(best)}"
    return [positives(samples), ("best success", words)]


def _robots_of(shown: Shown) -> list[Robot]:
    """The first robots of the candidates, in the order of `robot_index`."""
    samples, arm = shown.samples, shown.spec.arm
    assert arm is not None
    _, rows = np.unique(np.asarray(samples["robot_index"]), return_index=True)
    reach_m, height_m = samples["arm_reach_m"], samples["base_height_m"]
    return [open_robot(arm.robot, float(reach_m[row]), float(height_m[row])) for row in rows[:_ROBOTS]]


def best_success(samples: Columns) -> int | None:
    """Row of the best success, or None: most lifts, then fewest grasps, then the widest clearance."""
    rows = np.flatnonzero(samples["outcome"] == _SUCCESS)
    if not len(rows):
        return None
    keys = [-samples["path_clearance_m"][rows]]
    if "attempts" in samples:
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
    shown: Shown,
    robots: Sequence[Robot],
) -> tuple[list[Handle], list[Style]]:
    """Draw candidates by outcome and by score; returns the legend of both, and the picks."""
    recalled, samples, tau = shown.recalled, shown.samples, shown.spec.heuristic.tau
    centre = recalled.target_center_m
    xy = np.asarray(samples["base_xy_m"], np.float64)
    half_m = float(np.abs(xy - centre[:2]).max()) + 0.12
    draw_plan(outcome_ax, recalled, half_m, faded=True)
    seen = draw_plan(score_ax, recalled, half_m)
    handles = draw_outcomes(outcome_ax, xy, samples["outcome"], samples["base_is_clear"])
    scale = draw_scores(score_ax, xy, samples["heuristic_score"], tau)
    figure.colorbar(scale, ax=[outcome_ax, score_ax], shrink=0.8, label=f"H (good from {tau:.2g} on)")
    reach = [
        (f"{robot.name} {k}" if len(robots) > 1 else robot.name, reach_radius_m(robot, float(centre[2])))
        for k, robot in enumerate(robots)
    ]
    marked = [(row, style) for row, style in _picked(samples) if row is not None]
    for axes in (outcome_ax, score_ax):
        circles = draw_reach(axes, centre[:2], reach)
        for row, style in marked:
            draw_pick(axes, xy[row], style)
    outcome_ax.set_title("candidates by outcome")
    score_ax.set_title("candidates by score H")
    return handles + circles, [style for _, style in marked] + seen


def _draw_grasps(figure: Any, shown: Shown, robot: Robot) -> None:
    record, samples = shown.rows.record, shown.samples
    views = figure.subplots(1, 2)
    used = used_grasps(samples["T_target_tcp"][samples["outcome"] == _SUCCESS])
    sheet = support_sheet(np.asarray(record["T_world_support"]), np.asarray(record["support_size_m"]))
    scale = draw_grasps((views[0], views[1]), shown.recalled, sheet, robot.gripper, used)
    if scale is None:
        views[0].set_xlabel("none succeeded")
        return
    words = (
        f"candidates that succeed with a grasp ({len(used.count)} grasps, {int(used.count.sum())} successes)"
    )
    ticks = MaxNLocator(integer=True)
    figure.colorbar(scale, ax=views, location="bottom", shrink=0.6, aspect=35, label=words, ticks=ticks)


def _picked(samples: Columns) -> list[tuple[int | None, Style]]:
    by_score = best_clear(samples["heuristic_score"], samples["base_is_clear"])
    return [(by_score, BEST_BY_SCORE), (best_success(samples), BEST)]


def _robots(samples: Columns, robots: Sequence[Robot]) -> Lines:
    facts = [
        (f"robot {k}", f"{robot.name}, reach {robot.reach_m:.2f} m, mount {robot.base_height_m:.2f} m high")
        for k, robot in enumerate(robots)
    ]
    others = len(np.unique(samples["robot_index"])) - len(robots)
    return facts + ([("", f"and {others} more robots")] if others else [])


def _candidates(samples: Columns) -> Lines:
    label, clear = np.asarray(samples["label"]), np.asarray(samples["base_is_clear"])
    called = np.asarray(samples["heuristic_label"]).astype(bool) & clear
    near = clear & (samples["outcome"] != tuple(OUTCOMES).index("out_of_reach"))
    good, share = int(label.sum()), 100 * label[near].mean() if near.any() else 0.0
    missed = int((label & ~called).sum())
    return [
        (
            "candidates",
            f"{len(label)}, {int(clear.sum())} where the base fits, {int(near.sum())} also in reach",
        ),
        ("successes", f"{good} ({100 * label.mean():.1f}%; {share:.0f}% where the base fits, in reach)"),
        (
            "H",
            f"calls {int(called.sum())} good, {int((called & label).sum())} are; misses {missed} of {good}",
        ),
        *((head, _described(samples, row)) for head, (row, _) in zip(_PICKS, _picked(samples), strict=True)),
    ]


def _described(samples: Columns, row: int | None) -> str:
    if row is None:
        return "none"
    x, y = samples["base_xy_m"][row]
    name = tuple(OUTCOMES)[int(samples["outcome"][row])]
    text = f"candidate {row} at ({x:.2f}, {y:.2f}) m, H {samples['heuristic_score'][row]:.2f}: {name}"
    path_rad, clear_cm = samples["path_length_rad"][row], 100 * samples["path_clearance_m"][row]
    if path_rad > 0:
        text += f"; path {path_rad:.1f} rad long, {clear_cm:.1f} cm clear"
        if "lift_m" in samples and samples["trials"][row]:
            lift_cm, slip_cm = (100 * samples[key][row] for key in ("lift_m", "slip_m"))
            text += f"; lifted {int(samples['successes'][row])} of {int(samples['trials'][row])} times, "
            text += f"lift {lift_cm:.1f} cm, slip {slip_cm:.1f} cm"
    return text
