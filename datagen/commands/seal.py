"""`datagen seal` and `datagen unseal`: make or remove the one store that any Zarr reader opens."""

from __future__ import annotations

from datagen.console.options import RunPath
from datagen.console.printing import counted, listed, print_rows
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.sealing import SEALED, SealedRoot, sealed_root
from datagen.schemas.sealing import seal as seal_place
from datagen.schemas.sealing import unseal as unseal_place
from datagen.schemas.storage import open_storage


def seal(run: RunPath, /) -> int:
    """Make one flat Zarr store, data.zarr, of the committed shards; the run may be unfinished.

    Chunks are hard links, or copies by the S3 server. An older store stays until the new one is complete.

    For example: datagen seal runs/first
    """
    storage = open_storage(run, probe=False, create=False)
    address = seal_place(storage)
    rows = [("store", f"{address}: zarr.open or xarray.open_zarr reads it")]
    root = sealed_root(storage)
    if root is not None:
        rows += _part_rows(root)
    print_rows(f"sealed: {run}", rows)
    return 0


def unseal(run: RunPath, /) -> int:
    """Remove data.zarr. The run keeps every shard, and `datagen seal` makes the store again.

    For example: datagen unseal runs/first
    """
    storage = open_storage(run, probe=False, create=False)
    open_runs(storage)  # a folder without a run is not touched
    root = sealed_root(storage)
    was_there = next(iter(storage.list(SEALED)), None) is not None
    unseal_place(storage)
    rows = (
        [("removed", f"{storage.url}/{SEALED}")] if was_there else [("nothing to do", f"no {SEALED} there")]
    )
    if root is not None:
        rows += _part_rows(root)
    print_rows(f"unsealed: {run}", rows)
    return 0


def _part_rows(root: SealedRoot) -> list[tuple[str, str]]:
    """Rows with the labels and the missing shards of each run in a store."""
    rows: list[tuple[str, str]] = []
    for part in root.parts:
        title = f"run {part.spec_hash[:16]}"
        absent = part.missing_shards
        if absent:
            lacks = f"without {len(absent)} of its shards: {listed(absent)}"
            rows.append((title, f"{counted(part.n, 'label')} wanted; {lacks}"))
        else:
            rows.append((title, f"{counted(part.n, 'label')}, every shard"))
    return rows
