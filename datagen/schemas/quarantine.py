"""Release quarantined shards, so that they are tried again; their records are kept."""

from __future__ import annotations

import re
from itertools import count

from datagen.schemas.errors import InputError
from datagen.schemas.record_files import MAX_RECORD_BYTES, read_record
from datagen.schemas.run import Run
from datagen.schemas.run_records import QuarantineRecord

_LIFTED = re.compile(r"quarantine/([0-9]{6,18})\.lifted-([1-9][0-9]{0,8})\.json")


def lift_quarantine(run: Run) -> list[int]:
    """Release every quarantined shard; return their numbers.

    A record moves to `quarantine/<shard>.lifted-<k>.json`. It is written there first, so that after a kill in
    between the shard is still quarantined.
    """
    shards = sorted(run.quarantined())
    for shard in shards:
        key = f"quarantine/{shard:06d}.json"
        data = run.storage.get(key, MAX_RECORD_BYTES)
        if data is None:
            continue  # another process released it
        # An existing record with these bytes is from an interrupted call: a success.
        next(k for k in count(1) if run.storage.put_new(_lifted_key(shard, k), data))
        run.storage.delete([key])
    return shards


def lifted_records(run: Run) -> list[QuarantineRecord]:
    """Records of released shards, in order of shard and time. InputError as `read_record`."""
    names = (_LIFTED.fullmatch(file.key) for file in run.storage.list("quarantine"))
    records: list[QuarantineRecord] = []
    for shard, k in sorted((int(name[1]), int(name[2])) for name in names if name):
        key = _lifted_key(shard, k)
        if (record := read_record(run.storage, key, QuarantineRecord)) is None:
            continue
        if record.shard != shard:
            problem = f"is {record.shard}, not {shard}"
            raise InputError(f"{run.storage.url}/{key}", "shard", problem, "Remove this foreign file")
        records.append(record)
    return records


def _lifted_key(shard: int, k: int) -> str:
    return f"quarantine/{shard:06d}.lifted-{k}.json"
