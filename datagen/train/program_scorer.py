"""Score with a program: a model's network in NumPy, beside the parts of it that need no torch anyway.

A program is one safetensors file. Its tensors are the model's constants; its metadata name the inputs, the
outputs and the steps of each of its functions, which are operations of PyTorch's core ATen set
(docs.pytorch.org/docs/stable/torch.compiler_ir.html). `scripts/export_program.py` makes it of a checkpoint.
"""

from __future__ import annotations

import json
import math
import operator
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from safetensors import SafetensorError, safe_open

from datagen.schemas.errors import InputError
from datagen.train.hands.poses import poses_of_clouds
from datagen.train.hands.reach import hand_reach, hands_of
from datagen.train.inputs import F32, F64, Array, Batch, CandidateInputs, is_clear
from datagen.train.observed_visibility import visible_share

ENCODE, SCORE = "encode", "score"  # functions of a program
POINTS = 4096  # of a cloud; those of shorter ones are padded
AT_ONCE = 64  # candidates in one call: what more of them need leaves the processor cache
CLOUD = ("points_m", "rgb", "mask", "count", "height_m", "base_height_m", "reach_m")
TOKENS = ("same", "left", "centres_m", "valid", "numbers", "vectors", "tensors", "radius_m", "rise_m")
TO_SCORE = ("camera_rise_m", "reach_m", "poses", "base_xy_m", "rho", "codes")
_MOST_KEPT = 7  # other batches
_MIN_REACH_M = np.float32(0.05)
T = TypeVar("T")
Arrays = Mapping[str, Array]


class ProgramScorer:
    """A scorer, as `ModelScorer` of the model of which the program was made. InputError for another file.

    With `only_clear` the score of a base that is not clear is 0, without computing it. The latest scores are
    kept: of the same frame, another arrival error may be asked for.
    """

    def __init__(self, path: Path, name: str = "", only_clear: bool = False) -> None:
        self.program = read_program(path)
        facts = self.program.facts
        self.name, self.threshold = f"{name}{facts['name']}", 0.5
        self.only_clear, self.weights_sha256 = only_clear, facts["weights_sha256"]
        self.robots: dict[str, tuple[float, float]] = {k: (v[0], v[1]) for k, v in facts["robots"].items()}
        self.side_deg: float | None = facts["side_deg"]
        self._kept = dict[bytes, F64]()

    def score(self, batch: Batch[Array]) -> F64:
        """Probabilities (N,)."""
        wanted = is_clear(batch) if self.only_clear else np.ones(len(batch), np.bool_)
        key = pickle.dumps((batch.clouds, batch.robots, batch.candidates, wanted))
        if (found := self._kept.get(key)) is None:
            found = np.zeros(len(batch))
            for k in range(len(batch.robots)):
                rows = np.flatnonzero(wanted & (batch.candidates.robot_row == k))
                if len(rows):
                    found[rows] = self._of_robot(batch, k, rows)
        self._kept = dict([*self._kept.items()][-_MOST_KEPT:]) | {key: found}
        return found.copy()

    def _of_robot(self, batch: Batch[Array], k: int, rows: Array) -> F64:
        robot = _rows(batch.robots, np.array([k]))
        cloud = _rows(batch.clouds, robot.cloud_row)
        robot = replace(robot, cloud_row=np.zeros(1, np.int64))
        candidates = replace(_rows(batch.candidates, rows), robot_row=np.zeros(len(rows), np.int64))
        camera_rise_m = robot.camera_height_m - cloud.target_height_m

        padded = [_of_length(each) for each in (cloud.points_m, cloud.rgb, cloud.target_mask)]
        sizes = (cloud.target_height_m, robot.base_height_m, robot.arm_reach_m)
        of_cloud: dict[str, Array] = dict(
            zip(CLOUD, (*padded, cloud.n_points.astype(np.int64), *sizes), strict=True)
        )
        tokens: dict[str, Array] = dict(zip(TOKENS, self.program.run(ENCODE, of_cloud), strict=True))
        n_poses, hands = int(self.program.facts["hand_poses"]), hands_of(robot, 1)
        poses = poses_of_clouds(cloud.points_m, cloud.target_mask, cloud.n_points, n_poses, hands)
        reach_m = np.maximum(robot.arm_reach_m, _MIN_REACH_M)
        shared = tokens | {"camera_rise_m": camera_rise_m, "reach_m": reach_m, "poses": poses}
        rho = _visible_share(of_cloud, tokens, candidates, float(camera_rise_m[0]))
        codes = hand_reach(poses, cloud, robot, candidates, tokens["rise_m"])
        logits: list[F32] = []
        for start in range(0, len(rows), AT_ONCE):
            some = np.minimum(np.arange(start, start + AT_ONCE), len(rows) - 1)
            own = {"base_xy_m": candidates.base_xy_m[some], "rho": rho[some], "codes": codes[some]}
            logits += self.program.run(SCORE, shared | own)
        bad, good = np.concatenate(logits)[: len(rows)].astype(np.float64).T
        return 1 / (1 + np.exp(bad - good))


