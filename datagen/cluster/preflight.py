"""What a worker checks before its first attempt: that its machine can make shards of the run."""

from __future__ import annotations

import secrets
from collections.abc import Generator
from contextlib import contextmanager, suppress

from datagen.cluster.code_digest import code_digest
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.workers.engine_versions import refuse_other_engines

_SAME_CODE = "Install the same version of datagen on every machine"
_SHARED = "Put the run and its sources on a path that every machine has, or on s3://"


@contextmanager
def probe_in(run: Run) -> Generator[str]:
    """Give the name of a new file in the run, by which machines recognize it; removed after the block."""
    probe = f".probe-{secrets.token_hex(8)}"
    run.storage.put_new(probe, b"driver")
    try:
        yield probe
    finally:
        with suppress(InputError):
            run.storage.delete([probe])


def refuse_other_code(driver: str) -> None:
    """Raise InputError where this machine's code has another digest than the driver's."""
    if code_digest() != driver:
        raise InputError("datagen", "", "the code here differs from that of the job's driver", _SAME_CODE)


def refuse_unfit_machine(run: Run, probe: str) -> None:
    """Raise InputError where `run` is another folder than the driver's, or the engines here are others."""
    if probe and not run.storage.exists(probe):
        raise InputError(run.storage.url, "", "is another folder here than on the driver's machine", _SHARED)
    refuse_other_engines(f"{run.storage.url}/manifest.json", run.manifest.spec)
