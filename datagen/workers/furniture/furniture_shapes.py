"""Shapes of furniture, each from the size of its asset; front is +y, the back stands at the wall."""

from __future__ import annotations

from datagen.workers.furniture.asset_table import Asset
from datagen.workers.furniture.colours import hash_bytes, shade
from datagen.workers.furniture.solids import ColouredSolid, Rgb, ball, box, frustum, mirrored
from datagen.workers.furniture.support_tops import hutch_depth_m, top_height_m, top_rectangles

_CUSHION_PILLOW: Rgb = (232, 228, 220)
_DARK: Rgb = (44, 44, 48)
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


def counter(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """Cupboards on a plinth below a worktop, along every run of an I, L or U."""
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
        solids.append(box(x, y, (0.1, top - 0.04), cupboard))
        solids.append(box(r.x, r.y, (top - 0.04, top), worktop))
    solids.extend(_cupboard_doors(asset, top, shade(cupboard, 1.08)))
    return solids


def _cupboard_doors(asset: Asset, top: float, rgb: Rgb) -> list[ColouredSolid]:
    """Door leaves in front of the part of the back run that no wing hides."""
    runs = top_rectangles(asset)
    low = runs[2].x[1] if len(runs) == 3 else runs[0].x[0]
    high = runs[1].x[0] if len(runs) > 1 else runs[0].x[1]
    count = max(1, min(6, round((high - low) / 0.5)))
    step = (high - low) / count
    front = runs[0].y[1] - 0.02
    return [
        box(
            (low + k * step + 0.01, low + (k + 1) * step - 0.01),
            (front, front + 0.012),
            (0.12, top - 0.06),
            rgb,
        )
        for k in range(count)
    ]


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
