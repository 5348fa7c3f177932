"""Movable objects: `open_objects("builtin")` or `open_objects("ycb:DIR")`."""

from __future__ import annotations

from importlib import import_module

from schemas.errors import InputError, choices
from workers.objects.model import ObjectModel, ObjectSource

__all__ = ["OBJECT_SOURCES", "ObjectModel", "ObjectSource", "open_objects"]


# Name -> module and function that opens the source; it takes what follows the first colon of a
# reference, "" where there is none. A kind's module is imported when it is asked for.
OBJECT_SOURCES: dict[str, str] = {
    "builtin": "workers.objects.builtin:open_builtin",
    "ycb": "workers.objects.ycb:open_ycb",
}


def open_objects(ref: str) -> ObjectSource:
    """The source that a reference names: `builtin`, or `ycb:DIR` with a folder of objects.

    Raises InputError for an unknown kind, naming the valid ones, and as the source itself does.
    """
    kind, _, argument = ref.partition(":")
    if kind not in OBJECT_SOURCES:
        raise InputError(ref or "objects", "", f"{kind!r} is no object source", choices(OBJECT_SOURCES))
    module, function = OBJECT_SOURCES[kind].split(":")
    source: ObjectSource = getattr(import_module(module), function)(argument)
    return source
