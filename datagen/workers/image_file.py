"""Pictures from elsewhere, within limits."""

from __future__ import annotations

import io
import struct
import warnings
from pathlib import Path

import numpy as np
from PIL import Image

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular
from datagen.workers.geometry.mesh import U8

MAX_SIDE_PX = 8192
MAX_PIXELS = 4096 * 4096
MAX_FILE_BYTES = 256 * 2**20
FILE_FIX = "Name a readable file of at most 256 MiB"
# What readers of Pillow raise, above all those of TIFF.
_DAMAGED_IMAGE = (
    OSError, ValueError, SyntaxError, EOFError, TypeError, AttributeError, LookupError, ArithmeticError,
    RuntimeError, struct.error,
)  # fmt: skip


def read_grey(path: Path) -> tuple[U8, U8 | None]:
    """Grey values (H, W) of a PGM, PNG or BMP, and its opacity where it has one."""
    image = opened(path, ("PPM", "PNG", "BMP"), None)
    alpha = np.asarray(image.getchannel("A"), np.uint8) if image.mode in ("LA", "RGBA") else None
    return np.asarray(image.convert("L"), np.uint8), alpha


def opened(path: Path, formats: tuple[str, ...], mode: str | None) -> Image.Image:
    """The picture of a file, as `decoded` gives it."""
    return decoded(read_regular(path, MAX_FILE_BYTES, FILE_FIX), path, formats, mode)


def decoded(data: bytes, place: str | Path, formats: tuple[str, ...], mode: str | None = None) -> Image.Image:
    """A decoded picture. Its size is checked before its pixels are decoded."""
    kinds = " or ".join(formats)
    try:
        with warnings.catch_warnings():
            # Our own limit of size is stricter than the one that warns; other warnings are of damaged tags.
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data), formats=formats) as image:
                _refuse_size(place, *image.size)
                image.load()
                return image.copy() if mode is None else image.convert(mode)
    except Image.DecompressionBombError:
        _refuse_size(place, MAX_SIDE_PX + 1, MAX_SIDE_PX + 1)
        raise
    except InputError:
        raise
    except _DAMAGED_IMAGE as error:
        problem = f"is not a readable {kinds} image ({type(error).__name__})"
        raise InputError(place, "", problem, f"Save it again as {kinds}") from None


def _refuse_size(place: str | Path, width: int, height: int) -> None:
    if max(width, height) > MAX_SIDE_PX or width * height > MAX_PIXELS:
        size = "too many" if width > MAX_SIDE_PX and width == height else f"{width}x{height}"
        raise InputError(place, "", f"has {size} pixels", f"Give a frame of at most {MAX_PIXELS:,} pixels")
