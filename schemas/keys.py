"""Where the files of a run lie, and the runs of a merged place: keys below its root."""

from __future__ import annotations

# The record of a merged place, which names its parts.
MERGED = "merged.json"
# The mark in the folder of an attempt that is being removed.
REMOVING = "removing"


def shard_folder(shard: int, attempt: str) -> str:
    """Key of the folder of one attempt at a shard."""
    return f"shards/{shard:06d}/{attempt}"


def commit_key(shard: int) -> str:
    """Key of a shard's commit record."""
    return f"commits/{shard:06d}.json"


def commit_copy_key(shard: int, attempt: str) -> str:
    """Key of the copy of a commit record in its attempt's folder."""
    return f"{shard_folder(shard, attempt)}/commit.json"


def part_folder(spec_hash: str) -> str:
    """Folder of the part of a merged place with this specification."""
    return f"parts/{spec_hash[:16]}"
