"""Check a file of `torch.save` without executing code and with memory bounded by the file's size.

`torch.load(weights_only=True)` calls no foreign code, yet it allocates what a pickle asks for, and not every
release compares the size that a pickle states with that of the record. Whoever loads a checkpoint of unknown
origin looks at it here first: a zip of stored records with right checksums, whose pickle is one flat
dictionary of texts and dense tensors, each exactly as large as its record.
"""

from __future__ import annotations

import io
import math
import pickletools
import re
import zipfile
from dataclasses import dataclass
from typing import Any

from datagen.schemas.archives import DAMAGED_ZIP
from datagen.schemas.errors import InputError

MAX_BYTES = 2 << 30
_MAX_PICKLE_BYTES = 64 << 20
_MAX_RECORDS = 100_000
_MAX_AXES = 64
_ITEM_BYTES = {f"torch {k}Storage": n for k, n in {"Float": 4, "Long": 8, "Byte": 1, "Bool": 1}.items()}
_REBUILD, _HOOKS = "torch._utils _rebuild_tensor_v2", "collections OrderedDict"
_MEND = "Name a checkpoint of `datagen train`, or train it again"


@dataclass(frozen=True)
class _Name:
    text: str


@dataclass(frozen=True)
class _TensorStorage:
    items: int


@dataclass(frozen=True)
class _Tensor:
    shape: tuple[int, ...]


_MARK = object()
_NO_TEXT = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff]")
_MAX_TEXT = 4096


def refuse_foreign(place: str, data: bytes) -> None:
    """InputError unless `data` is a file of `torch.save` with a flat dictionary of texts and tensors."""
    try:
        _check(data)
    except zipfile.BadZipFile as e:
        raise InputError(place, "", f"is not a checkpoint, or incomplete ({e})", _MEND) from None
    except (*DAMAGED_ZIP, IndexError, KeyError, TypeError) as e:
        raise InputError(place, "", f"is not a datagen checkpoint ({e})", _MEND) from None


def refuse_odd_values(place: str, document: dict[str, Any]) -> None:
    """InputError at a number that is not finite or beyond 64 bits, and at text that no terminal may print."""
    left: list[tuple[str, Any]] = [("", document)]
    while left:
        where, value = left.pop()
        match value:
            case dict():
                left += [(where, key) for key in value]
                left += [(f"{where}.{key:.40}".lstrip("."), item) for key, item in value.items()]
            case list():
                left += [(where, item) for item in value]
            case str() if len(value) > _MAX_TEXT or _NO_TEXT.search(value):
                problem = (
                    f"text with control characters or surrogates, or of more than {_MAX_TEXT} characters"
                )
                raise InputError(place, where, problem, _MEND)
            case int() | float() if not -(2.0**63) < value < 2.0**63:
                raise InputError(place, where, f"{value!s:.20} is not a usable number", _MEND)
            case _:
                pass


def _check(data: bytes) -> None:
    # Every record of the zip's directory begins with these bytes; counted before a list is made of them.
    if data.count(b"PK\1\2") > _MAX_RECORDS:
        raise ValueError("too many records")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        records = {record.filename: record for record in archive.infolist()}
        if len(records) != len(archive.infolist()):
            raise ValueError("two records of one name")
        for record in records.values():
            if record.compress_type != zipfile.ZIP_STORED or record.file_size != record.compress_size:
                raise ValueError(f"record {record.filename} is compressed")
        if sum(record.file_size for record in records.values()) > len(data):
            raise ValueError("records overlap")
        root = next((name[: -len("data.pkl")] for name in records if name.endswith("/data.pkl")), None)
        if root is None:
            raise ValueError("it holds no data.pkl")
        if records[root + "data.pkl"].file_size > _MAX_PICKLE_BYTES:
            raise ValueError("its data.pkl is too large")
        if (damaged := archive.testzip()) is not None:
            raise zipfile.BadZipFile(f"record {damaged} is damaged")
        if root + "byteorder" in records and archive.read(root + "byteorder") != b"little":
            raise ValueError("bytes in another order")
        sizes = {name.removeprefix(root + "data/"): r.file_size for name, r in records.items()}
        declared = _declared(archive.read(root + "data.pkl"), sizes)
    if not isinstance(declared, dict) or not all(isinstance(v, str | _Tensor) for v in declared.values()):
        raise ValueError("not a dictionary of texts and tensors")


