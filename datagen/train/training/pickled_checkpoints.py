"""Checkpoints of format 1: files of `torch.save`, read as plain data without calling code.

`torch.load(weights_only=True)` calls no foreign code, yet it allocates what a pickle asks for, and not every
release compares the size that a pickle states with that of the record. Here a file is a zip of stored records
with right checksums, whose pickle is one flat dictionary of texts and dense tensors, each exactly as large
as its record; the unpickler knows the few opcodes that such a dictionary needs.
"""

from __future__ import annotations

import io
import math
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch import Tensor

_MAX_PICKLE_BYTES = 64 << 20
_MAX_RECORDS = 100_000
_MAX_AXES = 64
_DTYPES = {
    "FloatStorage": torch.float32, "LongStorage": torch.int64,
    "ByteStorage": torch.uint8, "BoolStorage": torch.bool,
}  # fmt: skip
# Errors from reading a file of another kind, or a damaged one.
NOT_PICKLED = (ArithmeticError, EOFError, LookupError, RuntimeError, TypeError, ValueError)
# Marks, dictionaries, tuples, texts, whole numbers, False, globals, the memo, storages, calls; and the end.
_OPCODES = b"\x80(})t\x85\x86\x87XJKM\x8a\x89cqrhjQR."


# The unpickler of the standard library that is written in Python: it can be given fewer opcodes, and its memo
# is a dictionary, while the one written in C allocates memory for any index in a file.
class _Unpickler(pickle._Unpickler):  # pyright: ignore[reportPrivateUsage]
    stack: list[Any]
    pop_mark: Callable[[], list[Any]]

    def __init__(self, data: bytes, records: dict[str, bytes]) -> None:
        super().__init__(io.BytesIO(data))
        self._records = records

    def _set_one(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._set([key, value])

    def _set_some(self) -> None:
        self._set(self.pop_mark())

    def _set(self, items: list[Any]) -> None:
        table = self.stack[-1]
        # Only texts are keys: the hash of nested tuples may take forever.
        if not isinstance(table, dict) or not all(isinstance(key, str) for key in items[::2]):
            raise ValueError("a dictionary with keys that are no text")
        table.update(zip(items[::2], items[1::2], strict=True))

    dispatch: ClassVar[Any] = {
        **{k: pickle._Unpickler.dispatch[k] for k in _OPCODES},  # pyright: ignore[reportPrivateUsage]
        pickle.SETITEM[0]: _set_one,
        pickle.SETITEMS[0]: _set_some,
    }

    def find_class(self, module: str, name: str) -> Any:
        if module == "torch" and name in _DTYPES:
            return _DTYPES[name]
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _tensor
        if (module, name) == ("collections", "OrderedDict"):
            return _hooks
        raise ValueError(f"it asks for {module!r:.80} {name!r:.80}")

    def persistent_load(self, pid: Any) -> Tensor:
        word, dtype, key, device, items = pid
        if word != "storage" or device != "cpu" or dtype not in _DTYPES.values() or type(items) is not int:
            raise ValueError("an unknown kind of storage")
        if not isinstance(key, str) or len(data := self._records[key]) != items * dtype.itemsize:
            raise ValueError(f"a tensor whose record {key!r:.80} is of another size")
        return torch.frombuffer(bytearray(data), dtype=dtype) if items else torch.empty(0, dtype=dtype)


def _hooks() -> dict[str, Any]:
    return {}


def _tensor(storage: Any, offset: Any, shape: Any, stride: Any, grad: Any, hooks: Any) -> Tensor:
    if not isinstance(storage, Tensor) or len(shape) > _MAX_AXES:
        raise ValueError("a tensor of no shape")
    if any(type(n) is not int or n < 0 for n in (*shape, *stride)):
        raise ValueError("a tensor of no shape")
    dense = tuple(math.prod(shape[k + 1 :]) for k in range(len(shape)))
    # The stride of an axis with one entry, or of an empty tensor, has no meaning.
    strided = len(storage) and any(a != b for n, a, b in zip(shape, stride, dense, strict=True) if n != 1)
    if offset != 0 or math.prod(shape) != len(storage) or strided or grad or hooks:
        raise ValueError("a tensor that is not dense")
    return storage.reshape(shape)


def read_pickled(data: bytes) -> tuple[dict[str, Tensor], str]:
    """The tensors of a file of format 1, and its `head`. Raises one of `NOT_PICKLED` for other files."""
    # Every record of the zip's directory begins with these bytes; counted before a list is made of them.
    if data.count(b"PK\1\2") > _MAX_RECORDS:
        raise ValueError("too many records")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            records = _records(archive, len(data))
        value = _Unpickler(records.pop("data.pkl"), records).load()
    except (zipfile.BadZipFile, zlib.error, pickle.UnpicklingError, struct.error) as error:
        raise ValueError(str(error)) from None
    if not isinstance(value, dict) or not isinstance(text := value.pop("head"), str):
        raise ValueError("not a dictionary with a head")
    if not all(isinstance(tensor, Tensor) for tensor in value.values()):
        raise ValueError("not a dictionary of texts and tensors")
    return value, text


def _records(archive: zipfile.ZipFile, n_bytes: int) -> dict[str, bytes]:
    """The pickle, `data.pkl`, and the bytes of each storage by its key."""
    stored = {record.filename: record for record in archive.infolist()}
    if len(stored) != len(archive.infolist()):
        raise ValueError("two records of one name")
    for record in stored.values():
        if record.compress_type != zipfile.ZIP_STORED or record.file_size != record.compress_size:
            raise ValueError(f"record {record.filename} is compressed")
    if sum(record.file_size for record in stored.values()) > n_bytes:
        raise ValueError("records overlap")
    root = next((name[: -len("data.pkl")] for name in stored if name.endswith("/data.pkl")), None)
    if root is None or stored[root + "data.pkl"].file_size > _MAX_PICKLE_BYTES:
        raise ValueError("it holds no data.pkl, or one that is too large")
    if root + "byteorder" in stored and archive.read(root + "byteorder") != b"little":
        raise ValueError("bytes in another order")
    names = [root + "data.pkl", *(name for name in stored if name.startswith(root + "data/"))]
    return {name.removeprefix(root).removeprefix("data/"): archive.read(name) for name in names}
