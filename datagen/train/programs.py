"""Models as lists of steps that NumPy computes: scores without torch.

A program is one safetensors file. Its tensors are the model's constants; its metadata name the inputs, the
outputs and the steps of each of its functions, which are operations of PyTorch's core ATen set
(docs.pytorch.org/docs/stable/torch.compiler_ir.html). `scripts/export_program.py` makes it of a checkpoint.
"""

from __future__ import annotations

import json
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open

from datagen.schemas.errors import InputError
from datagen.train.inputs import Array

MARK = "%"  # before the name of an earlier step, a constant or an input


@dataclass(frozen=True)
class Step:
    """One operation: its result's name, and arguments in which `%name` is a result."""

    name: str
    op: str
    args: tuple[Any, ...]
    options: Mapping[str, Any]


@dataclass(frozen=True)
class Function:
    """Steps from named inputs to outputs."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    steps: tuple[Step, ...]

    def named(self) -> set[str]:
        """All results, constants and inputs that it uses."""
        return {name for step in self.steps for name in _named(step)} | set(self.outputs)

    @cached_property
    def _dropped(self) -> list[set[str]]:
        """What no step after each one needs, of results and inputs that are no outputs."""
        last = {name: k for k, step in enumerate(self.steps) for name in _named(step)}
        own = {step.name for step in self.steps} | set(self.inputs)
        dropped = [set[str]() for _ in self.steps]
        for name in own & last.keys() - set(self.outputs):
            dropped[last[name]].add(name)
        return dropped

    def run(self, constants: Mapping[str, Array], inputs: Mapping[str, Array]) -> list[Array]:
        """The outputs for inputs by name."""
        known: dict[str, Any] = {**constants, **inputs}
        for step, dropped in zip(self.steps, self._dropped, strict=True):
            known[step.name] = OPERATIONS[step.op](*_filled(step.args, known), **_filled(step.options, known))
            for name in dropped:
                del known[name]
        return [known[name] for name in self.outputs]


@dataclass(frozen=True, eq=False)
class Program:
    """Functions by name, the constants of all, and facts about the model."""

    functions: Mapping[str, Function]
    constants: Mapping[str, Array]
    facts: Mapping[str, Any]

    def run(self, function: str, inputs: Mapping[str, Array]) -> list[Array]:
        """The outputs of one function."""
        return self.functions[function].run(self.constants, inputs)


def read_program(path: Path) -> Program:
    """The program of a file. InputError for another file."""
    try:
        with safe_open(path, "numpy") as file:
            document = json.loads((file.metadata() or {})["program"])
            constants = {name: file.get_tensor(name) for name in file.offset_keys()}
        functions = {
            name: Function(
                tuple(each["inputs"]),
                tuple(each["outputs"]),
                tuple(Step(step[0], step[1], tuple(step[2]), step[3]) for step in each["steps"]),
            )
            for name, each in document["functions"].items()
        }
        unknown = {step.op for each in functions.values() for step in each.steps} - OPERATIONS.keys()
        if unknown:
            raise ValueError(f"unknown operations: {', '.join(sorted(unknown))}")
        return Program(functions, constants, document["facts"])
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, IndexError) as error:
        fix = "Install the package again, or write it with scripts/export_program.py"
        raise InputError(path, "", f"is no program of a model ({error})", fix) from None


def _named(step: Step) -> set[str]:
    found: set[str] = set()

    def look(value: Any) -> None:
        if isinstance(value, str) and value.startswith(MARK):
            found.add(value[1:])
        elif isinstance(value, list | tuple):
            for each in value:
                look(each)

    look([*step.args, *step.options.values()])
    return found


def _filled(value: Any, known: Mapping[str, Any]) -> Any:
    if isinstance(value, str):
        return known[value[1:]] if value.startswith(MARK) else value
    if isinstance(value, list | tuple):
        return [_filled(each, known) for each in value]
    if isinstance(value, Mapping):
        return {key: _filled(each, known) for key, each in value.items()}
    return value


def _axes(axis: Any) -> Any:
    """None for no axes, as torch reduces over all then."""
    return (tuple(axis) if axis else None) if isinstance(axis, list) else axis


def _slice(x: Array, axis: int = 0, start: int | None = None, end: int | None = None, step: int = 1) -> Array:
    return x[(slice(None),) * (axis % x.ndim) + (slice(start, end, step),)]


def _index(x: Array, rows: Sequence[Array | None]) -> Array:
    return x[tuple(slice(None) if each is None else each for each in rows)]


def _scatter(x: Array, axis: int, rows: Array, values: Array) -> Array:
    found = x.copy()
    np.put_along_axis(found, rows, values, axis)
    return found


def _pad(x: Array, pad: Sequence[int], value: float = 0.0) -> Array:
    """Torch's padding: pairs of low and high, the last axis first."""
    pairs = [(pad[k], pad[k + 1]) for k in range(0, len(pad), 2)]
    return np.pad(x, [(0, 0)] * (x.ndim - len(pairs)) + pairs[::-1], constant_values=value)


