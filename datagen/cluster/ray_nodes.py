"""The machines of a Ray cluster: their health, and requests to the others."""

from __future__ import annotations

import os
import platform
import signal
import socket
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from datagen.cluster.attempt_guard import Note, collect_post_mortem, read_note

_SKIPPED_S = 30.0  # a machine that did not respond gets no request for this time
_LOOK_S, _RESPONDS_WITHIN_S = 1.0, 2.0
# A remote GCS server may be restarted, and a stopped one continued. Without one, Ray ends this process
# after 60 s, or waits for ever.
_PATIENCE_S = 20.0


class OwnNode:
    """Health of the two servers that a driver needs: its machine's raylet and the cluster's GCS server.

    Without them, Ray makes a driver wait, fail or exit a minute later. They are checked once a second, and
    before each request that would block.
    """

    def __init__(self, ray: Any, address: str) -> None:
        # Private: the raylet's socket has no public name.
        self._node = ray._private.worker._global_node
        # A local server that refuses connections is dead; one that accepts them may be slow.
        local = address == "local"
        self._patience_s, self._responds_within_s = (
            (0.0, _PATIENCE_S) if local else (_PATIENCE_S, _RESPONDS_WITHIN_S)
        )
        self._responded_s = self._looked_s = time.monotonic()

    def dead(self) -> str:
        """The server that has not responded for too long; "" for none."""
        if time.monotonic() < self._looked_s + _LOOK_S:
            return ""
        self._looked_s, silent = time.monotonic(), self.silent()
        if not silent:
            self._responded_s = self._looked_s
        return silent if self._looked_s - self._responded_s >= self._patience_s else ""

    def silent(self) -> str:
        """The server that does not respond now; "" for none."""
        host, _, port = self._node.gcs_address.rpartition(":")
        try:
            with socket.create_connection((host.strip("[]"), int(port)), self._responds_within_s) as gcs:
                gcs.recv(1)  # it speaks first; the kernel accepts connections for a stopped one
        except OSError as error:
            return f"Ray's GCS server at {host}:{port} does not respond ({error})"
        try:
            with socket.socket(socket.AF_UNIX) as raylet:
                raylet.settimeout(_RESPONDS_WITHIN_S)
                raylet.connect(self._node.raylet_socket_name)
        except OSError as error:
            return f"Ray's raylet on this machine does not respond ({error})"
        return ""


class OtherNodes:
    """The machines of a cluster except the driver's own.

    Each request is one small task per machine, pinned to it. Results of machines that do not respond in time
    are missing, without an error.
    """

    def __init__(self, ray: Any, address: str) -> None:
        self._ray = ray
        self.own = OwnNode(ray, address)
        self._alone = address == "local"
        self._own = str(ray.get_runtime_context().get_node_id())
        self._skipped_until_s: dict[str, float] = {}
        self._tasks: dict[Callable[..., Any], Any] = {}  # each is sent to the cluster once

    def alive(self) -> dict[str, str]:
        """Unique name of each living machine except the driver's, by id."""
        if self._alone or self.own.silent():
            return {}
        return {
            node["NodeID"]: f"{node['NodeManagerAddress']} (node {node['NodeID'][:12]})"
            for node in self._ray.nodes()
            if node["Alive"] and node["NodeID"] != self._own
        }

    def ask(self, function: Callable[..., Any], *arguments: Any, patience_s: float) -> dict[str, Any]:
        """Results of `function(*arguments)` on each machine that responds in time, by its name.

        Machines that did not respond to the last request are skipped for a while.
        """
        until_s, answers = time.monotonic() + patience_s, dict[str, Any]()
        now_s = time.monotonic()
        skipped = [node for node, skipped_s in self._skipped_until_s.items() if now_s < skipped_s]
        silent = self.send(function, *arguments, but=skipped)
        while silent and (left_s := until_s - time.monotonic()) > 0:
            ready, _ = self._ray.wait(list(silent), num_returns=1, timeout=left_s)
            for ref in ready:
                _, name = silent.pop(ref)
                try:
                    answers[name] = self._ray.get(ref)
                except self._ray.exceptions.RayError:  # the machine was lost, or cannot load this package
                    continue
        self._skipped_until_s |= dict.fromkeys((node for node, _ in silent.values()), until_s + _SKIPPED_S)
        return answers

    def send(
        self, function: Callable[..., Any], *arguments: Any, but: Sequence[str] = ()
    ) -> dict[Any, tuple[str, str]]:
        """Begin `function(*arguments)` on each machine: its id and name by the reference to the result."""
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
        return sent


def perform() -> Callable[[bytes], tuple[str, str, Any]]:
    """The function of an attempt's task: runs `guard(function, task)` of the pickled three.

    It returns the id and address of its machine with the report, or with the error of loading them as text:
    it is sent by value and needs nothing of this package, which a machine may lack.
    """

    def attempt(packed: bytes) -> tuple[str, str, Any]:
        import pickle

        import ray

        here = ray.get_runtime_context().get_node_id(), ray.util.get_node_ip_address()
        try:
            guard, function, task = pickle.loads(packed)  # noqa: S301 - from the driver, as all tasks of Ray
        except Exception as error:  # noqa: BLE001 - reported, whatever it is
            return *here, f"{type(error).__name__}: {error}"
        return *here, guard(function, task)

    return attempt


# Functions of the requests, which run on the other machines.


def attempts_begun(notes: str, attempts: Sequence[str]) -> list[str]:
    """The attempts that are running on this machine."""
    return [attempt for attempt in attempts if read_note(notes, attempt) is not None]


def post_mortems_of(notes: str, attempts: Sequence[str]) -> dict[str, Note]:
    """Read, and remove, the files that dead workers of the attempts left on this machine."""
    found = {attempt: collect_post_mortem(notes, attempt) for attempt in attempts}
    return {attempt: left for attempt, left in found.items() if left.host is not None}


def end_attempts(notes: str, attempts: Sequence[str]) -> None:
    """Kill the workers of this machine that run one of the attempts."""
    for attempt in attempts:
        note = read_note(notes, attempt)  # exists only while a process runs it
        if note is not None and note.host is not None and note.host.name == platform.node():
            _kill_worker(note.host.pid)


def _kill_worker(pid: int) -> None:
    try:
        if Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"ray::"):
            os.kill(pid, signal.SIGKILL)
    except (FileNotFoundError, ProcessLookupError):
        return  # it has ended meanwhile
