"""A checkpoint: one file with a model's weights, their origin, and the state to resume training.

On disk it is a safetensors file: tensors under `weights/` (the best epoch's) and `resume/` (the last step's
model and optimiser), and in the header's metadata one JSON text, `head`. Other numbers and the file's
checksum are in the JSON, which keeps every bit of a float.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from pydantic import ConfigDict, TypeAdapter, ValidationError
from safetensors import SafetensorError
from torch import Tensor

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular, whole_file
from datagen.train.dataset import DataOrigin
from datagen.train.models import Model, build_model
from datagen.train.training.validation import ValidationMetrics

FORMAT, FORMAT_VERSION = "datagen checkpoint", 2
MAX_BYTES = 2 << 30
_MAX_HEADER_BYTES = 32 << 20
_MAX_TENSORS, _MAX_AXES = 100_000, 64
_DTYPES = {"F32", "I64", "U8", "BOOL"}
_UNSIGNED = b"0" * 64  # stands for the checksum while it is computed
_NO_TEXT = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff]")
_MAX_TEXT = 4096
_FIX = "Name a checkpoint of `datagen train`, or train it again"
# Errors from reading a file of another kind, or a damaged one.
_NOT_READ = (
    SafetensorError,
    ArithmeticError,
    AttributeError,
    LookupError,
    RuntimeError,
    TypeError,
    ValueError,
)


class EpochRecord(ValidationMetrics):
    """The results of an epoch."""

    epoch: int  # counted from 1
    step: int
    loss: float  # the training loss
    accuracy: float


@dataclass(frozen=True)
class CheckpointHead:
    """The metadata of a checkpoint, as plain data."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    model: str
    model_config: dict[str, Any]
    stage: str  # stage1, stage2 or sim-only
    options: dict[str, Any]  # of training, resolved
    data: tuple[DataOrigin, ...]
    val_data: tuple[DataOrigin, ...]
    house_ids: tuple[str, ...]  # trained on, also by the checkpoint that this one began from
    object_digests: tuple[str, ...]  # the same of objects
    val_house_ids: tuple[str, ...]  # chose the best epoch, also of the checkpoint that this one began from
    cost: dict[str, float]  # label_cpu_s, train_cpu_s, train_wall_s; without those of `init`
    versions: dict[str, str]
    history: tuple[EpochRecord, ...]
    step: int = 0  # optimiser's steps up to the last weights
    epoch: int = 0  # whole epochs up to them
    best_epoch: int | None = None  # `load_model` gives its weights; counted from 1, None before the first
    finished: bool = False
    init: dict[str, Any] | None = None  # digest, stage and cost of the checkpoint that it began from
    digest: str = field(default="", compare=False)  # sha256 of the file; set by reading


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A complete checkpoint: `weights` of the best epoch; `resume` and `loop` of the last step."""

    head: CheckpointHead
    weights: dict[str, Tensor]
    resume: dict[str, Tensor] = field(default_factory=dict)
    loop: dict[str, Any] = field(default_factory=dict)


_HEAD = TypeAdapter(CheckpointHead)


def load_model(path: str | Path, device: str | torch.device = "cpu") -> tuple[Model, CheckpointHead]:
    """Load the model of a checkpoint with its best weights, in evaluation mode, and its metadata."""
    checkpoint = read_checkpoint(path)
    head = checkpoint.head
    with torch.random.fork_rng(devices=[]):  # the initial random parameters are replaced
        model = build_model(head.model, head.model_config)
    put_weights(model, checkpoint.weights, str(path))
    return model.to(device).eval(), head


def put_weights(model: Model, weights: Mapping[str, Tensor], place: str) -> None:
    """Replace all of a model's parameters and buffers. InputError where names, shapes or dtypes differ."""
    wanted = model.state_dict()
    for name in sorted(wanted.keys() ^ weights.keys()):
        problem = "the model has no such weights" if name in weights else "the checkpoint lacks it"
        raise InputError(place, name, problem, _FIX)
    for name, tensor in wanted.items():
        ours, theirs = (tuple(tensor.shape), tensor.dtype), (tuple(weights[name].shape), weights[name].dtype)
        if ours != theirs:
            problem = f"is {theirs[1]} {theirs[0]}, but {ours[1]} {ours[0]} in the model"
            raise InputError(place, name, problem, _FIX)
    model.load_state_dict(weights)


