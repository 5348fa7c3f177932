"""Physics until rest. SETTLERS is the registry; each engine lives in one file.

A simulator is imported when it is asked for, so that a machine that lacks one engine's system
libraries can use the other.
"""

from __future__ import annotations

from importlib import import_module

from schemas.errors import InputError, choices
from workers.settling.settler import Settler

SETTLERS: dict[str, str] = {
    "sapien": "workers.settling.sapien_settler:settle_sapien",
    "pybullet": "workers.settling.pybullet_settler:settle_pybullet",
}


def load_settler(name: str) -> Settler:
    """The settler of that name. Raises InputError where it is unknown or cannot be imported."""
    if name not in SETTLERS:
        raise InputError("--settler", name, "no such settler", choices(SETTLERS))
    module, function = SETTLERS[name].split(":")
    try:
        settler: Settler = getattr(import_module(module), function)
    except ImportError as error:
        mend = "Run `datagen doctor`, or take another one with --settler"
        raise InputError("--settler", name, f"cannot be imported here: {error}", mend) from error
    return settler


def first_settler() -> str:
    """The first settler of the registry that can be imported here."""
    for name, target in SETTLERS.items():
        try:
            import_module(target.split(":")[0])
        except ImportError:
            continue
        return name
    raise InputError("settlers", "", "none can be imported here", "Run `datagen doctor`")
