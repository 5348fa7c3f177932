"""Set up the training of a stage: streams, checks, model, and the position from which it resumes."""

from __future__ import annotations

import platform
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from datagen.display.progress import Progress, Seen
from datagen.schemas.errors import InputError
from datagen.train.dataset import SampleStream
from datagen.train.encoded_runs import EncodedBatches, encode_runs, encoded_stream
from datagen.train.headings import knows_headings, refuse_mixed_headings
from datagen.train.models import Model, build_model
from datagen.train.models.shared import SharedModel, with_reach
from datagen.train.rates import rate_fields
from datagen.train.run_parts import JOIN_FIELDS, open_parts, read_robots, refuse_mixed_labels
from datagen.train.splits import HouseShare, refuse_one_class, refuse_shared_houses, split_by_house
from datagen.train.training.checkpoints import (
    Checkpoint,
    CheckpointHead,
    below,
    only_writer,
    put_weights,
    read_checkpoint,
    write_checkpoint,
)
from datagen.train.training.loop import (
    Position,
    Training,
    TrainingProgress,
    make_optimiser,
    optimiser_tensors,
    put_optimiser_tensors,
    run_training,
)
from datagen.train.training.options import STAGES, Options

_POSITION = ("step", "epoch", "best_epoch", "finished")  # fields of both Position and CheckpointHead


@dataclass(frozen=True)
class TrainingJob:
    """A requested training. Only `options`, the runs' rows and `init` decide its weights."""

    options: Options
    runs: tuple[str, ...]
    val_runs: tuple[str, ...]  # empty: a share of the runs' houses is held out
    out: str
    init: str | None = None
    device: str = "cpu"
    threads: int = 1
    save_every_s: float = 300.0
    json_lines: bool = False  # for progress
    allow_incomplete: bool = False  # runs that lack samples of their plan
    encoded: str | None = None  # folder of `encode_runs`, which encodes clouds once


def choose_device(device: str) -> str:
    """`cpu`, or `cuda` where it is asked for or torch finds a GPU. InputError without one."""
    has_gpu = device != "cpu" and torch.cuda.is_available()
    if device == "cuda" and not has_gpu:
        raise InputError("datagen train", "--device", "torch finds no GPU", "Give --device cpu")
    return "cuda" if has_gpu else "cpu"


def train_job(job: TrainingJob, stopping: Callable[[], bool]) -> bool:
    """Train from the position of `job.out`. Whether it finished."""
    torch.set_num_threads(job.threads)
    with only_writer(job.out), Progress(job.json_lines) as shown:
        shown.phase("opening runs")
        training, head = prepare_training(job, shown.counter("scenes encoded"))
        callbacks = [TrainingProgress(shown, job.out)]
        return run_training(
            training, lambda: save_checkpoint(job.out, training, head), callbacks, stopping, job.save_every_s
        )


def prepare_training(job: TrainingJob, seen: Seen | None = None) -> tuple[Training, CheckpointHead]:
    """The training at the position of `job.out`, or at its beginning, and the head of its checkpoint.

    `seen(done, of)` is called while scenes are encoded.
    """
    options, stage = job.options, STAGES[job.options.stage]
    began = read_checkpoint(job.init) if job.init is not None else None
    train, val = _streams(job)
    refuse_one_class(train)
    if began is not None:
        known = sorted(val.house_ids() & set(began.head.house_ids))
        if known:
            problem = f"{known[0]!r} is in the training data of --init ({len(known)} such houses)"
            fix = "Name runs of other houses with --val, as `submit --split val` makes them"
            raise InputError(job.init or "", "house_id", problem, fix)
    class_weights = _class_weights(train, stage.weighted)
    model = _model(job, began)
    batches = (train, val) if job.encoded is None else _encoded(job, model, (train, val), seen)
    optimiser = make_optimiser(model, options.lr, options.weight_decay)
    head = _head(job, model, train, val, began.head if began else None)
    position = Position()
    if Path(job.out).exists():
        stored = read_checkpoint(job.out)
        refuse_other_training(job.out, stored.head, head)
        position = _resume_position(job.out, stored, model, optimiser)
    weights = class_weights.to(model.device)
    return Training(options, model, optimiser, *batches, weights, position), head


