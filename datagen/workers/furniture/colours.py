"""Plausible colours: by the name of a known material, else stable per asset."""

from __future__ import annotations

import hashlib

from datagen.workers.furniture.solids import Rgb
from datagen.workers.json_document import JsonNode

_BY_WORD: tuple[tuple[str, Rgb], ...] = (
    ("brick", (150, 84, 66)),
    ("wood", (164, 122, 82)),
    ("parquet", (158, 112, 70)),
    ("cabinet", (150, 104, 66)),
    ("marble", (206, 202, 196)),
    ("granite", (128, 126, 124)),
    ("concrete", (160, 158, 154)),
    ("tile", (196, 192, 184)),
    ("ceramic", (204, 200, 190)),
    ("porcelain", (224, 220, 210)),
    ("carpet", (138, 130, 120)),
    ("fabric", (150, 140, 128)),
    ("plaster", (222, 208, 176)),
    ("drywall", (214, 206, 194)),
    ("eggshell", (230, 224, 208)),
    ("metal", (168, 170, 174)),
)
_TINTS: tuple[tuple[str, Rgb], ...] = (
    ("yellow", (222, 196, 120)),
    ("orange", (210, 150, 96)),
    ("brown", (130, 94, 66)),
    ("grey", (140, 140, 140)),
    ("gray", (140, 140, 140)),
    ("blue", (120, 146, 178)),
    ("green", (132, 158, 124)),
    ("red", (166, 84, 74)),
    ("black", (52, 50, 50)),
    ("white", (228, 226, 220)),
    ("tan", (204, 178, 144)),
)
_FLOORS: tuple[Rgb, ...] = (
    (164, 122, 82), (140, 98, 62), (186, 150, 110), (176, 172, 164), (120, 108, 98), (150, 134, 118),
)  # fmt: skip
_WALLS: tuple[Rgb, ...] = (
    (226, 220, 208), (206, 212, 208), (214, 200, 178), (190, 200, 208), (218, 208, 214), (200, 196, 188),
)  # fmt: skip


def hash_bytes(text: str) -> bytes:
    """32 bytes that depend on the text alone, the same on every machine."""
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).digest()


def pick(palette: tuple[Rgb, ...], key: str) -> Rgb:
    """One colour of the palette, shaded by up to 8%, stable for the key."""
    h = hash_bytes(key)
    return shade(palette[h[0] % len(palette)], 0.92 + 0.16 * h[1] / 255)


def shade(rgb: Rgb, factor: float) -> Rgb:
    """A lighter or darker tone of the colour."""
    r, g, b = (min(255, max(0, round(c * factor))) for c in rgb)
    return (r, g, b)


def material_rgb(material: JsonNode | None, of_floor: bool) -> Rgb:
    """Colour of a wall or floor material `{name, color?: {r, g, b}}` (0 to 1 each), or of its name."""
    if material is None:
        return (176, 172, 164) if of_floor else (218, 214, 206)
    if isinstance(material.value, str):  # older files name the material without an object around it
        return named_rgb(material.text(), of_floor)
    colour = material.find("color")
    if colour is not None:
        r, g, b = (round(255 * colour.get(c).number(0.0, 1.0)) for c in "rgb")
        return (r, g, b)
    name = material.find("name")
    return named_rgb("" if name is None else name.text(), of_floor)


def named_rgb(name: str, of_floor: bool) -> Rgb:
    """The colour that a material's name suggests, else one of a palette, stable for the name."""
    lower = name.lower()
    for words in (_TINTS, _BY_WORD):
        for word, rgb in words:
            if word in lower:
                return pick((rgb,), name)
    return pick(_FLOORS if of_floor else _WALLS, name)
