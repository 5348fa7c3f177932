"""Choose the device, start training processes, and let them finish their step after Ctrl-C."""

from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from pathlib import Path
from threading import current_thread, main_thread
from types import FrameType
from typing import Any

import torch
import torch.distributed as dist

from datagen.schemas.errors import InputError
from datagen.schemas.locked_folders import locked_folder
from datagen.train.training.ranks import Ranks

Stopping = Callable[[], bool]
# The function of each process, importable by name; True when it finished.
ProcessWork = Callable[[Any, Ranks, Stopping], bool]
_PREFIX = "datagen-ranks-"


def choose_device(asked: str, processes: int | None) -> tuple[str, int]:
    """`cpu` or `cuda`, and the number of processes: as given, else one per GPU, or one.

    InputError where there are fewer GPUs than that.
    """
    gpus = torch.cuda.device_count() if asked != "cpu" and torch.cuda.is_available() else 0
    if asked == "cuda" and not gpus:
        raise InputError("datagen train", "--device", "torch finds no GPU", "Give --device cpu")
    if gpus and processes is not None and processes > gpus:
        problem = f"{processes} is more than {gpus} GPUs"
        raise InputError("datagen train", "--processes", problem, f"Give at most {gpus}, or --device cpu")
    return ("cuda" if gpus else "cpu"), processes or max(1, gpus)


@contextmanager
def interruptible() -> Generator[Stopping]:
    """Give a function that returns whether Ctrl-C (or SIGTERM) came. A second one ends the block at once."""
    came = False

    def note(_number: int, _frame: FrameType | None) -> None:
        nonlocal came
        came = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    numbers = (signal.SIGINT, signal.SIGTERM) if current_thread() is main_thread() else ()
    before = {number: signal.signal(number, note) for number in numbers}
    try:
        yield lambda: came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def train_in_processes(work: ProcessWork, job: Any, processes: int, device: str, stopping: Stopping) -> bool:
    """Run `work(job, ranks, stopping)` in new processes that can reach each other.

    What one of them raises as InputError is raised here, and ends the others; so does the end of this
    process. Returns whether they came to their end.
    """
    context = multiprocessing.get_context("spawn")
    with locked_folder(_PREFIX, Path(tempfile.gettempdir())) as folder:
        children: list[tuple[Any, Connection]] = []
        try:
            for rank in range(processes):
                here, there = context.Pipe(duplex=False)
                arguments = (work, job, Ranks(rank, processes), device, str(folder), there)
                child = context.Process(target=_child, args=arguments, daemon=True)
                child.start()
                there.close()
                children.append((child, here))
            return _ends(children, folder, stopping)
        finally:
            for child, here in children:
                child.kill()
                child.join()
                here.close()


def _ends(children: Sequence[tuple[Any, Connection]], folder: Path, stopping: Stopping) -> bool:
    """Wait for all; an error of one of them is raised."""
    waiting = {here: child for child, here in children}
    finished = True
    while waiting:
        if stopping():
            (folder / "stop").touch()
        ready = wait(list(waiting), timeout=0.2)
        answers = {here: _answer(here) for here in ready}  # type: ignore[arg-type]
        # Who lost another process ends without a word; the one that knows why has spoken before.
        for answer in answers.values():
            if isinstance(answer, InputError):
                raise answer
        for here, answer in answers.items():
            child = waiting.pop(here)  # type: ignore[arg-type]
            if answer is None:
                child.join()
                problem = f"a process exited with code {child.exitcode} without a message"
                fix = "Run the same command to resume, with fewer --processes if memory was short"
                raise InputError("datagen train", "--processes", problem, fix)
            finished = finished and bool(answer)
    return finished


def _answer(here: Connection) -> bool | InputError | None:
    try:
        return here.recv()
    except EOFError:
        return None


def _child(work: ProcessWork, job: Any, ranks: Ranks, device: str, folder: str, there: Connection) -> None:
    # Ctrl-C reaches the whole group of processes; only the first of them decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    parent, stop = multiprocessing.parent_process(), Path(folder, "stop")
    if device == "cuda":
        torch.cuda.set_device(ranks.rank)
    else:
        os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")  # this machine's name may mean nothing to it
    backend = "nccl" if device == "cuda" else "gloo"
    dist.init_process_group(
        backend, init_method=f"file://{folder}/rendezvous", rank=ranks.rank, world_size=ranks.world
    )
    try:
        done = work(job, ranks, lambda: stop.exists() or (parent is not None and not parent.is_alive()))
        with suppress(BrokenPipeError):  # the parent was killed
            there.send(done)
    except InputError as error:
        there.send(error)
    finally:
        dist.destroy_process_group()
