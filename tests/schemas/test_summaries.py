"""The index answers as the records do, whatever happened to either behind its back."""

from __future__ import annotations

import gzip
import json
import os
import random
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import datagen.schemas.summaries
from datagen.reports.spending import Spending, account_for
from datagen.schemas.errors import InputError
from datagen.schemas.keys import commit_key
from datagen.schemas.record_files import encode_record, signed_json
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit, Cost, Host, LedgerEntry
from datagen.schemas.summaries import (
    CommitSummary,
    EndSummary,
    Summaries,
    index_files,
    refresh,
    unreadable_files,
)
from tests.made_runs import commit_of, make_run

SHARDS = 12
OUTCOMES = ("failed", "crashed", "hung", "lost", "superseded", "out_of_memory", "cancelled")


def bare_run(folder: Path) -> Run:
    """A run whose commits name no files: what counts here are records."""
    return make_run(folder, n=10 * SHARDS, shards=())


def cost(rng: random.Random) -> Cost:
    stages = {stage: rng.uniform(0, 9) for stage in rng.sample(["draw", "settle", "observe", "write"], 3)}
    return Cost(
        wall_s=rng.uniform(30, 99), cpu_s=rng.uniform(0, 99), stage_wall_s=stages,
        stage_gpu_s={"observe": 0.1} if rng.random() < 0.3 else {}, peak_rss_bytes=rng.randrange(2**40),
        written_bytes=rng.randrange(2**40), source_s={"wall": 3.5, "cpu": 2.5} if rng.random() < 0.3 else {},
    )  # fmt: skip


def commit(run: Run, rng: random.Random, shard: int) -> Commit:
    redraws = {cause: rng.randrange(9) for cause in ("no_base", "bad_house") if rng.random() < 0.5}
    made = commit_of(run, shard, f"a{rng.randrange(10**9)}", (), rng.randrange(10), redraws)
    host = Host(name="h", cpu="c", cores=1, memory_bytes=1, pid=rng.randrange(3))
    return made.model_copy(update={"cost": cost(rng), "host": host})


def end(rng: random.Random, attempt: str, shard: int) -> LedgerEntry:
    return LedgerEntry(
        attempt=attempt, shard=shard, outcome=rng.choice(OUTCOMES), cause="x" * rng.choice([0, 9, 2000]),
        stack="a stack", cost=cost(rng) if rng.random() < 0.8 else None,
    )  # fmt: skip


def from_records(run: Run) -> tuple[list[CommitSummary], list[EndSummary], Spending]:
    """What the records alone say, each read by itself."""
    records = [Run.open(run.storage).commit_of(shard) for shard in sorted(run.committed())]
    commits = [CommitSummary(**{f: getattr(r, f) for f in CommitSummary.model_fields}) for r in records]
    ends = [EndSummary(**{f: getattr(r, f) for f in EndSummary.model_fields}) for r in run.ledger.ends()]
    files = {key: run.storage.get(key, 2**30) for key in index_files(run)}
    run.storage.delete(files)
    spending = account_for([run])
    for key, data in files.items():
        run.storage.put(key, data or b"")
    return commits, ends, spending


def assert_equal(run: Run) -> None:
    commits, ends, spending = from_records(run)
    assert list(Summaries(run).commits()) == commits
    assert list(Summaries(run).ends()) == ends
    said = account_for([run])
    assert said == spending and said.useful.unnamed_wall_s == spending.useful.unnamed_wall_s


