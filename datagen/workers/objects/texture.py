"""Texture images, the colours that they give to faces, and materials of Wavefront MTL."""

from __future__ import annotations

import re
import shlex
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import open_regular, read_regular
from datagen.workers.foreign_files import START_BYTES, refuse_other_kind
from datagen.workers.geometry.mesh import F32, I32, U8

MAX_FILE_BYTES = 256 * 2**20
MAX_SIDE_PX = 16_384
MAX_PIXELS = 8192 * 8192
# Larger images are reduced to this side; a 640x480 frame shows no finer detail of an object.
KEPT_SIDE_PX = 512

_IMAGES = (b"\x89PNG", b"\xff\xd8\xff")
# Barycentric points at which a face's colour is sampled: its centre and half way to each corner.
_SAMPLES = np.array([[2, 2, 2], [4, 1, 1], [1, 4, 1], [1, 1, 4]], np.float64) / 6


def read_texture(path: Path) -> U8:
    """The image as (H, W, 3) RGB, its longer side at most `KEPT_SIDE_PX`.

    The size is checked before pixels are decoded. Raises InputError naming the file: missing, not
    an image, broken, or too large.
    """
    file = open_regular(path, MAX_FILE_BYTES, "Put a smaller image there, or fetch the asset again")
    try:
        with file, warnings.catch_warnings():
            start = file.read(START_BYTES)
            file.seek(0)
            if not start.startswith(_IMAGES):
                refuse_other_kind(path, start, "an image", "Save the texture as JPEG or PNG")
            # Our own limit, checked below, is stricter than the one that warns.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(file, formats=("JPEG", "PNG")) as image:
                return reduced_image(image, path)
    except InputError:
        raise
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(
            path, "", f"not a readable JPEG or PNG image ({type(error).__name__})", "Fetch the asset again"
        ) from error


def reduced_image(image: Image.Image, path: Path) -> U8:
    """The pixels (H, W, 3), as `read_texture` returns them. Raises InputError naming the file."""
    width, height = image.size
    if max(width, height) > MAX_SIDE_PX or width * height > MAX_PIXELS:
        problem, fix = f"the image has {width}x{height} pixels", f"Give at most {MAX_PIXELS:,} pixels"
        raise InputError(path, "", problem, fix)
    image.draft("RGB", (KEPT_SIDE_PX, KEPT_SIDE_PX))
    pixels = rgb_of(image)
    pixels.thumbnail((KEPT_SIDE_PX, KEPT_SIDE_PX), Image.Resampling.BOX)
    return np.asarray(pixels, np.uint8)


def rgb_of(image: Image.Image) -> Image.Image:
    """The image in 8-bit RGB; Pillow alone clips 16-bit grey to white."""
    if image.mode.startswith("I"):  # "I" or "I;16", by Pillow's version
        image = Image.fromarray((np.asarray(image).astype(np.uint32) >> 8).astype(np.uint8))
    return image.convert("RGB")


def face_colours(image: U8, uv: F32, faces: I32) -> U8:
    """The mean texture colour of each face, (F, 3), over four points of it.

    `uv` is (V, 2) with the origin at the lower left corner; coordinates outside [0, 1] repeat.
    """
    height, width, _ = image.shape
    total = np.zeros((len(faces), 3), np.float64)
    corners = uv.astype(np.float64)[faces]  # (F, 3, 2)
    for weights in _SAMPLES:
        point = np.einsum("k,fkc->fc", weights, corners) % 1.0
        column = np.minimum((point[:, 0] * width).astype(np.int64), width - 1)
        row = np.minimum(((1.0 - point[:, 1]) * height).astype(np.int64), height - 1)
        total += image[row, column]
    return np.rint(total / len(_SAMPLES)).astype(np.uint8)


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
