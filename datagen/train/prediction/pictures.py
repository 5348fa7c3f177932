"""One picture of a prediction: the frame with its target, the scored grid from above and in perspective."""

from __future__ import annotations

import textwrap
from typing import IO, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.path import Path
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from datagen.display.figures import draw_frame, new_sheet, save_sheet, write_facts
from datagen.display.styles import BEST, CAMERA, SCORE_COLOURS, TARGET
from datagen.train.inputs import F64
from datagen.train.prediction.base_cells import BLOCKED, CLEAR, STATES, UNREACHABLE, UNSEEN
from datagen.train.prediction.predict import Prediction
from datagen.train.prediction.prediction_report import report_rows

_EDGE = {CLEAR: "#222222", UNSEEN: "none", BLOCKED: "none", UNREACHABLE: "none"}
_ALPHA = {CLEAR: 1.0, UNSEEN: 0.6, BLOCKED: 0.9, UNREACHABLE: 0.9}
_SHARE = {CLEAR: 0.92, UNSEEN: 0.92, BLOCKED: 0.3, UNREACHABLE: 0.3}  # of a cell's side
_MARK = {CLEAR: "s", UNSEEN: "s", BLOCKED: "s", UNREACHABLE: "D"}
_MOST_POINTS = 3_000


def draw_prediction(prediction: Prediction, out: IO[bytes]) -> None:
    """Write the picture as PNG: frame and plan above, numbers and perspective view below."""
    title = textwrap.fill(f"Base poses scored by {prediction.scorer}: {prediction.sure}", 80)
    figure = new_sheet(title, 8.8)
    left, right = np.asarray(figure.subfigures(1, 2, width_ratios=(1, 1.15))).tolist()
    frame, facts = left.subplots(2, 1, height_ratios=(1, 1.1))
    _draw_frame(frame, prediction)
    write_facts(facts, report_rows(prediction), head_characters=9)
    upper, lower = np.asarray(right.subfigures(2, 1, height_ratios=(1.45, 1))).tolist()
    plan = upper.subplots()
    upper.colorbar(_draw_plan(plan, prediction), ax=plan, shrink=0.75, label="score (0 bad, 1 good)")
    _draw_perspective(lower.add_subplot(projection="3d"), prediction)
    save_sheet(figure, out)


