"""Movable objects: `open_objects("builtin")` or `open_objects("ycb:DIR")`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from schemas.errors import InputError, choices
from workers.objects.builtin import BuiltinObjects
from workers.objects.model import ObjectModel, ObjectSource
from workers.objects.ycb import YcbObjects

__all__ = ["OBJECT_SOURCES", "ObjectModel", "ObjectSource", "open_objects"]


def _open_builtin(argument: str) -> ObjectSource:
    if argument:
        raise InputError(f"builtin:{argument}", "", "the built-in objects take no folder", "Write `builtin`")
    return BuiltinObjects()


def _open_ycb(argument: str) -> ObjectSource:
    if not argument:
        raise InputError("ycb", "", "the folder is missing", "Write `ycb:DIR`")
    return YcbObjects(Path(argument).expanduser())


# Each takes what follows the first colon of a reference, "" where there is none.
OBJECT_SOURCES: dict[str, Callable[[str], ObjectSource]] = {
    "builtin": _open_builtin,
    "ycb": _open_ycb,
}


def open_objects(ref: str) -> ObjectSource:
    """The source that a reference names: `builtin`, or `ycb:DIR` with a folder of objects.

    Raises InputError for an unknown kind, naming the valid ones, and as the source itself does.
    """
    kind, _, argument = ref.partition(":")
    if kind not in OBJECT_SOURCES:
        raise InputError(ref or "objects", "", f"{kind!r} is no object source", choices(OBJECT_SOURCES))
    return OBJECT_SOURCES[kind](argument)