def _layer_norm(x: Array, shape: Sequence[int], weight: Array, bias: Array, eps: float) -> tuple[Array, ...]:
    # A product with ones is several times as fast as a mean along short rows.
    away = x.reshape(-1, size := math.prod(shape))
    away = away - away @ np.full((size, 1), 1 / size, away.dtype)
    away *= 1 / np.sqrt(np.einsum("ij,ij->i", away, away)[:, None] / size + eps)
    away = away.reshape(x.shape) * weight
    away += bias
    return (away,)


def _softmax(x: Array, axis: int, _: bool) -> Array:
    powers = np.exp(x - x.max(axis=axis, keepdims=True))
    return powers / powers.sum(axis=axis, keepdims=True)


def _norm(x: Array, order: float = 2, axis: Any = None, keepdim: bool = False) -> Array:
    return np.sqrt((x * x).sum(axis=_axes(axis), keepdims=keepdim))


def _expand(x: Array, shape: Sequence[int]) -> Array:
    lead = len(shape) - x.ndim
    return np.broadcast_to(x, [x.shape[k - lead] if n == -1 else n for k, n in enumerate(shape)])


def _reduced(function: Callable[..., Array]) -> Callable[..., Array]:
    return lambda x, axis=None, keepdim=False: function(x, axis=_axes(axis), keepdims=keepdim)


def _mean(x: Array, axis: Any, keepdim: bool = False) -> Array:
    return x.mean(axis=_axes(axis), keepdims=keepdim)


def _real(function: Callable[..., Array]) -> Callable[..., Array]:
    """The function of two operands, of which integers take the other's type, as in torch."""

    def found(x: Any, y: Any) -> Array:
        if isinstance(x, np.ndarray) and isinstance(y, np.ndarray) and x.dtype != y.dtype:
            wide = x.dtype if x.dtype.kind == "f" else y.dtype
            x, y = x.astype(wide), y.astype(wide)
        return function(x, y)

    return found


def _arange(start: int, end: int, step: int = 1, dtype: str = "int64") -> Array:
    return np.arange(start, end, step).astype(dtype)


def _filled_like(x: Array, value: float) -> Array:
    return np.full_like(x, value)


OPERATIONS: dict[str, Callable[..., Any]] = {
    "_softmax": _softmax,
    "_to_copy": lambda x, dtype=None: x if dtype is None else x.astype(dtype),
    "abs": np.abs,
    "add": _real(operator.add),
    "addmm": lambda b, x, w: b + x @ w,
    "amax": _reduced(np.max),
    "amin": _reduced(np.min),
    "arange": _arange,
    "bitwise_and": operator.and_,
    "bitwise_not": operator.invert,
    "bmm": operator.matmul,
    "cat": lambda parts, axis=0: np.concatenate(parts, axis),
    "clamp": lambda x, low=None, high=None: np.clip(x, low, high),
    "clone": lambda x: x,
    "constant_pad_nd": _pad,
    "cumsum": np.cumsum,
    "div": _real(operator.truediv),
    "eq": operator.eq,
    "exp": np.exp,
    "expand": _expand,
    "full": lambda shape, value, dtype="float32": np.full(shape, value, dtype),
    "full_like": _filled_like,
    "gather": lambda x, axis, rows: np.take_along_axis(x, rows, axis),
    "getitem": operator.getitem,
    "gt": operator.gt,
    "hypot": np.hypot,
    "index": _index,
    "index_select": lambda x, axis, rows: np.take(x, rows, axis),
    "le": operator.le,
    "linalg_vector_norm": _norm,
    "log1p": np.log1p,
    "lt": operator.lt,
    "mean": _mean,
    "mm": operator.matmul,
    "mul": _real(operator.mul),
    "native_layer_norm": _layer_norm,
    "neg": operator.neg,
    "permute": np.transpose,
    "pow": operator.pow,
    "reciprocal": lambda x: 1 / x,
    "relu": lambda x: np.maximum(x, 0),
    "repeat_interleave": lambda counts: np.repeat(np.arange(len(counts)), counts),
    "scalar_tensor": lambda value, dtype="float32": np.array(value, dtype),
    "scatter": _scatter,
    "select": lambda x, axis, k: np.take(x, k, axis),
    "sigmoid": lambda x: 1 / (1 + np.exp(-x)),
    "slice": _slice,
    "split_with_sizes": lambda x, sizes, axis=0: np.split(x, np.cumsum(sizes)[:-1], axis),
    "sqrt": np.sqrt,
    "squeeze": lambda x, axes: np.squeeze(x, _axes(axes)),
    "sub": _real(operator.sub),
    "sum": _reduced(np.sum),
    "tanh": np.tanh,
    "unsqueeze": np.expand_dims,
    "view": np.reshape,
    "where": np.where,
}
