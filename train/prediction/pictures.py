"""One picture of a prediction: the frame with the target outlined, the scored grid from above and aslant."""

from __future__ import annotations

import textwrap
from typing import IO, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from datagen.schemas.specification import CandidateParams
from datagen.train.prediction.answer import told
from datagen.train.prediction.candidates import BLOCKED, CLEAR, STATES, UNSEEN
from datagen.train.prediction.predict import Prediction
from datagen.workers.geometry.mesh import F64

COLOURS, GOLD = "RdYlGn", "#ffc400"
_EDGE = {CLEAR: "#20502c", UNSEEN: "none", BLOCKED: "none"}
_ALPHA = {CLEAR: 1.0, UNSEEN: 0.6, BLOCKED: 0.9}
_BASE_RADIUS_M = CandidateParams().base_radius_m
_MOST_POINTS = 15_000


def draw_prediction(prediction: Prediction, out: IO[bytes]) -> None:
    """Write the picture as PNG."""
    figure = Figure(figsize=(19, 8.2), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"base poses scored by {prediction.scorer}: {prediction.sure}", fontsize=14)
    left, right = np.asarray(figure.subfigures(1, 2, width_ratios=(1, 2.3))).tolist()
    upper, lower = np.asarray(left.subfigures(2, 1, height_ratios=(1.15, 1.0))).tolist()
    _draw_frame(upper.subplots(), prediction)
    _write_numbers(lower.subplots(), prediction)
    above, aslant = right.add_subplot(1, 2, 1), right.add_subplot(1, 2, 2, projection="3d")
    scale = _draw_above(above, prediction)
    _draw_aslant(aslant, prediction)
    right.colorbar(scale, ax=[above, aslant], location="bottom", shrink=0.5, label="score", aspect=40)
    figure.savefig(out, format="png")


