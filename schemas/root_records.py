"""Records at a run's root: each is written once, with a second copy; what else is there is refused."""

from __future__ import annotations

from datagen.schemas.errors import InputError
from datagen.schemas.record_files import MAX_RECORD_BYTES, different_fields
from datagen.schemas.run_records import Manifest
from datagen.schemas.storage import Storage
from datagen.schemas.storage.errors import NotARegularFile


def copy_key(key: str) -> str:
    """Key of the copy of a record at the run's root."""
    return f"copies/{key}"


def publish(storage: Storage, key: str, record: bytes) -> None:
    """Write a record of the run's root once: its copy first, then the record with the copy's bytes.

    The copy decides races, so that both are always equal; one that was killed in between is completed
    by the next.
    """
    storage.put_new(copy_key(key), record)
    kept = storage.get(copy_key(key), MAX_RECORD_BYTES)
    storage.put_new(key, record if kept is None else kept)


def refuse_foreign(storage: Storage, *also: str) -> None:
    """Refuse a place without a run that holds files of something else; `also` begin further names of ours."""
    ours = ("manifest.json", "plans/", "copies/", "shards/", "commits/", "ledger/", ".probe-", *also)
    problem, mend = "the folder holds files of something else", "Choose a new --out"
    try:
        for file in storage.list(""):
            if not file.key.startswith(ours):
                raise InputError(storage.url, file.key, problem, mend)
    except NotARegularFile as e:
        raise InputError(e.place, "", problem, mend) from e


def refuse_other(place: str, there: Manifest, asked: Manifest) -> None:
    """Refuse to go on with a run of another specification, naming every field that differs."""
    # Not the schema's version: a run goes on in the one it was begun with.
    ours, theirs = (
        {"spec": one.spec.model_dump(mode="json"), "schema_name": one.schema_name} for one in (asked, there)
    )
    rows = different_fields(ours, theirs)
    where, each = f"{place}/manifest.json", there.layout.candidates_per_scene
    if each != asked.layout.candidates_per_scene:
        problem = f"{each}, not the {asked.layout.candidates_per_scene} asked"
        raise InputError(where, "layout.candidates_per_scene", problem, "Choose another --out")
    if rows:
        shown = [f"{path.removeprefix('spec.')}: it has {b!r}, asked {a!r}" for path, a, b in rows[:20]]
        more = f"; and {len(rows) - 20} more" if len(rows) > 20 else ""
        problem = "another specification lives here (" + "; ".join(shown) + more + ")"
        raise InputError(where, "", problem, "Choose another --out, or ask for what it has")
