"""Sizes and types of the assets that house files name by id."""

from __future__ import annotations

import gzip
import io
import json
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular
from datagen.workers.json_document import JsonNode, parse_json

TABLE_NAMES = ("asset_sizes.json", "asset-database.json", "annotations.json.gz", "annotations.json")
_SUPPORT_HEIGHTS = Path(__file__).with_name("support_heights.json")
_LARGEST_TABLE_BYTES = 256 << 20  # unpacked
_MAX_ASSETS = 200_000
_MAX_SIZE_M = 20.0
_THINNEST_M = 1e-4


@dataclass(frozen=True)
class Asset:
    """One asset in its own frame: x right, y front, z up, base at z = 0, metres.

    `rest_height_m` is the height above the base at which objects rest, None if none do or it is
    unknown; `levels_m` are further heights at which objects were observed.
    """

    asset_id: str
    object_type: str
    size_m: tuple[float, float, float]  # width, depth, height
    rest_height_m: float | None = None
    levels_m: tuple[float, ...] = ()

    @property
    def halves_m(self) -> tuple[float, float, float]:
        """Half the width, half the depth, and the height."""
        return self.size_m[0] / 2, self.size_m[1] / 2, self.size_m[2]


def read_asset_table(folder: Path, *, is_needed: bool = True) -> tuple[dict[str, Asset], bytes]:
    """The folder's size table by asset id, and the bytes that decide on it (for the digest).

    Reads `asset_sizes.json` ({assetId: {objectType, size}}), or else AI2-THOR's own
    `asset-database.json` ({objectType: [{assetId, boundingBox}]} or one flat list), which has no
    heights at which things rest: `support_heights.json` of this package has them. Or else the
    annotations of objathor ({assetId: {category, thor_metadata}}), which have none.
    """
    path = next((folder / name for name in TABLE_NAMES if (folder / name).exists()), None)
    fix = "Put asset_sizes.json into the folder; `datagen assets fetch procthor-10k` gets both."
    if path is None and not is_needed:
        return {}, b""
    if path is None:
        raise InputError(folder, "", f"has no size table ({' or '.join(TABLE_NAMES)})", fix)
    text = read_regular(path, _LARGEST_TABLE_BYTES, fix)
    if path.suffix == ".gz":
        text = _unpacked(path, text, fix)
    root = parse_json(text, str(path))
    assets = {asset.asset_id: asset for asset in _assets(root)}
    if not assets:
        raise InputError(path, "", "is an empty size table", fix)
    if path.name == TABLE_NAMES[0]:
        return assets, text
    heights = _SUPPORT_HEIGHTS.read_bytes()
    known = json.loads(heights)["assets"]
    return {i: _with_heights(asset, known.get(i)) for i, asset in assets.items()}, text + heights


def _with_heights(asset: Asset, known: tuple[float, float | None, list[float]] | None) -> Asset:
    """The asset with the heights at which things were seen to rest on an asset of its id and height."""
    if known is None or abs(known[0] - asset.size_m[2]) > 1e-3:
        return asset
    return replace(asset, rest_height_m=known[1], levels_m=tuple(known[2]))


def _assets(root: JsonNode) -> Iterator[Asset]:
    if isinstance(root.value, list):
        yield from map(_thor_entry, root.items(_MAX_ASSETS))
        return
    members: Mapping[str, object] = root.value if isinstance(root.value, dict) else {}
    if not members:
        raise root.error("is neither an object of assets nor a list of them")
    if len(members) > _MAX_ASSETS:
        raise root.error(f"has more than {_MAX_ASSETS} entries")
    for key, value in members.items():
        node = JsonNode(root.place, f"$.{key[:100]}", value)
        if isinstance(value, list):
            yield from map(_thor_entry, node.items(_MAX_ASSETS))
        elif (known := node.find("thor_metadata") or node).find("assetMetadata") is not None:
            yield _objathor_entry(key, node, known.get("assetMetadata"))
        else:
            yield _own_entry(key, node)


def _own_entry(key: str, entry: JsonNode) -> Asset:
    asset_id = JsonNode(entry.place, entry.path, key).text()
    width, height, depth = (max(side, _THINNEST_M) for side in entry.get("size").numbers(3, 0.0, _MAX_SIZE_M))
    rest = entry.find("surface_height_m")
    rest_height_m = None if rest is None else rest.number(0.0, 2 * _MAX_SIZE_M)
    if entry.given("surface_basis", "").text() == "observed_lifted_5cm_over_bbox_top":
        rest_height_m = height  # all objects observed on it floated
    found = list(entry.given("observed_support_levels", []).items(100))
    levels = sorted(n.get("height_m").number(0.0, 2 * _MAX_SIZE_M) for n in found)
    size_m = (width, depth, height)
    return Asset(asset_id, entry.get("objectType").text(), size_m, rest_height_m, tuple(levels))


def _thor_entry(node: JsonNode) -> Asset:
    box = node.get("boundingBox")
    width, height, depth = (_side(box.get(axis)) for axis in "xyz")
    return Asset(node.get("assetId").text(), node.get("objectType").text(), (width, depth, height))


def _objathor_entry(key: str, entry: JsonNode, metadata: JsonNode) -> Asset:
    """An asset of objathor; its box is a size, or holds one, or two corners."""
    # Imported here: shapes are made from assets.
    from datagen.workers.furniture.asset_geometry import type_of_name

    asset_id, box = JsonNode(entry.place, entry.path, key).text(), metadata.get("boundingBox")
    size, category = box.find("size") or box, entry.find("category") or metadata.get("objectType")
    if (low := box.find("min")) is None:
        sides = [_side(size.get(axis)) for axis in "xyz"]
    else:
        corners = zip(low.point(), box.get("max").point(), strict=True)
        sides = [_side(JsonNode(box.place, box.path, b - a)) for a, b in corners]
    return Asset(asset_id, type_of_name(category.text()), (sides[0], sides[2], sides[1]))


def _unpacked(path: Path, data: bytes, fix: str) -> bytes:
    try:
        text = gzip.GzipFile(fileobj=io.BytesIO(data)).read(_LARGEST_TABLE_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(path, "", f"is not a whole gzip file ({error})", fix) from None
    if len(text) > _LARGEST_TABLE_BYTES:
        raise InputError(path, "", f"unpacks to more than {_LARGEST_TABLE_BYTES:,} bytes", fix)
    return text


def _side(node: JsonNode) -> float:
    # Cards and papers have no thickness in the table; a solid needs some.
    return max(node.number(0.0, _MAX_SIZE_M), _THINNEST_M)


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
