"""Where a document of Holodeck differs from ProcTHOR's: small objects, and the sizes that it states itself.

Small objects are no children. Their ids end in that of the piece of furniture that they lie on. Pieces on the
floor are of Objaverse; the footprints that they were placed by are `vertices` (cm), 10 cm larger than the
pieces, and the centres of their boxes are half as high as they.
"""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from datagen.workers.furniture.asset_geometry import type_of_name
from datagen.workers.furniture.assets import Asset
from datagen.workers.json_document import JsonNode

_GAP_CM, _FARTHEST_CM, _MAX_SIZE_M, _THINNEST_M = 10.0, 1e5, 20.0, 0.01


@dataclass(frozen=True, eq=False)
class HolodeckObjects:
    """The pieces of furniture, and the small objects by the id of the piece that carries them."""

    furniture: list[JsonNode]
    carried: defaultdict[str, list[JsonNode]]
    on_floor: set[str]  # ids of pieces that stand on the floor

    def stated_asset(self, entry: JsonNode) -> Asset | None:
        """The asset of a piece on the floor as the document describes it; None for another object."""
        if entry.get("id").text() not in self.on_floor:
            return None
        name, outline = entry.get("id").text().partition(" (")[0], entry.find("vertices")
        height = 2 * entry.get("position").point()[1]
        yaw = entry.get("rotation").get("y").number(-1e6, 1e6)
        if outline is None or abs(yaw / 90 - round(yaw / 90)) > 1e-3:
            return None
        points_cm = [corner.numbers(2, -_FARTHEST_CM, _FARTHEST_CM) for corner in outline.items(16)]
        if len(points_cm) < 3:
            raise outline.error(f"has {len(points_cm)} corners")
        width, depth = ((np.ptp(np.array(points_cm), axis=0) - _GAP_CM) / 100).tolist()
        if round(yaw / 90) % 2:
            width, depth = depth, width
        if not all(_THINNEST_M <= side <= _MAX_SIZE_M for side in (width, depth, height)):
            raise outline.error(f"is of a piece of {width:.4g} x {depth:.4g} x {height:.4g} m")
        return Asset(
            entry.get("assetId").text(), type_of_name(re.sub(r"-\d+$", "", name)), (width, depth, height)
        )


def read_holodeck(root: JsonNode, objects: list[JsonNode]) -> HolodeckObjects | None:
    """The objects of a document of Holodeck; None for one of ProcTHOR."""
    pieces = root.find("floor_objects")
    if pieces is None:
        return None
    ids = {entry.get("id").text() for entry in objects}
    out = HolodeckObjects([], defaultdict(list), {p.get("id").text() for p in pieces.items(len(objects))})
    for entry in objects:
        carrier = entry.get("id").text().partition("|")[2]
        (out.carried[carrier] if carrier in ids else out.furniture).append(entry)
    return out
