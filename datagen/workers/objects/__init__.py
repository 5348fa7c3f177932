"""Movable objects: `open_objects("builtin")`, `open_objects("folder:DIR")` or `open_objects("ycb:DIR")`."""

from __future__ import annotations

from datagen.workers.objects.model import ObjectModel, ObjectSource
from datagen.workers.registry import open_source

__all__ = ["OBJECT_SOURCES", "ObjectModel", "ObjectSource", "open_objects"]


# Each function accepts the text after the first colon of a reference, "" if there is none.
OBJECT_SOURCES: dict[str, str] = {
    "builtin": "datagen.workers.objects.builtin:open_builtin",
    "folder": "datagen.workers.objects.folder:open_folder",
    "ycb": "datagen.workers.objects.ycb:open_ycb",
}
# Indexes of a folder of YCB objects: ours, and ManiSkill's.
MANISKILL_INDEXES = ("info_pick_v0.json", "info_raw.json")
YCB_INDEXES = ("objects.json", *MANISKILL_INDEXES)


def open_objects(ref: str) -> ObjectSource:
    """The source that a reference names: `builtin`, or `folder:DIR` or `ycb:DIR` with a folder of objects.

    Raises InputError for an unknown kind, naming the valid ones, and as the source itself does.
    """
    return open_source(OBJECT_SOURCES, ref, "--objects")
