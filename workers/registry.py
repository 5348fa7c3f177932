"""Registries: plain dictionaries from a name to `module:attribute`, imported when it is asked for.

So `datagen --help` waits for no simulator, and a machine that lacks one engine's system libraries
uses another.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from datagen.schemas.errors import InputError, choices

# What extras bring, by the names that are imported: what pip calls it, and the extra. The core works without.
SIM_MODULES = {"pinocchio": "pin", "coal": "coal", "mani_skill": "mani-skill"}
_EXTRAS = {
    "train": {"torch": "torch", "tensorboard": "tensorboard", "plotly": "plotly"},
    "detect": {"transformers": "transformers"},
    "sim": SIM_MODULES,
}


def install_line(*modules: str) -> str:
    """How to install these modules of one extra, for an error's mend."""
    extra = next(name for name, brings in _EXTRAS.items() if modules[0] in brings)
    packages = " ".join(_EXTRAS[extra][name] for name in modules)
    source = "of the folder or URL that datagen was installed from"
    return f"Install it: pip install {packages}, or the extra `{extra}` {source}"


SIM_MEND = install_line(*SIM_MODULES)


def missing_library(error: Exception) -> InputError | None:
    """The one line for a library of an extra that is not installed; None for any other error."""
    name = (error.name or "").split(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    found = [module for brings in _EXTRAS.values() for module in brings]
    return InputError(name, "", "is not installed", install_line(name)) if name in found else None


def entry(registry: Mapping[str, str], name: str, option: str) -> Any:
    """What a registry holds under a name. `option` is where the name was given, for the error.

    Raises InputError for an unknown name, listing the valid ones, and for an engine that cannot be
    imported on this machine.
    """
    if name not in registry:
        raise InputError(option, name or "''", "no such entry", choices(registry))
    module, attribute = registry[name].split(":")
    try:
        return getattr(import_module(module), attribute)
    except ImportError as error:
        mend = f"Run `datagen doctor`, or take another one: {', '.join(sorted(registry))}"
        if missing_library(error) is not None:
            mend = SIM_MEND
        raise InputError(option, name, f"cannot be imported here: {error}", mend) from error


def open_source(registry: Mapping[str, str], ref: str, option: str) -> Any:
    """The source that a reference `kind` or `kind:text` names, opened with its text.

    Raises InputError as `entry` does, and where a folder is named without its kind.
    """
    kind, _, text = ref.partition(":")
    if kind not in registry and "/" in kind:
        mend = f"Write KIND:{ref}, where KIND is one of {', '.join(sorted(registry))}"
        raise InputError(option, ref, "is a folder without its kind", mend)
    return entry(registry, kind, option)(text)


def can_import(registry: Mapping[str, str], name: str) -> bool:
    """Whether an entry's module can be imported on this machine."""
    try:
        import_module(registry[name].split(":")[0])
    except ImportError:
        return False
    return True
