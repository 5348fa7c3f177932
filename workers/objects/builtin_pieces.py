"""Pieces of built-in objects as plain data: millimetres and degrees in, metres and radians out.

A piece names a function of `shapes` with its arguments, its paint (a function of `shapes` too) and
where it is put. Because pieces are data, their hash is an object's digest.
"""

from __future__ import annotations

import math
from typing import Any

Piece = dict[str, Any]
Rgb = tuple[int, int, int]
Vector = tuple[float, float, float]
Points = list[tuple[float, float]]  # (radius, height)


def plain(rgb: Rgb) -> Piece:
    """One colour."""
    return {"paint": "plain", "rgb": rgb}


def bands(*levels: tuple[float, Rgb], axis: int = 2) -> Piece:
    """Colours up to each level along an axis; the last one beyond."""
    return {"paint": "bands", "levels": [(level / 1000, rgb) for level, rgb in levels], "axis": axis}


def label(body: Rgb, print_: Rgb, low: float, high: float, text: Rgb) -> Piece:
    """A printed band between two heights of a body."""
    return {
        "paint": "label",
        "body": body,
        "print_": print_,
        "low_m": low / 1000,
        "high_m": high / 1000,
        "text": text,
    }


def checks(period: float, first: Rgb, second: Rgb) -> Piece:
    """Patches of two colours."""
    return {"paint": "checks", "period_m": period / 1000, "first": first, "second": second}


def sides(*colours: Rgb) -> Piece:
    """Six colours: +x, -x, +y, -y, +z, -z."""
    return {"paint": "faces_of_box", "colours": list(colours)}


def put(at: Vector, turn_deg: Vector, scale: Vector) -> Piece:
    """Where a piece goes: scaled, turned by a rotation vector, then shifted."""
    return {
        "offset_m": [v / 1000 for v in at],
        "turn": [math.radians(v) for v in turn_deg],
        "scale": list(scale),
    }


def block(
    x: float,
    y: float,
    z: float,
    paint: Piece,
    at: Vector = (0, 0, 0),
    turn_deg: Vector = (0, 0, 0),
    cells: int = 6,
) -> Piece:
    """A box about its centre."""
    return {
        "shape": "block",
        "size_m": [x / 1000, y / 1000, z / 1000],
        "cells": cells,
        "with": paint,
        "put": put(at, turn_deg, (1, 1, 1)),
    }


def lathe(
    profile: Points,
    paint: Piece,
    at: Vector = (0, 0, 0),
    turn_deg: Vector = (0, 0, 0),
    scale: Vector = (1, 1, 1),
    segments: int = 32,
) -> Piece:
    """A solid of revolution, from its outline bottom to top."""
    return {
        "shape": "lathe",
        "profile_m": [(r / 1000, z / 1000) for r, z in profile],
        "segments": segments,
        "with": paint,
        "put": put(at, turn_deg, scale),
    }


def vessel(outer: Points, inner: Points, paint: Piece, segments: int = 20) -> Piece:
    """An open vessel; the outer outline has one point more, its foot."""
    return {
        "shape": "vessel",
        "outer_m": [(r / 1000, z / 1000) for r, z in outer],
        "inner_m": [(r / 1000, z / 1000) for r, z in inner],
        "segments": segments,
        "with": paint,
        "put": put((0, 0, 0), (0, 0, 0), (1, 1, 1)),
    }


def tube(centres: list[Vector], radii: list[float], paint: Piece, flat: float = 1.0) -> Piece:
    """A bent bar along a path in a plane."""
    return {
        "shape": "tube",
        "centres_m": [[v / 1000 for v in c] for c in centres],
        "radii_m": [r / 1000 for r in radii],
        "flat": flat,
        "with": paint,
        "put": put((0, 0, 0), (0, 0, 0), (1, 1, 1)),
    }


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