def _rows(table: T, rows: Array) -> T:
    columns = {name: value[rows] for name, value in vars(table).items() if isinstance(value, np.ndarray)}
    return replace(table, **columns)  # type: ignore[type-var]


def _of_length(a: Array) -> Array:
    """An array (1, P, ...) with `POINTS` rows."""
    return np.pad(a[:, :POINTS], [(0, 0), (0, max(0, POINTS - a.shape[1])), *[(0, 0)] * (a.ndim - 2)])


def _visible_share(
    cloud: dict[str, Array],
    tokens: dict[str, Array],
    candidates: CandidateInputs[Array],
    camera_rise_m: float,
) -> F32:
    """Estimated rho (N,), from the points within reach, rounded as the model's crop does."""
    points, mask = cloud["points_m"][0], cloud["mask"][0]
    inside = np.arange(len(points)) < cloud["count"][0]
    inside &= np.sqrt((points * points).sum(axis=1)) <= cloud["reach_m"][0]
    points, mask = points[inside], mask[inside]
    points[:, 2] = (points[:, 2] + tokens["rise_m"][0]) - tokens["rise_m"][0]
    eyes_m = np.column_stack([candidates.base_xy_m, np.full(len(candidates), camera_rise_m)])
    radius_m = float(tokens["radius_m"][0])
    return visible_share(points[~mask], points[mask], radius_m, eyes_m.astype(np.float32)).astype(np.float32)


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
        known: dict[str, Any] = {**constants, **inputs}
        for step, dropped in zip(self.steps, self._dropped, strict=True):
            options = {name: _filled(value, known) for name, value in step.options.items()}
            known[step.name] = OPERATIONS[step.op](*_filled(step.args, known), **options)
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
    if type(value) is str:
        return known[value[1:]] if value.startswith(MARK) else value
    return [_filled(each, known) for each in value] if type(value) in (list, tuple) else value


def _axes(axis: Any) -> Any:
    """None for no axes, as torch reduces over all then."""
    return (tuple(axis) if axis else None) if isinstance(axis, list) else axis


def _slice(x: Array, axis: int = 0, start: int | None = None, end: int | None = None, step: int = 1) -> Array:
    return x[(slice(None),) * (axis % x.ndim) + (slice(start, end, step),)]


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


def _real(function: Callable[..., Array]) -> Callable[..., Array]:
    """The function of two operands, of which integers take the other's type, as in torch."""

    def found(x: Any, y: Any) -> Array:
        if isinstance(x, np.ndarray) and isinstance(y, np.ndarray) and x.dtype != y.dtype:
            wide = x.dtype if x.dtype.kind == "f" else y.dtype
            x, y = x.astype(wide), y.astype(wide)
        return function(x, y)

    return found


OPERATIONS: dict[str, Callable[..., Any]] = {
    "_softmax": _softmax,
    "_to_copy": lambda x, dtype=None: x if dtype is None else x.astype(dtype),
    "abs": np.abs,
    "add": _real(operator.add),
    "addmm": lambda b, x, w: b + x @ w,
    "amax": _reduced(np.max),
    "amin": _reduced(np.min),
    "arange": lambda start, end, step=1, dtype="int64": np.arange(start, end, step).astype(dtype),
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
    "full_like": np.full_like,
    "gather": lambda x, axis, rows: np.take_along_axis(x, rows, axis),
    "getitem": operator.getitem,
    "gt": operator.gt,
    "hypot": np.hypot,
    "index": lambda x, rows: x[tuple(slice(None) if each is None else each for each in rows)],
    "index_select": lambda x, axis, rows: np.take(x, rows, axis),
    "le": operator.le,
    "linalg_vector_norm": _norm,
    "log1p": np.log1p,
    "lt": operator.lt,
    "mean": _reduced(np.mean),
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
