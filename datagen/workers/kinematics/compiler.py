"""How functions become machine code: exact arithmetic, kept in the user's cache for later processes."""

# numba has no types for its own classes.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportPrivateUsage=false

from __future__ import annotations

import os
import pickle
import sys
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numba
import numpy as np
from numba.core import cgutils, imputils, types
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps
from numba.experimental import structref

from datagen.schemas.safe_files import whole_file
from datagen.workers.content_cache import cache_folder, drop_unused, refresh
from datagen.workers.kinematics import tell_of_compiling

_Function = TypeVar("_Function", bound=Callable[..., Any])
_Tuple = TypeVar("_Tuple", bound=NamedTuple)
_MOST_FILES = 1024  # of all versions; one has about 100


def compiled(function: _Function) -> _Function:
    """The function as machine code. Without fast-math: equal arguments give equal bits on one platform."""
    dispatcher: Any = numba.njit(error_model="numpy")(function)
    dispatcher._cache = _MachineCode(_name_of(function))
    return cast("_Function", dispatcher)


def _name_of(function: Callable[..., Any]) -> str:
    return f"{function.__module__}.{function.__qualname__}"


def is_kept(function: Callable[..., Any]) -> bool:
    """Whether machine code of a compiled function, for any types of arguments, is on this machine."""
    return any(code_folder().glob(f"{_name_of(function)}-*.code"))


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
    # Machine code on disk names types by their module.
    setattr(sys.modules[fields.__module__], kind.__name__, kind)
    made = type(name, (structref.StructRefProxy,), own)
    structref.define_proxy(made, kind, list(fields._fields))
    for field in fields._fields:
        _read_uncounted(kind, field)

    def new(*values: Any) -> Any:
        return made(*values)

    new.__module__, new.__qualname__ = fields.__module__, f"{name}.new"
    _new_structs[fields] = compiled(new)
    return cast("type[_Tuple]", made)


def _read_uncounted(kind: Any, field: str) -> None:
    """Read arrays of a structure without counting references, which took a fifth of the time of a plan."""

    @imputils.lower_getattr(kind, field)
    def read(context: Any, builder: Any, typ: Any, value: Any) -> Any:
        found = getattr(structref._Utils(context, builder, typ).get_data_struct(value), field)
        if not isinstance(typ.field_dict[field], types.Array):
            return imputils.impl_ret_borrowed(context, builder, typ.field_dict[field], found)
        array = cgutils.create_struct_proxy(typ.field_dict[field])(context, builder, value=found)
        array.meminfo = cgutils.get_null_value(array.meminfo.type)
        array.parent = cgutils.get_null_value(array.parent.type)
        return array._getvalue()

    del read


_new_structs: dict[type, Callable[..., Any]] = {}


def in_memory(value: _Tuple) -> _Tuple:
    """The structure of a tuple's fields, which shares its arrays; such tuples in it become structures."""
    made = [in_memory(field) if type(field) in _new_structs else field for field in value]
    return _new_structs[type(value)](*made)


@cache
def code_folder() -> Path:
    """Where the machine code of these sources is kept: a file a function and type of arguments.

    numba's own cache is not used: it takes code as current whose callees in other files have changed, mixes
    up files of processes that compile at once, and ends the program at a damaged file or a full disk.
    """
    whole = sha256(f"{numba.__version__} {sys.version}".encode())
    for folder in ("kinematics", "motion"):
        for path in sorted((Path(__file__).parents[1] / folder).glob("*.py")):
            whole.update(path.read_bytes())
    return cache_folder() / "machine-code" / whole.hexdigest()[:16]


class _MachineCode(NullCache):
    """Machine code of one function on disk; what is damaged or another user's counts as absent."""

    def __init__(self, name: str) -> None:
        self._name = name

    def load_overload(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, sig: Any, target_context: Any
    ) -> CompileResult | None:
        target_context.refresh()
        path = self._path(sig, target_context)
        try:
            with path.open("rb") as file:
                is_own = os.fstat(file.fileno()).st_uid == os.geteuid()
                digest, data = file.read(32), file.read()
        except OSError:
            is_own, digest, data = False, b"", b""
        if not is_own or digest != sha256(data).digest():
            tell_of_compiling()
            return None
        refresh(path)
        return CompileResult._rebuild(target_context, *pickle.loads(data))  # noqa: S301  our own file

    def save_overload(self, sig: Any, cres: CompileResult) -> None:
        path = self._path(sig, cres.target_context)
        data = dumps(cres._reduce())
        try:
            with whole_file(path, mode=0o600) as file:
                file.write(sha256(data).digest() + data)
        except OSError:
            return
        drop_unused(path.parent, _MOST_FILES)

    def _path(self, sig: Any, target_context: Any) -> Path:
        key = f"{self._name} {sig} {target_context.codegen().magic_tuple()}"
        return code_folder() / f"{self._name}-{sha256(key.encode()).hexdigest()[:32]}.code"
