"""The tops of supporting furniture, from which both shapes and support surfaces are made.

Local frame: x right, y front, z up, origin on the floor below the centre, metres.
"""

from __future__ import annotations

from dataclasses import dataclass

from datagen.workers.furniture.asset_table import Asset

# Depth of a run of kitchen counter (24 inches, as all straight ones in the table).
COUNTER_DEPTH_M = 0.61

# Types whose tops support objects. Not beds, seats, sinks and toilets.
CARRYING_TYPES = frozenset(
    {
        "Cabinet", "Cart", "CoffeeTable", "CounterTop", "Desk", "DiningTable", "Dresser", "Shelf",
        "ShelvingUnit", "SideTable", "TVStand", "Table",
    }
)  # fmt: skip

# Corner desks: depth of the back run and width of the right wing, from the positions of objects
# observed on them.
_CORNER_DESKS = {"Desk_302": (0.60, 0.52), "Desk_316": (0.60, 0.55)}

# A rest height below this share of the height is an inner shelf, or a desk top below a hutch.
_INNER = 0.9


@dataclass(frozen=True)
class Rectangle:
    """A horizontal rectangle given by its intervals."""

    x: tuple[float, float]
    y: tuple[float, float]

    @property
    def size_m(self) -> tuple[float, float]:
        return (self.x[1] - self.x[0], self.y[1] - self.y[0])

    @property
    def centre_m(self) -> tuple[float, float]:
        return ((self.x[0] + self.x[1]) / 2, (self.y[0] + self.y[1]) / 2)


def top_height_m(asset: Asset) -> float:
    """Height of the top of furniture: the rest height, or the box's height if that is an inner shelf."""
    rest = asset.rest_height_m
    height = asset.size_m[2]
    if rest is None or rest <= 0.05:
        return height
    if asset.object_type == "Desk":
        return rest
    return rest if rest >= _INNER * height else height


def hutch_depth_m(asset: Asset) -> float:
    """Depth of the hutch above the back of a desk; 0 if it has none."""
    above = asset.size_m[2] - top_height_m(asset)
    return 0.25 * asset.size_m[1] if asset.object_type == "Desk" and above > 0.05 else 0.0


def top_rectangles(asset: Asset) -> list[Rectangle]:
    """The rectangles that make up the top: one, two for an L, three for a U."""
    width, depth, _ = asset.size_m
    x, y = (-width / 2, width / 2), (-depth / 2, depth / 2)
    run, wing, both = _corner(asset)
    if run is None:
        return [Rectangle(x, y)]
    rectangles = [Rectangle(x, (y[0], y[0] + run)), Rectangle((x[1] - wing, x[1]), (y[0] + run, y[1]))]
    if both:
        rectangles.append(Rectangle((x[0], x[0] + wing), (y[0] + run, y[1])))
    return rectangles


def _corner(asset: Asset) -> tuple[float | None, float, bool]:
    """(depth of the back run or None, width of the wings, whether there are two wings)."""
    width, depth, _ = asset.size_m
    if asset.object_type == "CounterTop":
        shape = asset.asset_id.rsplit("_", 2)[-2:-1]
        if shape in (["L"], ["C"]) and min(width, depth) > COUNTER_DEPTH_M + 0.1:
            return COUNTER_DEPTH_M, min(COUNTER_DEPTH_M, width / 2), shape == ["C"]
    for prefix, (run, wing) in _CORNER_DESKS.items():
        is_one = asset.object_type == "Desk" and asset.asset_id.startswith(prefix)
        if is_one and run < depth and wing < width:
            return run, wing, False
    return None, 0.0, False
