"""The built-in objects: published sizes and masses of YCB objects as simple solids.

Sizes (millimetres, as in the source) and masses are those of the tables of object data in
B. Calli et al., "Benchmarking in Manipulation Research: The YCB Object and Model Set and
Benchmarking Protocols", IEEE Robotics & Automation Magazine 22(3), 2015. Values that the
tables lack (wall thicknesses, necks, handles, colours) are chosen to match the real objects.

A piece is plain data: it names a function of `shapes` with its arguments, its paint (a function of `shapes` too)
and its pose and scale, in metres and radians. The hash of its pieces is an object's digest.
"""
# ruff: noqa: E501 - a table reads best with one piece per line

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


WHITE, BLACK, STEEL = (238, 236, 230), (28, 28, 30), (176, 178, 184)
RED, BLUE, GREEN, YELLOW, ORANGE = (200, 32, 36), (28, 60, 150), (40, 130, 60), (236, 196, 40), (238, 128, 24)
WOOD, BROWN, PINK = (196, 154, 98), (96, 56, 30), (222, 120, 140)

# fmt: off
_CUP_SIZES = [(55, 60), (60, 62), (65, 64), (70, 66), (75, 68), (80, 70), (85, 72), (90, 74), (95, 76), (100, 78)]
_CUP_COLOURS = [RED, ORANGE, YELLOW, GREEN, BLUE]
_TRUNCATED_PEAR: Points = [
    (6, 0), (22, 4), (31, 16), (33.1, 31), (30, 47), (22.5, 63), (17, 78), (13, 90), (6, 98.5), (0, 100),
]
RECIPES: dict[str, list[Piece]] = {
    "001_chips_can": [lathe(cylinder(75, 250, 12), label(RED, YELLOW, 90, 170, WHITE))],
    "002_master_chef_can": [lathe(cylinder(102, 139, 10), label(BLUE, WHITE, 30, 110, RED))],
    "003_cracker_box": [block(60, 158, 210, checks(52, RED, YELLOW), cells=8)],
    "004_sugar_box": [block(38, 89, 175, checks(44, YELLOW, WHITE), cells=8)],
    "005_tomato_soup_can": [lathe(cylinder(66, 101), bands((2, STEEL), (50, WHITE), (99, RED), (999, STEEL)))],
    "006_mustard_bottle": [
        lathe(
            [(43, 0), (47.5, 8), (47.5, 30), (46.5, 60), (45, 90), (42, 120), (32, 145), (16, 160), (15, 168), (13, 175), (4, 183), (3, 190)],
            bands((30, YELLOW), (60, RED), (110, YELLOW), (150, BLUE), (160, YELLOW), (999, RED)),
            scale=(1.0, 0.62, 1.0),
        )
    ],
    "007_tuna_fish_can": [lathe(cylinder(85, 33, 6), label(BLUE, WHITE, 6, 27, GREEN))],
    "008_pudding_box": [block(110, 89, 35, checks(40, BROWN, YELLOW))],
    "009_gelatin_box": [block(85, 73, 28, checks(30, RED, WHITE))],
    "010_potted_meat_can": [lathe(cylinder(97, 82), label(BLUE, WHITE, 20, 60, YELLOW), scale=(1.0, 50 / 97, 1.0))],
    "011_banana": [
        tube(arc(117, 38, 142, 13), [3.5, 8, 12.5, 15.5, 17.3, 18, 18, 18, 17.3, 15.5, 12.5, 8, 4], bands((-88, BROWN), (84, YELLOW), (999, BROWN), axis=0))
    ],
    "012_strawberry": [
        lathe([(3, 0), (11, 5), (17, 15), (21, 30), (21.9, 38), (19, 46), (11, 51), (5, 55)], bands((49, RED), (99, GREEN)))
    ],
    "013_apple": [lathe(ball(75), bands((20, RED), (50, (176, 24, 30)), (70, RED), (99, BROWN)))],
    "014_lemon": [lathe([(0, 0), (6, 3), (17, 10), (25, 22), (27, 34), (25, 46), (17, 58), (6, 65), (0, 68)], plain(YELLOW), turn_deg=(0, 90, 0))],
    "015_peach": [lathe(ball(59), bands((25, ORANGE), (45, PINK), (99, RED)))],
    "016_pear": [lathe(_TRUNCATED_PEAR, bands((55, (160, 180, 60)), (99, (190, 190, 70)), (999, BROWN)), turn_deg=(90, 0, 0))],
    "017_orange": [lathe(ball(73), plain(ORANGE))],
    "018_plum": [lathe(ball(52), plain((84, 30, 70)))],
    "019_pitcher_base": [
        vessel([(48, 0), (48, 4), (50, 120), (54, 235)], [(45, 4), (47, 120), (51, 235)], plain((40, 80, 170))),
        tube([(-48, 0, 190), (-75, 0, 200), (-88, 0, 175), (-88, 0, 110), (-75, 0, 80), (-46, 0, 78)], [8, 8, 8, 8, 8, 8], plain((40, 80, 170))),
    ],
    "021_bleach_cleanser": [
        lathe(
            [(44, 0), (49, 8), (49, 45), (49, 90), (49, 140), (44, 175), (30, 205), (18, 222), (18, 230), (21, 230.5), (21, 250)],
            bands((40, WHITE), (90, BLUE), (140, WHITE), (228, WHITE), (999, BLUE)),
            scale=(1.0, 0.663, 1.0),
        )
    ],
    "022_windex_bottle": [
        lathe(
            [(48, 0), (52.5, 8), (52.5, 60), (50, 110), (36, 150), (18, 180), (14, 195), (14, 225)],
            bands((40, (60, 140, 220)), (110, WHITE), (190, (60, 140, 220)), (999, RED)),
            scale=(1.0, 0.76, 1.0),
        ),
        block(95, 30, 45, plain(RED), at=(-2, 0, 247.5)),
        block(12, 14, 45, plain(RED), at=(26, 0, 205), turn_deg=(0, -25, 0)),
    ],
    "023_wine_glass": [
        lathe([(38, 0), (38, 2.5), (10, 5), (4.5, 10), (4, 30), (4, 60), (6, 64)], plain((200, 214, 220)), segments=24),
        vessel([(6, 63), (26, 68), (43, 90), (44.5, 105), (40, 137)], [(22, 68), (40, 90), (41.5, 105), (38, 137)], plain((200, 214, 220))),
    ],
    "024_bowl": [
        vessel([(40, 0), (46, 4), (63, 17), (74, 34), (79.5, 53)], [(42, 4), (59, 18), (70, 35), (76.5, 53)], bands((8, (150, 30, 30)), (999, RED)), segments=24)
    ],
    "025_mug": [
        vessel([(38, 0), (39, 6), (40, 82)], [(35, 6), (36.5, 82)], bands((8, BLACK), (999, RED)), segments=24),
        tube([(38, 0, 68), (52, 0, 66), (60, 0, 52), (60, 0, 36), (52, 0, 22), (38, 0, 19)], [5, 5, 5, 5, 5, 5], plain(RED), flat=1.4),
    ],
    "026_sponge": [block(114, 72, 14, sides(YELLOW, YELLOW, YELLOW, YELLOW, GREEN, YELLOW))],
    "027_skillet": [
        vessel([(110, 0), (113, 4), (135, 30)], [(110, 4), (131, 30)], plain(BLACK), segments=24),
        tube([(128, 0, 24), (180, 0, 34), (240, 0, 40), (320, 0, 40)], [8, 10, 11, 12], plain((50, 50, 54)), flat=0.6),
    ],
    "029_plate": [
        vessel([(80, 0), (86, 4), (112, 16), (129, 24)], [(82, 4), (109, 19.5), (126.5, 24)], plain((190, 30, 34)), segments=24)
    ],
    "031_spoon": [
        tube([(-97, 0, 12), (-60, 0, 9), (-20, 0, 6), (20, 0, 4), (46, 0, 6)], [7, 6, 4, 3, 4], plain(STEEL), flat=1.0),
        lathe(ball(38, 13), plain(STEEL), at=(72, 0, 0), scale=(1.4, 1.0, 1.0)),
    ],
    "032_knife": [
        block(95, 18, 14, plain(STEEL), at=(-60, 0, 0)),
        block(120, 20, 4, plain((196, 198, 204)), at=(47.5, 0, 0)),
    ],
    "033_spatula": [
        tube([(-175, 0, 14), (-60, 0, 14), (40, 0, 12), (90, 0, 5)], [11, 11, 6, 6], plain(BLACK)),
        block(92, 83, 5, plain((40, 40, 42)), at=(129, 0, 3)),
    ],
    "035_power_drill": [
        lathe([(20, 0), (23, 6), (23, 120), (17, 135), (10, 150), (6, 184)], bands((95, ORANGE), (125, BLACK), (999, STEEL)), at=(-92, 0, 150), turn_deg=(0, 90, 0)),
        block(36, 40, 108, checks(30, BLACK, (44, 44, 48)), at=(-62, 0, 90), turn_deg=(0, -8, 0)),
        block(80, 70, 40, sides(BLACK, BLACK, ORANGE, ORANGE, BLACK, BLACK), at=(-56, 0, 20)),
    ],
    "036_wood_block": [block(85, 85, 200, checks(34, WOOD, (186, 142, 86)), cells=8)],
    "038_padlock": [
        block(47, 38, 24, bands((0, (190, 160, 60)), (999, (200, 172, 74)), axis=1), at=(0, -14, 0)),
        tube([(-16, 0, 0), (-16, 16, 0), (-11, 27, 0), (0, 31, 0), (11, 27, 0), (16, 16, 0), (16, 0, 0)], [4] * 7, plain(STEEL)),
    ],
    "040_large_marker": [lathe([(7, 0), (9, 3), (9, 80), (9, 84), (9, 118), (6, 121)], bands((80, WHITE), (84, BLACK), (999, BLACK)), turn_deg=(0, 90, 0), segments=20)],
    "042_adjustable_wrench": [
        block(150, 22, 8, plain(STEEL), at=(-27, 0, 0)),
        block(30, 55, 12, plain((150, 152, 158)), at=(60, 0, 0)),
        block(28, 14, 12, plain(STEEL), at=(88, 19, 0)),
        block(28, 14, 12, plain(STEEL), at=(88, -16, 0)),
    ],
    "043_phillips_screwdriver": [
        lathe([(11, 0), (15.5, 8), (15.5, 60), (12, 85), (14, 98), (10, 104)], bands((12, BLACK), (60, ORANGE), (999, BLACK)), turn_deg=(0, 90, 0), segments=20),
        lathe([(3.2, 0), (3.2, 100), (0.8, 112)], plain(STEEL), at=(103, 0, 0), turn_deg=(0, 90, 0), segments=12),
    ],
    "044_flat_screwdriver": [
        lathe([(11, 0), (15.5, 8), (15.5, 60), (12, 85), (14, 98), (10, 104)], bands((12, BLACK), (60, BLUE), (999, BLACK)), turn_deg=(0, 90, 0), segments=20),
        lathe([(3.2, 0), (3.2, 105)], plain(STEEL), at=(103, 0, 0), turn_deg=(0, 90, 0), segments=12),
        block(6, 9, 2, plain(STEEL), at=(211, 0, 0)),
    ],
    "048_hammer": [
        lathe([(14, 0), (14, 60), (12, 140), (11, 240), (9, 300)], bands((140, BLACK), (999, WOOD)), at=(-180, 0, 0), turn_deg=(0, 90, 0), scale=(0.9, 1.1, 1.0), segments=20),
        lathe([(12, 0), (16, 3), (16, 24), (10, 34), (10, 90), (6, 135)], plain((96, 98, 104)), at=(120, 45, 0), turn_deg=(90, 0, 0), segments=20),
    ],
    "053_mini_soccer_ball": [lathe(ball(140, rings=20), checks(46, WHITE, BLACK), segments=40)],
    "054_softball": [lathe(ball(96), bands((30, YELLOW), (36, RED), (60, YELLOW), (66, RED), (999, YELLOW)))],
    "055_baseball": [lathe(ball(75), bands((20, WHITE), (26, RED), (50, WHITE), (56, RED), (999, WHITE)))],
    "056_tennis_ball": [lathe(ball(64.7), bands((28, (200, 220, 50)), (36, WHITE), (999, (200, 220, 50))))],
    "057_racquetball": [lathe(ball(55.3), plain((30, 60, 190)))],
    "058_golf_ball": [lathe(ball(42.7), plain(WHITE))],
    "061_foam_brick": [block(50, 75, 50, plain((170, 40, 50)))],
    "062_dice": [block(16.2, 16.2, 16.2, sides(WHITE, WHITE, WHITE, WHITE, RED, BLACK))],
    **{
        f"065-{letter}_cups": [cup(diameter, height, 2.5, bands((6, WHITE), (999, _CUP_COLOURS[i % 5])))]
        for i, (letter, (diameter, height)) in enumerate(zip("abcdefghij", _CUP_SIZES, strict=True))
    },
    "070-b_colored_wood_blocks": [block(26, 26, 26, sides(RED, RED, RED, RED, RED, (170, 24, 30)))],
    "077_rubiks_cube": [block(57, 57, 57, sides(RED, ORANGE, BLUE, GREEN, WHITE, YELLOW))],
}
