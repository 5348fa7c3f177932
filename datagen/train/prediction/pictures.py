"""One picture of a prediction: the frame with its target, the scored grid from above, and the answer."""

from __future__ import annotations

import textwrap
from itertools import pairwise
from typing import IO, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon

from datagen.display.figures import draw_frame, new_sheet, save_sheet, write_facts
from datagen.display.styles import BEST, CAMERA, SCORE_COLOURS, TARGET
from datagen.train.inputs import I64
from datagen.train.prediction.answer import Prediction
from datagen.train.prediction.base_cells import BLOCKED, CLEAR, STATES, UNREACHABLE, UNSEEN
from datagen.train.prediction.prediction_report import report_rows

_SQUARE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
_DIAMOND = np.array([[-1, 0], [0, -1], [1, 0], [0, 1]]) / 2
# Of each state: corners in sides of a cell, opacity, edge.
_LOOK: dict[str, tuple[Any, float, str]] = {
    CLEAR: (0.92 * _SQUARE, 1.0, "#222222"),
    UNSEEN: (0.92 * _SQUARE, 0.6, "none"),
    BLOCKED: (0.3 * _SQUARE, 0.9, "none"),
    UNREACHABLE: (0.42 * _DIAMOND, 0.9, "none"),
}
_HEIGHT_IN, _FACTS_IN = 7.0, 3.6  # of a sheet, and of the facts that fit on it
_TITLE_IN = 0.24  # of each further line of the title
_MOST_POINTS = 6_000
_BEHIND_M = 0.05  # what is nearer than the floor by more hides it
_NEAREST_M = 0.05  # before a camera; nearer points are not in its picture
_MAP_COLOURS = (("free in the map", "#e8eef4"), ("occupied", "#4a4a4a"))


def draw_prediction(prediction: Prediction, out: IO[bytes], ending: str = ".png") -> None:
    """Write the picture, .png, .pdf or .svg: frame and answer on the left, the plan on the right."""
    said = "; ".join((prediction.level, *prediction.reasons))
    title = textwrap.fill(f"Base poses scored by {prediction.scorer}: {said}", 80)
    figure = new_sheet(title, _HEIGHT_IN)
    left, right = np.asarray(figure.subfigures(1, 2, width_ratios=(1, 1.15))).tolist()
    frame, facts = left.subplots(2, 1, height_ratios=(1, 1.05))
    draw_view(frame, prediction)
    over_in = write_facts(facts, report_rows(prediction), columns=62) - _FACTS_IN
    if over_in > 0:  # the answer has many reasons, in the title too
        frame.get_gridspec().set_height_ratios((_FACTS_IN / 1.05, _FACTS_IN + over_in))
        figure.set_figheight(_HEIGHT_IN + over_in + _TITLE_IN * title.count("\n"))
    draw_plan(right.subplots(), prediction)
    save_sheet(figure, out, ending)


def draw_view(axes: Axes, prediction: Prediction) -> None:
    """Draw the first image with a mask: its target, and the best base and its heading on the floor."""
    axes.set_axis_off()
    shown = zip(prediction.frames, prediction.grounds, strict=True)
    seen = [(f.image, ground) for f, ground in shown if f.image is not None and f.image.mask is not None]
    if not seen:
        return
    image, T_world_camera = seen[0][0], seen[0][1].T_world_camera
    draw_frame(axes, image.rgb, image.mask, "target outlined, base on the floor")
    if prediction.best is None:
        return
    xy, yaw = prediction.base_xy_m[prediction.best], float(prediction.yaw_rad[prediction.best])
    corners = prediction.robot.outline.outline(xy, yaw)
    ahead = np.linspace(xy, xy + 0.38 * np.array([np.cos(yaw), np.sin(yaw)]), 20)
    height, width = image.depth_m.shape
    ring = [np.linspace(a, b, 24) for a, b in pairwise([*corners, corners[0]])]
    for line in (np.concatenate(ring), ahead):
        points = (np.insert(line, 2, 0.0, axis=1) - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        u, v = image.pinhole.pixels(points).T
        u[points[:, 2] < _NEAREST_M] = np.nan  # ends the line
        row, column = (
            np.clip(np.nan_to_num(p).astype(np.int64), 0, n - 1) for p, n in ((v, height), (u, width))
        )
        near_m = image.depth_m[row, column]
        hidden = (near_m > 0) & (near_m < points[:, 2] - _BEHIND_M)
        hidden &= np.roll(hidden, 1) | np.roll(hidden, -1)  # one alone is a wrong pixel
        for shown, style in ((np.where(hidden, np.nan, u), "-"), (np.where(hidden, u, np.nan), ":")):
            for colour, thick in (("black", 5), (BEST.colour, 3)):
                axes.plot(shown, v, style, color=colour, lw=thick if style == "-" else thick / 2)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))


