"""Folders of houses that were made to do harm: bombs, pipes, and texts that no store can hold."""

from __future__ import annotations

import gzip
import os
import resource
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from datagen.schemas.errors import InputError
from datagen.schemas.specification import Source, Specification
from datagen.workers.houses import line_index, open_houses
from datagen.workers.json_document import parse_json
from datagen.workers.world import World
from tests.workers.houses.house_files import SIZES, two_rooms, write_houses


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DATAGEN_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@contextmanager
def little_memory(more: int) -> Generator[None]:
    """Let the process grow by so many bytes of addresses and no more."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + more, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def packed(folder: Path, block: bytes, blocks: int) -> Path:
    """A folder of houses whose file unpacks to that many blocks; gzip members may follow each other."""
    write_houses(folder, [])
    (folder / "houses.jsonl.gz").write_bytes(gzip.compress(block, 9) * blocks)
    return folder


BOMBS: dict[str, tuple[bytes, int, str]] = {
    "30 million lines": (b"{}\n" * 1_000_000, 30, "more than 100,000 lines"),
    "400 MB of newlines": (b"\n" * 10_000_000, 40, "more than 100,000 lines"),
    "a line without end": (b"a" * 10_000_000, 40, "a line of more than 16 MiB"),
    "lines of spaces": ((b" " * 999_999 + b"\n") * 10, 60, "unpacks to too many bytes"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_in_little_memory(name: str, tmp_path: Path) -> None:
    block, blocks, said = BOMBS[name]
    folder = packed(tmp_path / "houses", block, blocks)
    with little_memory(1 << 30), pytest.raises(InputError, match=said) as refused:
        open_houses(f"procthor:{folder}")
    assert "houses.jsonl.gz:" in str(refused.value)
    assert list((tmp_path / "cache/houses").iterdir()) == []


def test_houses_of_all_files_are_counted_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from datagen.workers.houses import procthor

    write_houses(tmp_path, [two_rooms()] * 2, name="a.jsonl")
    write_houses(tmp_path, [two_rooms()] * 2, name="b.jsonl")
    assert open_houses(f"procthor:{tmp_path}").house_ids() == ["two-rooms"]
    monkeypatch.setattr(procthor, "MAX_LINES", 3)
    with pytest.raises(InputError, match="more than 3 houses"):
        open_houses(f"procthor:{tmp_path}")


@pytest.mark.parametrize("name", ["houses.jsonl.gz", "houses.jsonl", "asset_sizes.json"])
def test_a_pipe_in_a_files_place_is_refused(name: str, tmp_path: Path) -> None:
    write_houses(tmp_path, [two_rooms()])
    (tmp_path / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match=f"{name}: is not a file"):
        open_houses(f"procthor:{tmp_path}")


def bad_text(things: str, key: str, text: str) -> dict[str, Any]:
    house = two_rooms()
    house[things][0][key] = text
    return house


@pytest.mark.parametrize("text", ["\ud800", "a\0b", "\x1b[31m", "a\u202eb", "a\nb"], ids=ascii)
@pytest.mark.parametrize("where", ["rooms id", "rooms roomType", "objects id", "objects assetId", "walls id"])
def test_a_text_that_cannot_be_printed_is_a_bad_house(where: str, text: str, tmp_path: Path) -> None:
    """Refused where it is read: in a store, a lone surrogate would quarantine the shard without a name."""
    write_houses(tmp_path, [bad_text(*where.split(), text)])
    source = open_houses(f"procthor:{tmp_path}")
    with pytest.raises(InputError, match="unprintable character") as refused:
        source.load("two-rooms")
    told = str(refused.value)
    assert "houses.jsonl.gz" in told and "two-rooms" in told and "$." in told and told.isprintable()


def test_a_key_of_the_size_table_or_a_file_name_that_cannot_be_printed_is_refused(tmp_path: Path) -> None:
    write_houses(tmp_path, [two_rooms()], sizes={**SIZES, "Table\ud800": SIZES["Table_1"]})
    with pytest.raises(InputError, match=r"asset_sizes\.json.*unprintable character \\ud800"):
        open_houses(f"procthor:{tmp_path}")
    write_houses(tmp_path, [two_rooms()], name="a\x1b[2J.jsonl")
    with pytest.raises(InputError, match="unprintable"):
        open_houses(f"procthor:{tmp_path}")
    (tmp_path / "a\x1b[2J.jsonl").rename(tmp_path / "\udcff.jsonl")
    with pytest.raises(InputError, match="unprintable"):
        open_houses(f"procthor:{tmp_path}")


def test_a_bad_house_is_read_once_by_a_world(tmp_path: Path) -> None:
    write_houses(tmp_path, [bad_text("rooms", "id", "\ud800")])
    houses = Mock(wraps=open_houses(f"procthor:{tmp_path}"))
    any_source = Source(kind="procthor", digest="0" * 64)
    world = World(Specification(houses=any_source, objects=any_source), houses, None, [], [], [])  # type: ignore[arg-type]
    for _ in range(200):
        with pytest.raises(InputError, match="unprintable character"):
            world.house("two-rooms")
    houses.load.assert_called_once_with("two-rooms")


def test_packed_houses_that_are_not_used_are_removed(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(line_index, "_MOST_CACHED", 2)
    for k, name in enumerate("abc"):
        folder = write_houses(tmp_path / name, [{**two_rooms(), "_id": name}])
        assert open_houses(f"procthor:{folder}").load(name).rooms
        newest = max(cache.rglob("*.zip"), key=lambda path: path.stat().st_mtime)
        os.utime(newest, (k, k))
    assert len(list(cache.rglob("*.zip"))) == 2


@pytest.mark.parametrize(
    "make",
    [lambda: b"[" * 5_000_000, lambda: b'{"a":' * 2_000_000, lambda: b"[" + b"[]," * 9_000_000 + b"[]]"],
    ids=["lists", "objects", "side by side"],
)
def test_documents_beyond_any_house_are_refused_before_they_are_parsed(make: Callable[[], bytes]) -> None:
    with little_memory(1 << 29), pytest.raises(InputError):
        parse_json(make(), "file")
