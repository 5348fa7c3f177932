"""Shapes of lamps, plants, screens, containers and small objects, from the sizes of their assets."""

from __future__ import annotations

from datagen.workers.furniture.assets import Asset
from datagen.workers.furniture.solids import (
    ColouredSolid,
    Rgb,
    ball,
    box,
    frustum,
    hash_bytes,
    mirrored,
    pick,
    profile,
    shade,
)

_DARK: Rgb = (38, 38, 42)
_STEEL: Rgb = (176, 178, 182)
_LEAF: tuple[Rgb, ...] = ((74, 112, 58), (96, 132, 70), (60, 96, 60))
_LINEN: Rgb = (236, 226, 200)


def block(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A box of the asset's size."""
    x, y, height = asset.halves_m
    return [box((-x, x), (-y, y), (0.0, height), rgb)]


def column(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """An elliptic cylinder: rolls, tins, candles."""
    x, y, height = asset.halves_m
    return [frustum((0.0, height), (x, y), (x, y), rgb, 12)]


def pebble(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """An ellipsoid: fruit, balls, pillows."""
    x, y, height = asset.halves_m
    return [ball((0.0, 0.0, height / 2), (x, y, height / 2), rgb)]


def plant(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A pot and a crown of three tufts."""
    x, y, height = asset.halves_m
    pot = 0.3 * height
    leaf = pick(_LEAF, asset.asset_id)
    crown = height - pot
    return [
        frustum((0.0, pot), (0.38 * x, 0.38 * y), (0.55 * x, 0.55 * y), rgb),
        frustum((pot, pot + 0.35 * crown), (0.06 * x, 0.06 * y), (0.1 * x, 0.1 * y), (96, 78, 50), 6),
        ball((0.0, 0.0, height - 0.3 * crown), (0.62 * x, 0.62 * y, 0.3 * crown), leaf),
        ball((-0.4 * x, 0.15 * y, pot + 0.4 * crown), (0.6 * x, 0.7 * y, 0.3 * crown), shade(leaf, 0.88)),
        ball((0.4 * x, -0.15 * y, pot + 0.45 * crown), (0.6 * x, 0.7 * y, 0.3 * crown), shade(leaf, 1.12)),
    ]


def lamp(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """Foot, pole and shade."""
    x, y, height = asset.halves_m
    pole = max(0.008, 0.03 * min(x, y))
    low = 0.74 * height
    return [
        frustum((0.0, 0.03 * height), (0.6 * x, 0.6 * y), (0.55 * x, 0.55 * y), rgb),
        frustum((0.03 * height, low), (pole, pole), (pole, pole), rgb, 6),
        frustum((low, height), (x, y), (0.68 * x, 0.68 * y), _LINEN),
    ]


def screen(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A flat screen that faces +y, on a foot if it is deep."""
    x, y, height = asset.halves_m
    if y < 0.07:
        return [
            box((-x, x), (-y, 0.5 * y), (0.0, height), _DARK),
            box((-x + 0.015, x - 0.015), (0.5 * y, y), (0.015, height - 0.015), (18, 20, 26)),
        ]
    foot = 0.12 * height
    return [
        box((-x, x), (-0.03, 0.02), (foot, height), _DARK),
        box((-x + 0.015, x - 0.015), (0.02, 0.026), (foot + 0.015, height - 0.015), (18, 20, 26)),
        box((-0.05, 0.05), (-0.03, 0.02), (0.015, foot), _DARK),
        box((-0.4 * x, 0.4 * x), (-y, y), (0.0, 0.015), _DARK),
    ]


def painting(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A frame with a picture of three fields, facing +y."""
    x, y, height = asset.halves_m
    h = hash_bytes(asset.asset_id)
    edge = min(0.04, 0.1 * min(x, height))
    level = edge + (0.3 + 0.3 * h[5] / 255) * (height - 2 * edge)
    field: Rgb = (60 + h[6] % 160, 60 + h[7] % 160, 60 + h[8] % 160)
    sky: Rgb = (120 + h[9] % 120, 120 + h[10] % 120, 120 + h[11] % 120)
    inner = (-x + edge, x - edge)
    return [
        box((-x, x), (-y, 0.4 * y), (0.0, height), rgb),
        box(inner, (0.4 * y, y), (edge, level), field),
        box(inner, (0.4 * y, y), (level, height - edge), sky),
    ]


def laptop(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """An open laptop: keyboard in front, lid leaning back."""
    x, y, height = asset.halves_m
    hinge = -y + 0.35 * 2 * y
    lid = [(hinge, 0.01), (hinge + 0.012, 0.015), (-y + 0.012, height), (-y, height - 0.005)]
    base = box((-x, x), (hinge, y), (0.0, 0.018), rgb)
    keys = box((-0.9 * x, 0.9 * x), (hinge + 0.03, hinge + 0.6 * (y - hinge)), (0.018, 0.021), _DARK)
    return [base, keys, profile(lid, (-x, x), shade(rgb, 0.5))]


def container(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """An open box: bottom and four sides."""
    x, y, height = asset.halves_m
    t = min(0.012, 0.1 * min(x, y))
    z = (t, height)
    dark = shade(rgb, 0.9)
    return [
        box((-x, x), (-y, y), (0.0, t), shade(rgb, 0.8)),
        *mirrored((x - t, x), (-y, y), z, rgb),
        box((-x + t, x - t), (-y, -y + t), z, dark),
        box((-x + t, x - t), (y - t, y), z, dark),
    ]


def bin_(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A tapered bucket with a dark mouth."""
    x, y, height = asset.halves_m
    mouth = max(0.9 * height, height - 0.02)
    return [
        frustum((0.0, mouth), (0.78 * x, 0.78 * y), (0.98 * x, 0.98 * y), rgb, 12),
        frustum((mouth, height), (x, y), (x, y), shade(rgb, 0.6), 12),
    ]


def bowl(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A vessel that opens upwards: bowls and plates."""
    x, y, height = asset.halves_m
    low = 0.75 * height
    return [
        frustum((0.0, low), (0.5 * x, 0.5 * y), (0.92 * x, 0.92 * y), rgb, 12),
        frustum((low, height), (0.92 * x, 0.92 * y), (x, y), shade(rgb, 0.85), 12),
    ]


def cup(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A cup; with a handle if it is longer in one direction."""
    x, y, height = asset.halves_m
    radius = min(x, y)
    shift = (-(x - radius), -(y - radius))
    solids = [frustum((0.0, height), (0.8 * radius, 0.8 * radius), (radius, radius), rgb, centre_m=shift)]
    if x - y > 0.01:
        grip = (x - 2 * (x - radius) - 0.01, x)
        solids.append(box(grip, (-0.007, 0.007), (0.25 * height, 0.8 * height), rgb))
    elif y - x > 0.01:
        grip = (y - 2 * (y - radius) - 0.01, y)
        solids.append(box((-0.007, 0.007), grip, (0.25 * height, 0.8 * height), rgb))
    return solids


def bottle(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """Body, shoulder and neck."""
    x, y, height = asset.halves_m
    neck = max(0.004, 0.32 * min(x, y))
    return [
        frustum((0.0, 0.6 * height), (x, y), (x, y), rgb),
        frustum((0.6 * height, 0.76 * height), (x, y), (neck, neck), rgb),
        frustum((0.76 * height, height), (neck, neck), (neck, neck), shade(rgb, 0.7), 8),
    ]


def vase(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A belly that narrows to a mouth."""
    x, y, height = asset.halves_m
    return [
        frustum((0.0, 0.45 * height), (0.5 * x, 0.5 * y), (x, y), rgb),
        frustum((0.45 * height, 0.85 * height), (x, y), (0.4 * x, 0.4 * y), rgb),
        frustum((0.85 * height, height), (0.4 * x, 0.4 * y), (0.55 * x, 0.55 * y), rgb),
    ]


def pan(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A round pan with a handle along the longer side; two grips if it is nearly round."""
    x, y, height = asset.halves_m
    radius = min(x, y)
    if max(x, y) < 1.2 * radius:
        grip = box((-x, x), (-0.02, 0.02), (0.7 * height, 0.85 * height), shade(rgb, 0.6))
        return [frustum((0.0, height), (0.8 * x, 0.9 * y), (0.85 * x, 0.95 * y), rgb, 12), grip]
    along_y = y > x
    far = max(x, y)
    centre = (0.0, -(far - radius)) if along_y else (-(far - radius), 0.0)
    reach = (2 * radius - far - 0.01, far)
    across = (-0.012, 0.012)
    grip = (across, reach) if along_y else (reach, across)
    return [
        frustum((0.0, height), (0.85 * radius, 0.85 * radius), (radius, radius), rgb, 12, centre),
        box(grip[0], grip[1], (0.5 * height, 0.9 * height), _DARK),
    ]


def dispenser(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A bottle with a pump or trigger on top."""
    x, y, height = asset.halves_m
    pump = (0.3 * x, 0.3 * y)
    return [
        frustum((0.0, 0.68 * height), (x, 0.75 * y), (0.9 * x, 0.7 * y), rgb),
        frustum((0.68 * height, 0.86 * height), pump, pump, shade(rgb, 0.7), 6),
        box((-0.3 * x, 0.3 * x), (-0.3 * y, y), (0.86 * height, height), shade(rgb, 0.7)),
    ]


def appliance(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A box with a dark front window and a panel: microwaves, safes, computers."""
    x, y, height = asset.halves_m
    return [
        box((-x, x), (-y, y - 0.012), (0.0, height), rgb),
        box((-0.94 * x, 0.5 * x), (y - 0.012, y), (0.1 * height, 0.92 * height), _DARK),
        box((0.56 * x, 0.94 * x), (y - 0.012, y - 0.004), (0.1 * height, 0.92 * height), shade(rgb, 0.75)),
    ]


def toaster(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A rounded block with two slots."""
    x, y, height = asset.halves_m
    slot = (0.4 * x - 0.012, 0.4 * x + 0.012)
    slots = mirrored(slot, (-0.7 * y, 0.7 * y), (0.96 * height, height), _DARK)
    return [box((-x, x), (-y, y), (0.0, 0.96 * height), rgb), *slots]


def coffee_machine(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A foot and a brewing head that protrudes from a column at the back."""
    x, y, height = asset.halves_m
    return [
        box((-x, x), (-y, y), (0.0, 0.12 * height), _DARK),
        box((-x, x), (-y, -0.1 * y), (0.12 * height, height), rgb),
        box((-0.9 * x, 0.9 * x), (-0.1 * y, 0.9 * y), (0.68 * height, height), shade(rgb, 0.85)),
    ]


def kettle(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """Body, spout and handle."""
    x, y, height = asset.halves_m
    return [
        frustum((0.0, 0.75 * height), (0.9 * x, 0.8 * y), (0.55 * x, 0.5 * y), rgb),
        box((-0.015, 0.015), (0.45 * y, y), (0.5 * height, 0.68 * height), _STEEL),
        box((-0.015, 0.015), (-0.6 * y, 0.5 * y), (0.9 * height, height), _DARK),
        box((-0.015, 0.015), (-0.6 * y, -0.4 * y), (0.7 * height, 0.9 * height), _DARK),
    ]


def book(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """Covers around pages."""
    x, y, height = asset.halves_m
    t = 0.2 * height
    return [
        box((-x, x), (-y, y), (0.0, t), rgb),
        box((-x + 0.003, x - 0.006), (-y + 0.006, y - 0.006), (t, height - t), (238, 232, 216)),
        box((-x, x), (-y, y), (height - t, height), rgb),
    ]


def statue(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A figure on a plinth."""
    x, y, height = asset.halves_m
    return [
        box((-0.8 * x, 0.8 * x), (-0.8 * y, 0.8 * y), (0.0, 0.1 * height), shade(rgb, 0.6)),
        ball((0.0, 0.0, 0.42 * height), (x, y, 0.33 * height), rgb),
        ball((0.0, 0.1 * y, 0.84 * height), (0.5 * x, 0.55 * y, 0.16 * height), rgb),
    ]


def teddy(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A sitting bear: body, head, ears, legs."""
    x, y, height = asset.halves_m
    dark = shade(rgb, 0.85)
    return [
        ball((0.0, -0.2 * y, 0.3 * height), (0.6 * x, 0.7 * y, 0.3 * height), rgb),
        ball((0.0, -0.1 * y, 0.74 * height), (0.5 * x, 0.6 * y, 0.22 * height), rgb),
        ball((-0.42 * x, -0.1 * y, 0.93 * height), (0.15 * x, 0.15 * y, 0.07 * height), dark),
        ball((0.42 * x, -0.1 * y, 0.93 * height), (0.15 * x, 0.15 * y, 0.07 * height), dark),
        ball((-0.6 * x, 0.5 * y, 0.13 * height), (0.3 * x, 0.5 * y, 0.13 * height), dark),
        ball((0.6 * x, 0.5 * y, 0.13 * height), (0.3 * x, 0.5 * y, 0.13 * height), dark),
    ]


def basket_bed(asset: Asset, rgb: Rgb) -> list[ColouredSolid]:
    """A cushion with a raised border on three sides."""
    x, y, height = asset.halves_m
    t = 0.14 * min(x, y)
    return [
        box((-x, x), (-y, y), (0.0, 0.45 * height), rgb),
        box((-x, x), (-y, -y + t), (0.45 * height, height), shade(rgb, 0.8)),
        *mirrored((x - t, x), (-y + t, y), (0.45 * height, height), shade(rgb, 0.8)),
    ]
