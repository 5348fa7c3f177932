"""The training loop: batches, steps, validation, early stopping, and a position to resume from.

No random state is saved: batches follow from seed and epoch, and the random numbers of a step (dropout)
from seed, epoch and batch.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NoReturn, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.utils import deterministic

from datagen.display.progress import Pace, Progress, clock_text, whole
from datagen.schemas.errors import InputError
from datagen.train.inputs import Array, Batch
from datagen.train.models import Model
from datagen.train.rates import label_losses
from datagen.train.tensors import to_torch
from datagen.train.training.checkpoints import EpochRecord
from datagen.train.training.options import Options
from datagen.train.training.validation import validate

_STEP_STREAM = 0x57E9  # separates the random numbers of steps from those of batches
_IDS_NAMED = 4


class Batches(Protocol):
    """The part of a `SampleStream` that the loop uses."""

    @property
    def batches_per_epoch(self) -> int: ...

    def epoch(self, k: int, skip_batches: int = 0) -> Iterator[Batch[Array]]: ...


@dataclass
class Position:
    """Status of a training, and its results so far."""

    epoch: int = 0  # completed
    batch: int = 0  # completed in the current epoch
    step: int = 0
    sums: list[float] = field(default_factory=lambda: [0.0] * 4)  # the epoch's weight, loss, hits, samples
    history: list[EpochRecord] = field(default_factory=list)
    best_epoch: int | None = None  # with the lowest validation loss, counted from 1
    best_weights: dict[str, Tensor] = field(default_factory=dict)
    finished: bool = False
    cost: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Training:
    """The parts of a training; `position`, the model and the optimiser change."""

    options: Options
    model: Model
    optimiser: torch.optim.Optimizer
    train: Batches
    val: Batches
    class_weights: Tensor  # (2,) float32, on the model's device
    position: Position


def run_training(
    training: Training,
    save: Callable[[], None],
    callbacks: Sequence[TrainingProgress] = (),
    stopping: Callable[[], bool] = lambda: False,
    save_every_s: float = 300.0,
) -> bool:
    """Train from the position on; True if it finished, False if it was stopped and saved.

    `save` is called after each epoch, every `save_every_s` and on a stop. InputError at a loss or gradient
    that is not finite, before it reaches the weights.
    """
    at, clock = training.position, _Clock()
    training.model.train()
    kept_s = time.monotonic()
    with _repeatable(training.model.device):
        while not at.finished:
            wait_began_s = time.perf_counter()
            for batch in training.train.epoch(at.epoch, at.batch):
                clock.wait_s += time.perf_counter() - wait_began_s
                stop = stopping()
                step = _step(training, batch, clock)
                for callback in callbacks:
                    callback.step(step)
                if stop or time.monotonic() - kept_s >= save_every_s:
                    save()
                    kept_s = time.monotonic()
                if stop:
                    return False
                wait_began_s = time.perf_counter()
            record = _end_epoch(training, clock)
            for callback in callbacks:
                callback.epoch(record)
            save()
    return True


@contextmanager
def _repeatable(device: torch.device) -> Generator[None]:
    """Let operations on a CPU give the same bits each time; the process is then as it was before.

    By default threads add the gradients of rows that `x[rows]` repeats in the order in which they come.
    Operations that cannot repeat warn instead of failing: a model of the user may have them. New memory is
    not filled, as torch then does by default, which costs a tenth of the time.
    """
    memory: Any = deterministic  # has this attribute, which its types lack
    before, filled = torch.get_deterministic_debug_mode(), memory.fill_uninitialized_memory
    if device.type == "cpu":
        torch.set_deterministic_debug_mode(max(before, 1))
        memory.fill_uninitialized_memory = False
    try:
        yield
    finally:
        torch.set_deterministic_debug_mode(before)
        memory.fill_uninitialized_memory = filled


def _step(training: Training, batch: Batch[Array], clock: _Clock) -> TrainingStep:
    """Take a step on a batch. InputError at a loss or gradient that is not finite."""
    options, at, device = training.options, training.position, training.model.device
    seed = np.random.SeedSequence([_STEP_STREAM, options.seed, at.epoch, at.batch, 0])
    torch.manual_seed(int(seed.generate_state(1, np.uint64)[0]))
    given = to_torch(batch, device)
    with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
        logits = training.model(given.clouds, given.candidates, given.robots)
    losses = label_losses(logits.float(), given)
    weights = training.class_weights[given.label]
    loss = (weights * losses).sum()
    hits = (logits.argmax(dim=1) == given.label).sum()
    sums = [float(weights.sum()), loss.item(), float(hits), float(len(batch))]
    wall_s, cpu_s, wait_s = clock.lap()
    if not math.isfinite(sums[1]):
        _refuse("loss", at, batch, ~torch.isfinite(losses))
    (loss * (1 / sums[0])).backward()
    norm = torch.nn.utils.clip_grad_norm_(training.model.parameters(), options.clip_norm)
    if not math.isfinite(float(norm)):
        _refuse("gradient", at, batch, torch.ones_like(losses, dtype=torch.bool))
    steps = options.epochs * training.train.batches_per_epoch
    rate = rate_at(at.step, steps, options.lr, options.warmup)
    set_rate(training.optimiser, rate)
    training.optimiser.step()
    training.optimiser.zero_grad(set_to_none=True)
    at.batch, at.step = at.batch + 1, at.step + 1
    at.sums = [a + b for a, b in zip(at.sums, sums, strict=True)]
    _add_cost(at, wall_s, cpu_s, wait_s)
    return TrainingStep(at.step, steps, at.epoch + 1, sums[1] / sums[0], len(batch), wait_s, wall_s)


def _end_epoch(training: Training, clock: _Clock) -> dict[str, Any]:
    """Validate, keep the best weights, and decide whether to continue. Returns the row for callbacks."""
    at, options = training.position, training.options
    measured = validate(training.model, training.val.epoch(0), training.class_weights)
    weight, loss, hits, samples = at.sums
    record: EpochRecord = {
        "epoch": at.epoch + 1,
        "step": at.step,
        "loss": loss / weight,
        "accuracy": hits / samples,
        **measured,
    }
    best = at.best_epoch is None or measured["val_loss"] < at.history[at.best_epoch - 1]["val_loss"]
    at.history.append(record)
    at.epoch, at.batch, at.sums = at.epoch + 1, 0, [0.0] * 4
    if best:
        at.best_epoch = at.epoch
        at.best_weights = training.model.tempered(measured.get("val_temperature", 1.0))
    worse_for = at.epoch - (at.best_epoch or 0)
    at.finished = at.epoch >= options.epochs or worse_for >= options.patience
    wall_s, cpu_s, _ = clock.lap()
    _add_cost(at, wall_s, cpu_s, 0.0)
    return {**record, "best": best}


def _refuse(quantity: str, at: Position, batch: Batch[Array], bad: Tensor) -> NoReturn:
    ids = [bytes(i).hex() for i in batch.sample_id[bad.cpu().numpy()]]
    named = ", ".join(ids[:_IDS_NAMED]) + (", ..." if len(ids) > _IDS_NAMED else "")
    raise InputError(
        f"training, epoch {at.epoch + 1}, batch {at.batch + 1}",
        quantity,
        f"is not finite for {len(ids)} samples: {named}",
        "Nothing was overwritten. Check them with `datagen verify`, or give a smaller --lr and a new --out",
    )


def _add_cost(at: Position, wall_s: float, cpu_s: float, wait_s: float) -> None:
    for name, value in (("train_wall_s", wall_s), ("train_cpu_s", cpu_s), ("data_wait_s", wait_s)):
        at.cost[name] = at.cost.get(name, 0.0) + value


class _Clock:
    """Wall and CPU seconds of this process since the last lap, and how many it waited for batches."""

    def __init__(self) -> None:
        self._wall_s, self._cpu_s, self.wait_s = time.perf_counter(), time.process_time(), 0.0

    def lap(self) -> tuple[float, float, float]:
        """Wall, CPU and waiting seconds since the last lap."""
        wall_s, cpu_s, wait_s = self._wall_s, self._cpu_s, self.wait_s
        self._wall_s, self._cpu_s, self.wait_s = time.perf_counter(), time.process_time(), 0.0
        return self._wall_s - wall_s, self._cpu_s - cpu_s, wait_s


def make_optimiser(model: Model, lr: float, weight_decay: float) -> torch.optim.AdamW:
    """AdamW; weight decay acts on matrices alone, not on biases and norms."""
    matrices = [p for p in model.parameters() if p.ndim > 1]
    others = [p for p in model.parameters() if p.ndim <= 1]
    groups = [{"params": matrices, "weight_decay": weight_decay}, {"params": others, "weight_decay": 0.0}]
    return torch.optim.AdamW([group for group in groups if group["params"]], lr=lr)


def set_rate(optimiser: torch.optim.Optimizer, lr: float) -> None:
    """Set the learning rate of the next step."""
    for group in optimiser.param_groups:
        group["lr"] = lr


def rate_at(step: int, steps: int, highest: float, warmup: float) -> float:
    """Rate of step 0 .. steps - 1: up on a line over the share `warmup`, then a cosine down to 1%."""
    rising = max(1, round(warmup * steps))
    if step < rising:
        return highest * ((step + 1) / rising)
    along = (step - rising) / max(1, steps - rising)
    return highest * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * along)))


def optimiser_tensors(optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Its moments and counts as `<parameter>.<name>`; rates and groups follow from the options."""
    state = optimiser.state_dict()["state"]
    return {f"{k}.{name}": value for k, values in state.items() for name, value in values.items()}


