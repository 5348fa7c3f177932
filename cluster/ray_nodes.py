"""The other machines of a Ray cluster: asked, rarely, for what only they can see."""

from __future__ import annotations

import os
import platform
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from cluster.guard import Remains, clear_notes, collect_remains, read_note

_PATIENCE_S = 10.0  # a machine may have to start a process first
_MUTE_S = 30.0  # a machine that did not answer is left alone for so long


class OtherNodes:
    """The machines of a cluster beside the driver's own, as they come and go.

    Each question is one tiny task a machine, pinned to it. A machine that does not answer in time is
    no error: what it would have said is missing.
    """

    def __init__(self, ray: Any, address: str) -> None:
        self._ray = ray
        # The client of `ray://` runs on no machine of the cluster.
        self._own = "" if address.startswith("ray://") else str(ray.get_runtime_context().get_node_id())
        self._mute_until_s: dict[str, float] = {}

    def alive(self) -> dict[str, str]:
        """Address of each living machine but the driver's, by id."""
        return {
            node["NodeID"]: node["NodeManagerAddress"]
            for node in self._ray.nodes()
            if node["Alive"] and node["NodeID"] != self._own
        }

    def ask(
        self, function: Callable[..., Any], *arguments: Any, patience_s: float = _PATIENCE_S
    ) -> dict[str, Any]:
        """What `function(*arguments)` gives on each machine, by its address, of those that answer in time."""
        refs, answers = self._send(function, arguments), {}
        if not refs:
            return {}
        ready, silent = self._ray.wait(list(refs), num_returns=len(refs), timeout=patience_s)
        for ref in ready:
            try:
                answers[refs[ref][1]] = self._ray.get(ref)
            except self._ray.exceptions.RayError:  # the machine went, or cannot load this package
                continue
        for ref in silent:
            self._mute_until_s[refs[ref][0]] = time.monotonic() + _MUTE_S
        return answers

    def tell(self, function: Callable[..., Any], *arguments: Any) -> None:
        """Have `function(*arguments)` run on each machine, without waiting for it."""
        self._send(function, arguments)

    def _send(self, function: Callable[..., Any], arguments: Sequence[Any]) -> dict[Any, tuple[str, str]]:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        options: dict[str, Any] = {"num_cpus": 0, "max_retries": 0}
        work, now_s = self._ray.remote(**options)(function), time.monotonic()
        sent: dict[Any, tuple[str, str]] = {}
        for node, address in self.alive().items():
            if self._mute_until_s.get(node, 0.0) <= now_s:
                pinned = NodeAffinitySchedulingStrategy(node, soft=False)
                ref = work.options(scheduling_strategy=pinned).remote(*arguments)
                sent[ref] = (node, address)
        return sent


# What the machines are asked; each of these runs there.


def attempts_begun(notes: str, attempts: Sequence[str]) -> list[str]:
    """Those of the attempts that this machine is at."""
    return [attempt for attempt in attempts if read_note(notes, attempt) is not None]


def remains_of(notes: str, attempts: Sequence[str]) -> dict[str, Remains]:
    """What dead workers of this machine left of the attempts; what is given is removed here."""
    found = {attempt: collect_remains(notes, attempt) for attempt in attempts}
    return {attempt: left for attempt, left in found.items() if left.note is not None}


def end_attempts(notes: str, attempts: Sequence[str]) -> None:
    """SIGKILL to the workers of this machine that are at one of the attempts."""
    for attempt in attempts:
        note = read_note(notes, attempt)  # exists only while a process is at it
        if note is not None and note.host.name == platform.node():
            _kill_worker(note.host.pid)


def forget_job(notes: str) -> None:
    """Remove this machine's notes of a job."""
    clear_notes(notes)


def _kill_worker(pid: int) -> None:
    """SIGKILL to a process of this machine if it is a Ray worker; others are left alone."""
    try:
        if Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"ray::"):
            os.kill(pid, signal.SIGKILL)
    except (FileNotFoundError, ProcessLookupError):
        return  # it has ended meanwhile
