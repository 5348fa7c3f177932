"""Registries: dictionaries from a name to `module:attribute`, imported on first use.

`datagen --help` therefore imports no simulator, and a machine without the system libraries of one engine
can use another. A name that is itself `module:attribute` is an entry outside the package.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from importlib import import_module
from typing import Any

from datagen.schemas.errors import InputError, choices
from datagen.workers.extras import missing_library

# Entries outside the package that this process and its workers may import, separated by spaces. Runs and
# checkpoints from elsewhere contain names too, and those must not import anything.
ALLOWED = "DATAGEN_ALLOW"
_OUTSIDE = re.compile(r"([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*:[A-Za-z_]\w*)(?::.*)?", re.DOTALL)


def allow(words: Iterable[str]) -> None:
    """Allow the entries outside the package among words that the user wrote: names, references, options."""
    found = [match[1] for word in words if (match := _OUTSIDE.fullmatch(word.rpartition("=")[2]))]
    os.environ[ALLOWED] = " ".join(dict.fromkeys([*os.environ.get(ALLOWED, "").split(), *found]))


def entry(registry: Mapping[str, str], name: str, option: str) -> Any:
    """Return an entry of a registry, or one outside the package that is allowed.

    `option` is the command-line option to name in errors. Raises InputError for an unknown name, listing the
    valid ones, for one outside that is not allowed, and for one that cannot be imported on this machine.
    """
    target = registry.get(name, name)
    if name not in registry:
        if not _OUTSIDE.fullmatch(name):
            raise InputError(option, name or "''", "is unknown", choices(registry, name))
        if name not in os.environ.get(ALLOWED, "").split():
            fix = f"Set {ALLOWED}={name} if you trust this code, or {choices(registry).lower()}"
            raise InputError(option, name, "is outside the package, and not named by you", fix)
    place, attribute = target.split(":")
    try:
        module = import_module(place)
    except ImportError as error:
        if name not in registry and error.name == place:
            raise InputError(option, name, "is unknown", choices(registry, name)) from None
        others = ", ".join(sorted(set(registry) - {name}))
        another = f". Or choose another one: {others}" if others else ""
        if missing := missing_library(error):
            problem = f"needs {missing.place}, which is not installed"
            raise InputError(option, name, problem, missing.fix + another) from error
        problem = f"cannot be imported here: {error}"
        raise InputError(option, name, problem, f"Run `datagen doctor`{another}") from error
    if not hasattr(module, attribute):
        raise InputError(option, name, f"{place} has no {attribute}", "Name one of its attributes")
    return getattr(module, attribute)


def open_source(registry: Mapping[str, str], ref: str, option: str) -> Any:
    """Open the source of a reference: `kind`, `kind:text`, or `module:attribute:text` outside the package.

    Raises InputError as `entry` does, and for a folder without a kind.
    """
    kind, _, text = ref.partition(":")
    if kind not in registry and "/" in kind:
        fix = f"Write KIND:{ref}, where KIND is one of {', '.join(sorted(registry))}"
        raise InputError(option, ref, "is a folder without the kind of its content", fix)
    if kind not in registry and (outside := _OUTSIDE.fullmatch(ref)):
        kind = outside[1]
        text = ref[len(kind) + 1 :]
    return entry(registry, kind, option)(text)