def put_optimiser_tensors(
    optimiser: torch.optim.Optimizer, tensors: Mapping[str, Tensor], place: str
) -> None:
    """Restore tensors of `optimiser_tensors`. InputError where they do not fit the parameters."""
    document = optimiser.state_dict()
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        index, _, what = name.partition(".")
        known = index.isdecimal() and int(index) < len(parameters)
        wanted = {"step": (), "exp_avg": None, "exp_avg_sq": None}
        shape = tuple(parameters[int(index)].shape) if known else ()
        if not known or what not in wanted or tuple(tensor.shape) != (() if what == "step" else shape):
            raise InputError(
                place, name, "does not fit the model's optimiser", "Train it again to another file"
            )
        state.setdefault(int(index), {})[what] = tensor
    if state and (len(state) != len(parameters) or any(len(values) != 3 for values in state.values())):
        raise InputError(place, "optimiser", "incomplete", "Train it again to another file")
    optimiser.load_state_dict({**document, "state": state})


@dataclass(frozen=True)
class TrainingStep:
    """One step of the optimiser."""

    step: int  # counted from 1
    steps: int  # in the whole schedule
    epoch: int  # counted from 1
    loss: float
    samples: int
    wait_s: float  # for the batch
    step_s: float  # for the whole step


class TrainingProgress:
    """Progress of the training to `place`: loss, speed, time left, the loader's share; a row per epoch."""

    def __init__(self, shown: Progress, place: str) -> None:
        self._shown, self._place = shown, place
        self._spent_s = self._samples = self._waited_s = self._steps = 0.0
        self._pace = Pace(lambda: self._spent_s)
        self._stepped_s = self._validation_s = 0.0
        self._epochs = self._epoch_steps = 0.0  # done, and the steps of each

    def step(self, step: TrainingStep) -> None:
        """Called after each step."""
        self._stepped_s = self._shown.clock()
        self._spent_s, self._steps = self._spent_s + step.step_s, self._steps + 1
        self._samples, self._waited_s = self._samples + step.samples, self._waited_s + step.wait_s
        self._pace.see(self._samples, self._waited_s, self._steps)
        self._shown.update("steps", step.step, step.steps, lambda: self._figures(step))

    def epoch(self, record: dict[str, Any]) -> None:
        """Called after each epoch with its row of the history, and whether it is the `best`."""
        self._validation_s = self._shown.clock() - self._stepped_s
        self._epochs, self._epoch_steps = record["epoch"], record["step"] / record["epoch"]
        numbers = "".join(
            f"  {name} {record[field]:.4f}"
            for name, field in (("balanced", "val_balanced_accuracy"), ("AUC", "val_auc"))
            if record[field] is not None
        )
        text = (
            f"epoch {record['epoch']:3d}  loss {record['loss']:.4f}  validation {record['val_loss']:.4f}  "
            f"accuracy {record['val_accuracy']:.4f}{numbers}{'  best' if record['best'] else ''}"
        )
        self._shown.say("epoch", {"out": self._place, **record, **self._speed(4)}, text)

    def _speed(self, rate_digits: int) -> dict[str, float]:
        samples_per_s = round(self._pace.per_s(0), rate_digits)
        return {"samples_per_s": samples_per_s, "loader_share": round(self._pace.per_s(1), 4)}

    def _figures(self, step: TrainingStep) -> tuple[str, dict[str, object]]:
        speed, left_s = self._speed(1), self._pace.left_s(step.steps - step.step, 2)
        if left_s is not None and self._epoch_steps:  # each epoch left ends with a validation
            left_s += (step.steps / self._epoch_steps - self._epochs) * self._validation_s
        text = (
            f"loss {step.loss:.4f}  {speed['samples_per_s']:,.0f} samples/s  "
            f"{clock_text(left_s)} left  data {speed['loader_share']:.0%}"
        )
        values = {"epoch": step.epoch, "step": step.step, "steps": step.steps, "loss": round(step.loss, 5)}
        return text, {"out": self._place, **values, **speed, "left_s": whole(left_s)}
