"""Whole numbers on the command line: digits and a sign, nothing that would have to be rounded."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from cyclopts import Parameter, Token

_DIGITS = re.compile(r"[+-]?[0-9]{1,30}")


def _parse(kind: Any, tokens: Sequence[Token]) -> int:
    text = tokens[0].value
    if not _DIGITS.fullmatch(text):
        shown = text if len(text) <= 40 else text[:37] + "..."
        raise ValueError(f'"{shown}" is not a whole number.')
    return int(text)


# In an annotation beside the option's own Parameter. Without it 2.5 is taken as 2.
WHOLE_NUMBER = Parameter(converter=_parse)