def _declared(pickle: bytes, sizes: dict[str, int]) -> Any:
    """The value that a pickle builds, with tensors as their shapes. ValueError at anything unusual."""
    stack: list[Any] = []
    memo: dict[int, Any] = {}

    def down_to_mark() -> list[Any]:
        for at in reversed(range(len(stack))):
            if stack[at] is _MARK:
                values = stack[at + 1 :]
                del stack[at:]
                return values
        raise ValueError("it closes what it never opened")

    for opcode, argument, _ in pickletools.genops(pickle):
        match opcode.name:
            case "PROTO":
                pass
            case "MARK":
                stack.append(_MARK)
            case "EMPTY_DICT":
                stack.append({})
            case "EMPTY_TUPLE":
                stack.append(())
            case "BINUNICODE" | "BININT" | "BININT1" | "BININT2" | "LONG1":
                stack.append(argument)
            case "NEWFALSE":
                stack.append(False)
            case "GLOBAL":
                if argument not in (*_ITEM_BYTES, _REBUILD, _HOOKS):
                    raise ValueError(f"it asks for {argument}")
                stack.append(_Name(str(argument)))
            case "TUPLE":
                stack.append(tuple(down_to_mark()))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                count = int(opcode.name[-1])
                values = tuple(stack[-count:])
                del stack[-count:]
                stack.append(values)
            case "BINPUT" | "LONG_BINPUT":
                memo[int(argument)] = stack[-1]  # type: ignore[arg-type]
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[int(argument)])  # type: ignore[arg-type]
            case "BINPERSID":
                stack.append(_storage(stack.pop(), sizes))
            case "REDUCE":
                arguments = stack.pop()
                stack.append(_called(stack.pop(), arguments))
            case "SETITEM":
                value, key = stack.pop(), stack.pop()
                _set(stack[-1], [key, value])
            case "SETITEMS":
                items = down_to_mark()
                _set(stack[-1], items)
            case "STOP":
                return stack.pop()
            case other:
                raise ValueError(f"it does what no checkpoint needs ({other})")
    raise ValueError("it has no end")


def _storage(identity: Any, sizes: dict[str, int]) -> _TensorStorage:
    word, kind, key, device, items = identity
    if word != "storage" or device != "cpu" or not isinstance(kind, _Name) or type(items) is not int:
        raise ValueError("an unknown kind of storage")
    if key not in sizes or sizes[key] != items * _ITEM_BYTES[kind.text]:
        raise ValueError(f"a tensor whose record {key} is of another size")
    return _TensorStorage(items)


def _called(function: Any, arguments: Any) -> Any:
    if function == _Name(_HOOKS) and arguments == ():
        return {}
    if function != _Name(_REBUILD):
        raise ValueError("it calls what no checkpoint needs")
    storage, offset, shape, stride, requires_grad, hooks = arguments
    if not isinstance(storage, _TensorStorage) or len(shape) > _MAX_AXES:
        raise ValueError("a tensor of no shape")
    if any(type(n) is not int or n < 0 for n in (*shape, *stride)):
        raise ValueError("a tensor of no shape")
    dense = tuple(math.prod(shape[k + 1 :]) for k in range(len(shape)))
    # The stride of an axis with one entry, or of no entries at all, says nothing.
    strided = storage.items and any(a != b for n, a, b in zip(shape, stride, dense, strict=True) if n != 1)
    if offset != 0 or math.prod(shape) != storage.items or strided or requires_grad or hooks:
        raise ValueError("a tensor that is not dense")
    return _Tensor(shape)


def _set(table: Any, items: list[Any]) -> None:
    if not isinstance(table, dict) or len(items) % 2 or not all(isinstance(k, str) for k in items[::2]):
        raise ValueError("a dictionary with keys that are no text")
    table.update(zip(items[::2], items[1::2], strict=True))
