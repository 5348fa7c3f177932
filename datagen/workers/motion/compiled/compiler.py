"""How functions become machine code: exact arithmetic, kept on disk, so that later processes load it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """The function as machine code. Without fast-math: equal arguments give equal bits on one platform."""
    return numba.njit(cache=True, error_model="numpy")(function)
