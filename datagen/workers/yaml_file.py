"""YAML from elsewhere."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from datagen.schemas.errors import InputError


class _Loader(yaml.SafeLoader):
    """Reads 1e-05 as a number, as YAML 1.2 does and programs write it."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?\d+[eE][-+]?\d+$"), [*"-+0123456789"]
)


def parse_yaml(data: bytes, path: Path, fix: str) -> Any:
    """The first value of a YAML file, also of one of OpenCV. InputError for another one."""
    try:
        return next(yaml.load_all(re.sub(rb"(?m)^%.*$|!!opencv-matrix", b"", data), _Loader), None)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise InputError(path, "", f"is not YAML ({type(error).__name__})", fix) from None
