"""How functions become machine code: exact arithmetic, kept on disk, so that later processes load it."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numba
import numpy as np
from numba.core import types
from numba.experimental import structref

_Function = TypeVar("_Function", bound=Callable[..., Any])
_Tuple = TypeVar("_Tuple", bound=NamedTuple)


def compiled(function: _Function) -> _Function:
    """The function as machine code. Without fast-math: equal arguments give equal bits on one platform."""
    made: Any = numba.njit(cache=True, error_model="numpy")(function)
    # Numba recompiles a function when its own file changes. Its machine code contains what it calls, and
    # constants of other files: these must count too.
    file, known = made._cache._cache_file, function.__globals__
    used = [known[name] for name in function.__code__.co_names if name in known]
    stamps = [x._cache._cache_file._source_stamp for x in used if isinstance(x, type(made))]
    values = [x for x in used if isinstance(x, int | float | np.number)]
    file._source_stamp = hashlib.sha256(repr((file._source_stamp, stamps, values)).encode()).digest()
    return cast("_Function", made)


def constant(value: int) -> int:
    """An integer for arguments of compiled functions, which are made again for each plain one."""
    return cast("int", np.int64(value))


def struct(fields: type[_Tuple]) -> type[_Tuple]:
    """A structure in memory with the fields of a NamedTuple, as machine code takes it: one pointer.

    A tuple of arrays would be passed as all their sizes and strides: that compiles and runs many
    times slower.
    """
    name = f"{fields.__name__}Struct"
    own = {"__module__": fields.__module__, "__doc__": fields.__doc__}
    kind = structref.register(type(f"{name}Type", (types.StructRef,), own))
    # Caches name types by their module.
    setattr(sys.modules[fields.__module__], kind.__name__, kind)
    made = type(name, (structref.StructRefProxy,), own)
    structref.define_proxy(made, kind, list(fields._fields))
    _structs[fields] = made
    return cast("type[_Tuple]", made)


_structs: dict[type, Any] = {}


def in_memory(value: _Tuple) -> _Tuple:
    """The structure of a tuple's fields, which shares its arrays; such tuples in it become structures."""
    made = [in_memory(field) if type(field) in _structs else field for field in value]  # pyright: ignore
    return _structs[type(value)](*made)
