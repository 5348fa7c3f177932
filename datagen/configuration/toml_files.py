"""Read TOML files that a user names, and describe the first wrong field of one."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular

_MAX_BYTES, _MOST_PARTS = 1 << 20, 200
_TEXT = re.compile(r'"(?:\\.|[^"\\\n])*"|\'[^\'\n]*\'|#[^\n]*')  # quoted text and comments
_BETWEEN = re.compile(r"[\n,=\[\]{}]")  # separates keys from values


def read_toml(
    path: Path, fix: str = "Give a TOML file as in docs/reference/specification.md"
) -> dict[str, Any]:
    """The content of a TOML file. InputError, with `fix`, where it is not TOML, too large or unreadable."""
    data = read_regular(path, _MAX_BYTES, fix)
    try:
        text = data.decode("utf-8-sig")  # after the byte order mark of some editors
        # The parser's memory grows with the square of the parts of a key.
        if max(part.count(".") for part in _BETWEEN.split(_TEXT.sub("", text))) >= _MOST_PARTS:
            raise ValueError(f"a key has more than {_MOST_PARTS} parts")
        content = tomllib.loads(text)
        repr(content)  # RecursionError where it is nested too deeply for an error message
        return content
    except (ValueError, RecursionError) as error:
        raise InputError(path, "", f"is not TOML: {error}", fix) from None


def first_of(error: ValidationError, place: str, *section: str) -> InputError:
    """The InputError for the first wrong field of a file, or of a section of it."""
    first = error.errors()[0]
    field = ".".join((*section, *map(str, first["loc"])))
    fix = (
        "Remove or correct the key: docs/reference/specification.md lists all"
        if (first["type"] == "extra_forbidden")
        else "Correct the value"
    )
    return InputError(place, field, f"{first['msg']} (given: {str(first['input'])[:80]})", fix)
