"""Shapes of furniture and fixtures, each from the size of its asset; front is +y, the back is at the wall."""

from __future__ import annotations

from collections.abc import Sequence

from datagen.workers.furniture.assets import Asset, hutch_depth_m, top_height_m, top_rectangles
from datagen.workers.furniture.solids import (
    ColouredSolid,
    Rgb,
    ball,
    box,
    frustum,
    hash_bytes,
    mirrored,
    shade,
)

_CUSHION_PILLOW: Rgb = (232, 228, 220)
_DARK: Rgb = (44, 44, 48)
_STEEL: Rgb = (176, 178, 182)
_WHITE: Rgb = (236, 236, 234)
# Height of a sofa's seat as a share of the sofa's height, if no object was observed on it.
SOFA_SEAT_SHARE = 0.46


def _legs(x: float, y: float, z: tuple[float, float], side: float, rgb: Rgb) -> list[ColouredSolid]:
    """Four square legs whose outer faces are at +-x and +-y."""
    across = ((-x, side - x), (x - side, x))
    along = ((-y, side - y), (y - side, y))
    return [box(i, j, z, rgb) for i in across for j in along]


def table(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A top on four legs."""
    x, y, _ = asset.halves_m
    top = top_height_m(asset)
    slab = min(0.04, 0.12 * top)
    leg = min(0.07, 0.16 * min(x, y))
    inset = 0.02 if min(x, y) > 0.2 else 0.0
    legs = _legs(x - inset, y - inset, (0.0, top - slab), leg, shade(rgb, 0.86))
    return [box((-x, x), (-y, y), (top - slab, top), rgb), *legs]


def side_table(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A small table with a lower board, or a bedside cabinet, by the hash of the asset."""
    x, y, _ = asset.halves_m
    top = top_height_m(asset)
    if hash_bytes(asset.asset_id)[2] % 2:
        return dresser(asset, rgb)
    inner = [z for z in asset.levels_m if 0.05 < z < top - 0.1]
    board = inner[0] if inner else 0.3 * top
    lower = box((-x + 0.015, x - 0.015), (-y + 0.015, y - 0.015), (board - 0.02, board), shade(rgb, 0.95))
    return [*table(asset, rgb), lower]


def counter(asset: Asset, rgb: Rgb, opened: Sequence[tuple[float, float]] = ()) -> list[ColouredSolid]:
    """Cupboards on a plinth below a worktop, along every run of an I, L or U.

    The columns `opened` of the back run, intervals along x, are left out.
    """
    top = top_height_m(asset)
    cupboard, worktop = rgb, shade((176, 172, 166), 0.8 + 0.4 * hash_bytes(asset.asset_id)[3] / 255)
    solids: list[ColouredSolid] = []
    for k, r in enumerate(top_rectangles(asset)):
        # The toe space is at the side that faces the room: +y for the back run, inwards for wings.
        front = ((0.0, 0.0, 0.0, 0.06), (0.06, 0.0, 0.0, 0.0), (0.0, 0.06, 0.0, 0.0))[k]
        x = (r.x[0] + front[0], r.x[1] - front[1])
        y = (r.y[0] + front[2], r.y[1] - front[3])
        solids.append(box(x, y, (0.0, 0.1), shade(cupboard, 0.55)))
        x = (r.x[0] + front[0] / 3, r.x[1] - front[1] / 3)
        y = (r.y[0] + front[2] / 3, r.y[1] - front[3] / 3)
        ends = [x[0], *(end for column in opened for end in column), x[1]] if k == 0 else [*x]
        pairs = [(low, high) for low, high in zip(ends[::2], ends[1::2], strict=True) if high - low > 1e-3]
        solids.extend(box(pair, y, (0.1, top - 0.04), cupboard) for pair in pairs)
        solids.append(box(r.x, r.y, (top - 0.04, top), worktop))
    columns, leaf = cupboard_columns(asset)
    for low, high in columns:
        if (low, high) not in opened:
            x, z = (low + 0.01, high - 0.01), (0.12, top - 0.06)
            solids.append(box(x, (leaf, leaf + 0.012), z, shade(cupboard, 1.08)))
    return solids


def cupboard_columns(asset: Asset) -> tuple[list[tuple[float, float]], float]:
    """The columns of the back run of a counter that no wing hides, along x, and the y of their fronts."""
    runs = top_rectangles(asset)
    low = runs[2].x[1] if len(runs) == 3 else runs[0].x[0]
    high = runs[1].x[0] if len(runs) > 1 else runs[0].x[1]
    count = max(1, min(6, round((high - low) / 0.5)))
    step = (high - low) / count
    return [(low + k * step, low + (k + 1) * step) for k in range(count)], runs[0].y[1] - 0.02


def desk(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A top on a side panel, a back panel and drawers, open at the front; a hutch on a higher desk."""
    x, y, height = asset.halves_m
    top = top_height_m(asset)
    board = (top - 0.035, top)
    below = (0.0, top - 0.035)
    dark = shade(rgb, 0.88)
    rectangles = top_rectangles(asset)
    run_y = rectangles[0].y
    solids = [box(r.x, r.y, board, rgb) for r in rectangles]
    solids.append(box((-x, -x + 0.03), run_y, below, dark))
    solids.append(box((-x + 0.03, x), (-y, -y + 0.02), (0.35 * top, top - 0.035), dark))
    drawers = min(0.4, 0.3 * 2 * x)
    solids.append(box((x - drawers, x), (-y + 0.02, run_y[1] - 0.02), below, dark))
    solids.append(
        box((x - drawers + 0.01, x - 0.01), (run_y[1] - 0.02, run_y[1] - 0.005), (0.06, below[1] - 0.01), rgb)
    )
    for wing in rectangles[1:]:
        solids.append(box((wing.x[0], wing.x[1]), (wing.y[1] - 0.03, wing.y[1]), below, dark))
    hutch = hutch_depth_m(asset)
    if hutch > 0:
        back = (-y, -y + hutch)
        solids.append(box((-x, x), (-y, -y + 0.02), (top, height), dark))
        solids += mirrored((x - 0.02, x), (-y + 0.02, back[1]), (top, height), dark)
        solids.append(box((-x + 0.02, x - 0.02), (-y + 0.02, back[1]), (height - 0.02, height), rgb))
    return solids


def dresser(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A chest with drawer fronts on a plinth."""
    x, y, _ = asset.halves_m
    top = top_height_m(asset)
    plinth = min(0.06, 0.1 * top)
    dark = shade(rgb, 0.8)
    solids = [
        box((-x + 0.01, x - 0.01), (-y, y - 0.03), (0.0, plinth), shade(rgb, 0.6)),
        box((-x + 0.005, x - 0.005), (-y, y - 0.015), (plinth, top - 0.025), dark),
        box((-x, x), (-y, y), (top - 0.025, top), rgb),
    ]
    columns = 2 if x > 0.4 else 1
    rows = max(1, min(4, round((top - plinth) / 0.24)))
    wide, high = (2 * x - 0.01) / columns, (top - 0.025 - plinth) / rows
    for c in range(columns):
        for r in range(rows):
            left, low = -x + 0.005 + c * wide, plinth + r * high
            front = ((left + 0.012, left + wide - 0.012), (low + 0.012, low + high - 0.012))
            solids.append(box(front[0], (y - 0.015, y - 0.003), front[1], rgb))
    return solids


def tv_stand(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A low board with open compartments."""
    x, y, _ = asset.halves_m
    top = top_height_m(asset)
    dark = shade(rgb, 0.85)
    inner = (0.08, top - 0.03)
    return [
        box((-x, x), (-y, y), (top - 0.03, top), rgb),
        box((-x, x), (-y, y), (0.05, 0.08), dark),
        box((-x + 0.03, x - 0.03), (-y + 0.03, y - 0.03), (0.0, 0.05), shade(rgb, 0.55)),
        *mirrored((x - 0.03, x), (-y, y), inner, dark),
        box((-0.015, 0.015), (-y + 0.02, y - 0.01), inner, dark),
        box((-x + 0.03, x - 0.03), (-y, -y + 0.02), inner, shade(rgb, 0.7)),
    ]


def shelf(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """Sides, a back and boards: at heights of observed objects, else evenly spaced."""
    x, y, _ = asset.halves_m
    top = top_height_m(asset)
    seen = sorted({z for z in (*asset.levels_m, asset.rest_height_m or 0.0) if 0.08 < z < top - 0.1})
    boards: list[float] = []
    for z in seen:
        if not boards or z - boards[-1] > 0.08:
            boards.append(z)
    if not boards:
        count = max(1, min(6, round(top / 0.36) - 1))
        boards = [top * (k + 1) / (count + 1) for k in range(count)]
    dark = shade(rgb, 0.88)
    side = min(0.025, 0.1 * x)
    solids = [
        *mirrored((x - side, x), (-y, y), (0.0, top - 0.025), dark),
        box((-x + side, x - side), (-y, -y + 0.012), (0.0, top - 0.025), shade(rgb, 0.75)),
        box((-x, x), (-y, y), (top - 0.025, top), rgb),
        box((-x + side, x - side), (-y + 0.012, y), (0.03, 0.05), rgb),
    ]
    for z in boards[:12]:
        solids.append(box((-x + side, x - side), (-y + 0.012, y), (z - 0.02, z), rgb))
    return solids


def cart(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """Three trays between four posts."""
    x, y, height = asset.halves_m
    top = top_height_m(asset)
    trays = [box((-x, x), (-y, y), (z - 0.025, z), rgb) for z in (0.2 * height, 0.6 * height, top)]
    return [*trays, *_legs(x, y, (0.0, top - 0.025), 0.03, shade(rgb, 0.7))]


def seat_height_m(asset: Asset, share: float) -> float:
    """Height of a seat or mattress: the rest height if it is below the back, else a share."""
    height, rest = asset.size_m[2], asset.rest_height_m
    return rest if rest is not None and 0.15 < rest < 0.9 * height else share * height


def sofa(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """Seat, back and arms; also for armchairs."""
    x, y, height = asset.halves_m
    seat = seat_height_m(asset, SOFA_SEAT_SHARE)
    arm = min(0.2, 0.22 * x)
    back = min(0.24, 0.3 * 2 * y)
    arm_top = min(height, seat + 0.5 * (height - seat))
    cushions = max(1, min(4, round((2 * x - 2 * arm) / 0.7)))
    wide = (2 * x - 2 * arm) / cushions
    solids = [
        box((-x + 0.03, x - 0.03), (-y + 0.03, y - 0.03), (0.0, 0.06), _DARK),
        box((-x + arm, x - arm), (-y + back, y - 0.02), (0.06, seat - 0.1), shade(rgb, 0.85)),
        box((-x + arm, x - arm), (-y, -y + back), (0.06, height), shade(rgb, 0.93)),
        *mirrored((x - arm, x), (-y, y), (0.06, arm_top), shade(rgb, 0.9)),
    ]
    for k in range(cushions):
        left = -x + arm + k * wide
        solids.append(box((left + 0.005, left + wide - 0.005), (-y + back, y), (seat - 0.1, seat), rgb))
    return solids


def chair(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """Four legs, a seat and a back at the rear."""
    x, y, height = asset.halves_m
    seat = seat_height_m(asset, 0.5)
    rear, low = (-y, -y + 0.035), seat + 0.3 * (height - seat)
    back = box((-x, x), rear, (low, height), rgb)
    posts = mirrored((x - 0.035, x), rear, (seat, low), shade(rgb, 0.85))
    legs = _legs(x, y, (0.0, seat - 0.04), 0.035, shade(rgb, 0.85))
    return [box((-x, x), (-y, y), (seat - 0.04, seat), rgb), back, *posts, *legs]


def stool(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A seat on four legs."""
    x, y, _ = asset.halves_m
    top = top_height_m(asset)
    seat = frustum((top - 0.05, top), (x, y), (x, y), rgb, 12)
    return [seat, *_legs(0.75 * x, 0.75 * y, (0.0, top - 0.05), 0.035, shade(rgb, 0.8))]


def ottoman(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """An upholstered block on a base."""
    x, y, _ = asset.halves_m
    top = top_height_m(asset)
    base = box((-x + 0.03, x - 0.03), (-y + 0.03, y - 0.03), (0.0, 0.06), _DARK)
    return [base, box((-x, x), (-y, y), (0.06, top), rgb)]


def bed(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A mattress on a frame with a headboard and pillows; on posts for a loft or bunk bed."""
    x, y, height = asset.halves_m
    top = seat_height_m(asset, 0.6)
    frame: Rgb = shade((140, 104, 72), 0.8 + 0.4 * hash_bytes(asset.asset_id)[4] / 255)
    mattress = 0.2 if top > 0.35 else 0.5 * top
    low = (top - mattress - 0.12, top - mattress) if top > 1.0 else (0.08, top - mattress)
    head = 0.05
    solids = [
        box((-x + 0.02, x - 0.02), (-y + head, y - 0.02), (max(low[0], 0.01), low[1]), frame),
        box((-x + 0.02, x - 0.02), (-y + head, y - 0.02), (low[1], top), _WHITE),
        box((-x, x), (-0.2 * y, y), (low[1] + 0.02, top + 0.005), rgb),
        box((-x, x), (-y, -y + head), (0.0, height), frame),
        *_legs(x - 0.02, y - 0.02, (0.0, max(low[0], 0.01)), 0.05, frame),
    ]
    pillows = 2 if x > 0.6 else 1
    room = min(0.11, height - top) if height - top > 0.04 else 0.11
    deep = min(0.19, 0.2 * y)
    for k in range(pillows):
        centre = ((k - (pillows - 1) / 2) * 0.9 * x, -y + head + deep + 0.03, top + room / 2)
        solids.append(ball(centre, (min(0.33, 0.42 * x), deep, room / 2), _CUSHION_PILLOW))
    return solids


def fridge(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """Two doors with handles in front of a body."""
    x, y, height = asset.halves_m
    split = 0.35 * height
    door = (y - 0.06, y - 0.03)
    bar = (y - 0.03, y)
    grip = (-x + 0.05, -x + 0.08)
    return [
        box((-x, x), (-y, y - 0.065), (0.0, height), shade(rgb, 0.9)),
        box((-x, x), door, (0.03, split - 0.005), rgb),
        box((-x, x), door, (split + 0.005, height), rgb),
        box(grip, bar, (0.6 * split, 0.95 * split), _STEEL),
        box(grip, bar, (split + 0.05, split + 0.4 * (height - split)), _STEEL),
    ]


def toilet(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """Bowl, seat and cistern."""
    x, y, height = asset.halves_m
    seat = min(0.42, 0.45 * height)
    tank = min(0.2, 0.25 * 2 * y)
    centre = (0.0, tank / 2)
    reach = y - tank / 2
    return [
        frustum((0.0, seat - 0.04), (0.5 * x, 0.62 * reach), (0.75 * x, 0.97 * reach), rgb, centre_m=centre),
        frustum((seat - 0.04, seat), (0.78 * x, reach), (0.78 * x, reach), shade(rgb, 0.95), 12, centre),
        box((-0.85 * x, 0.85 * x), (-y, -y + tank), (seat - 0.05, height - 0.03), rgb),
        box((-0.9 * x, 0.9 * x), (-y, -y + tank + 0.01), (height - 0.03, height), shade(rgb, 0.95)),
    ]


def sink(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A basin with a rim, on a pedestal if it stands on the floor."""
    x, y, height = asset.halves_m
    rim = min(height, 0.86) if height > 0.5 else height
    deep = min(0.16, rim) if rim < 0.3 else 0.16
    wall = min(0.06, 0.2 * min(x, y))
    z = (rim - deep, rim)
    solids = [
        box((-x, x), (-y, -y + 2 * wall), z, rgb),
        box((-x, x), (y - wall, y), z, rgb),
        *mirrored((x - wall, x), (-y + 2 * wall, y - wall), z, rgb),
        box((-x + wall, x - wall), (-y + 2 * wall, y - wall), (z[0], z[0] + 0.25 * deep), shade(rgb, 0.88)),
    ]
    if z[0] > 0.3:
        solids.append(box((-0.35 * x, 0.35 * x), (-y, 0.3 * y), (0.0, z[0]), shade(rgb, 0.95)))
    if height - rim > 0.05:
        solids.append(box((-0.08 * x, 0.08 * x), (-y, -y + 2 * wall), (rim, height), _STEEL))
    return solids


def washing_machine(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A box with a panel and a round door."""
    x, y, height = asset.halves_m
    radius = min(0.7 * x, 0.32 * height)
    return [
        box((-x, x), (-y, y - 0.03), (0.0, height), rgb),
        box((-x, x), (y - 0.03, y - 0.015), (0.85 * height, height), shade(rgb, 0.8)),
        ball((0.0, y - 0.03, 0.45 * height), (radius, 0.03, radius), (70, 78, 88)),
    ]


def stove(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """An oven with a glass door below four hotplates."""
    x, y, height = asset.halves_m
    radii = (0.28 * x, 0.28 * y)
    plates = [
        frustum((height - 0.012, height), radii, radii, _DARK, centre_m=(sx * 0.45 * x, sy * 0.4 * y))
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    return [
        box((-x, x), (-y, y - 0.02), (0.0, height - 0.012), rgb),
        box((-0.85 * x, 0.85 * x), (y - 0.02, y - 0.008), (0.15 * height, 0.7 * height), _DARK),
        box((-0.85 * x, 0.85 * x), (y - 0.02, y), (0.74 * height, 0.77 * height), _STEEL),
        *plates,
    ]


def wall_cabinet(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A hanging cupboard with two doors."""
    x, y, height = asset.halves_m
    doors = mirrored((0.005, x - 0.005), (y - 0.02, y - 0.004), (0.01, height - 0.01), shade(rgb, 1.06))
    return [box((-x, x), (-y, y - 0.02), (0.0, height), rgb), *doors]
