"""YAML from elsewhere."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from datagen.schemas.errors import InputError


def parse_yaml(data: bytes, path: Path, fix: str) -> Any:
    """The first value of a YAML file, also of one of OpenCV. InputError for another one."""
    try:
        return next(yaml.safe_load_all(re.sub(rb"(?m)^%.*$|!!opencv-matrix", b"", data)), None)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise InputError(path, "", f"is not YAML ({type(error).__name__})", fix) from None
