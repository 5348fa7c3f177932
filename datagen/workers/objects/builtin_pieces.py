"""Pieces of built-in objects as plain data: millimetres and degrees in, metres and radians out.

A piece names a function of `shapes` with its arguments, its paint (a function of `shapes` too) and
its pose and scale. Because pieces are data, their hash is an object's digest.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

Piece = dict[str, Any]
Rgb = tuple[int, int, int]
Vector = tuple[float, float, float]
Points = list[tuple[float, float]]  # (radius, height)
_ZERO: Vector = (0, 0, 0)
_ONE: Vector = (1, 1, 1)


def plain(rgb: Rgb) -> Piece:
    """One colour."""
    return {"paint": "plain", "rgb": rgb}


def bands(*levels: tuple[float, Rgb], axis: int = 2) -> Piece:
    """Colours up to each level along an axis; the last colour also beyond its level."""
    return {"paint": "bands", "levels": [(level / 1000, rgb) for level, rgb in levels], "axis": axis}


def label(body: Rgb, print_: Rgb, low: float, high: float, text: Rgb) -> Piece:
    """A printed band between two heights of a body."""
    span = {"low_m": low / 1000, "high_m": high / 1000}
    return {"paint": "label", "body": body, "print_": print_, **span, "text": text}


def checks(period: float, first: Rgb, second: Rgb) -> Piece:
    """Patches of two colours."""
    return {"paint": "checks", "period_m": period / 1000, "first": first, "second": second}


def sides(*colours: Rgb) -> Piece:
    """Six colours: +x, -x, +y, -y, +z, -z."""
    return {"paint": "faces_of_box", "colours": list(colours)}


def _piece(
    shape: str,
    paint: Piece,
    at: Vector = _ZERO,
    turn_deg: Vector = _ZERO,
    scale: Vector = _ONE,
    **arguments: Any,
) -> Piece:
    """A piece that is scaled, turned by a rotation vector, then shifted."""
    turn = [math.radians(v) for v in turn_deg]
    put = {"offset_m": _metres(at), "turn": turn, "scale": list(scale)}
    return {"shape": shape, **arguments, "with": paint, "put": put}


def _metres(lengths: Iterable[float]) -> list[float]:
    return [v / 1000 for v in lengths]


def _outline(points: Points) -> list[tuple[float, float]]:
    return [(r / 1000, z / 1000) for r, z in points]


def block(
    x: float, y: float, z: float, paint: Piece, at: Vector = _ZERO, turn_deg: Vector = _ZERO, cells: int = 6
) -> Piece:
    """A box about its centre."""
    return _piece("block", paint, at, turn_deg, size_m=_metres((x, y, z)), cells=cells)


def lathe(
    profile: Points,
    paint: Piece,
    at: Vector = _ZERO,
    turn_deg: Vector = _ZERO,
    scale: Vector = _ONE,
    segments: int = 32,
) -> Piece:
    """A solid of revolution, from its outline bottom to top."""
    return _piece("lathe", paint, at, turn_deg, scale, profile_m=_outline(profile), segments=segments)


def vessel(outer: Points, inner: Points, paint: Piece, segments: int = 20) -> Piece:
    """An open vessel; the outer outline has one point more, its foot."""
    return _piece("vessel", paint, outer_m=_outline(outer), inner_m=_outline(inner), segments=segments)


def tube(centres: list[Vector], radii: list[float], paint: Piece, flat: float = 1.0) -> Piece:
    """A bent bar along a path in a plane."""
    return _piece("tube", paint, centres_m=[_metres(c) for c in centres], radii_m=_metres(radii), flat=flat)


def cylinder(diameter: float, height: float, levels: int = 8) -> Points:
    """Upright, with rings between the caps so that a label can be painted on the side."""
    return [(diameter / 2, height * i / levels) for i in range(levels + 1)]


def ball(diameter: float, height: float | None = None, rings: int = 14) -> Points:
    """A ball or, with another height, a spheroid."""
    tall = height or diameter
    turns = [math.pi * i / rings for i in range(rings + 1)]
    return [
        (max(diameter / 2 * math.sin(t), 0.0) if 0 < t < math.pi else 0.0, tall / 2 * (1 - math.cos(t)))
        for t in turns
    ]


def arc(radius: float, start_deg: float, end_deg: float, count: int) -> list[Vector]:
    """Points on a circle about the origin, in the x-y plane."""
    angles = [math.radians(start_deg + (end_deg - start_deg) * i / (count - 1)) for i in range(count)]
    return [(radius * math.cos(a), radius * math.sin(a), 0.0) for a in angles]


def cup(diameter: float, height: float, wall: float, paint: Piece) -> Piece:
    """A stacking cup that widens upwards by 12%."""
    r = diameter / 2
    return vessel(
        [(0.88 * r, 0), (0.885 * r, wall), (r, height)], [(0.885 * r - wall, wall), (r - wall, height)], paint
    )