def save_checkpoint(path: str, training: Training, head: CheckpointHead) -> None:
    """Write the checkpoint of a training at its position."""
    at, last = training.position, training.model.state_dict()
    resume = {f"model.{k}": v for k, v in last.items()}
    resume |= {f"optimiser.{k}": v for k, v in optimiser_tensors(training.optimiser).items()}
    head = replace(
        head,
        cost={**head.cost, **at.cost},
        history=tuple(at.history),
        **{name: getattr(at, name) for name in _POSITION},
    )
    # Before the first epoch ends, the last weights are the best.
    weights = at.best_weights or last
    write_checkpoint(path, Checkpoint(head, weights, resume, {"batch": at.batch, "sums": at.sums}))


def _resume_position(
    place: str, stored: Checkpoint, model: Model, optimiser: torch.optim.Optimizer
) -> Position:
    resume = stored.resume
    put_weights(model, below("model.", resume), place)
    put_optimiser_tensors(optimiser, below("optimiser.", resume), place)
    batch, sums = stored.loop.get("batch"), stored.loop.get("sums")
    best = stored.head.best_epoch
    if type(batch) is not int or batch < 0 or not isinstance(sums, list) or len(sums) != 4:
        raise InputError(place, "loop", "has no position to resume from", "Train it again to another file")
    if best is not None and not 1 <= best <= len(stored.head.history):
        raise InputError(place, "best_epoch", "is beyond the history", "Train it again to another file")
    return Position(
        **{name: getattr(stored.head, name) for name in _POSITION},
        batch=batch,
        sums=[float(value) for value in sums],
        history=list(stored.head.history),
        best_weights={k: v.to(model.device) for k, v in stored.weights.items()} if best else {},
        cost={k: v for k, v in stored.head.cost.items() if k != "label_cpu_s"},
    )


def _streams(job: TrainingJob) -> tuple[SampleStream, SampleStream]:
    options = job.options
    common: dict[str, Any] = {
        "scenes_per_batch": options.batch_scenes,
        "seed": options.seed,
        "allow_incomplete": job.allow_incomplete,
        "extra": _rate_fields(job, job.runs),
    }
    if job.val_runs:
        share = HouseShare(options.house_share)
        train = SampleStream(job.runs, **common, houses=share)
        common["extra"] = _rate_fields(job, job.val_runs)
        val = SampleStream(job.val_runs, **common, shuffle=False)
    else:
        train, val = split_by_house(job.runs, options.house_share, **common)
    for stream in (train, val):
        _refuse_other_labels(options.stage, stream)
    parts = [summary.part for stream in (train, val) for summary in stream.parts]
    named = [(part.place, spec) for part in parts for spec in part.specs]
    refuse_mixed_labels(named)
    if knows_headings(options.model, options.model_config):
        read_robots(parts)
    else:
        refuse_mixed_headings(named)
    refuse_shared_houses(train, val)
    return train, val


def _encoded(
    job: TrainingJob, model: Model, streams: tuple[SampleStream, SampleStream], seen: Seen | None
) -> tuple[EncodedBatches, EncodedBatches]:
    """Batches of the streams' scenes from clouds that are encoded once. InputError if options exclude it."""
    options, folder = job.options, Path(job.encoded or "")
    sides = job.runs, job.val_runs or job.runs
    excluded = {
        f"--model {model.name}": not isinstance(model, SharedModel),
        "runs of --perturb or --draws": any(_rate_fields(job, runs) for runs in sides),
    }
    for name, is_given in excluded.items():
        if is_given:
            problem = f"does not go with {name}: candidates of `shared` are encoded once, with one label each"
            raise InputError("datagen train", "--encoded", problem, "Omit one of them")
    assert isinstance(model, SharedModel)
    made: list[EncodedBatches] = []
    for stream, runs, seed in zip(streams, sides, (options.seed, None), strict=True):
        clouds = encoded_stream(runs, job.allow_incomplete)
        encoded = encode_runs(clouds, model, folder, seen or (lambda done, of: None))
        scenes = np.flatnonzero(np.isin(encoded.houses, sorted(stream.house_ids())))
        made.append(EncodedBatches(encoded, scenes, options.batch_scenes, seed))
    return made[0], made[1]


