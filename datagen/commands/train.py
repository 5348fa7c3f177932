"""`datagen train`: train a model on labels, stage by stage."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_type_hints

from cyclopts import Parameter
from pydantic import TypeAdapter, ValidationError

from datagen.configuration.specify import parse_toml, read_toml
from datagen.console.command_lines import Interrupted, print_interrupted, prints
from datagen.console.options import AllowIncomplete, AsJson, File, PathOrAddress, PathsOrAddresses, Whole
from datagen.console.printing import print_json, print_rows, seconds
from datagen.released import checkpoint_file
from datagen.schemas.errors import InputError, choices

if TYPE_CHECKING:
    from datagen.train.augment import Augmentation
    from datagen.train.training.checkpoints import CheckpointHead, EpochRecord
    from datagen.train.training.training_setup import TrainingJob
else:
    CheckpointHead = Any  # the command line resolves it, without importing torch


_FIX = "Give a TOML file as in docs/guides/train.md"


def print_training(head: CheckpointHead | None, out: str | Path, json: bool, **_: Any) -> int:
    """Print the content of a checkpoint; `head` is None where training was interrupted before it had one."""
    finished = head is not None and head.finished
    best = head.history[head.best_epoch - 1] if head and head.best_epoch else None
    if json:
        print_json(
            {
                "out": str(out),
                "end": "finished" if finished else "interrupted",
                "digest": head.digest if head else None,
                "model": head.model if head else None,
                "epochs": head.epoch if head else 0,
                "steps": head.step if head else 0,
                "best": best,
                "history": head.history if head else (),
                "cost": head.cost if head else {},
            }
        )
    elif head is not None:
        print_rows(f"{'finished' if finished else 'interrupted'}: {out}", list(_rows(head, best)))
    if finished:
        return 0
    print_interrupted("; nothing is lost", sys.argv[1:])
    return 130


def _rows(head: CheckpointHead, best: EpochRecord | None) -> Iterator[tuple[str, str]]:
    yield "model", f"{head.model}, {head.stage}, sha256 {head.digest[:16]}"
    for name, runs in (("trained on", head.data), ("validated on", head.val_data)):
        for run in runs:
            labels = f"{run['n_samples']:,} {run['schema']} labels of {run['n_scenes']:,} scenes"
            specified = "+".join(spec_hash[:12] for spec_hash in run["spec_hashes"])
            yield name, f"{labels}, by {specified}, samples {run['samples_sha256'][:12]}"
    yield "trained", f"{head.epoch} epochs, {head.step:,} steps"
    if best is not None:
        balanced, auc = best["val_balanced_accuracy"], best["val_auc"]
        numbers = [f"loss {best['val_loss']:.4f}", f"accuracy {best['val_accuracy']:.4f}"]
        numbers += [f"balanced {balanced:.4f}"] if balanced is not None else []
        numbers += [f"AUC {auc:.4f}"] if auc is not None else []
        yield "validation", f"epoch {head.best_epoch}: {', '.join(numbers)}"
    wall_s, cpu_s = head.cost.get("train_wall_s", 0.0), head.cost.get("train_cpu_s", 0.0)
    waited = head.cost.get("data_wait_s", 0.0) / wall_s if wall_s > 0 else 0.0
    yield "time", f"{seconds(wall_s)}, {waited:.1%} of it waiting for data"
    yield "cost", f"{seconds(head.cost.get('label_cpu_s', 0.0))} of CPU for labels, {seconds(cpu_s)} to train"


@prints(print_training)
def train_model(
    stage: Annotated[Literal["stage1", "stage2", "sim-only"], Parameter(name="STAGE")],
    runs: Annotated[Sequence[str | Path], Parameter(name="RUN...")],
    /,
    *,
    out: File,
    val: PathsOrAddresses | None = None,
    init: File | None = None,
    model: Literal["paper", "shared", "n2m"] | None = None,
    model_config: Sequence[str] | None = None,
    epochs: Whole | None = None,
    batch_scenes: Whole = 16,
    house_share: float = 1.0,
    candidates_per_robot: Whole | None = None,
    lr: float | None = None,
    weight_decay: float | None = None,
    seed: Whole = 0,
    patience: Whole = 8,
    augment: str | None = None,
    encoded: PathOrAddress | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    processes: Whole | None = None,
    threads: Whole | None = None,
    tensorboard: PathOrAddress | None = None,
    allow_incomplete: AllowIncomplete = False,
    allow_mixed_labels: bool = False,
    json: AsJson = False,
) -> CheckpointHead:
    """Train a model; the checkpoint records the data, settings and history.

    stage1 trains on heuristic labels with class-weighted cross-entropy; stage2 continues from a checkpoint on
    sim or plan labels with cross-entropy and weight decay; sim-only is stage2 from scratch. Training stops
    when the loss on held-out houses no longer falls, and the best epoch's weights are used. After Ctrl-C, the
    same command resumes.

    For example: datagen train stage1 runs/first --out model.ckpt

    Args:
        stage: Heuristic labels, then sim labels, or sim labels alone.
        runs: Runs to train on; merged and sealed ones too.
        out: Checkpoint to write; the same command resumes it.
        val: Runs for validation [a tenth of the houses is held out].
        init: Checkpoint to continue from, of stage 1 or another training, or released (stage2).
        model: Architecture [shared, or that of --init].
        model_config: Sizes of the model: a TOML file, or field=value; repeat for more.
        epochs: Epochs [12 in stage1, else 20].
        batch_scenes: Scenes per step, over all processes.
        house_share: Share of the houses to train on, for learning curves.
        candidates_per_robot: Candidates sampled per robot per epoch [all].
        lr: Highest learning rate [0.002; 0.001 in stage2].
        weight_decay: Weight decay [0 in stage1, else 0.01].
        seed: Seed of weights, order and dropout.
        patience: Epochs without a lower validation loss before training stops.
        augment: noise, holes, dropout, colour, rotation, comma-separated; or a TOML file.
        encoded: Folder for encoded inputs of `shared`: written once, read by later trainings.
        device: Device of the model.
        processes: Training processes [one per GPU; one on CPUs].
        threads: Threads per process [cores / processes].
        tensorboard: Folder for TensorBoard logs.
        allow_incomplete: Accept runs that lack planned samples instead of failing.
        allow_mixed_labels: Accept labels of one source in different versions instead of failing.
        json: Report progress as JSON lines.

    Returns:
        The metadata of the checkpoint.

    Raises:
        InputError: An option or a run cannot be used.
        KeyboardInterrupt: Training was stopped; the same call continues it.

    Example:
        >>> head = datagen.train_model(
        ...     "stage1", [run], val=[other], out=folder / "model.ckpt", epochs=1, device="cpu"
        ... )
        >>> head.finished, head.epoch, len(head.history)
        (True, 1, 1)
    """
    if not runs:
        raise InputError("datagen train", "RUN", "is missing", "Name one or more run folders")
    each = share_cores(processes, threads)
    from datagen.train.training.checkpoints import read_checkpoint
    from datagen.train.training.launching import choose_device
    from datagen.train.training.options import STAGES, Options
    from datagen.train.training.training_setup import TrainingJob

    chosen = STAGES[stage]
    _refuse_odd_init(stage, init, chosen.from_checkpoint)
    start = None if init is None else checkpoint_file(str(init)) or str(init)
    began = read_checkpoint(start).head if start else None
    augmentation, effects = read_augmentation(augment)
    options = Options(
        stage=stage,
        model=model or (began.model if began else "shared"),
        model_config={**(began.model_config if began else {}), **model_sizes(model_config or ())},
        epochs=chosen.epochs if epochs is None else epochs,
        batch_scenes=batch_scenes,
        house_share=house_share,
        candidates_per_robot=candidates_per_robot,
        lr=chosen.lr if lr is None else lr,
        weight_decay=chosen.weight_decay if weight_decay is None else weight_decay,
        seed=seed,
        patience=patience,
        augment=effects,
    )
    options.refuse_bad()
    where, n_processes = choose_device(device, processes)
    job = TrainingJob(
        options,
        tuple(map(str, runs)),
        tuple(map(str, val or ())),
        str(out),
        augmentation,
        start,
        where,
        each,
        tensorboard=None if tensorboard is None else str(tensorboard),
        json_lines=json,
        allow_incomplete=allow_incomplete,
        allow_mixed_labels=allow_mixed_labels,
        encoded=None if encoded is None else str(encoded),
    )
    if not _train(job, n_processes):
        head = read_checkpoint(out).head if Path(out).exists() else None
        raise Interrupted(f"Training stopped; the same call on {out} continues it", head)
    return read_checkpoint(out).head


def _refuse_odd_init(stage: str, init: str | Path | None, needs_one: bool) -> None:
    if init is None and needs_one:
        problem = f"is missing: {stage} starts from a checkpoint"
        fix = "Give --init CKPT or --init released, or train sim-only"
        raise InputError("datagen train", "--init", problem, fix)
    if init is not None and not needs_one:
        problem = f"does not apply: {stage} starts from random weights"
        raise InputError("datagen train", "--init", problem, "Omit it, or train stage2")


def _train(job: TrainingJob, processes: int) -> bool:
    """Run the training; True when it finished, False when it was interrupted."""
    from datagen.train.training.launching import Ranks, interruptible, train_in_processes
    from datagen.train.training.training_setup import train_job

    with interruptible() as stopping:
        if processes == 1:
            return train_job(job, Ranks(), stopping)
        return train_in_processes(train_job, job, processes, job.device, stopping)


def model_sizes(words: Sequence[str]) -> dict[str, Any]:
    """Read fields from files and `field=value` words; later ones override. Values are TOML."""
    sizes: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            sizes |= read_toml(Path(word), _FIX)
            continue
        try:
            sizes[name.strip()] = parse_toml(f"value = {text}")["value"]
        except ValueError:
            sizes[name.strip()] = text
    return sizes


def read_augmentation(word: str | None) -> tuple[Augmentation | None, dict[str, Any]]:
    """Read `--augment`, names of effects or a TOML file; return it also as plain data."""
    if word is None:
        return None, {}
    from datagen.train.augment import Augmentation

    kinds = {name: get_args(kind)[0] for name, kind in get_type_hints(Augmentation).items()}
    sections: dict[str, Any] = {name.strip(): {} for name in word.split(",")}
    if word.endswith(".toml"):
        sections = read_toml(Path(word), _FIX)
    effects: dict[str, Any] = {}
    for name, values in sections.items():
        if name not in kinds:
            raise InputError("--augment", name, "is not an effect", choices(kinds, name))
        known = {f.name for f in fields(kinds[name])}
        if not isinstance(values, dict) or not values.keys() <= known:
            raise InputError("--augment", name, "is not a section of the file", choices(known, name))
        try:
            effects[name] = TypeAdapter(kinds[name]).validate_python(values)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, (name, *first["loc"])))
            raise InputError("--augment", where, first["msg"].lower(), _FIX) from None
    return Augmentation(**effects), {name: asdict(effect) for name, effect in effects.items()}


def share_cores(processes: int | None, threads: int | None) -> int:
    """Return the threads of each process: those given, or an equal share of the cores.

    Call it before torch is imported. The threads of a single process are bound to cores, since unbound ones
    may share a core for minutes; those of several processes are not, since each would start at the first
    core.
    """
    cores = len(os.sched_getaffinity(0))
    for option, value in (("--processes", processes), ("--threads", threads)):
        if value is not None and not 1 <= value <= 1024:
            raise InputError("datagen train", option, f"{value}", "Give 1 or more, or leave it out")
    each = threads or max(1, cores // (processes or 1))
    if (processes or 1) == 1 and each == cores > 1:
        os.environ.setdefault("OMP_PROC_BIND", "true")
        os.environ.setdefault("OMP_PLACES", "cores")
    elif processes is not None and processes > 1:
        os.environ.setdefault("OMP_NUM_THREADS", str(each))
    return each
