"""Records at a run's root, each written once with a second copy, and checks of foreign files."""

from __future__ import annotations

from datagen.schemas.errors import InputError
from datagen.schemas.record_files import MAX_RECORD_BYTES, different_fields
from datagen.schemas.run_records import FORMAT_VERSION, Manifest
from datagen.schemas.storage import Storage
from datagen.schemas.storage.errors import NotARegularFile


def copy_key(key: str) -> str:
    """Key of the copy of a record at the run's root."""
    return f"copies/{key}"


def publish(storage: Storage, key: str, record: bytes) -> None:
    """Write a record at the run's root once: its copy first, then the record with the copy's bytes.

    The copy decides races, so that both are equal; after a kill in between, the next call completes it.
    """
    storage.put_new(copy_key(key), record)
    kept = storage.get(copy_key(key), MAX_RECORD_BYTES)
    storage.put_new(key, record if kept is None else kept)


def refuse_other_format(place: str, version: int) -> None:
    """Raise InputError for a record of another format, at `place`."""
    if version != FORMAT_VERSION:
        problem = f"is {version}, but this program reads {FORMAT_VERSION}"
        raise InputError(place, "format_version", problem, "Use the version of datagen that made the run")


def refuse_foreign(storage: Storage, *also: str) -> None:
    """Raise InputError for a folder with other files than a run's; `also` are further allowed prefixes."""
    ours = ("manifest.json", "plans/", "copies/", "shards/", "commits/", "ledger/", ".probe-", *also)
    problem, fix = "holds other files than those of a run", "Choose a new --out"
    try:
        for file in storage.list(""):
            if not file.key.startswith(ours):
                raise InputError(storage.url, file.key, problem, fix)
    except NotARegularFile as e:
        raise InputError(e.place, "", problem, fix) from e


def refuse_other(place: str, there: Manifest, asked: Manifest) -> None:
    """Raise InputError for a run of another specification, with every field that differs."""
    # Without the schema version: a run keeps the one it was started with.
    ours, theirs = (
        {"spec": one.spec.model_dump(mode="json"), "schema_name": one.schema_name} for one in (asked, there)
    )
    rows = different_fields(ours, theirs)
    where, each = f"{place}/manifest.json", there.layout.candidates_per_scene
    if each != asked.layout.candidates_per_scene:
        problem = f"is {each}, not {asked.layout.candidates_per_scene}"
        raise InputError(where, "layout.candidates_per_scene", problem, "Choose another --out")
    if rows:
        shown = [f"{path.removeprefix('spec.')}: {b!r}, but {a!r} was given" for path, a, b in rows[:20]]
        more = f"; and {len(rows) - 20} more" if len(rows) > 20 else ""
        problem = "has another specification (" + "; ".join(shown) + more + ")"
        raise InputError(where, "", problem, "Choose another --out, or give the same options")
