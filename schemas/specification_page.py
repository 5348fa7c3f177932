"""Writes docs/specification.md, the page of all fields that a configuration file can set."""

from __future__ import annotations

import sys
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from schemas.specification import Range, Specification

_HEAD = """# Specification

This page is generated: `python -m schemas.specification_page > docs/specification.md`.

A run's specification is everything that decides what its samples are. `datagen submit --config FILE.toml`
sets any field below; an option of the command line wins over the file, the file over the default.
`label_source`, `houses`, `objects` and `engines` come from the command line and the machine alone.
The hash of the specification names the run's samples; n, workers, paths and shard size are not part of it.

The defaults, as such a file:

"""
_RESERVED = {"label_source", "houses", "objects", "engines"}
_LIMITS = ((Ge, ">=", "ge"), (Gt, ">", "gt"), (Le, "<=", "le"), (Lt, "<", "lt"))


def page() -> str:
    """The page's text."""
    top: list[str] = []
    tables: list[str] = []
    _write(Specification, "", top, tables)
    return _HEAD + "```toml\n" + "\n".join([*top, *tables]) + "\n```\n"


def _write(model: type[BaseModel], prefix: str, rows: list[str], tables: list[str]) -> None:
    for name, field in model.model_fields.items():
        if not prefix and name in _RESERVED:
            continue
        default: Any = field.get_default(call_default_factory=True)
        if isinstance(default, Range):
            rows.append(f"{name} = {{ low = {default.low}, high = {default.high} }}")
        elif isinstance(default, BaseModel):
            section: list[str] = [f"\n[{prefix}{name}]  # {_first_line(type(default))}"]
            below: list[str] = []
            _write(type(default), f"{prefix}{name}.", section, below)
            tables += [*section, *below]
        else:
            comment = _comment(field)
            rows.append(f"{name} = {_toml(default)}" + (f"  # {comment}" if comment else ""))


def _first_line(model: type[BaseModel]) -> str:
    return (model.__doc__ or "").strip().splitlines()[0]


def _comment(field: FieldInfo) -> str:
    limits = [
        f"{sign} {getattr(item, attribute)}"
        for kind, sign, attribute in _LIMITS
        for item in field.metadata
        if isinstance(item, kind)
    ]
    return "; ".join(filter(None, [_choices(field.annotation), " and ".join(limits)]))


def _choices(annotation: Any) -> str:
    """The words that a field takes, where it takes words only or beside numbers."""
    if get_origin(annotation) is Literal:
        return "one of " + ", ".join(repr(value) for value in get_args(annotation))
    if get_origin(annotation) in (Union, UnionType):
        words = [_choices(part) for part in get_args(annotation)]
        return "a number, or " + "".join(words) if any(words) else ""
    return ""


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)


if __name__ == "__main__":
    sys.stdout.write(page())
