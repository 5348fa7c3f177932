"""The room from above, with the candidates by label or outcome, or by score."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.path import Path

from datagen.display.styles import (
    CAMERA,
    CLUTTER,
    LABEL_STYLES,
    OUTCOME_STYLES,
    SCORE_COLOURS,
    TARGET,
    Style,
)
from datagen.schemas.fields import OUTCOMES
from datagen.workers.geometry.mesh import F64, transformed
from datagen.workers.geometry.planar import convex_hull, polygons_at
from datagen.workers.houses.house import StaticBody
from datagen.workers.scenes.reconstruct import ReconstructedScene

_HEAD_ROOM_M = 1.9  # higher parts, such as the wall over a door, are not drawn
_KIND_EDGE = {"wall": "#303030", "furniture": "#6b5b4a", "small": "#8a6fb0"}
_DOT_PT2, _SMALL_PT2 = 26, 11  # small: frequent outcomes of little interest
_OF_LITTLE_INTEREST = ("out_of_reach", "base_collision")
_LEGEND_CHARACTERS, _LEGEND_LINE_IN = 60, 0.215

Handle = Line2D | Patch


def draw_plan(axes: Axes, recalled: ReconstructedScene, base_xy_m: F64) -> list[Handle]:
    """Draw house, placed objects and camera around the target, pale; return the legend.

    The plan shows all base poses (N, 2), and the camera where it is among them.
    """
    x, y = (float(v) for v in recalled.target_center_m[:2])
    half_m = max(1.1, float(np.abs(base_xy_m - (x, y)).max()) + 0.12)
    for room in recalled.house.house.rooms:
        axes.add_patch(Polygon(room.polygon_m, closed=True, facecolor="#f4efe6", edgecolor="#c9bfae", lw=0.5))
    solid = [b for b in recalled.house.house.bodies if height_m(b) > 0.01]
    for body in sorted(solid, key=height_m):
        # A stage of habitat is one body, with the floor.
        parts = [p for p in body.convex_parts_m if p[:, 2].min() < _HEAD_ROOM_M and p[:, 2].max() > 0.01]
        outlines = [convex_hull(p[:, :2].astype(np.float64)) for p in parts]
        if outlines:
            colour = "#454545" if body.kind == "wall" else tuple(body.visual.face_rgb.mean(axis=0) / 255)
            edge = _KIND_EDGE[body.kind]
            axes.add_collection(
                PolyCollection(outlines, facecolors=[colour], edgecolors=edge, linewidths=0.4)
            )
    pale: dict[str, Any] = {"transform": axes.transAxes, "color": "white", "alpha": 0.5, "lw": 0, "zorder": 4}
    axes.add_patch(Rectangle((0, 0), 1, 1, **pale))
    for k, (model, T) in enumerate(zip(recalled.models, recalled.T_world_object, strict=True)):
        points = transformed(np.concatenate(model.convex_parts_m), T)
        outline, style = convex_hull(points[:, :2]), CLUTTER if k else TARGET
        axes.add_patch(Polygon(outline, fc=style.colour, ec=style.edge, lw=0.5, zorder=5))
    _draw_camera(axes, recalled)
    axes.set(xlim=(x - half_m, x + half_m), ylim=(y - half_m, y + half_m), xlabel="x [m]", ylabel="y [m]")
    axes.set_aspect("equal")
    is_near = bool((np.abs(recalled.camera.T_world_camera[:2, 3] - (x, y)) < half_m).all())
    marks = [*([CAMERA] if is_near else []), TARGET, *([CLUTTER] if len(recalled.models) > 1 else [])]
    return [handle(style, style.words) for style in marks]


def draw_candidates(axes: Axes, samples: Mapping[str, Any]) -> list[Handle]:
    """Draw candidates by outcome, or by label without outcomes; hollow where the base collides.

    Returns the legend with the number of each kind.
    """
    xy, clear = np.asarray(samples["base_xy_m"], np.float64), np.asarray(samples["base_is_clear"], np.bool_)
    if "outcome" in samples:
        kinds = [(OUTCOME_STYLES[name], code, f"{name}: ") for code, name in enumerate(OUTCOMES)]
        values = np.asarray(samples["outcome"])
    else:
        kinds = [(style, label, "") for label, style in LABEL_STYLES.items()]
        values = np.asarray(samples["label"])
    legend: list[Handle] = []
    for style, value, name in kinds:
        size_pt2 = _SMALL_PT2 if name.removesuffix(": ") in _OF_LITTLE_INTEREST else _DOT_PT2
        for fits in (True, False):
            rows = (values == value) & (clear == fits)
            if not rows.any():
                continue
            face = style.colour if fits else "none"
            look: dict[str, Any] = {"facecolors": face, "edgecolors": style.colour, "lw": 1, "zorder": 8}
            axes.scatter(*xy[rows].T, s=size_pt2, marker=_marker(style), **look)
            words = "" if name else ", base fits" if fits else ", base collides"
            legend.append(handle(style, f"{int(rows.sum())} {name}{style.words}{words}", fits))
    return legend


def draw_scores(axes: Axes, base_xy_m: F64, score: Any, threshold: float) -> ScalarMappable:
    """Draw candidates by score, the threshold in the middle of the colours; returns the scale."""
    norm = Normalize(0, 2 * threshold or 1)
    look: dict[str, Any] = {"s": 24, "zorder": 8, "edgecolors": "#444444", "lw": 0.4}
    return axes.scatter(*base_xy_m.T, c=score, cmap=SCORE_COLOURS, norm=norm, **look)


def draw_pick(axes: Axes, base_xy_m: F64, style: Style) -> Handle:
    """Draw a chosen candidate (2,); returns its line of the legend."""
    look: dict[str, Any] = {"color": style.colour, "edgecolors": style.edge, "lw": 1, "zorder": 9}
    axes.scatter(*base_xy_m, marker=_marker(style), s=190, **look)
    return handle(style, style.words)


def draw_base(axes: Axes, polygon_m: F64, base_xy_m: F64, yaw_rad: float, style: Style) -> None:
    """Draw the outline (K, 2) of a base, x ahead, at its pose, with a line from the mount to its front."""
    front_m = np.array([[0.0, 0.0], [float(polygon_m[:, 0].max()), 0.0]])
    outline, line = (
        polygons_at(points, base_xy_m[None], np.array([yaw_rad]))[0] for points in (polygon_m, front_m)
    )
    axes.add_patch(Polygon(outline, closed=True, fill=False, ec=style.edge, lw=1.2, zorder=8))
    axes.plot(*line.T, color=style.edge, lw=1.2, zorder=8)


def draw_legend(axes: Axes, handles: Sequence[Handle]) -> float:
    """Draw a legend that fills a panel; returns its height in inches."""
    axes.set_axis_off()
    lines = 0
    for entry in handles:
        text = textwrap.fill(str(entry.get_label()), _LEGEND_CHARACTERS)
        entry.set_label(text)
        lines += text.count("\n") + 1
    look: dict[str, Any] = {"frameon": False, "borderaxespad": 0, "labelspacing": 0.5, "handlelength": 2}
    axes.legend(handles=handles, loc="upper left", fontsize=10, **look)
    return _LEGEND_LINE_IN * (lines + 1)


def handle(style: Style, text: str, is_filled: bool = True) -> Handle:
    """A line of a legend."""
    if not style.marker:
        return Patch(fc=style.colour, ec=style.edge, lw=0.8, label=text)
    face = style.colour if is_filled else "none"
    return Line2D([], [], ls="", ms=9, marker=_marker(style), mfc=face, mec=style.edge, label=text)


def _draw_camera(axes: Axes, recalled: ReconstructedScene) -> None:
    """The observation camera and its horizontal field of view."""
    camera = recalled.camera
    eye, ahead = camera.T_world_camera[:2, 3], camera.T_world_camera[:2, 2]
    half, heading = np.arctan(camera.width_px / 2 / camera.fx_px), float(np.arctan2(ahead[1], ahead[0]))
    rays = eye + 0.6 * np.array([[np.cos(heading + s), np.sin(heading + s)] for s in (half, -half)])
    axes.add_patch(Polygon([eye, *rays], closed=True, facecolor=CAMERA.colour, alpha=0.12, lw=0, zorder=6))
    c, s = np.cos(heading), np.sin(heading)
    marker = Path(np.array(CAMERA.marker) @ np.array([[c, s], [-s, c]]))
    axes.scatter(*eye, marker=marker, s=190, color=CAMERA.colour, edgecolors=CAMERA.edge, lw=0.8, zorder=7)


def _marker(style: Style) -> str | Path:
    """The marker as matplotlib accepts it."""
    return style.marker if isinstance(style.marker, str) else Path(np.array(style.marker))


def height_m(body: StaticBody) -> float:
    """The highest z of a body, world."""
    return max((float(p[:, 2].max()) for p in body.convex_parts_m), default=0.0)
