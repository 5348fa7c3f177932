"""The sizes of the built-in furniture: usual dimensions of household goods, three variants each."""

from __future__ import annotations

from datagen.workers.furniture.asset_table import Asset

# Type: width, depth, height in metres, and the share by which variants differ from it.
_SIZES: dict[str, tuple[float, float, float, float]] = {
    "AlarmClock": (0.14, 0.06, 0.12, 0.1),
    "Apple": (0.08, 0.08, 0.075, 0.1),
    "ArmChair": (0.82, 0.84, 0.86, 0.06),
    "Bed": (1.50, 2.05, 0.95, 0.05),
    "Book": (0.16, 0.23, 0.035, 0.2),
    "Bottle": (0.08, 0.08, 0.26, 0.15),
    "Bowl": (0.17, 0.17, 0.07, 0.15),
    "Box": (0.40, 0.32, 0.28, 0.15),
    "Candle": (0.06, 0.06, 0.12, 0.3),
    "Chair": (0.46, 0.48, 0.88, 0.05),
    "CoffeeMachine": (0.24, 0.34, 0.36, 0.1),
    "CoffeeTable": (1.10, 0.62, 0.43, 0.08),
    "Cup": (0.085, 0.085, 0.10, 0.15),
    "Desk": (1.30, 0.65, 0.75, 0.06),
    "DeskLamp": (0.22, 0.22, 0.46, 0.1),
    "DiningTable": (1.45, 0.90, 0.75, 0.08),
    "Dresser": (1.15, 0.48, 0.88, 0.08),
    "FloorLamp": (0.40, 0.40, 1.65, 0.06),
    "Fridge": (0.70, 0.70, 1.80, 0.04),
    "GarbageCan": (0.34, 0.30, 0.52, 0.15),
    "HousePlant": (0.42, 0.42, 0.85, 0.2),
    "Kettle": (0.20, 0.22, 0.22, 0.1),
    "Laptop": (0.34, 0.28, 0.24, 0.05),
    "LaundryHamper": (0.45, 0.36, 0.62, 0.1),
    "Microwave": (0.52, 0.38, 0.30, 0.06),
    "Mug": (0.12, 0.085, 0.095, 0.1),
    "Painting": (0.80, 0.03, 0.60, 0.2),
    "Pillow": (0.44, 0.32, 0.14, 0.1),
    "Plate": (0.25, 0.25, 0.025, 0.1),
    "Pot": (0.30, 0.24, 0.15, 0.1),
    "RemoteControl": (0.05, 0.17, 0.022, 0.1),
    "ShelvingUnit": (0.85, 0.34, 1.60, 0.1),
    "SideTable": (0.46, 0.42, 0.54, 0.08),
    "SoapBottle": (0.08, 0.07, 0.19, 0.1),
    "Sofa": (2.00, 0.90, 0.84, 0.06),
    "Stove": (0.60, 0.60, 0.92, 0.0),
    "TVStand": (1.40, 0.42, 0.52, 0.08),
    "Television": (1.10, 0.22, 0.70, 0.08),
    "TissueBox": (0.23, 0.12, 0.10, 0.1),
    "Toaster": (0.28, 0.18, 0.20, 0.1),
    "Toilet": (0.40, 0.70, 0.80, 0.04),
    "Vase": (0.15, 0.15, 0.24, 0.2),
    "WallCabinet": (0.60, 0.34, 0.65, 0.0),
    "WashingMachine": (0.60, 0.60, 0.86, 0.0),
}
_VARIANTS = 3

COUNTER_HEIGHT_M = 0.92
_COUNTER_DEPTH_M = 0.61


def _variants() -> dict[str, Asset]:
    out: dict[str, Asset] = {}
    for kind, (width, depth, height, spread) in _SIZES.items():
        for k in range(_VARIANTS):
            scale = 1.0 + spread * (k - 1)
            size_m = (round(width * scale, 3), round(depth * scale, 3), round(height * scale, 3))
            out[f"{kind}_{k}"] = Asset(f"{kind}_{k}", kind, size_m)
    return out


def _fixed() -> list[Asset]:
    counters = [
        Asset(f"Counter_I_{round(10 * w)}", "CounterTop", (w, _COUNTER_DEPTH_M, COUNTER_HEIGHT_M))
        for w in (1.2, 1.8, 2.4)
    ]
    corners = [
        Asset(f"Counter_L_{round(10 * w)}x{round(10 * d)}", "CounterTop", (w, d, COUNTER_HEIGHT_M))
        for w in (1.8, 2.4, 3.0) for d in (1.2, 1.8)
    ]  # fmt: skip
    sinks = [
        Asset("Sink_counter", "Sink", (0.50, 0.40, 0.12)),
        Asset("Sink_pedestal", "Sink", (0.56, 0.46, 1.00)),
    ]
    return [*counters, *corners, *sinks]


BUILTIN_ASSETS: dict[str, Asset] = {**_variants(), **{a.asset_id: a for a in _fixed()}}


def variants_of(kind: str) -> list[Asset]:
    """The variants of a type."""
    return [BUILTIN_ASSETS[f"{kind}_{k}"] for k in range(_VARIANTS)]
