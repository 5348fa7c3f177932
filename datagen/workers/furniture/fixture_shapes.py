"""Shapes of kitchen and bathroom fixtures, each from the size of its asset; front is +y."""

from __future__ import annotations

from datagen.workers.furniture.asset_table import Asset
from datagen.workers.furniture.colours import shade
from datagen.workers.furniture.solids import ColouredSolid, Rgb, ball, box, frustum, mirrored

_STEEL: Rgb = (176, 178, 182)
_DARK: Rgb = (44, 44, 48)


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
