"""Writes docs/specification.md, the page of all fields that a configuration file can set."""

from __future__ import annotations

import sys
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from datagen.schemas.specification import Interval, Range, Specification

_HEAD = """# Specification

This page is generated: `python -m schemas.specification_page > docs/specification.md`.

A run's specification is everything that decides what its samples are. `datagen submit --config FILE.toml`
sets any field below; an option of the command line wins over the file, the file over the default.
`label_source`, `houses`, `objects`, `scenes_from` and `engines` come from the command line and the machine
alone. The hash of the specification names the run's samples; n, workers, paths and shard size are not part
of it.

What is absent by default is commented out, with the values that it then has: the sections of `arm` are
for the label sources `plan` and `sim`, `arm.trial` and `arm.disturbance` for `sim`. These two sources take
whole grids with one robot by default, and where a robot has one reach, a range of heights or a base of its
own, that is what its candidates have by default.

The defaults, as such a file:

"""
_RESERVED = {"label_source", "houses", "objects", "scenes_from", "engines"}
_LIMITS = ((Ge, ">=", "ge"), (Gt, ">", "gt"), (Le, "<=", "le"), (Lt, "<", "lt"))


def page() -> str:
    """The page's text."""
    top: list[str] = []
    tables: list[str] = []
    _write(Specification, "", top, tables)
    return _HEAD + "```toml\n" + "\n".join([*top, *tables]) + "\n```\n"


def _write(
    model: type[BaseModel], prefix: str, rows: list[str], tables: list[str], absent: bool = False
) -> None:
    """Add the model's values to `rows` and its sections to `tables`, commented out where `absent`."""
    mark = "# " if absent else ""
    for name, field in model.model_fields.items():
        if not prefix and name in _RESERVED:
            continue
        default: Any = field.get_default(call_default_factory=True)
        below = type(default) if isinstance(default, BaseModel) else _section_of(field.annotation)
        if isinstance(default, (Range, Interval)):
            rows.append(f"{mark}{name} = {{ low = {default.low}, high = {default.high} }}")
        elif below is not None:
            hidden = absent or default is None
            title = f"[{prefix}{name}]  # {_first_line(below)}"
            section, deeper = ["", f"# {title}" if hidden else title], list[str]()
            _write(below, f"{prefix}{name}.", section, deeper, hidden)
            tables += [*section, *deeper]
        elif default is None:
            rows.append(f"# {name} = {_toml(_words(field.annotation)[0])}  # absent, or {_comment(field)}")
        else:
            comment = _comment(field)
            rows.append(f"{mark}{name} = {_toml(default)}" + (f"  # {comment}" if comment else ""))


def _section_of(annotation: Any) -> type[BaseModel] | None:
    """The model of a section that may be absent, None for what is no section."""
    parts = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else ()
    models = [part for part in parts if isinstance(part, type) and issubclass(part, BaseModel)]
    return models[0] if models else None


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
    words = _words(annotation)
    if not words:
        return ""
    numbers = get_origin(annotation) is not Literal and NoneType not in get_args(annotation)
    return ("a number, or " if numbers else "") + "one of " + ", ".join(repr(word) for word in words)


def _words(annotation: Any) -> list[str]:
    if get_origin(annotation) is Literal:
        return list(get_args(annotation))
    if get_origin(annotation) in (Union, UnionType):
        return [word for part in get_args(annotation) for word in _words(part)]
    return []


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)


if __name__ == "__main__":
    sys.stdout.write(page())
