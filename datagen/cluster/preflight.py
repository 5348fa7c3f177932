"""Check, before the first shard, that every machine of a cluster can make shards of the run."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from datagen.cluster.attempt import open_task
from datagen.cluster.protocol import JobCannotContinue, ShardTask
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.workers.extras import versions_of

_PATIENCE_S = 120.0  # sources are opened, and their digests computed
_SHARED = "Put the run and its sources on a path that every machine has, or on s3://"


@dataclass(frozen=True)
class MachineReport:
    """Why a machine cannot make shards of the run ("" when it can), and its versions of libraries."""

    problem: str
    versions: dict[str, str]


def refuse_unfit_machines(ask: Callable[..., dict[str, Any]], run: Run, task: ShardTask) -> None:
    """Raise InputError for the first machine that cannot make the run's shards.

    `ask(function, *arguments, patience_s=...)` returns each other machine's result by its name. A machine is
    fit when it can read and write the same run, finds the sources, and has the same versions of libraries
    that can change bits. Machines that do not respond in time are skipped.
    """
    names, probe = sorted(task.spec.engines), f".probe-{secrets.token_hex(8)}"
    run.storage.put_new(probe, b"driver")
    try:
        found: dict[str, MachineReport] = ask(inspect_machine, task, probe, names, patience_s=_PATIENCE_S)
    finally:
        run.storage.delete([probe])
    here = versions_of(names)
    for machine, fitness in sorted(found.items()):
        place = f"machine {machine}"
        if fitness.problem:
            raise InputError(place, "", fitness.problem, _SHARED)
        if others := {n: v for n, v in fitness.versions.items() if v != here[n]}:
            name, its = min(others.items())
            problem = f"is {its or 'missing'} there, but {here[name]} on this machine"
            raise InputError(place, name, problem, "Install the versions of constraints.txt on every machine")


def inspect_machine(task: ShardTask, probe: str, names: Iterable[str]) -> MachineReport:
    """The fitness of this machine; runs on each machine."""
    versions = versions_of(names)
    try:
        run, _, _ = open_task(task)
        if not run.storage.exists(probe):
            return MachineReport(f"{task.run}: is another folder there", versions)
        answer = f"{probe}-{secrets.token_hex(8)}"
        run.storage.put_new(answer, b"seen")
        run.storage.delete([answer])
    except (JobCannotContinue, InputError) as error:
        return MachineReport(" ".join(str(error).split()), versions)
    return MachineReport("", versions)
