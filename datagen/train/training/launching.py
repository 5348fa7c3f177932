"""Training in one or many processes: device, start, sums and gradients over ranks, Ctrl-C."""

from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from threading import current_thread, main_thread
from types import FrameType
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from datagen.schemas.errors import InputError
from datagen.schemas.locked_folders import locked_folder
from datagen.train.models import Model


@dataclass(frozen=True)
class Ranks:
    """This process among `world` that train together; a world of 1 needs no process group."""

    rank: int = 0
    world: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process writes files and shows progress."""
        return self.rank == 0

    def total(self, values: Tensor) -> Tensor:
        """Sums over all ranks, element by element."""
        if self.world > 1:
            dist.all_reduce(values)
        return values

    def gather(self, value: Any) -> list[Any]:
        """The values of all ranks, in order."""
        if self.world == 1:
            return [value]
        values: list[Any] = [None] * self.world
        dist.all_gather_object(values, value)
        return values

    def share_gradients(self, model: Model) -> Callable[..., Tensor]:
        """The model to call in training: gradients are the mean over ranks, parameters those of rank 0."""
        return DistributedDataParallel(model) if self.world > 1 else model

    def share_buffers(self, model: Model) -> None:
        """Copy the running statistics of rank 0, which are saved, to all ranks."""
        if self.world > 1:
            with torch.no_grad():
                for buffer in model.buffers():
                    dist.broadcast(buffer, 0)


Stopping = Callable[[], bool]
# The function of each process, importable by name; True when it finished.
ProcessWork = Callable[[Any, Ranks, Stopping], bool]
_PREFIX = "datagen-ranks-"


def choose_device(device: str, processes: int | None) -> tuple[str, int]:
    """`cpu` or `cuda`, and the number of processes: as given, else one per GPU, or one."""
    gpus = torch.cuda.device_count() if device != "cpu" and torch.cuda.is_available() else 0
    if device == "cuda" and not gpus:
        raise InputError("datagen train", "--device", "torch finds no GPU", "Give --device cpu")
    if gpus and processes is not None and processes > gpus:
        problem = f"{processes} is more than {gpus} GPUs"
        raise InputError("datagen train", "--processes", problem, f"Give at most {gpus}, or --device cpu")
    return ("cuda" if gpus else "cpu"), processes or max(1, gpus)


@contextmanager
def interruptible() -> Generator[Stopping]:
    """Yield a function that returns whether Ctrl-C or SIGTERM came. A second Ctrl-C ends the block."""
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
    """Run `work(job, ranks, stopping)` in new processes; whether they finished. Raises their InputError."""
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
    """Wait for all processes; whether they finished. Raises their InputError."""
    waiting = {here: child for child, here in children}
    finished = True
    while waiting:
        if stopping():
            (folder / "stop").touch()
        ready = wait(list(waiting), timeout=0.2)
        answers: dict[Any, Any] = {}
        for here in ready:
            with suppress(EOFError):  # without an answer
                answers[here] = here.recv()  # type: ignore[union-attr]
        # A process whose peer failed ends without an answer; the peer's error explains it.
        for answer in answers.values():
            if isinstance(answer, InputError):
                raise answer
        for here in ready:
            child = waiting.pop(here)  # type: ignore[arg-type]
            if here not in answers:
                child.join()
                problem = f"a process exited with code {child.exitcode} without a message"
                fix = "Run the same command to resume, with fewer --processes if memory was short"
                raise InputError("datagen train", "--processes", problem, fix)
            finished = finished and answers[here]
    return finished


def _child(work: ProcessWork, job: Any, ranks: Ranks, device: str, folder: str, there: Connection) -> None:
    # Ctrl-C reaches the whole group of processes; only the parent handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    parent, stop = multiprocessing.parent_process(), Path(folder, "stop")
    if device == "cuda":
        torch.cuda.set_device(ranks.rank)
    else:
        os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")  # the host name may not resolve
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
