"""Keys of the files of a run, and of the parts of merged runs, relative to the root."""

from __future__ import annotations

# The record of merged runs, which names the parts.
MERGED = "merged.json"
# The folder of files that a repair has set aside.
SET_ASIDE = "set-aside"


def shard_folder(shard: int, attempt: str) -> str:
    """Key of the folder of one attempt of a shard."""
    return f"shards/{shard:06d}/{attempt}"


def commit_key(shard: int) -> str:
    """Key of a shard's commit record."""
    return f"commits/{shard:06d}.json"


def commit_copy_key(shard: int, attempt: str) -> str:
    """Key of the copy of a commit record in its attempt's folder."""
    return f"{shard_folder(shard, attempt)}/commit.json"


def part_folder(spec_hash: str) -> str:
    """Folder of the part with this specification in merged runs."""
    return f"parts/{spec_hash[:16]}"