def read_checkpoint(path: str | Path) -> Checkpoint:
    """Load a complete checkpoint on the CPU. InputError as `load_model`; memory is bounded by its size."""
    place, data = str(path), read_regular(Path(path), MAX_BYTES, _FIX)
    try:
        tensors, document = _read(data)
    except _NOT_READ as e:
        problem = f"not a datagen checkpoint, or damaged ({e!s:.200})"
        raise InputError(place, "", problem, _FIX) from None
    _refuse_other_document(place, document)
    try:
        head = replace(_HEAD.validate_python(document["head"]), digest=hashlib.sha256(data).hexdigest())
        loop = dict(document["loop"])
    except (ValidationError, KeyError, TypeError, ValueError) as e:
        first = e.errors()[0] if isinstance(e, ValidationError) else None
        where = ".".join(str(part) for part in first["loc"]) if first else "head"
        problem = first["msg"].lower() if first else f"incomplete ({e})"
        raise InputError(place, where, problem, _FIX) from None
    _refuse_not_finite(place, tensors, _FIX)
    return Checkpoint(head, below("weights/", tensors), below("resume/", tensors), loop)


def write_checkpoint(path: str | Path, checkpoint: Checkpoint) -> None:
    """Replace the file atomically. InputError, and the file stays, where a tensor is not finite."""
    path = Path(path)
    document = {
        "sha256": _UNSIGNED.decode(),  # before any other text that could contain these zeros
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "head": {k: v for k, v in asdict(checkpoint.head).items() if k != "digest"},
        "loop": checkpoint.loop,
    }
    stored = {f"weights/{k}": _own(v) for k, v in checkpoint.weights.items()}
    stored |= {f"resume/{k}": _own(v) for k, v in checkpoint.resume.items()}
    fix = "Nothing was overwritten. Train again with a smaller --lr and a new --out"
    _refuse_not_finite(str(path), stored, fix)
    data = safetensors.torch.save(stored, {"head": json.dumps(document, allow_nan=False)})
    data = data.replace(_UNSIGNED, hashlib.sha256(data).hexdigest().encode(), 1)
    with whole_file(path, durable=True, alone=True) as file:
        file.write(data)


@contextmanager
def only_writer(path: str | Path) -> Generator[None]:
    """Lock the checkpoint for this process. InputError while another process on this machine holds it."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = path.with_name(f".{path.name}.lock")
    with open(lock, "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            mine = os.path.samestat(os.fstat(file.fileno()), lock.stat())
        except (BlockingIOError, FileNotFoundError):
            mine = False
        if not mine:
            fix = "Wait for it, stop it, or give another --out"
            raise InputError(path, "", "is being trained by another process", fix)
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)


def _refuse_not_finite(place: str, tensors: Mapping[str, Tensor], fix: str) -> None:
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise InputError(place, name, "has NaN or infinite numbers", fix)


def _own(tensor: Tensor) -> Tensor:
    """A dense copy on the CPU: a view would be saved with its whole base tensor."""
    return tensor.detach().cpu().contiguous().clone()


def _read(data: bytes) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors of a safetensors file and its `head`, read. ValueError and others for a damaged one."""
    end = 8 + int.from_bytes(data[:8], "little")
    if not 8 < end <= min(len(data), _MAX_HEADER_BYTES):
        raise ValueError("no header of a safetensors file")
    header: Any = json.loads(data[8:end])
    document: dict[str, Any] = json.loads(header.pop("__metadata__")["head"])
    if len(header) > _MAX_TENSORS:
        raise ValueError("too many tensors")
    for name, entry in header.items():
        if entry["dtype"] not in _DTYPES or len(entry["shape"]) > _MAX_AXES:
            raise ValueError(f"tensor {name!r:.80} has a type or shape that no checkpoint has")
    stated: str = document["sha256"]
    unsigned = data[:end].replace(stated.encode(), _UNSIGNED, 1)
    digest = hashlib.sha256(unsigned)
    digest.update(memoryview(data)[end:])
    if digest.hexdigest() != stated:
        raise ValueError("its checksum is another one")
    return safetensors.torch.load(data), document


def _refuse_other_document(place: str, document: dict[str, Any]) -> None:
    if document.get("format") != FORMAT:
        raise InputError(place, "head", "is not that of a datagen checkpoint", _FIX)
    _refuse_odd_values(place, document)
    version = document.get("format_version")
    if version != FORMAT_VERSION:
        problem = f"is {version!r:.20}, but this program reads {FORMAT_VERSION}"
        raise InputError(place, "format_version", problem, "Use the version of datagen that wrote it")


def below(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors whose names begin with a prefix, by the rest of their names."""
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _refuse_odd_values(place: str, document: dict[str, Any]) -> None:
    """InputError for a number that is not finite or beyond 64 bits, and for text unfit for a terminal."""
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
                raise InputError(place, where, problem, _FIX)
            case int() | float() if not -(2.0**63) < value < 2.0**63:
                raise InputError(place, where, f"{value!s:.20} is not a usable number", _FIX)
            case _:
                pass
