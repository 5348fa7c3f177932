"""Options of `datagen train` with structure: sizes of a model, augmentation, threads."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from pydantic import TypeAdapter, ValidationError

from datagen.configuration.specify import parse_toml, read_toml
from datagen.schemas.errors import InputError, choices

if TYPE_CHECKING:
    from datagen.train.augment import Augmentation

_FIX = "Give a TOML file as in docs/guides/train.md"


def model_sizes(words: Sequence[str]) -> dict[str, Any]:
    """Read fields from files and `field=value` words; later ones override. Values are TOML."""
    sizes: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            sizes |= read_toml(Path(word), _FIX)
            continue
        try:
            sizes[name.strip()] = parse_toml(f"value = {text}")["value"]
        except ValueError:
            sizes[name.strip()] = text
    return sizes


def read_augmentation(word: str | None) -> tuple[Augmentation | None, dict[str, Any]]:
    """Read `--augment`, names of effects or a TOML file; return it also as plain data."""
    if word is None:
        return None, {}
    from datagen.train.augment import Augmentation

    kinds = {name: get_args(kind)[0] for name, kind in get_type_hints(Augmentation).items()}
    asked: dict[str, Any] = {name.strip(): {} for name in word.split(",")}
    if word.endswith(".toml"):
        asked = read_toml(Path(word), _FIX)
    effects: dict[str, Any] = {}
    for name, values in asked.items():
        if name not in kinds:
            raise InputError("--augment", name, "is not an effect", choices(kinds, name))
        known = {f.name for f in fields(kinds[name])}
        if not isinstance(values, dict) or not values.keys() <= known:
            raise InputError("--augment", name, "is not a section of the file", choices(known, name))
        try:
            effects[name] = TypeAdapter(kinds[name]).validate_python(values)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, (name, *first["loc"])))
            raise InputError("--augment", where, first["msg"].lower(), _FIX) from None
    return Augmentation(**effects), {name: asdict(effect) for name, effect in effects.items()}


def share_cores(processes: int | None, threads: int | None) -> int:
    """Return the threads of each process: those given, or an equal share of the cores.

    Call it before torch is imported. The threads of a single process are bound to cores, since unbound ones
    may share a core for minutes; those of several processes are not, since each would start at the first
    core.
    """
    cores = len(os.sched_getaffinity(0))
    for option, value in (("--processes", processes), ("--threads", threads)):
        if value is not None and not 1 <= value <= 1024:
            raise InputError("datagen train", option, f"{value}", "Give 1 or more, or leave it out")
    each = threads or max(1, cores // (processes or 1))
    if (processes or 1) == 1 and each == cores > 1:
        os.environ.setdefault("OMP_PROC_BIND", "true")
        os.environ.setdefault("OMP_PLACES", "cores")
    elif processes is not None and processes > 1:
        os.environ.setdefault("OMP_NUM_THREADS", str(each))
    return each
