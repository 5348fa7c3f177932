"""Small real tasks that misbehave as told, for the executors."""

from __future__ import annotations

import ctypes
import errno
import os
import resource
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datagen.cluster.attempt_guard import Meter
from datagen.cluster.protocol import AttemptResult, JobCannotContinue
from datagen.schemas.fields import sized_schema
from datagen.schemas.run_records import Layout
from tests.made_runs import small_spec, tables_of


@dataclass(frozen=True)
class ScriptedTask:
    """Does the n-th of its words at its n-th attempt, and commits when it has no more."""

    shard: int
    attempt: str
    deadline_s: float
    notes: str
    words: tuple[str, ...] = ()
    tries: str = ""  # folder that counts attempts, one file each; "" is beside the notes


def perform(task: ScriptedTask, meter: Meter) -> AttemptResult:
    """The task function. Attempts are counted by files."""
    tries = Path(task.tries) if task.tries else Path(task.notes).parent / "tries"
    tries.mkdir(exist_ok=True)
    n = len(list(tries.glob(f"{task.shard}-*")))
    (tries / f"{task.shard}-{n}-{os.getpid()}").touch()
    word = task.words[n] if n < len(task.words) else "commit"
    misbehave(word)
    return AttemptResult(word != "superseded", labels=10, positives=4, cost=meter.cost())


def misbehave(word: str) -> None:
    """Crash, hang, raise or return, by name."""
    if word == "segfault":
        ctypes.string_at(0)
    elif word == "exit":
        os._exit(3)
    elif word == "silent_exit":
        os._exit(0)
    elif word == "abort":
        os.abort()
    elif word == "system_exit":
        raise SystemExit(2)
    elif word == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    elif word == "hang":
        time.sleep(600)
    elif word == "hang_with_lock":
        ctypes.PyDLL(None).sleep(600)  # unlike CDLL, keeps the interpreter's lock
    elif word == "stop":
        os.kill(os.getpid(), signal.SIGSTOP)
    elif word == "raise":
        raise ValueError("a scene\nof two lines")
    elif word == "memory":
        raise MemoryError
    elif word == "memory_limit":
        resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
        GROWN.append(bytearray(16 << 30))
    elif word == "fill_memory":
        GROWN.append(bytearray(b"\1") * FILL_BYTES)
        time.sleep(600)
    elif word in ("not_finite", "one_row_less"):
        hand_over_bad_rows(word)
    elif word == "disk":
        raise JobCannotContinue(f"RUN: {os.strerror(errno.ENOSPC)}. Free disk space")


def hand_over_bad_rows(word: str) -> None:
    """Let the check that every shard passes see rows that it must refuse."""
    spec = small_spec()
    schema = sized_schema("heuristic", spec)
    _, rows = tables_of(schema, Layout(scenes_per_shard=2, candidates_per_scene=5), seed=0, shard=0)
    if word == "not_finite":
        rows["visibility"][3] = np.nan
    else:
        rows["visibility"] = rows["visibility"][:-1]
    schema.check("sample", 10, rows)


GROWN: list[bytearray] = []
FILL_BYTES = 4 << 30