class History:
    """Things that happen to a run, by name."""

    def __init__(self, run: Run, seed: int) -> None:
        self.run, self.rng, self.edits = run, random.Random(seed), 0

    def rewrite(self, key: str, data: bytes) -> None:
        """Change a file behind the program's back, in place, as an editor may."""
        path = Path(self.run.storage.url, key)
        path.write_bytes(data)
        self.edits += 1
        at = 1_900_000_000 + self.edits  # as if at another time: the clock of a file system has coarse ticks
        os.utime(path, (at, at))

    def commits(self) -> None:
        for shard in self.rng.sample(range(SHARDS), 3):
            made = commit(self.run, self.rng, shard)
            won = self.run.commit(made)
            entry = end(self.rng, made.attempt, shard)
            self.run.ledger.end(entry.model_copy(update={"outcome": "committed"}) if won else entry)

    def fails(self) -> None:
        for _ in range(3):
            name = f"a{self.rng.randrange(10**9)}"
            self.run.ledger.start(name, 1)
            if self.rng.random() < 0.8:
                self.run.ledger.end(end(self.rng, name, 1))

    def refreshes(self) -> None:
        refresh(self.run)

    def changes_a_commit(self) -> None:
        for shard in sorted(self.run.committed())[:2]:
            changed = commit(self.run, self.rng, shard)
            self.rewrite(commit_key(shard), encode_record(changed))

    def changes_an_end(self) -> None:
        for entry in list(self.run.ledger.ends())[:2]:
            changed = end(self.rng, entry.attempt, entry.shard)
            self.rewrite(f"ledger/{entry.attempt}.json", encode_record(changed))

    def loses_records(self) -> None:
        keys = [f.key for folder in ("commits", "ledger") for f in self.run.storage.list(folder)]
        self.run.storage.delete(self.rng.sample(sorted(keys), min(2, len(keys))))

    def damages_the_index(self) -> None:
        for key in index_files(self.run)[:1]:
            data = bytearray(self.run.storage.get(key, 2**30) or b"")
            data[self.rng.randrange(len(data))] ^= 1 << self.rng.randrange(8)
            self.rewrite(key, bytes(data[: self.rng.choice([None, len(data) // 2])]))

    def loses_the_index(self) -> None:
        self.run.storage.delete(index_files(self.run)[: self.rng.choice([1, 9])])


HAPPENS = sorted(name for name, member in vars(History).items() if name[0] != "_" and name != "rewrite")


@settings(max_examples=25, deadline=None)
@given(st.lists(st.sampled_from(HAPPENS), max_size=8), st.integers(0, 2**32), st.sampled_from([4, 16_384]))
def test_answers_are_those_of_the_records(words: list[str], seed: int, rows: int) -> None:
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(datagen.schemas.summaries, "ROWS_PER_FILE", rows)
        run = bare_run(Path(folder))
        history = History(run, seed)
        history.commits()
        history.refreshes()
        for word in words:
            getattr(history, word)()
            assert_equal(run)
        refresh(run)
        assert_equal(run)
        records = len(run.committed()) + sum(1 for _ in run.ledger.ends())
        assert len(index_files(run)) <= 2 + 2 * records // rows + 2  # halves at most, and a rest of each kind
        assert refresh(run) == 0


def indexed(folder: Path) -> Run:
    run = bare_run(folder)
    History(run, 1).commits()
    History(run, 2).fails()
    refresh(run)
    return run


def test_what_the_index_holds_is_not_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = indexed(tmp_path)
    read: list[str] = []
    get: Callable[..., object] = run.storage.get
    monkeypatch.setattr(run.storage, "get", lambda key, limit: get(read.append(key) or key, limit))
    assert len(list(Summaries(run).commits())) == 3
    list(Summaries(run).ends())
    monkeypatch.undo()
    long = [e.attempt for e in run.ledger.ends() if len(e.cause) > 1000]
    assert [key for key in read if "commits/" in key] == []
    assert long and {key for key in read if "ledger/" in key} == {f"ledger/{name}.json" for name in long}


def test_a_damaged_record_is_refused_as_without_an_index(tmp_path: Path) -> None:
    run = indexed(tmp_path)
    shard = min(run.committed())
    path = tmp_path / commit_key(shard)
    path.write_bytes(path.read_bytes().replace(b'"samples": 10', b'"samples": 11'))
    with pytest.raises(InputError, match="damaged or was edited"):
        list(Summaries(run).commits())
    refresh(run)  # leaves it out
    with pytest.raises(InputError, match="damaged or was edited"):
        list(Summaries(run).commits())


def put_signed(run: Run, key: str, body: bytes) -> None:
    """A file of the index with this body under a sha256 that is right."""
    run.storage.put(key, gzip.compress(sha256(body).hexdigest().encode() + b"\n" + body))


def body_of(run: Run) -> bytes:
    (key,) = index_files(run)
    return gzip.decompress(run.storage.get(key, 2**30) or b"").partition(b"\n")[2]


def test_an_index_of_another_run_does_not_count(tmp_path: Path) -> None:
    ours, theirs = indexed(tmp_path / "a"), indexed(tmp_path / "b")
    whole, other = body_of(ours).replace(b'"positives":', b'"positives":1'), b"7" * 64
    foreign = whole.replace(ours.manifest.spec_hash.encode(), other)
    assert b'"positives":1' in whole and other in foreign
    theirs.storage.put("index/1.json.gz", gzip.compress(b"7" * 64 + b"\n" + whole))
    put_signed(theirs, "index/2.json.gz", foreign)
    assert_equal(theirs)
    assert set(unreadable_files(theirs)) == {"index/1.json.gz", "index/2.json.gz"}
    refresh(theirs)
    assert_equal(theirs)
    assert unreadable_files(theirs) == []


@pytest.mark.parametrize(
    "damage", ["swapped", "another shard", "of another size", "negative", "not JSON", ""]
)
def test_a_row_that_is_not_of_its_record_does_not_count(damage: str, tmp_path: Path) -> None:
    run = indexed(tmp_path)
    (key,) = index_files(run)
    rows = [line.split("\t") for line in body_of(run).decode().split("\n")]
    first, second = [row for row in rows if row[0].startswith("commits/")][:2]
    end = next(row for row in rows if row[0].startswith("ledger/"))
    one = json.loads(first[2])
    texts = {
        "swapped": second[2],
        "another shard": json.dumps(one | {"shard": 77}),
        "of another size": json.dumps(one | {"samples": one["samples"] + 1}),
        "negative": json.dumps(one | {"positives": -1}),
        "not JSON": "[" * 1000,
        "": "",
    }
    first[2], end[2] = texts[damage], json.dumps(json.loads(end[2]) | {"attempt": "another"})
    put_signed(run, key, "\n".join("\t".join(row) for row in rows).encode())
    assert unreadable_files(run) == []
    assert_equal(run)


@pytest.mark.parametrize("rest", [b"\n" * 10**6, b"\na\tb", b"\n\xff\t\t", b"\t\t\t\n"])
def test_a_signed_file_without_rows_holds_nothing(rest: bytes, tmp_path: Path) -> None:
    run = indexed(tmp_path)
    put_signed(run, "index/1.json.gz", body_of(run).partition(b"\n")[0] + rest)
    assert unreadable_files(run) == ["index/1.json.gz"]
    assert_equal(run)


def test_an_index_of_the_former_format_is_replaced(tmp_path: Path) -> None:
    run = indexed(tmp_path)
    run.storage.delete(index_files(run))
    former = {
        "format_version": 2, "spec_hash": run.manifest.spec_hash, "kind": "ends", "names": ["a"],
        "stamps": ["s"], "texts": {"attempt": {"words": ["a"], "rows": [0]}}, "numbers": {"shard": [0.0]},
    }  # fmt: skip
    run.storage.put("index/1.json.gz", gzip.compress(signed_json(former)))
    assert_equal(run)
    assert unreadable_files(run) == ["index/1.json.gz"] and refresh(run) > 0
    assert len(index_files(run)) == 1 and unreadable_files(run) == []
    assert_equal(run)


def test_drivers_that_write_the_index_at_once_leave_a_whole_one(tmp_path: Path) -> None:
    run = bare_run(tmp_path)
    together = threading.Barrier(4, timeout=600)  # where one fails, the others do not wait for it

    def drive(seed: int) -> None:
        own, history = Run.open(run.storage), History(run, seed)
        for _ in range(3):
            together.wait()
            history.commits()
            history.fails()
            refresh(own)

    with ThreadPoolExecutor(4) as threads:
        list(threads.map(drive, range(4)))
    assert_equal(run)
    refresh(run)
    assert_equal(run)
    assert len(index_files(run)) == 1 and refresh(run) == 0


def test_an_index_that_unpacks_to_terabytes_is_not_unpacked(tmp_path: Path) -> None:
    run = indexed(tmp_path)
    bomb = gzip.compress(bytes(2**27 + 1), 1)
    run.storage.put("index/7.json.gz", bomb)
    assert_equal(run)
    assert refresh(run) >= 0 and "index/7.json.gz" not in index_files(run)
