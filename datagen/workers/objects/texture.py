"""Texture images and the colours they give to faces."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from PIL import Image

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import open_regular
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