def _rate_fields(job: TrainingJob, runs: tuple[str, ...]) -> tuple[str, ...]:
    return rate_fields(open_parts(runs, JOIN_FIELDS, job.allow_incomplete))


def _refuse_other_labels(stage: str, stream: SampleStream) -> None:
    wanted = STAGES[stage].label_sources
    for summary in stream.parts:
        source = summary.part.schema
        if source not in wanted:
            fitting = " or ".join(name for name, other in STAGES.items() if source in other.label_sources)
            problem = f"is {source}, but {stage} trains on {' or '.join(wanted)} labels"
            raise InputError(summary.part.place, "label_source", problem, f"Use it for {fitting}")


def _class_weights(train: SampleStream, weighted: bool) -> Tensor:
    """Weights (2,) float32 that balance the classes, with 1 as the mean over samples; or ones."""
    counts = np.array(train.class_counts(), np.float64)
    weights = counts.sum() / (2 * counts) if weighted else np.ones(2)
    return torch.from_numpy(weights.astype(np.float32))


def _model(job: TrainingJob, began: Checkpoint | None) -> Model:
    """The model with parameters of the checkpoint to begin from, or with random ones from the seed."""
    options = job.options
    torch.manual_seed(options.seed)
    model = build_model(options.model, options.model_config)
    if began is not None:
        other, weights = began.head, began.weights
        if other.model == options.model and model.config == {**other.model_config, "kinematics": True}:
            weights = with_reach(weights)
        elif (other.model, other.model_config) != (options.model, model.config):
            problem = f"is {other.model} {other.model_config}, not {options.model} {model.config}"
            fix = "Omit --model and --model-config; kinematics=true may be added"
            raise InputError(str(job.init), "model", problem, fix)
        put_weights(model, weights, str(job.init))
    return model.to(job.device)


def _head(
    job: TrainingJob, model: Model, train: SampleStream, val: SampleStream, began: CheckpointHead | None
) -> CheckpointHead:
    data = tuple(train.origin())
    # These include the houses of --init, and those that chose its best epoch: the weights depend on both.
    house_ids = train.house_ids().union(began.house_ids if began else ())
    object_digests = train.object_digests().union(began.object_digests if began else ())
    val_house_ids = val.house_ids().union(began.val_house_ids if began else ()) - house_ids
    return CheckpointHead(
        model=job.options.model,
        model_config=model.config,
        stage=job.options.stage,
        options=job.options.document(),
        data=data,
        val_data=tuple(val.origin()),
        house_ids=tuple(sorted(house_ids)),
        object_digests=tuple(sorted(object_digests)),
        val_house_ids=tuple(sorted(val_house_ids)),
        cost={"label_cpu_s": sum(float((origin.get("cost") or {}).get("cpu_s", 0.0)) for origin in data)},
        versions={"python": platform.python_version(), "torch": torch.__version__, "numpy": np.__version__},
        history=(),
        init={"digest": began.digest, "stage": began.stage, "cost": began.cost} if began else None,
    )


def refuse_other_training(place: str, stored: CheckpointHead, requested: CheckpointHead) -> None:
    """Raise InputError with the fields in which a checkpoint differs from these options."""
    theirs, ours = _decisive(stored), _decisive(requested)
    names = [name for name in {**ours, **theirs} if ours.get(name) != theirs.get(name)]
    if names:
        shown = [f"{name} ({theirs.get(name)!s:.60}, now {ours.get(name)!s:.60})" for name in names[:4]]
        more = f" and {len(names) - 4} more" if len(names) > 4 else ""
        problem = f"holds another training: {', '.join(shown)}{more} differ"
        raise InputError(
            place, names[0], problem, "Give the options that it was started with, or another --out"
        )


def _decisive(head: CheckpointHead) -> dict[str, str]:
    fields = {"stage": head.stage, "model": head.model}
    fields |= {f"model_config.{k}": v for k, v in head.model_config.items()}
    fields |= dict(head.options)
    fields |= {
        "data": [run["samples_sha256"] for run in head.data],
        "val_data": [r["samples_sha256"] for r in head.val_data],
    }
    fields |= {"init": head.init["digest"] if head.init else None}
    return {name: str(value) for name, value in fields.items()}
