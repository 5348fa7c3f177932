"""Registries: dictionaries from a name to `module:attribute`, imported on first use.

`datagen --help` therefore imports no simulator, and a machine without the system libraries of one engine
can use another.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from datagen.schemas.errors import InputError, choices

# Optional libraries by extra: name of the import -> name for pip.
SIM_MODULES = {"pinocchio": "pin", "coal": "coal", "mani_skill": "mani-skill"}
_EXTRAS = {
    "train": {"torch": "torch", "tensorboard": "tensorboard", "plotly": "plotly"},
    "detect": {"transformers": "transformers"},
    "sim": SIM_MODULES,
}


def install_line(*modules: str) -> str:
    """How to install these modules of one extra, for the fix of an error."""
    extra = next(name for name, brings in _EXTRAS.items() if modules[0] in brings)
    packages = " ".join(_EXTRAS[extra][name] for name in modules)
    source = "of the folder or URL that datagen was installed from"
    return f"Install it: pip install {packages}, or the extra `{extra}` {source}"


SIM_MEND = install_line(*SIM_MODULES)


def missing_library(error: Exception) -> InputError | None:
    """The InputError for a library of an extra that is not installed; None for any other error."""
    name = (error.name or "").split(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    found = [module for brings in _EXTRAS.values() for module in brings]
    return InputError(name, "", "is not installed", install_line(name)) if name in found else None


def entry(registry: Mapping[str, str], name: str, option: str) -> Any:
    """Return the entry of a registry. `option` is where the name was given, for the error.

    Raises InputError for an unknown name, listing the valid ones, and for an engine that cannot be
    imported on this machine.
    """
    if name not in registry:
        raise InputError(option, name or "''", "is unknown", choices(registry, name))
    module, attribute = registry[name].split(":")
    try:
        return getattr(import_module(module), attribute)
    except ImportError as error:
        mend = f"Run `datagen doctor`, or use another one: {', '.join(sorted(registry))}"
        if missing_library(error) is not None:
            mend = SIM_MEND
        raise InputError(option, name, f"cannot be imported here: {error}", mend) from error


def open_source(registry: Mapping[str, str], ref: str, option: str) -> Any:
    """Open the source of a reference `kind` or `kind:text`.

    Raises InputError as `entry` does, and for a folder without its kind.
    """
    kind, _, text = ref.partition(":")
    if kind not in registry and "/" in kind:
        mend = f"Write KIND:{ref}, where KIND is one of {', '.join(sorted(registry))}"
        raise InputError(option, ref, "is a folder without the kind of its content", mend)
    return entry(registry, kind, option)(text)


def can_import(registry: Mapping[str, str], name: str) -> bool:
    """Whether an entry's module can be imported on this machine."""
    try:
        import_module(registry[name].split(":")[0])
    except ImportError:
        return False
    return True
