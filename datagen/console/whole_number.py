"""Whole numbers on the command line: 180000, 180,000 or 1e5; a value that needs rounding is refused."""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal
from typing import Any

from cyclopts import Parameter, Token

_NUMBER = re.compile(r"[+-]?([0-9]{1,30}|[0-9]{1,3}(,[0-9]{3}){1,9})((\.[0-9]{1,30})?[eE]\+?[0-9]{1,2})?")


def _parse(kind: Any, tokens: Sequence[Token]) -> int:
    text = tokens[0].value
    value = Decimal(text.replace(",", "")) if _NUMBER.fullmatch(text) else None
    if value is None or value != int(value):
        shown = text if len(text) <= 40 else text[:37] + "..."
        raise ValueError(f'"{shown}" is not a whole number like 600, 180,000 or 1e5.')
    return int(value)


# In an annotation with the option's own Parameter. Without it 2.5 is read as 2.
WHOLE_NUMBER = Parameter(converter=_parse)