def shown_rows(prediction: Prediction, most: int, around_m: float) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Rows of points to draw: a bounded number near the target, without those overhead."""
    points = prediction.seen.points_m
    rel = points[:, :2] - prediction.center_m[:2]
    near = (np.abs(rel) < around_m).all(axis=1) & (points[:, 2] > -0.3) & (points[:, 2] < 2.0)
    rows = np.flatnonzero(near)
    return rows if len(rows) <= most else np.random.default_rng(0).choice(rows, most, replace=False)


def _draw_frame(axes: Axes, prediction: Prediction) -> None:
    axes.set_axis_off()
    for frame in prediction.frames:
        if frame.image is not None and frame.image.mask is not None:
            draw_frame(axes, frame.image.rgb, frame.image.mask)
            return
    axes.text(0.5, 0.5, "a cloud without a picture", ha="center", transform=axes.transAxes)


def _half_m(prediction: Prediction) -> float:
    return float(np.abs(prediction.cells.offset_m).max()) + 0.35


def _draw_plan(axes: Axes, prediction: Prediction) -> ScalarMappable:
    rows = shown_rows(prediction, 2 * _MOST_POINTS, _half_m(prediction))
    rows = rows[np.argsort(prediction.seen.points_m[rows, 2])]  # higher points hide lower ones
    points, colours = prediction.seen.points_m[rows], prediction.seen.rgb[rows] / 255
    axes.scatter(points[:, 0], points[:, 1], c=colours, s=2.5, lw=0, zorder=1)
    scale, side = ScalarMappable(Normalize(0, 1), SCORE_COLOURS), _side_m(prediction)
    legend: list[Any] = []
    for state in STATES:
        rows, size = prediction.rows(state), side * _SHARE[state]
        for (x, y), colour in zip(
            prediction.base_xy_m[rows],
            scale.to_rgba(prediction.score[rows], alpha=_ALPHA[state]),
            strict=True,
        ):
            corner, turn_deg = (x - size / 2, y - size / 2), 45 * (_MARK[state] == "D")
            axes.add_patch(
                Rectangle(
                    corner, size, size, angle=turn_deg, rotation_point="center",
                    fc=colour, ec=_EDGE[state], lw=0.9, zorder=3,
                )
            )  # fmt: skip
        if len(rows):
            look: dict[str, Any] = {"ms": 11 * _SHARE[state], "mec": _EDGE[state], "alpha": _ALPHA[state]}
            label = f"{len(rows)} {state}"
            legend.append(
                Line2D(
                    [], [], ls="", marker=_MARK[state], mfc=colormaps[SCORE_COLOURS](0.8), label=label, **look
                )
            )
    target = prediction.seen.points_m[prediction.seen.on_target]
    axes.scatter(target[:, 0], target[:, 1], s=3, c=TARGET.colour, lw=0, zorder=4)
    legend.append(Patch(fc=TARGET.colour, label=TARGET.words))
    camera: dict[str, Any] = {"color": CAMERA.colour, "edgecolors": CAMERA.edge, "s": 150, "lw": 0.8}
    half, centre = _half_m(prediction), prediction.center_m
    eyes = np.array([ground.T_world_camera[:2, 3] for ground in prediction.grounds])
    if (np.abs(eyes - centre[:2]) < half).all(axis=1).any():
        marker = Path(np.array(CAMERA.marker))
        legend.append(axes.scatter(*eyes.T, marker=marker, label=CAMERA.words, zorder=6, **camera))
    if prediction.best is not None:
        xy, yaw = prediction.base_xy_m[prediction.best], prediction.yaw_rad[prediction.best]
        outline = prediction.robot.outline.outline(xy, float(yaw))
        axes.add_patch(Polygon(outline, fc="none", ec="black", lw=5, zorder=7))
        axes.add_patch(Polygon(outline, fc="none", ec=BEST.colour, lw=3, zorder=7))
        tip = xy + 0.38 * np.array([np.cos(yaw), np.sin(yaw)])
        arrow = {"arrowstyle": "-|>", "color": BEST.colour, "lw": 3, "mutation_scale": 22}
        axes.annotate("", tuple(tip), tuple(xy), arrowprops=arrow, zorder=8)
        axes.plot(*xy, "o", color=BEST.colour, mec="black", ms=9, zorder=9)
        legend.append(
            Line2D([], [], ls="", marker="o", ms=11, mfc="none", mec=BEST.colour, mew=3, label="best")
        )
    if (nominal := prediction.choice.nominal) not in (None, prediction.best):
        xy = prediction.base_xy_m[nominal]
        axes.plot(*xy, "D", color="white", mec="black", ms=8, zorder=9)
        legend.append(Line2D([], [], ls="", marker="D", ms=8, mfc="white", mec="black", label="best score"))
    axes.set(xlim=(centre[0] - half, centre[0] + half), ylim=(centre[1] - half, centre[1] + half))
    axes.set_aspect("equal")
    axes.set(xlabel="x [m]", ylabel="y [m]", title="from above")
    axes.legend(handles=legend, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3, frameon=False)
    return scale


def _draw_perspective(axes: Any, prediction: Prediction) -> None:
    half, centre = _half_m(prediction), prediction.center_m
    rows = shown_rows(prediction, _MOST_POINTS, half)
    points, colours = prediction.seen.points_m[rows], prediction.seen.rgb[rows] / 255
    axes.computed_zorder = False
    drawn = np.flatnonzero(np.isin(prediction.cells.state, [STATES.index(CLEAR), STATES.index(UNSEEN)]))
    tiles = [_square(xy, 0.92 * _side_m(prediction)) for xy in prediction.base_xy_m[drawn]]
    faces = colormaps[SCORE_COLOURS](prediction.score[drawn], alpha=0.85)
    if tiles:
        axes.add_collection3d(Poly3DCollection(tiles, facecolors=faces, edgecolors="none", zorder=1))
    if prediction.best is not None:
        lines = robot_lines(prediction, prediction.best)
        axes.add_collection3d(Line3DCollection(lines, colors="black", linewidths=3.4, zorder=5))
        axes.add_collection3d(Line3DCollection(lines, colors=BEST.colour, linewidths=2.2, zorder=6))
    axes.scatter(*points.T, c=colours, s=2.2, lw=0, depthshade=False, zorder=3)
    target = prediction.seen.points_m[prediction.seen.on_target]
    axes.scatter(*target.T, c=TARGET.colour, s=3, lw=0, depthshade=False, zorder=4)
    axes.set_xlim(centre[0] - half, centre[0] + half)
    axes.set_ylim(centre[1] - half, centre[1] + half)
    axes.set_zlim(0, 1.6)
    axes.set_box_aspect((2 * half, 2 * half, 1.6), zoom=1.25)
    rel = prediction.grounds[0].T_world_camera[:2, 3] - centre[:2]
    axes.view_init(elev=34, azim=float(np.degrees(np.arctan2(rel[1], rel[0]))) + 25)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", title="perspective view from the camera's side")
    axes.locator_params(nbins=4)


def robot_lines(prediction: Prediction, row: int) -> list[F64]:
    """Lines (K, 3) of the robot at a base pose: outline at two heights, heading, and the camera's mast."""
    (x, y), yaw = prediction.base_xy_m[row], float(prediction.yaw_rad[row])
    ring = prediction.robot.outline.outline(np.array([x, y]), yaw)
    ring = np.concatenate([ring, ring[:1]])
    mount, top = prediction.robot.base_height_m, prediction.robot.camera_height_m
    return [
        *(np.column_stack([ring, np.full(len(ring), z)]) for z in (0.01, mount)),
        *(
            np.array([[*ring[k], 0.01], [*ring[k], mount]])
            for k in range(0, len(ring) - 1, max(1, len(ring) // 6))
        ),
        np.array([[x, y, 0.01], [x, y, max(top, mount)]]),
        np.array([[x, y, mount], [x + 0.35 * np.cos(yaw), y + 0.35 * np.sin(yaw), mount]]),
    ]


def _side_m(prediction: Prediction) -> float:
    """Distance of neighbouring grid cells."""
    axis = np.unique(prediction.cells.offset_m[:, 0])
    return float(axis[1] - axis[0])


def _square(xy: F64, side: float) -> F64:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * side / 2 + xy
    return np.column_stack([corners, np.full(4, 0.005)])