def shown_rows(prediction: Prediction, most: int, around_m: float) -> I64:
    """Rows of points to draw: a bounded number near the target, without those overhead."""
    points = prediction.seen.points_m
    rel = points[:, :2] - prediction.center_m[:2]
    near = (np.abs(rel) < around_m).all(axis=1) & (points[:, 2] > -0.3) & (points[:, 2] < 2.0)
    rows = np.flatnonzero(near)
    return rows if len(rows) <= most else np.random.default_rng(0).choice(rows, most, replace=False)


def draw_plan(axes: Axes, prediction: Prediction) -> None:
    """Draw the grid from above on the map: scores, target and best base; its legend below."""
    scale = ScalarMappable(Normalize(0, 1), SCORE_COLOURS)
    axes.figure.colorbar(scale, ax=axes, shrink=0.75, fraction=0.06, label="score (0 bad, 1 good)")
    offset_m, centre = prediction.cells.offset_m, prediction.center_m
    half_m, side_m = float(np.abs(offset_m).max()) + 0.35, float(np.diff(np.unique(offset_m[:, 0])[:2])[0])
    legend: list[Any] = []
    if prediction.known is not None:
        known = prediction.known.points(centre[:2] - half_m, centre[:2] + half_m)
        for xy, (words, colour) in zip(known, _MAP_COLOURS, strict=True):
            axes.scatter(*xy.T, s=4, c=colour, lw=0, marker="s", zorder=0, rasterized=True)
            legend.append(Patch(fc=colour, ec="#999999", label=words))
    rows = shown_rows(prediction, _MOST_POINTS, half_m)
    rows = rows[np.argsort(prediction.seen.points_m[rows, 2])]  # higher points hide lower ones
    x, y, _ = prediction.seen.points_m[rows].T
    axes.scatter(x, y, c=prediction.seen.rgb[rows] / 255, s=2.5, lw=0, zorder=1, rasterized=True)
    for state in STATES:
        rows, (corners, alpha, edge) = prediction.rows(state), _LOOK[state]
        if len(rows):
            cells = prediction.base_xy_m[rows][:, None] + side_m * corners
            faces = scale.to_rgba(prediction.score[rows], alpha=alpha)
            look: dict[str, Any] = {"facecolors": faces, "edgecolors": edge, "linewidths": 0.9, "zorder": 3}
            axes.add_collection(PolyCollection(list(cells), **look))
            closed = np.concatenate([corners, corners[:1]])
            marker: dict[str, Any] = {"marker": closed, "ms": 14 * np.ptp(corners), "mec": edge}
            face = scale.to_rgba(np.array([0.8]), alpha=alpha)[0]
            legend.append(Line2D([], [], ls="", mfc=face, label=f"{len(rows)} {state}", **marker))
    x, y, _ = prediction.seen.points_m[prediction.seen.on_target].T
    axes.scatter(x, y, s=3, c=TARGET.colour, lw=0, zorder=4)
    eyes = np.array([ground.T_world_camera[:2, 3] for ground in prediction.grounds])
    camera: dict[str, Any] = {"ls": "", "marker": np.array(CAMERA.marker), "ms": 11, "mec": CAMERA.edge}
    legend.append(Patch(fc=TARGET.colour, label=TARGET.words))
    eyes = eyes[(np.abs(eyes - centre[:2]) < half_m).all(axis=1)]
    if len(eyes):
        legend += axes.plot(*eyes.T, color=CAMERA.colour, label=CAMERA.words, zorder=6, **camera)
    gold: dict[str, Any] = {"ls": "", "marker": "o", "ms": 9, "color": BEST.colour, "mec": "black"}
    if prediction.best is not None:
        xy, yaw = prediction.base_xy_m[prediction.best], prediction.yaw_rad[prediction.best]
        outline = prediction.robot.outline.outline(xy, float(yaw))
        for colour, width in (("black", 5), (BEST.colour, 3)):
            axes.add_patch(Polygon(outline, fc="none", ec=colour, lw=width, zorder=7))
        tip = xy + 0.38 * np.array([np.cos(yaw), np.sin(yaw)])
        arrow = {"arrowstyle": "-|>", "color": BEST.colour, "lw": 3, "mutation_scale": 22}
        axes.annotate("", tuple(tip), tuple(xy), arrowprops=arrow, zorder=8)
        legend += axes.plot(*xy, label="best", zorder=9, **gold)
    nominal, expected = prediction.choice.nominal, prediction.choice.expected
    if expected is not None and nominal not in (None, prediction.best):
        white: dict[str, Any] = gold | {"marker": "D", "color": "white"}
        legend += axes.plot(*prediction.base_xy_m[nominal], label="best score", zorder=9, **white)
    axes.set(xlim=(centre[0] - half_m, centre[0] + half_m), ylim=(centre[1] - half_m, centre[1] + half_m))
    axes.set_aspect("equal")
    axes.set(xlabel="x [m]", ylabel="y [m]", title="from above")
    axes.figure.legend(handles=legend, loc="outside lower center", ncols=3, frameon=False)
