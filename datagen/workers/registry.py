"""Registries: dictionaries from a name to `module:attribute`, imported on first use.

`datagen --help` therefore imports no simulator, and a machine without the system libraries of one engine
can use another.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from datagen.schemas.errors import InputError, choices
from datagen.workers.extras import missing_library


def entry(registry: Mapping[str, str], name: str, option: str) -> Any:
    """Return the entry of a registry. `option` is the command-line option to name in errors.

    Raises InputError for an unknown name, listing the valid ones, and for an engine that cannot be
    imported on this machine.
    """
    if name not in registry:
        raise InputError(option, name or "''", "is unknown", choices(registry, name))
    module, attribute = registry[name].split(":")
    try:
        return getattr(import_module(module), attribute)
    except ImportError as error:
        others = f"choose another one: {', '.join(sorted(set(registry) - {name}))}"
        if missing := missing_library(error):
            problem = f"needs {missing.place}, which is not installed"
            raise InputError(option, name, problem, f"{missing.fix}. Or {others}") from error
        fix = f"Run `datagen doctor`, or {others}"
        raise InputError(option, name, f"cannot be imported here: {error}", fix) from error


def open_source(registry: Mapping[str, str], ref: str, option: str) -> Any:
    """Open the source of a reference `kind` or `kind:text`.

    Raises InputError as `entry` does, and for a folder without a kind.
    """
    kind, _, text = ref.partition(":")
    if kind not in registry and "/" in kind:
        fix = f"Write KIND:{ref}, where KIND is one of {', '.join(sorted(registry))}"
        raise InputError(option, ref, "is a folder without the kind of its content", fix)
    return entry(registry, kind, option)(text)


def can_import(registry: Mapping[str, str], name: str) -> bool:
    """Whether an entry's module can be imported on this machine."""
    try:
        import_module(registry[name].split(":")[0])
    except ImportError:
        return False
    return True
