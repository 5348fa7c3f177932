"""`datagen train`: train a model on labels, stage by stage."""

from __future__ import annotations

import os
import sys
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from datagen.configuration.toml_files import read_toml
from datagen.console.command_lines import Interrupted, interruptible, options_of, print_interrupted, prints
from datagen.console.options import AllowIncomplete, AsJson, File, PathsOrAddresses, Whole
from datagen.console.printing import print_json, print_rows, seconds, summary_of_stored
from datagen.released import checkpoint_file
from datagen.schemas.errors import InputError

if TYPE_CHECKING:
    from datagen.train.training.checkpoints import CheckpointHead, EpochRecord
else:
    CheckpointHead = Any  # the command line resolves it, without importing torch


_FIX = "Give a TOML file as in docs/guides/train.md"


def print_training(head: CheckpointHead | None, out: str | Path, json: bool, **_: Any) -> int:
    """Print the content of a checkpoint; `head` is None where training was interrupted before it had one."""
    finished = head is not None and head.finished
    best = head.history[head.best_epoch - 1] if head and head.best_epoch else None
    with summary_of_stored():
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
    is_known = all(run["cost"] is not None for run in head.data)  # not of a sealed store without its run
    labels = f"{seconds(head.cost.get('label_cpu_s', 0.0))} of CPU" if is_known else "unknown"
    yield "cost", f"{labels} for labels, {seconds(cpu_s)} of CPU to train"


@dataclass(frozen=True)
class TrainOptions:
    """Options of `train_model`.

    Args:
        stage: Heuristic labels, then sim labels, or sim labels alone.
        runs: Runs to train on; merged and sealed ones too.
        out: Checkpoint to write; the same command resumes it.
        val: Runs for validation. [default: a tenth of the houses is held out]
        init: Checkpoint to continue from, of stage 1 or another training, or released (stage2).
        model: shared, paper, n2m or module:attribute. [default: shared, or that of --init]
        model_config: Sizes of the model: a TOML file, or field=value; repeat for more.
        epochs: Epochs. [default: 12 in stage1, else 20]
        house_share: Share of the houses to train on, for learning curves.
        lr: Highest learning rate. [default: 0.002; 0.001 in stage2]
        seed: Seed of weights, order and dropout.
        encoded: Folder for encoded inputs of `shared`: written once, read by later trainings.
        device: Device of the model.
        threads: Threads. [default: all cores]
        allow_incomplete: Accept runs that lack planned samples instead of failing.
    """

    stage: Annotated[Literal["stage1", "stage2", "sim-only"], Parameter(name="STAGE")]
    runs: Annotated[Sequence[str | Path], Parameter(name="RUN...")]
    _: KW_ONLY
    out: File
    val: PathsOrAddresses | None = None
    init: File | None = None
    model: str | None = None
    model_config: Sequence[str] | None = None
    epochs: Whole | None = None
    house_share: float = 1.0
    lr: float | None = None
    seed: Whole = 0
    encoded: File | None = None
    device: Literal["auto", "cpu", "cuda"] = "auto"
    threads: Whole | None = None
    allow_incomplete: AllowIncomplete = False
    json: AsJson = False

    def __post_init__(self) -> None:
        """Raise InputError for options that do not fit."""
        if not self.runs:
            raise InputError("datagen train", "RUN", "is missing", "Name one or more run folders")
        for name in ("out", "encoded"):
            if "://" in str(getattr(self, name) or ""):
                fix = "Name a place on this machine, and copy it afterwards"
                raise InputError(f"--{name}", str(getattr(self, name)), "is an address", fix)
        if self.threads is not None and not 1 <= self.threads <= 1024:
            fix = "Give 1 or more, or leave it out"
            raise InputError("datagen train", "--threads", f"{self.threads}", fix)
        if self.stage == "stage2" and self.init is None:
            problem = "is missing: stage2 starts from a checkpoint"
            fix = "Give --init CKPT or --init released, or train sim-only"
            raise InputError("datagen train", "--init", problem, fix)
        if self.stage != "stage2" and self.init is not None:
            problem = f"does not apply: {self.stage} starts from random weights"
            raise InputError("datagen train", "--init", problem, "Omit it, or train stage2")


@prints(print_training)
@options_of(TrainOptions)
def train_model(given: TrainOptions) -> CheckpointHead:
    """Train a model; the checkpoint records the data, settings and history.

    stage1 trains on heuristic labels with class-weighted cross-entropy; stage2 continues from a checkpoint on
    sim or plan labels with cross-entropy and weight decay; sim-only is stage2 from scratch. Training stops
    when the loss on held-out houses no longer falls, and the best epoch's weights are used. After Ctrl-C, the
    same command resumes.

    For example: datagen train stage1 runs/first --out model.ckpt

    Returns:
        The metadata of the checkpoint.

    Raises:
        InputError: An option or a run cannot be used.
        KeyboardInterrupt: Training was stopped; the same call continues it.

    Examples:
        >>> head = datagen.train_model(
        ...     "stage1", [run], val=[other], out=folder / "model.ckpt", epochs=1, device="cpu"
        ... )
        >>> head.finished, head.epoch, len(head.history)
        (True, 1, 1)
    """
    threads = given.threads or _all_cores()
    # Imported here: torch takes seconds to import, and reads the variables that were set above.
    from datagen.train.training.checkpoints import read_checkpoint
    from datagen.train.training.options import STAGES, Options
    from datagen.train.training.training_setup import TrainingJob, choose_device, train_job

    stage = STAGES[given.stage]
    start = None if given.init is None else checkpoint_file(str(given.init)) or str(given.init)
    began = read_checkpoint(start).head if start else None
    options = Options(
        stage=given.stage,
        model=given.model or (began.model if began else "shared"),
        model_config={**(began.model_config if began else {}), **model_sizes(given.model_config or ())},
        epochs=stage.epochs if given.epochs is None else given.epochs,
        house_share=given.house_share,
        lr=stage.lr if given.lr is None else given.lr,
        weight_decay=stage.weight_decay,
        seed=given.seed,
    )
    job = TrainingJob(
        options,
        tuple(map(str, given.runs)),
        tuple(map(str, given.val or ())),
        str(given.out),
        init=start,
        device=choose_device(given.device),
        threads=threads,
        json_lines=given.json,
        allow_incomplete=given.allow_incomplete,
        encoded=None if given.encoded is None else str(given.encoded),
    )
    with interruptible() as stopping:
        finished = train_job(job, stopping)
    head = read_checkpoint(given.out).head if Path(given.out).exists() else None
    if head is None or not finished:
        raise Interrupted(f"Training stopped; the same call on {given.out} continues it", head)
    return head


def model_sizes(words: Sequence[str]) -> dict[str, Any]:
    """Read fields from files and `field=value` words; later ones override. Values are TOML."""
    sizes: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            sizes |= read_toml(Path(word), _FIX)
            continue
        try:
            sizes[name.strip()] = tomllib.loads(f"value = {text}")["value"]
        except (ValueError, RecursionError):
            sizes[name.strip()] = text
    return sizes


def _all_cores() -> int:
    """Return the number of cores, and bind torch's threads to them, since unbound ones may share a core.

    Call it before torch is imported.
    """
    cores = len(os.sched_getaffinity(0))
    if cores > 1:
        os.environ.setdefault("OMP_PROC_BIND", "true")
        os.environ.setdefault("OMP_PLACES", "cores")
    return cores
