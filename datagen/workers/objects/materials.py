"""Wavefront MTL: colours and texture images of a mesh."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular
from datagen.workers.foreign_files import refuse_other_kind

_MAX_BYTES = 2**20
_BAKE = "Bake the mesh into one texture"
# Options before the image's name and the most words that follow each. The first three move or stretch it.
_MOVES = {"-s": 1.0, "-o": 0.0, "-t": 0.0}
_WORDS = {
    "-mm": 2,
    "-blendu": 1,
    "-blendv": 1,
    "-bm": 1,
    "-boost": 1,
    "-cc": 1,
    "-clamp": 1,
    "-imfchan": 1,
    "-texres": 1,
}
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


@dataclass
class Material:
    """A colour (0 to 1), and the file name of an image that covers it, "" without one."""

    rgb: tuple[float, ...] = (0.7, 0.7, 0.7)
    image: str = ""


def read_materials(library: Path) -> dict[str, Material]:
    """The materials of a library by name. Raises InputError naming the library and the line."""
    data = read_regular(library, _MAX_BYTES, "Put the mesh's material library next to it")
    refuse_other_kind(library, data, "text", _BAKE)
    found: dict[str, Material] = {}
    material = ""
    for number, line in enumerate(data.decode("utf-8", "replace").splitlines(), 1):
        keyword, value = ([*line.split(None, 1), "", ""])[:2]
        if keyword == "newmtl":
            material = value.strip()
            found.setdefault(material, Material())
        elif keyword == "map_Kd":
            found.setdefault(material, Material()).image = _image_name(library, number, value)
        elif keyword == "Kd" and all(map(_NUMBER.fullmatch, words := value.split()[:3])) and len(words) == 3:
            found.setdefault(material, Material()).rgb = tuple(map(float, words))
    return found


def texture_of_materials(library: Path, used: Sequence[str]) -> str:
    """The image that a material library gives to the used materials, or to all where none is named.

    Raises InputError naming the library: missing, or a material with a colour alone, or with another image.
    """
    images = {name: material.image for name, material in read_materials(library).items()}
    named = [name for name in used if name in images] or list(images)
    found = {images[name] for name in named}
    if "" in found:
        bare = next(name for name in named if not images[name])
        raise InputError(library, f"newmtl {bare}", "has a colour and no texture image (map_Kd)", _BAKE)
    if len(found) != 1:
        problem = f"{len(found)} texture images for one mesh, where 1 is needed"
        raise InputError(library, "map_Kd", problem, _BAKE)
    return found.pop()


def _image_name(library: Path, number: int, value: str) -> str:
    """The file name of a `map_Kd` line: after its options, with or without quotes, before a comment."""
    words = re.sub(r"(^|\s)#.*", "", value).strip()
    while words.startswith("-"):
        option, _, words = words.partition(" ")
        words = words.lstrip()
        if option not in _MOVES and option not in _WORDS:
            raise InputError(library, f"line {number}", f"unknown option {option!r:.40}", "Remove the option")
        for _ in range(_WORDS.get(option, 3)):
            word, _, rest = words.partition(" ")
            is_number = bool(_NUMBER.fullmatch(word))
            if option in _MOVES and is_number and float(word) != _MOVES[option]:
                raise InputError(library, f"line {number}", f"{option} {word} moves the texture", _BAKE)
            if not is_number and option not in ("-blendu", "-blendv", "-cc", "-clamp", "-imfchan"):
                break
            words = rest.lstrip()
    if words.startswith(('"', "'")):
        try:
            words = shlex.split(words)[0]
        except ValueError:
            pass  # an open quote is part of the name
    return words
