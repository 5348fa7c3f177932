"""Physics until rest. SETTLERS is the registry; each engine lives in one file."""

from __future__ import annotations

from datagen.schemas.errors import InputError
from datagen.workers.registry import can_import, entry
from datagen.workers.settling.settler import Settler

SETTLERS: dict[str, str] = {
    "sapien": "datagen.workers.settling.sapien_settler:settle_sapien",
    "pybullet": "datagen.workers.settling.pybullet_settler:settle_pybullet",
}


def load_settler(name: str) -> Settler:
    """The settler of that name. Raises InputError where it is unknown or cannot be imported."""
    settler: Settler = entry(SETTLERS, name, "--settler")
    return settler


def first_settler() -> str:
    """The first settler of the registry that can be imported here."""
    for name in SETTLERS:
        if can_import(SETTLERS, name):
            return name
    raise InputError("--settler", "", "none can be imported here", "Run `datagen doctor`")
