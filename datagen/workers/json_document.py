"""Values of a parsed JSON document, each with its path, so that a bad one can be named."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Any, NamedTuple, cast

from datagen.schemas.errors import InputError, printable
from datagen.workers.foreign_files import START_BYTES, refuse_other_kind

# No house is larger; a larger coordinate is a unit error or garbage.
EXTENT_M = 1000.0
_LONGEST_TEXT = 500
# An empty object takes 3 bytes of text and 70 of memory.
_MOST_PARTS = 4_000_000


class JsonNode(NamedTuple):
    """A JSON value; `place` is the file (and line), `path` its location in the document."""

    place: str
    path: str
    value: Any

    def error(self, problem: str, fix: str = "Correct or remove this entry.") -> InputError:
        """The error that names this value."""
        return InputError(self.place, self.path, problem, fix)

    def get(self, key: str) -> JsonNode:
        """The member of an object. Raises InputError if it is absent."""
        members = self._members()
        if key not in members:
            raise self.error(f"has no key {key!r}")
        return JsonNode(self.place, f"{self.path}.{key}", members[key])

    def find(self, key: str) -> JsonNode | None:
        """The member of an object, or None where it is absent or null."""
        value = self._members().get(key)
        return None if value is None else JsonNode(self.place, f"{self.path}.{key}", value)

    def given(self, key: str, default: Any) -> JsonNode:
        """The member of an object, or `default` where it is absent or null."""
        return self.find(key) or JsonNode(self.place, f"{self.path}.{key}", default)

    def items(self, limit: int) -> Iterator[JsonNode]:
        """The elements of a list of at most `limit`."""
        if not isinstance(self.value, list):
            raise self.error(f"is {_kind(self.value)}, not a list")
        values = cast(list[Any], self.value)
        if len(values) > limit:
            raise self.error(f"has {len(values)} entries, more than the {limit} allowed")
        for i, value in enumerate(values):
            yield JsonNode(self.place, f"{self.path}[{i}]", value)

    def number(self, low: float, high: float) -> float:
        value = self.value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(f"is {_kind(value)}, not a number")
        if not low <= value <= high:  # also false for NaN; an int of any size compares exactly
            shown = f"{value:g}" if isinstance(value, float) or abs(value) < 1e15 else "a huge number"
            raise self.error(f"{shown} is not within [{low:g}, {high:g}]")
        return float(value)

    def numbers(self, count: int, low: float, high: float) -> list[float]:
        values = [item.number(low, high) for item in self.items(count)]
        if len(values) != count:
            raise self.error(f"has {len(values)} numbers, not {count}")
        return values

    def text(self) -> str:
        """A string of at most 500 printable characters, as it is copied into records and arrays."""
        if not isinstance(self.value, str):
            raise self.error(f"is {_kind(self.value)}, not a string")
        if len(self.value) > _LONGEST_TEXT:
            raise self.error(f"has {len(self.value)} characters, more than {_LONGEST_TEXT}")
        if not self.value.isprintable():
            bad = printable(next(c for c in self.value if not c.isprintable()))
            raise self.error(f"has the unprintable character {bad}")
        return self.value

    def point(self) -> tuple[float, float, float]:
        """The unconverted numbers of `{x, y, z}`, each finite and within 1000 m of 0."""
        return (
            self.get("x").number(-EXTENT_M, EXTENT_M),
            self.get("y").number(-EXTENT_M, EXTENT_M),
            self.get("z").number(-EXTENT_M, EXTENT_M),
        )

    def _members(self) -> dict[str, Any]:
        if not isinstance(self.value, dict):
            raise self.error(f"is {_kind(self.value)}, not an object")
        return cast(dict[str, Any], self.value)


def parse_json(text: bytes, place: str) -> JsonNode:
    """The document, or an InputError for text that is not JSON or is nested too deeply."""
    fix = "Restore the file from its source."
    refuse_other_kind(place, text[:START_BYTES], "a JSON text", fix)
    if text.count(b"{") + text.count(b"[") > _MOST_PARTS:
        raise InputError(place, "$", f"more than {_MOST_PARTS:,} lists and objects", fix)
    try:
        return JsonNode(place, "$", json.loads(text))
    except RecursionError:
        raise InputError(place, "$", "lists or objects nested too deeply", fix) from None
    except UnicodeDecodeError as error:
        raise InputError(place, "$", f"not UTF-8 at byte {error.start}", fix) from None
    except json.JSONDecodeError as error:
        raise InputError(place, f"character {error.pos}", f"not JSON ({error.msg})", fix) from None
    except ValueError:  # an integer of thousands of digits
        raise InputError(place, "$", "a number with too many digits", fix) from None


def _kind(value: object) -> str:
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    names: dict[type, str] = {
        dict: "an object",
        list: "a list",
        str: "a string",
        bool: "a boolean",
        int: "a number",
    }
    return "null" if value is None else names.get(type(value), "a number")
