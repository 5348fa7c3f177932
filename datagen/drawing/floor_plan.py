"""The room from above: walls, furniture, target, observation camera and candidates."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.patches import Polygon

from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.planar import convex_hull
from datagen.workers.houses.house import Body, House
from datagen.workers.rendering.frame import Camera

_HEAD_ROOM_M = 1.9  # higher parts, such as the wall over a door, are not drawn
_KIND_EDGE = {"wall": "#303030", "furniture": "#6b5b4a", "small": "#8a6fb0"}


def draw_house(axes: Axes, house: House) -> None:
    """Draw floors and the footprints of all bodies, low ones first, in their own colours."""
    for room in house.rooms:
        axes.add_patch(Polygon(room.polygon_m, closed=True, facecolor="#f4efe6", edgecolor="#c9bfae", lw=0.5))
    solid = [b for b in house.bodies if _height_m(b) > 0.01]
    for body in sorted(solid, key=_height_m):
        parts = [p for p in body.convex_parts_m if p[:, 2].min() < _HEAD_ROOM_M]
        outlines = [convex_hull(p[:, :2].astype(np.float64)) for p in parts]
        if outlines:
            colour = "#454545" if body.kind == "wall" else _mean_colour(body)
            edge = _KIND_EDGE[body.kind]
            axes.add_collection(PolyCollection(outlines, facecolors=colour, edgecolors=edge, linewidths=0.4))


def draw_objects(axes: Axes, outlines_m: list[F64]) -> None:
    """Draw outlines of the placed objects; the first is the target."""
    for k, outline in enumerate(outlines_m):
        colour = "#d6204e" if k == 0 else "#3f7fbf"
        axes.add_patch(Polygon(outline, closed=True, facecolor=colour, edgecolor="white", lw=0.4, zorder=5))


def draw_camera(axes: Axes, camera: Camera) -> None:
    """Draw the observation camera and its horizontal field of view."""
    eye = camera.T_world_camera[:2, 3]
    half = np.arctan(camera.width_px / 2 / camera.fx_px)
    forward = camera.T_world_camera[:2, 2]
    heading = np.arctan2(forward[1], forward[0])
    rays = eye + 0.6 * np.array([[np.cos(heading + s), np.sin(heading + s)] for s in (half, -half)])
    axes.add_patch(Polygon([eye, *rays], closed=True, facecolor="#2f6fdd", alpha=0.25, zorder=6))
    axes.plot(*eye, marker="^", color="#2f6fdd", ms=8, zorder=7, label="camera")


def draw_labels(axes: Axes, base_xy_m: F64, label: Any, clear: Any) -> None:
    """Draw candidates by label: filled where the base is clear, else hollow."""
    for value, colour, name in ((1, "#1a9850", "good"), (0, "#d73027", "bad")):
        for fits, face in ((True, colour), (False, "none")):
            rows = (label == value) & (clear == fits)
            text = f"{name}, {'clear' if fits else 'not clear'} ({int(rows.sum())})"
            axes.scatter(
                *base_xy_m[rows].T, s=16, facecolors=face, edgecolors=colour, lw=0.9, zorder=8, label=text
            )


def draw_scores(axes: Axes, base_xy_m: F64, score: Any, best: int | None) -> ScalarMappable:
    """Draw candidates by score, the best clear one as a gold star; return the colour scale."""
    dots = axes.scatter(
        *base_xy_m.T, c=score, cmap="viridis", norm=Normalize(0, 0.8), s=20, zorder=8, edgecolors="none"
    )
    if best is not None:
        axes.scatter(
            *base_xy_m[best],
            marker="*",
            s=260,
            color="gold",
            edgecolors="black",
            lw=0.9,
            zorder=9,
            label="best",
        )
    return dots


def frame_axes(axes: Axes, centre_m: F64, half_m: float) -> None:
    """Set equal scales in metres around a point."""
    axes.set_xlim(centre_m[0] - half_m, centre_m[0] + half_m)
    axes.set_ylim(centre_m[1] - half_m, centre_m[1] + half_m)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def _height_m(body: Body) -> float:
    return max((float(p[:, 2].max()) for p in body.convex_parts_m), default=0.0)


def _mean_colour(body: Body) -> tuple[float, float, float]:
    r, g, b = body.visual.face_rgb.mean(axis=0) / 255
    return (float(r), float(g), float(b))
