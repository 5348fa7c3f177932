"""Check, before the first shard, that every machine of a cluster can make shards of the run."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping
from typing import Any

from datagen.cluster.attempt import open_task
from datagen.cluster.protocol import JobCannotContinue, ShardTask
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.workers.extras import versions_of

_PATIENCE_S = 120.0  # sources are opened, and their digests computed
_SHARED = "Put the run and its sources on a path that every machine has, or on s3://"
_VERSIONS = "Install the versions of constraints.txt on every machine"


def refuse_unfit_machines(ask: Callable[..., dict[str, Any]], run: Run, task: ShardTask) -> None:
    """Raise InputError for the first machine that cannot make the run's shards.

    `ask(function, *arguments, patience_s=...)` returns each other machine's result by its name. A machine is
    fit when it can read and write the same run, finds the sources, and has the same versions of libraries
    that can change bits. Machines that do not respond in time are skipped.
    """
    here, probe = versions_of(sorted(task.spec.engines)), f".probe-{secrets.token_hex(8)}"
    run.storage.put_new(probe, b"driver")
    try:
        found: dict[str, str] = ask(problem_here, task, probe, here, patience_s=_PATIENCE_S)
    finally:
        run.storage.delete([probe])
    for machine, problem in sorted(found.items()):
        if problem:
            fix = _VERSIONS if " there, but " in problem else _SHARED
            raise InputError(f"machine {machine}", "", problem, fix)


def problem_here(task: ShardTask, probe: str, versions: Mapping[str, str]) -> str:
    """Why this machine cannot make shards of the run; "" when it can. Runs on each machine."""
    try:
        run, _, _ = open_task(task)
        if not run.storage.exists(probe):
            return f"{task.run}: is another folder there"
        answer = f"{probe}-{secrets.token_hex(8)}"
        run.storage.put_new(answer, b"seen")
        run.storage.delete([answer])
    except (JobCannotContinue, InputError) as error:
        return " ".join(str(error).split())
    for name, its in versions_of(versions).items():
        if its != versions[name]:
            return f"{name}: is {its or 'missing'} there, but {versions[name]} on the driver's machine"
    return ""
