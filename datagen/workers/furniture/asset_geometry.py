"""Bodies of assets: the shape of the type, scaled to the asset's size, in a colour of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

from datagen.workers.furniture import furniture_shapes as f
from datagen.workers.furniture import open_shapes as o
from datagen.workers.furniture import small_shapes as s
from datagen.workers.furniture.assets import Asset
from datagen.workers.furniture.solids import ColouredSolid, Rgb, join, pick
from datagen.workers.geometry.mesh import F32, Mesh

Shape = Callable[[Asset, Rgb], list[ColouredSolid]]

_WOOD: tuple[Rgb, ...] = (
    (164, 122, 82), (126, 88, 58), (196, 160, 116), (92, 66, 48), (224, 218, 208), (70, 66, 64),
)  # fmt: skip
_CLOTH: tuple[Rgb, ...] = (
    (112, 122, 134), (150, 96, 84), (96, 116, 96), (178, 166, 146), (70, 78, 98), (140, 124, 152),
)  # fmt: skip
_ENAMEL: tuple[Rgb, ...] = ((238, 238, 236), (226, 226, 228))
_METAL: tuple[Rgb, ...] = ((172, 174, 178), (206, 208, 210), (58, 60, 64), (196, 70, 62))
_PLASTIC: tuple[Rgb, ...] = (
    (58, 98, 150), (196, 62, 56), (240, 196, 60), (66, 140, 88), (230, 230, 226), (44, 44, 48),
)  # fmt: skip
_CLAY: tuple[Rgb, ...] = ((196, 110, 74), (220, 214, 202), (96, 118, 134), (148, 82, 62))
_GLASS: tuple[Rgb, ...] = ((96, 140, 110), (150, 176, 186), (110, 70, 48))
_CARD: tuple[Rgb, ...] = ((186, 146, 100), (170, 130, 88))

# Shape and palette of every type that has its own; proportions decide the shape of other types.
SHAPES: dict[str, tuple[Shape, tuple[Rgb, ...]]] = {
    "AlarmClock": (s.appliance, _PLASTIC),
    "Apple": (s.pebble, ((178, 42, 40), (120, 160, 60), (206, 160, 60))),
    "ArmChair": (f.sofa, _CLOTH),
    "BaseballBat": (s.column, _WOOD),
    "BasketBall": (s.pebble, ((210, 110, 50),)),
    "Bed": (f.bed, _CLOTH),
    "Book": (s.book, _PLASTIC),
    "Boots": (s.block, _WOOD),
    "Bottle": (s.bottle, _GLASS),
    "Bowl": (s.bowl, _CLAY),
    "Box": (s.container, _CARD),
    "Bread": (s.pebble, ((190, 132, 70),)),
    "Cabinet": (f.dresser, _WOOD),
    "Candle": (s.column, ((240, 228, 200), (200, 80, 70))),
    "Cart": (f.cart, _METAL),
    "Chair": (f.chair, _WOOD),
    "ClothesDryer": (f.washing_machine, _ENAMEL),
    "CoffeeMachine": (s.coffee_machine, _METAL),
    "CoffeeTable": (f.side_table, _WOOD),
    "CounterTop": (f.counter, _WOOD),
    "Cup": (s.cup, _CLAY),
    "Desk": (f.desk, _WOOD),
    "DeskLamp": (s.lamp, _METAL),
    "Desktop": (s.screen, _METAL),
    "DiningTable": (f.table, _WOOD),
    "DogBed": (s.basket_bed, _CLOTH),
    "Dresser": (f.dresser, _WOOD),
    "Egg": (s.pebble, ((232, 214, 186),)),
    "FloorLamp": (s.lamp, _METAL),
    "Footstool": (f.stool, _WOOD),
    "Fridge": (f.fridge, _METAL[:2] + _ENAMEL),
    "GarbageBag": (s.pebble, ((40, 42, 46),)),
    "GarbageCan": (s.bin_, _METAL),
    "HousePlant": (s.plant, _CLAY),
    "Kettle": (s.kettle, _METAL),
    "Laptop": (s.laptop, _METAL[:3]),
    "LaundryHamper": (s.bin_, _CARD),
    "Lettuce": (s.pebble, ((120, 168, 72),)),
    "Microwave": (s.appliance, _METAL),
    "Mug": (s.cup, _CLAY),
    "Ottoman": (f.ottoman, _CLOTH),
    "Painting": (s.painting, _WOOD),
    "Pan": (s.pan, _METAL[1:3]),
    "PaperTowelRoll": (s.column, _ENAMEL),
    "PepperShaker": (s.bottle, _METAL),
    "Pillow": (s.pebble, _CLOTH),
    "Plate": (s.bowl, _ENAMEL + _CLAY),
    "Pot": (s.pan, _METAL),
    "Potato": (s.pebble, ((172, 132, 84),)),
    "Safe": (s.appliance, _METAL[2:3]),
    "SaltShaker": (s.bottle, _ENAMEL),
    "Shelf": (f.shelf, _WOOD),
    "ShelvingUnit": (f.shelf, _WOOD),
    "SideTable": (f.side_table, _WOOD),
    "Sink": (f.sink, _ENAMEL),
    "SoapBottle": (s.dispenser, _PLASTIC),
    "Sofa": (f.sofa, _CLOTH),
    "SprayBottle": (s.dispenser, _PLASTIC),
    "Statue": (s.statue, _CLAY),
    "Stool": (f.stool, _WOOD),
    "Stove": (f.stove, _METAL[:2] + _ENAMEL),
    "TVStand": (f.tv_stand, _WOOD),
    "Table": (f.table, _WOOD),
    "TeddyBear": (s.teddy, ((150, 106, 66),)),
    "Television": (s.screen, ((38, 38, 42),)),
    "TissueBox": (s.block, _PLASTIC),
    "Toaster": (s.toaster, _METAL),
    "Toilet": (f.toilet, _ENAMEL),
    "ToiletPaper": (s.column, _ENAMEL),
    "Tomato": (s.pebble, ((200, 52, 38),)),
    "Vase": (s.vase, _CLAY),
    "WallCabinet": (f.wall_cabinet, _WOOD),
    "WashingMachine": (f.washing_machine, _ENAMEL),
    "WineBottle": (s.bottle, _GLASS),
}

# Shapes with their doors open, of the types that have doors.
_OPEN: dict[str, Shape] = {
    "Cabinet": o.open_cupboard,
    "CounterTop": o.open_counter,
    "Dresser": o.open_cupboard,
    "Fridge": o.open_fridge,
    "Microwave": o.open_microwave,
}

# Anything thinner is a plain box: its details would be solids without volume.
_DETAIL_M = 0.02
_THINNEST_M = 0.004


# Last words of names that are no name of a type.
_SYNONYMS = {
    "bookcase": "ShelvingUnit", "bookshelf": "ShelvingUnit", "couch": "Sofa", "counter": "CounterTop",
    "cupboard": "Cabinet", "drawers": "Dresser", "island": "CounterTop", "lamp": "DeskLamp",
    "nightstand": "SideTable", "refrigerator": "Fridge", "shelves": "Shelf", "sideboard": "Dresser",
    "wardrobe": "Dresser",
}  # fmt: skip


@lru_cache(maxsize=4096)
def type_of_name(name: str) -> str:
    """The type that an English name ends in ("oak coffee table"), the longest one; "Object" if it is none."""
    letters = "".join(c for c in name if c.isalpha()).lower()
    types = {kind.lower(): kind for kind in SHAPES} | _SYNONYMS
    return types.get(max((word for word in types if letters.endswith(word)), key=len, default=""), "Object")


@lru_cache(maxsize=8192)
def asset_geometry(asset: Asset, is_open: bool = False) -> tuple[Mesh, tuple[F32, ...]]:
    """Mesh and convex parts in the asset's own frame, base at z = 0. Shared: never write to them.

    With `is_open`, the doors of cupboards, fridges and microwaves stand open.
    """
    width, depth, height = (max(side, _THINNEST_M) for side in asset.size_m)
    asset = replace(asset, size_m=(width, depth, height))
    is_square = 0.8 < width / depth < 1.25
    shape, palette = SHAPES.get(asset.object_type, (s.column if is_square else s.block, _PLASTIC))
    if min(asset.size_m) < _DETAIL_M and asset.object_type != "Painting":
        shape = s.block
    elif is_open:
        shape = _OPEN.get(asset.object_type, shape)
    mesh, parts_m = join(shape(asset, pick(palette, asset.asset_id)))
    for array in (mesh.vertices_m, mesh.faces, mesh.face_rgb, *parts_m):
        array.setflags(write=False)
    return mesh, parts_m
