"""The trainings of a frontier: each is a file named by the digest of its inputs, made on one thread.

A file `<key>.npz` has the weights of the best epoch, the scores of the test candidates within reach, and a
record in JSON. A training has one thread: it gives the same bits for any number of processes.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import zipfile
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from datagen.frontier.mixtures import CHEAP, Mixture, options_of
from datagen.schemas.errors import InputError
from datagen.schemas.identity import digest_of
from datagen.schemas.whole_files import whole_file
from datagen.train.inputs import F32

if TYPE_CHECKING:
    from multiprocessing.synchronize import Event

    from datagen.train.encoded.runs import EncodedRuns

# Raise it when the same inputs and options would give another model.
_VERSION = 2
_BATCH_SCENES = 8
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class TrainingTask:
    """A mixture with a seed. `encodings`: folder of each source, of "val" and of "test", by name."""

    mixture: Mixture
    seed: int
    encodings: Mapping[str, str]
    out: str

    @property
    def key(self) -> str:
        """Digest of the inputs and options."""
        stages = [
            [stage.source, Path(self.encodings[stage.source]).name, stage.share]
            for stage in self.mixture.stages
        ]
        judged = [Path(self.encodings[name]).name for name in ("val", "test")]
        document = asdict(options_of(self.mixture, 1, self.seed, _BATCH_SCENES))
        return digest_of({"version": _VERSION, "stages": stages, "judged": judged, "options": document})

    @property
    def path(self) -> Path:
        """File of the result."""
        return Path(self.out, "trainings", f"{self.key}.npz")

    @property
    def before(self) -> TrainingTask | None:
        """The training that this one begins from."""
        before = self.mixture.before
        return TrainingTask(before, self.seed, self.encodings, self.out) if before else None


@dataclass(frozen=True, eq=False)
class TrainingResult:
    """The result of a training."""

    labels: Mapping[str, int]  # labels of each source behind the model, those of held-out houses too
    scores: F32  # (T,) of the test candidates within reach
    record: Mapping[str, Any]


def make_trainings(
    tasks: Sequence[TrainingTask],
    workers: int,
    stopping: Callable[[], bool],
    seen: Callable[[int, int], None],
) -> bool:
    """Make the missing results; return whether all exist, else it was stopped.

    A task begins when the one that it begins from is done; large ones go first. `seen(done, of)`.
    """
    left = {task.key: task for task in _with_those_before(tasks) if not task.path.exists()}
    of = len(left)
    if not left:
        return True
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    running: dict[Future[bool], str] = {}
    with _one_thread(), ProcessPoolExecutor(workers, context, _begin, (stop,)) as pool:
        try:
            while (left or running) and not stopping():
                for key, task in sorted(left.items(), key=_size):
                    if len(running) < workers and (task.before is None or task.before.path.exists()):
                        running[pool.submit(_make, left.pop(key))] = key
                for future in wait(running, timeout=0.2, return_when=FIRST_COMPLETED).done:
                    running.pop(future)
                    future.result()
                    seen(of - len(left) - len(running), of)
        except BrokenProcessPool:
            fix = "Run the same command to resume, with fewer --workers if memory was short"
            raise InputError(
                "datagen frontier", "--workers", "a process ended without a message", fix
            ) from None
        finally:
            stop.set()
    return not left and not running


def read_result(task: TrainingTask) -> TrainingResult:
    """The result of a task. InputError where its file is damaged."""
    arrays = _arrays(task.path)
    record = json.loads(arrays["record"].tobytes())
    return TrainingResult(record["labels"], arrays["scores"], record)


def _with_those_before(tasks: Sequence[TrainingTask]) -> list[TrainingTask]:
    found = list(tasks)
    for task in found:
        if task.before is not None:
            found.append(task.before)
    return found


def _size(item: tuple[str, TrainingTask]) -> tuple[int, float]:
    """Sort key: first tasks that others begin from, then the largest."""
    stages = item[1].mixture.stages
    return len(stages), -stages[-1].share


@contextmanager
def _one_thread() -> Generator[None]:
    """Limit child processes to one thread by variables that their libraries read when they load."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


_stop: Event | None = None


def _begin(stop: Event) -> None:
    """Set up a child process. It ignores Ctrl-C, which reaches the whole group; the parent handles it."""
    global _stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    _stop = stop
    import torch

    torch.set_num_threads(1)


def _stopping() -> bool:
    parent = multiprocessing.parent_process()
    return (_stop is not None and _stop.is_set()) or (parent is not None and not parent.is_alive())


def _make(task: TrainingTask) -> bool:
    """Train, score and write; False where it was stopped."""
    from datagen.train.encoded.batches import EncodedBatches, hold_out, subset_of_houses
    from datagen.train.encoded.training import scores_of, train_encoded

    last = task.mixture.stages[-1]
    data, judge, test = (_opened(task.encodings[name]) for name in (last.source, "val", "test"))
    scenes = subset_of_houses(data, last.share, task.seed)
    n_labels = EncodedBatches(data, scenes, _BATCH_SCENES).n_samples
    options = options_of(task.mixture, n_labels, task.seed, _BATCH_SCENES)
    judged = np.arange(len(judge.houses))
    if last.source == CHEAP:  # as `datagen train stage1` without --val: no dear label chooses the epoch
        judge = data
        scenes, judged = hold_out(data, scenes, task.seed)
    train = EncodedBatches(data, scenes, _BATCH_SCENES, task.seed)
    init, labels = None, {last.source: n_labels}
    if task.before is not None:
        arrays = _arrays(task.before.path)
        init = _weights(arrays)
        labels |= json.loads(arrays["record"].tobytes())["labels"]
    trained = train_encoded(options, train, EncodedBatches(judge, judged, _BATCH_SCENES), init, _stopping)
    if trained is None:
        return False
    record = {
        "labels": labels,
        "stages": [[stage.source, stage.share] for stage in task.mixture.stages],
        "seed": task.seed,
        "epochs": len(trained.history),
        "best_epoch": trained.best_epoch,
        "validation": trained.history[trained.best_epoch - 1],
        "cost": dict(trained.cost),
    }
    with whole_file(task.path) as file:
        np.savez(
            file,
            record=np.frombuffer(json.dumps(record).encode(), np.uint8),
            scores=scores_of(trained.model, test)[test.in_range],
            **{f"weights/{name}": t.numpy() for name, t in trained.model.state_dict().items()},
        )
    return True


def _weights(arrays: Mapping[str, Any]) -> dict[str, Any]:
    import torch

    names = [name for name in arrays if name.startswith("weights/")]
    return {name.removeprefix("weights/"): torch.from_numpy(arrays[name]) for name in names}


def _arrays(path: Path) -> dict[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        _ = json.loads(arrays["record"].tobytes())["labels"], arrays["scores"]
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile, EOFError) as e:
        raise InputError(path, "", f"is damaged ({e!s:.200})", "Remove this file; it is made again") from e
    return arrays


@cache
def _opened(folder: str) -> EncodedRuns:
    from datagen.train.encoded.runs import open_encoded

    return open_encoded(Path(folder))
