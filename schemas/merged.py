"""A place that holds one run, or several that were merged: the parts of a merged one are runs themselves."""

from __future__ import annotations

from pathlib import Path

from schemas.errors import InputError
from schemas.record_files import read_record
from schemas.run import Run
from schemas.run_records import FORMAT_VERSION, Merged
from schemas.storage import Storage, open_storage

MERGED = "merged.json"


def open_runs(place: Storage | Path | str) -> list[Run]:
    """The run at `place`, or the parts of a merged one, in the order of their rows in its store.

    InputError when there is no run, or it is damaged or of another format.
    """
    storage = place if isinstance(place, Storage) else open_storage(place, probe=False, create=False)
    merged = read_record(storage, MERGED, Merged)
    if merged is None:
        return [Run.open(storage)]
    if merged.format_version != FORMAT_VERSION:
        raise InputError(
            f"{storage.url}/{MERGED}",
            "format_version",
            f"{merged.format_version}, and this program reads {FORMAT_VERSION}",
            "Use the version of the program that made the run",
        )
    return [Run.open(storage.below(part_folder(spec_hash))) for spec_hash in merged.parts]


def part_folder(spec_hash: str) -> str:
    """Folder of the part with this specification."""
    return f"parts/{spec_hash[:16]}"
