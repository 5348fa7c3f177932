"""Furniture with its doors open: a hollow body with boards, and door leaves that stand in the way.

Frame as in `solids`. Doors are hinged at a side and opened outwards, by an angle that the asset's id decides.
"""

from __future__ import annotations

import numpy as np

from datagen.workers.furniture.assets import Asset, top_height_m, top_rectangles
from datagen.workers.furniture.furniture_shapes import counter, cupboard_columns, dresser
from datagen.workers.furniture.solids import (
    ColouredSolid,
    Rgb,
    box,
    hash_bytes,
    prism,
    shade,
)

_BOARD_M = 0.018
_LEAF_M = 0.02
_OPENED_DEG = (75.0, 90.0, 105.0)
# Height of a compartment that no observed level decides, and the lowest one kept.
_COMPARTMENT_M, _LOWEST_M = 0.32, 0.16
_WIDE_M = 0.7  # wider fronts have two leaves


def open_cupboard(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A cupboard with boards behind open doors, or a closed chest of drawers, by the hash of the asset."""
    if hash_bytes(asset.asset_id)[5] % 2:
        return dresser(asset, rgb)
    x, y, _ = asset.halves_m
    top = top_height_m(asset)
    plinth = min(0.06, 0.1 * top)
    foot = box((-x + 0.01, x - 0.01), (-y, y - 0.03), (0.0, plinth), shade(rgb, 0.6))
    z = (plinth, top)
    front = y - _LEAF_M
    solids = [foot, *_carcass((-x, x), (-y, front), z, _BOARD_M, _boards(z, asset.levels_m), rgb)]
    return solids + _doors(asset, (-x, x), front, z, shade(rgb, 1.06))


def open_fridge(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A fridge with its large door open above a closed freezer."""
    x, y, height = asset.halves_m
    split, wall = 0.35 * height, 0.05
    front = y - 0.06
    z = (split, height)
    freezer = [
        box((-x, x), (-y, front), (0.0, split), shade(rgb, 0.9)),
        box((-x, x), (front, y - 0.03), (0.03, split - 0.005), rgb),
    ]
    inner: Rgb = (240, 242, 244)
    solids = freezer + _carcass((-x, x), (-y, front), z, wall, _boards(z, ()), inner)
    return solids + [_leaf(asset, (-x, x), front, (split + 0.005, height), 0.05, rgb)]


def open_microwave(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A microwave with its door open beside the closed panel."""
    x, y, height = asset.halves_m
    panel = 0.55 * x
    front, wall = y - 0.012, 0.03
    electronics = box((panel, x), (-y, y), (0.0, height), shade(rgb, 0.75))
    solids = [electronics, *_carcass((-x, panel), (-y, front), (0.0, height), wall, [], rgb)]
    return solids + [
        _leaf(asset, (-x, panel), front, (0.01, height - 0.01), _LEAF_M, (44, 44, 48), left=True)
    ]


def open_counter(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A counter of which about every third cupboard of the back run is open, at least one."""
    columns, front = cupboard_columns(asset)
    chosen = [k for k in range(len(columns)) if hash_bytes(asset.asset_id)[5 + k] % 3 == 0]
    opened = [columns[k] for k in chosen or [hash_bytes(asset.asset_id)[4] % len(columns)]]
    top = top_height_m(asset) - 0.04
    back, z = top_rectangles(asset)[0].y[0], (0.1, top)
    solids = counter(asset, rgb, opened)
    for x in opened:
        solids += _carcass(x, (back, front), z, _BOARD_M, _boards(z, ()), shade(rgb, 0.95))
        solids += _doors(asset, x, front, (0.12, top - 0.02), shade(rgb, 1.08))
    return solids


def _boards(z: tuple[float, float], levels_m: tuple[float, ...]) -> list[float]:
    """Heights of the boards between bottom and top: where objects were observed, else evenly spaced."""
    seen: list[float] = []
    for level in levels_m:
        if level - (seen[-1] if seen else z[0]) > _LOWEST_M and z[1] - level > _LOWEST_M:
            seen.append(level)
    count = max(1, round((z[1] - z[0]) / _COMPARTMENT_M))
    return seen or [z[0] + (z[1] - z[0]) * (k + 1) / count for k in range(count - 1)]


def _carcass(
    x: tuple[float, float],
    y: tuple[float, float],
    z: tuple[float, float],
    wall: float,
    boards: list[float],
    rgb: Rgb,
) -> list[ColouredSolid]:
    """A box without a front: bottom, top, sides, back, and boards whose upper sides are at `boards`."""
    inner_x, inner_z, dark = (x[0] + wall, x[1] - wall), (z[0] + wall, z[1] - wall), shade(rgb, 0.9)
    solids = [
        box(x, y, (z[0], inner_z[0]), rgb),
        box(x, y, (inner_z[1], z[1]), rgb),
        box((x[0], inner_x[0]), y, inner_z, dark),
        box((inner_x[1], x[1]), y, inner_z, dark),
        box(inner_x, (y[0], y[0] + wall), inner_z, shade(rgb, 0.8)),
    ]
    depth = (y[0] + wall, y[1] - 0.01)
    return solids + [box(inner_x, depth, (at - _BOARD_M, at), rgb) for at in boards]


def _doors(
    asset: Asset, x: tuple[float, float], front: float, z: tuple[float, float], rgb: Rgb
) -> list[ColouredSolid]:
    """The open leaves of a front: two that part in the middle, or one."""
    middle = (x[0] + x[1]) / 2
    if x[1] - x[0] < _WIDE_M:
        return [_leaf(asset, x, front, z, _LEAF_M, rgb)]
    return [
        _leaf(asset, half, front, z, _LEAF_M, rgb, left)
        for half, left in (((x[0], middle), True), ((middle, x[1]), False))
    ]


def _leaf(
    asset: Asset,
    x: tuple[float, float],
    front: float,
    z: tuple[float, float],
    thick: float,
    rgb: Rgb,
    left: bool | None = None,
) -> ColouredSolid:
    """A door leaf of the opening `x`, hinged at its left or right end; None: by the hash of the asset."""
    key = hash_bytes(asset.asset_id)
    is_left = key[6] % 2 == 0 if left is None else left
    angle = np.deg2rad(_OPENED_DEG[key[7] % len(_OPENED_DEG)])
    along = np.array([np.cos(angle), np.sin(angle)]) * (x[1] - x[0] - 0.004)
    across = np.array([np.sin(angle), -np.cos(angle)]) * thick
    corners = np.array([np.zeros(2), across, across + along, along])
    if not is_left:
        corners = corners[::-1] * (-1.0, 1.0)
    corners = corners + (x[0] if is_left else x[1], front + 0.002)
    low, high = (np.column_stack([corners, np.full(4, height)]) for height in z)
    return prism(low, high, rgb)
