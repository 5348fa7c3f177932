"""The room from above with candidates by label, outcome or score, marks, and the legend."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon, Rectangle
from matplotlib.path import Path
from matplotlib.patheffects import withStroke

from datagen.display.styles import (
    BEST,
    CAMERA,
    CLUTTER,
    LABEL_STYLES,
    OUTCOME_STYLES,
    SCORE_COLOURS,
    TARGET,
    Style,
)
from datagen.schemas.outcomes import OUTCOMES
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.planar import convex_hull
from datagen.workers.houses.house import StaticBody
from datagen.workers.scenes.reconstruct import ReconstructedScene

_HEAD_ROOM_M = 1.9  # higher parts, such as the wall over a door, are not drawn
_KIND_EDGE = {"wall": "#303030", "furniture": "#6b5b4a", "small": "#8a6fb0"}
_DOT_PT2 = 26
_SMALL_PT2 = {"out_of_reach": 9, "base_collision": 13}  # frequent outcomes of little interest
_REACH_COLOUR, _REACH_DASHES = "#1b3a6b", ((5, 3), (1, 1.5), (7, 2, 1, 2), (3, 1))
_LEGEND_CHARACTERS = 40

Handle = Line2D | Patch


def draw_plan(axes: Axes, recalled: ReconstructedScene, half_m: float, faded: bool = False) -> list[Style]:
    """Draw house, placed objects and camera, `half_m` to each side of the target; returns the drawn styles.

    `faded` makes the plan pale, so that candidates stand out.
    """
    x, y = (float(v) for v in recalled.target_center_m[:2])
    for room in recalled.house.house.rooms:
        axes.add_patch(Polygon(room.polygon_m, closed=True, facecolor="#f4efe6", edgecolor="#c9bfae", lw=0.5))
    solid = [b for b in recalled.house.house.bodies if _height_m(b) > 0.01]
    for body in sorted(solid, key=_height_m):
        parts = [p for p in body.convex_parts_m if p[:, 2].min() < _HEAD_ROOM_M]
        outlines = [convex_hull(p[:, :2].astype(np.float64)) for p in parts]
        if outlines:
            colour = "#454545" if body.kind == "wall" else _mean_colour(body)
            edge = _KIND_EDGE[body.kind]
            axes.add_collection(PolyCollection(outlines, facecolors=colour, edgecolors=edge, linewidths=0.4))
    for k, outline in enumerate(object_outlines(recalled)):
        style = CLUTTER if k else TARGET
        axes.add_patch(
            Polygon(outline, closed=True, facecolor=style.colour, edgecolor=style.edge, lw=0.5, zorder=5)
        )
    if faded:
        axes.add_patch(
            Rectangle((0, 0), 1, 1, transform=axes.transAxes, color="white", alpha=0.55, lw=0, zorder=4)
        )
    _draw_camera(axes, recalled)
    axes.set(xlim=(x - half_m, x + half_m), ylim=(y - half_m, y + half_m), xlabel="x [m]", ylabel="y [m]")
    axes.set_aspect("equal")
    is_near = bool((np.abs(recalled.camera.T_world_camera[:2, 3] - (x, y)) < half_m).all())
    return [*([CAMERA] if is_near else []), TARGET, *([CLUTTER] if len(recalled.models) > 1 else [])]


def half_width_m(recalled: ReconstructedScene) -> float:
    """Half the side (m) of a plan that shows the camera and the usual range of candidates."""
    gap = np.abs(recalled.camera.T_world_camera[:2, 3] - recalled.target_center_m[:2]).max()
    return max(1.35, float(gap) + 0.3)


def object_outlines(recalled: ReconstructedScene) -> list[F64]:
    """Outlines (K, 2) of the placed objects seen from above, world; the first is the target."""
    outlines = []
    for model, T in zip(recalled.models, recalled.T_world_object, strict=True):
        points = np.concatenate(model.convex_parts_m).astype(np.float64)
        outlines.append(convex_hull((points @ T[:3, :3].T + T[:3, 3])[:, :2]))
    return outlines


def draw_labels(axes: Axes, base_xy_m: F64, label: Any, clear: Any) -> list[Handle]:
    """Draw candidates (N, 2) by label, filled where the base fits, hollow elsewhere; returns the legend."""
    legend: list[Handle] = []
    for value, style in LABEL_STYLES.items():
        for fits, words in ((True, "base fits"), (False, "base collides")):
            rows = (label == value) & (clear == fits)
            if rows.any():
                _draw_dots(axes, base_xy_m[rows], style, fits, _DOT_PT2)
                text = f"{int(rows.sum())} {style.words}, {words}"
                legend.append(_handle(style, text, filled=fits))
    return legend


def draw_outcomes(axes: Axes, base_xy_m: F64, outcome: Any, clear: Any) -> list[Handle]:
    """Draw candidates (N, 2) by outcome code (N,), hollow where the base collides; returns the legend."""
    legend: list[Handle] = []
    for code, name in enumerate(OUTCOMES):
        style, count = OUTCOME_STYLES[name], int((outcome == code).sum())
        for fits in (True, False):
            rows = (outcome == code) & (clear == fits)
            _draw_dots(axes, base_xy_m[rows], style, fits, _SMALL_PT2.get(name, _DOT_PT2))
        if count:
            filled = bool((clear & (outcome == code)).any())
            legend.append(_handle(style, f"{count} {name}: {style.words}", filled))
    return legend


def draw_scores(axes: Axes, base_xy_m: F64, score: Any, threshold: float) -> ScalarMappable:
    """Draw candidates by score, the threshold in the middle of the colours; returns the scale."""
    norm = Normalize(0, 2 * threshold or 1)
    return axes.scatter(
        *base_xy_m.T, c=score, cmap=SCORE_COLOURS, norm=norm, s=24, zorder=8, edgecolors="#444444", lw=0.4
    )


def draw_pick(axes: Axes, base_xy_m: F64, style: Style) -> None:
    """Draw a chosen candidate (2,)."""
    axes.scatter(
        *base_xy_m, marker=_plain(style), s=190, color=style.colour, edgecolors=style.edge, lw=1,
        zorder=9,
    )  # fmt: skip


def draw_reach(axes: Axes, target_xy_m: F64, radii_m: Sequence[tuple[str, float]]) -> list[Handle]:
    """Draw a circle around the target for each (robot, reach); returns the legend."""
    x, y = (float(v) for v in target_xy_m)
    legend: list[Handle] = []
    for k, (name, radius_m) in enumerate(radii_m):
        look: dict[str, Any] = {"ls": (0, _REACH_DASHES[k % 4]), "lw": 1.4}
        halo = [withStroke(linewidth=3, foreground="white")]
        axes.add_patch(
            Circle((x, y), radius_m, fill=False, edgecolor=_REACH_COLOUR, zorder=7, path_effects=halo, **look)
        )
        angle = np.radians(90 - 40 * k)
        axes.annotate(
            name, (x + radius_m * np.cos(angle), y + radius_m * np.sin(angle)), (0, 3),
            textcoords="offset points", color=_REACH_COLOUR, fontsize=9, ha="center", zorder=10,
            path_effects=halo, annotation_clip=True,
        )  # fmt: skip
        legend.append(
            Line2D(
                [],
                [],
                color=_REACH_COLOUR,
                label=f"{name} reaches the target from within {radius_m:.2f} m",
                **look,
            )
        )
    return legend


def draw_legend(axes: Axes, handles: Sequence[Handle], title: str, marks: Sequence[Style]) -> None:
    """Draw a legend that fills a panel: these handles, and the marks."""
    axes.set_axis_off()
    handles = [*handles, *(_handle(style, style.words) for style in marks)]
    for handle in handles:
        handle.set_label(textwrap.fill(str(handle.get_label()), _LEGEND_CHARACTERS))
    axes.legend(
        handles=handles, title=title, alignment="left", loc="upper left", frameon=False, fontsize=10,
        borderaxespad=0, labelspacing=0.55, handlelength=2.2,
    )  # fmt: skip


def _draw_camera(axes: Axes, recalled: ReconstructedScene) -> None:
    """The observation camera and its horizontal field of view."""
    camera = recalled.camera
    eye = camera.T_world_camera[:2, 3]
    half = np.arctan(camera.width_px / 2 / camera.fx_px)
    forward = camera.T_world_camera[:2, 2]
    heading = float(np.arctan2(forward[1], forward[0]))
    rays = eye + 0.6 * np.array([[np.cos(heading + s), np.sin(heading + s)] for s in (half, -half)])
    axes.add_patch(Polygon([eye, *rays], closed=True, facecolor=CAMERA.colour, alpha=0.12, lw=0, zorder=6))
    c, s = np.cos(heading), np.sin(heading)
    marker = Path(np.array(CAMERA.marker) @ np.array([[c, s], [-s, c]]))
    axes.scatter(*eye, marker=marker, s=190, color=CAMERA.colour, edgecolors=CAMERA.edge, lw=0.8, zorder=7)


def _draw_dots(axes: Axes, xy_m: F64, style: Style, filled: bool, size_pt2: float) -> None:
    face = style.colour if filled else "none"
    axes.scatter(
        *xy_m.T, s=size_pt2, marker=_plain(style), facecolors=face, edgecolors=style.colour, lw=1, zorder=8
    )


def _handle(style: Style, text: str, filled: bool = True) -> Handle:
    if not style.marker:
        return Patch(fc=style.colour, ec=style.edge, lw=0.8, label=text)
    face = style.colour if filled else "none"
    size = 13 if style is BEST else 8 if isinstance(style.marker, str) else 12
    return Line2D([], [], ls="", ms=size, marker=_plain(style), mfc=face, mec=style.edge, label=text)


def _plain(style: Style) -> str | Path:
    """The marker as matplotlib accepts it."""
    return style.marker if isinstance(style.marker, str) else Path(np.array(style.marker))


def _height_m(body: StaticBody) -> float:
    return max((float(p[:, 2].max()) for p in body.convex_parts_m), default=0.0)


def _mean_colour(body: StaticBody) -> tuple[float, float, float]:
    r, g, b = body.visual.face_rgb.mean(axis=0) / 255
    return (float(r), float(g), float(b))
