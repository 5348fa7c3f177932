"""Read TOML files that a user names, and describe the first wrong field of one."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular

_MAX_BYTES, _MAX_DOTS = 1 << 20, 200


def read_toml(
    path: Path, fix: str = "Give a TOML file as in docs/reference/specification.md"
) -> dict[str, Any]:
    """The content of a TOML file. InputError, with `fix`, where it is not TOML, too large or unreadable."""
    data = read_regular(path, _MAX_BYTES, fix)
    try:
        text = data.decode()
        # The parser's memory grows with the square of the parts of a key.
        if any(line.count(".") > _MAX_DOTS for line in text.splitlines()):
            raise ValueError(f"a line has more than {_MAX_DOTS} dots")
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
