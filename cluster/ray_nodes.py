"""The machines of a Ray cluster: whether the driver's own is part of it, and what only others can see."""

from __future__ import annotations

import os
import platform
import signal
import socket
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from datagen.cluster.post_mortem import PostMortem, collect_post_mortem, read_note

_MUTE_S = 30.0  # a machine that did not answer is left alone for so long
_LOOK_S, _CONNECTS_WITHIN_S = 1.0, 2.0
# A GCS server of others may be started anew, and be back at once. Without one, Ray ends the process at 60 s.
_PATIENCE_S = 20.0


class OwnNode:
    """The two servers that a driver needs: its machine's raylet, and the cluster's GCS server.

    Ray lets a driver without them wait, fail or die, a minute later. So they are asked whether they
    listen: once a second, and right before each request that would block.
    """

    def __init__(self, ray: Any, address: str) -> None:
        self._node = ray._private.worker._global_node  # None for a client (ray://), which needs neither
        self._patience_s = 0.0 if address == "local" else _PATIENCE_S
        self._heard_s = self._looked_s = time.monotonic()

    def dead(self) -> str:
        """Which server has been silent for too long; "" where none has."""
        if self._node is None or time.monotonic() < self._looked_s + _LOOK_S:
            return ""
        self._looked_s, silent = time.monotonic(), self.silent()
        if not silent:
            self._heard_s = self._looked_s
        return silent if self._looked_s - self._heard_s >= self._patience_s else ""

    def silent(self) -> str:
        """Which server does not answer now; "" where both do."""
        if self._node is None:
            return ""
        host, _, port = self._node.gcs_address.rpartition(":")
        try:
            socket.create_connection((host.strip("[]"), int(port)), _CONNECTS_WITHIN_S).close()
        except OSError as error:
            return f"Ray's GCS server at {host}:{port} does not answer ({error})"
        try:
            with socket.socket(socket.AF_UNIX) as raylet:
                raylet.settimeout(_CONNECTS_WITHIN_S)
                raylet.connect(self._node.raylet_socket_name)
        except OSError as error:
            return f"Ray's raylet on this machine does not answer ({error})"
        return ""


@dataclass
class Question:
    """A question to every other machine, and the answers so far, by the machine's name."""

    silent: dict[Any, tuple[str, str]]  # reference to the answer -> the machine's id and name
    until_s: float  # when those that are still silent are given up
    answers: dict[str, Any] = field(default_factory=dict)


class OtherNodes:
    """The machines of a cluster beside the driver's own, as they come and go.

    Each question is one tiny task a machine, pinned to it. A machine that does not answer in time is
    no error: what it would have said is missing.
    """

    def __init__(self, ray: Any, address: str) -> None:
        self._ray = ray
        self.own = OwnNode(ray, address)
        self._alone = address == "local"
        # The client of `ray://` runs on no machine of the cluster.
        self._own = "" if address.startswith("ray://") else str(ray.get_runtime_context().get_node_id())
        self._mute_until_s: dict[str, float] = {}
        self._tasks: dict[Callable[..., Any], Any] = {}  # each is sent to the cluster once

    def alive(self) -> dict[str, str]:
        """Name of each living machine but the driver's, by id: address, and what tells neighbours apart."""
        if self._alone or self.own.silent():
            return {}
        return {
            node["NodeID"]: f"{node['NodeManagerAddress']} (node {node['NodeID'][:12]})"
            for node in self._ray.nodes()
            if node["Alive"] and node["NodeID"] != self._own
        }

    def ask(self, function: Callable[..., Any], *arguments: Any, patience_s: float) -> dict[str, Any]:
        """What `function(*arguments)` gives on each machine, by its name, of those that answer in time.

        Waits for them, but leaves those alone for a while that were silent at the last time.
        """
        now_s = time.monotonic()
        deaf = [node for node, until_s in self._mute_until_s.items() if now_s < until_s]
        question = self.put(function, *arguments, patience_s=patience_s, but=deaf)
        while question.silent and (left_s := question.until_s - time.monotonic()) > 0:
            ready, _ = self._ray.wait(list(question.silent), num_returns=1, timeout=left_s)
            self.hear(question, ready)
        self._mute_until_s |= dict.fromkeys((n for n, _ in question.silent.values()), now_s + _MUTE_S)
        return question.answers

    def put(
        self, function: Callable[..., Any], *arguments: Any, patience_s: float, but: Sequence[str] = ()
    ) -> Question:
        """Put a question to every machine that is not among `but`, without waiting for answers."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        if function not in self._tasks:
            options: dict[str, Any] = {"num_cpus": 0, "max_retries": 0}
            self._tasks[function] = self._ray.remote(**options)(function)
        sent: dict[Any, tuple[str, str]] = {}
        for node, name in self.alive().items():
            if node not in but:
                pinned = NodeAffinitySchedulingStrategy(node, soft=False)
                ref = self._tasks[function].options(scheduling_strategy=pinned).remote(*arguments)
                sent[ref] = (node, name)
        return Question(sent, time.monotonic() + patience_s)

    def hear(self, question: Question, ready: Iterable[Any]) -> None:
        """Take the answers that have come among these references."""
        for ref in [r for r in ready if r in question.silent]:
            _, name = question.silent.pop(ref)
            try:
                question.answers[name] = self._ray.get(ref)
            except self._ray.exceptions.RayError:  # the machine went, or cannot load this package
                continue


# What the machines are asked; each of these runs there.


def attempts_begun(notes: str, attempts: Sequence[str]) -> list[str]:
    """Those of the attempts that this machine is at."""
    return [attempt for attempt in attempts if read_note(notes, attempt) is not None]


def post_mortems_of(notes: str, attempts: Sequence[str]) -> dict[str, PostMortem]:
    """What dead workers of this machine left of the attempts; what is given is removed here."""
    found = {attempt: collect_post_mortem(notes, attempt) for attempt in attempts}
    return {attempt: left for attempt, left in found.items() if left.note is not None}


def end_attempts(notes: str, attempts: Sequence[str]) -> None:
    """SIGKILL to the workers of this machine that are at one of the attempts."""
    for attempt in attempts:
        note = read_note(notes, attempt)  # exists only while a process is at it
        if note is not None and note.host.name == platform.node():
            _kill_worker(note.host.pid)


def _kill_worker(pid: int) -> None:
    """SIGKILL to a process of this machine if it is a Ray worker; others are left alone."""
    try:
        if Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"ray::"):
            os.kill(pid, signal.SIGKILL)
    except (FileNotFoundError, ProcessLookupError):
        return  # it has ended meanwhile