def shown_rows(prediction: Prediction, most: int, around_m: float) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Rows of the seen points to draw: at most so many, near the target, without what hangs over all."""
    points = prediction.seen.points_m
    rel = points[:, :2] - prediction.center_m[:2]
    near = (np.abs(rel) < around_m).all(axis=1) & (points[:, 2] > -0.3) & (points[:, 2] < 2.0)
    rows = np.flatnonzero(near)
    return rows if len(rows) <= most else np.random.default_rng(0).choice(rows, most, replace=False)


def _draw_frame(axes: Axes, prediction: Prediction) -> None:
    axes.set_axis_off()
    frame = next((f for f in prediction.frames if f.image is not None and f.image.mask is not None), None)
    if frame is None or frame.image is None or frame.image.mask is None:
        axes.text(0.5, 0.5, "a cloud without a picture", ha="center", transform=axes.transAxes)
        return
    axes.imshow(frame.image.rgb)
    axes.contour(frame.image.mask, levels=[0.5], colors=["#ff2d6f"], linewidths=1.6)
    axes.set_title("RGB frame, target outlined")


def _half_m(prediction: Prediction) -> float:
    return float(np.abs(prediction.places.offset_m).max()) + 0.35


def _draw_above(axes: Axes, prediction: Prediction) -> ScalarMappable:
    rows = shown_rows(prediction, 4 * _MOST_POINTS, _half_m(prediction))
    rows = rows[np.argsort(prediction.seen.points_m[rows, 2])]  # what is higher hides what is lower
    points, colours = prediction.seen.points_m[rows], prediction.seen.rgb[rows] / 255
    axes.scatter(points[:, 0], points[:, 1], c=colours, s=2.5, lw=0, zorder=1)
    palette, scale = colormaps[COLOURS], ScalarMappable(Normalize(0, 1), COLOURS)
    side = _side_m(prediction)
    for state in STATES:
        for row in prediction.rows(state):
            x, y = prediction.base_xy_m[row]
            size = side * (0.92 if state != BLOCKED else 0.28)
            colour = (*palette(float(prediction.score[row]))[:3], _ALPHA[state])
            corner = (x - size / 2, y - size / 2)
            axes.add_patch(Rectangle(corner, size, size, fc=colour, ec=_EDGE[state], lw=0.9, zorder=3))
    target = prediction.seen.points_m[prediction.seen.on_target]
    axes.scatter(target[:, 0], target[:, 1], s=3, c="#d6204e", lw=0, zorder=4)
    for ground, mark in zip(prediction.grounds, "^" * len(prediction.grounds), strict=True):
        axes.plot(*ground.T_world_camera[:2, 3], marker=mark, color="#2f6fdd", ms=10, mec="white", zorder=6)
    if prediction.best is not None:
        xy, yaw = prediction.base_xy_m[prediction.best], prediction.yaw_rad[prediction.best]
        axes.add_patch(Circle(tuple(xy), _BASE_RADIUS_M, fc="none", ec="black", lw=5, zorder=7))
        axes.add_patch(Circle(tuple(xy), _BASE_RADIUS_M, fc="none", ec=GOLD, lw=3, zorder=7))
        tip = xy + 0.38 * np.array([np.cos(yaw), np.sin(yaw)])
        look = {"arrowstyle": "-|>", "color": GOLD, "lw": 3, "mutation_scale": 22}
        axes.annotate("", tuple(tip), tuple(xy), arrowprops=look, zorder=8)
        axes.plot(*xy, "o", color=GOLD, mec="black", ms=9, zorder=9)
    half, centre = _half_m(prediction), prediction.center_m
    axes.set_xlim(centre[0] - half, centre[0] + half)
    axes.set_ylim(centre[1] - half, centre[1] + half)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_title("from above: edged squares clear, plain unseen, small blocked")
    return scale


def _draw_aslant(axes: Any, prediction: Prediction) -> None:
    half, centre = _half_m(prediction), prediction.center_m
    rows = shown_rows(prediction, _MOST_POINTS, half)
    points, colours = prediction.seen.points_m[rows], prediction.seen.rgb[rows] / 255
    axes.computed_zorder = False
    tiles = [_square(xy, 0.92 * _side_m(prediction)) for xy in prediction.base_xy_m]
    palette = colormaps[COLOURS]
    drawn = prediction.places.state != STATES.index(BLOCKED)
    faces = [(*palette(float(s))[:3], 0.85) for s in prediction.score[drawn]]
    kept = [tile for tile, keep in zip(tiles, drawn, strict=True) if keep]
    if kept:
        axes.add_collection3d(Poly3DCollection(kept, facecolors=faces, edgecolors="none", zorder=1))
    if prediction.best is not None:
        _draw_robot(axes, prediction, prediction.best)
    axes.scatter(*points.T, c=colours, s=2.2, lw=0, depthshade=False, zorder=3)
    target = prediction.seen.points_m[prediction.seen.on_target]
    axes.scatter(*target.T, c="#d6204e", s=3, lw=0, depthshade=False, zorder=4)
    axes.set_xlim(centre[0] - half, centre[0] + half)
    axes.set_ylim(centre[1] - half, centre[1] + half)
    axes.set_zlim(0, 1.6)
    axes.set_box_aspect((2 * half, 2 * half, 1.6), zoom=1.25)
    rel = prediction.grounds[0].T_world_camera[:2, 3] - centre[:2]
    axes.view_init(elev=34, azim=float(np.degrees(np.arctan2(rel[1], rel[0]))) + 25)
    axes.set_title("aslant, from the camera's side: the best pose in gold")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def _draw_robot(axes: Any, prediction: Prediction, row: int) -> None:
    (x, y), yaw = prediction.base_xy_m[row], float(prediction.yaw_rad[row])
    angle = np.linspace(0, 2 * np.pi, 49)
    ring = np.stack([x + _BASE_RADIUS_M * np.cos(angle), y + _BASE_RADIUS_M * np.sin(angle)], axis=1)
    mount, top = prediction.robot.base_height_m, prediction.robot.camera_height_m
    lines = [np.column_stack([ring, np.full(len(ring), z)]) for z in (0.01, mount)]
    lines += [np.array([[*ring[k], 0.01], [*ring[k], mount]]) for k in range(0, 48, 8)]
    lines.append(np.array([[x, y, mount], [x, y, max(top, mount)]]))
    lines.append(np.array([[x, y, mount], [x + 0.35 * np.cos(yaw), y + 0.35 * np.sin(yaw), mount]]))
    axes.add_collection3d(Line3DCollection(lines, colors="black", linewidths=3.4, zorder=5))
    axes.add_collection3d(Line3DCollection(lines, colors=GOLD, linewidths=2.2, zorder=6))


def _side_m(prediction: Prediction) -> float:
    """Distance of neighbouring grid places."""
    axis = np.unique(prediction.places.offset_m[:, 0])
    return float(axis[1] - axis[0])


def _square(xy: F64, side: float) -> F64:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * side / 2 + xy
    return np.column_stack([corners, np.full(4, 0.005)])


def _write_numbers(axes: Axes, prediction: Prediction) -> None:
    axes.set_axis_off()
    lines: list[str] = []
    for head, text in told(prediction):
        lines += textwrap.wrap(text, 76, initial_indent=f"{head:<11}", subsequent_indent=" " * 11)
    axes.text(
        0.0, 1.0, "\n".join(lines), va="top", family="monospace", fontsize=8.5, transform=axes.transAxes
    )
