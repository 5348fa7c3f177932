"""`datagen gc`: what nothing names goes; what is committed, young or at work stays, whatever races."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen import cli
from datagen.reports.spending import account_for
from datagen.schemas.errors import InputError
from datagen.schemas.garbage_collection import find_garbage, sweep
from datagen.schemas.jobs import JobRecord, Jobs, new_job_id
from datagen.schemas.keys import REMOVING, commit_copy_key, commit_key, shard_folder
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.record_files import utc_now
from datagen.schemas.run import Run
from datagen.schemas.sealing import seal
from datagen.schemas.storage import Storage, StoredFile, open_storage
from datagen.schemas.summaries import index_files, refresh
from tests.made_runs import attempt, check_digests, files_of, make_run, small_spec, write
from tests.refusals import refused
from tests.small_runs import json_of

DAY_S = 86400


def littered(folder: Path) -> tuple[Run, set[str]]:
    """A run of five shards, three of them committed, with every kind of garbage; keys of the garbage."""
    run = make_run(folder, n=50, shards=[0, 1, 2])
    attempt(run, 1, "late")  # superseded
    write(run, 3, "never-committed")
    run.ledger.start("never-committed", 3)
    seal(run.storage)
    refresh(run)
    keys = {
        f"commits/000007.json.{'a' * 16}.part",
        f"{shard_folder(0, 'a-0')}/zarr.json.{'b' * 16}.part",
        f"{shard_folder(2, 'a-2')}/{REMOVING}",
        f".probe-{'c' * 16}",
        f"data.zarr.{'d' * 16}.partial/label/c.0",
        "index/9.json.gz",
    }
    for key in keys:
        run.storage.put(key, b"left behind")
    litter = [f.key for folder in (shard_folder(1, "late"), shard_folder(3, "never-committed"))
              for f in run.storage.list(folder)]  # fmt: skip
    return run, keys | set(litter)


def age(run: Run, keys: Iterator[str] | set[str] | list[str], seconds: float) -> None:
    at = time.time() - seconds
    for key in keys:
        os.utime(Path(run.storage.url, key), (at, at))


def age_all(run: Run, seconds: float) -> None:
    age(run, [file.key for file in run.storage.list("")], seconds)


def kept_of(folder: Path, garbage: set[str]) -> dict[str, bytes]:
    return {key: data for key, data in files_of(folder).items() if key not in garbage and key[:6] != "index/"}


def test_garbage_goes_and_everything_else_keeps_its_bytes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, garbage = littered(tmp_path / "run")
    age_all(run, 2 * DAY_S)
    before = kept_of(tmp_path / "run", garbage)
    told = json_of(capsys, ["gc", run.storage.url, "--dry-run"])
    assert set(files_of(tmp_path / "run")) >= garbage
    done = json_of(capsys, ["gc", run.storage.url])
    assert told["found"] == done["found"] and done["removed"]["files"] == len(garbage)
    assert {kind: found["pieces"] for kind, found in done["found"].items()} == {
        "attempts": 2, "drafts": 4, "probes": 1, "index": 1,
    }  # fmt: skip
    assert kept_of(tmp_path / "run", set()) == before
    assert not (tmp_path / "run" / shard_folder(1, "late")).exists()
    assert not list((tmp_path / "run").glob("data.zarr.*"))
    check_digests(run, run.commit_of(0))
    assert len(list(run.ledger.ends())) == 4  # the ledger keeps them all
    again = json_of(capsys, ["gc", run.storage.url])
    assert again["removed"] == {"files": 0, "bytes": 0}
    assert cli.run(["gc", run.storage.url]) == 0 and "removed from" in capsys.readouterr().out


def test_what_is_young_stays(tmp_path: Path) -> None:
    run, _ = littered(tmp_path)
    age_all(run, 2 * DAY_S)
    newest = f"{shard_folder(1, 'late')}/zarr.json"
    age(run, [newest, "ledger/never-committed.start.json"], 60)
    found = {piece.key for piece in find_garbage(run.storage, DAY_S, time.time())}
    assert shard_folder(1, "late") not in found and shard_folder(3, "never-committed") not in found
    assert f".probe-{'c' * 16}" in found and len(found) == 6
    assert len(find_garbage(run.storage, 30, time.time())) == 8
    assert find_garbage(run.storage, 3 * DAY_S, time.time()) == []


def test_what_began_under_a_job_that_is_at_work_stays(tmp_path: Path) -> None:
    run, _ = littered(tmp_path)
    age_all(run, 60)
    jobs = Jobs(run.storage)
    jobs.begin(JobRecord(id=new_job_id(), command=(), host="h", pid=1, started=utc_now(), address="local"))
    write(run, 4, "at-work")
    found = {piece.key for piece in find_garbage(run.storage, 0, time.time())}
    assert shard_folder(4, "at-work") not in found and shard_folder(1, "late") in found


def test_a_silent_job_of_another_machine_may_still_be_at_work(tmp_path: Path) -> None:
    run, _ = littered(tmp_path)
    began = (datetime.now(UTC) - timedelta(hours=1)).isoformat()
    record = JobRecord(id=new_job_id(), command=(), host="elsewhere", pid=1, started=began, address="local")
    Jobs(run.storage).begin(record)
    assert find_garbage(run.storage, -1, time.time()) == []


def test_a_claim_to_a_lost_commit_record_stays(tmp_path: Path) -> None:
    run = make_run(tmp_path, n=50, shards=[0, 1])
    run.storage.delete([commit_key(1)])
    damaged = tmp_path / commit_key(0)
    damaged.write_bytes(b"{}")
    write(run, 0, "other")
    assert find_garbage(run.storage, -1, time.time()) == []
    assert run.storage.exists(commit_copy_key(1, "a-1"))


@pytest.mark.parametrize("step", ["sync", "put"])  # the shard's files are there, or all but its commit
def test_a_merge_that_gc_takes_files_from_says_what_to_do(
    step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, shards in (("a", [0, 1]), ("b", [1, 2])):
        make_run(tmp_path / name, 30, shards=shards)
    out, plain = tmp_path / "out", getattr(Storage, step)
    merge = ["merge", str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(out)]

    def after_gc(storage: Storage, *arguments: Any) -> None:
        monkeypatch.undo()
        place = open_storage(out, probe=False)
        for piece in find_garbage(place, 0, time.time() + DAY_S):
            sweep(piece)
        plain(storage, *arguments)

    monkeypatch.setattr(Storage, step, after_gc)
    refused(merge, capsys, str(out), "same command again", "datagen gc")
    assert cli.run(merge) == 0 and cli.run(["verify", str(out)]) == 0
    assert Run.open(out).committed() == {0, 1, 2}


def test_a_removal_that_was_cut_short_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, garbage = littered(tmp_path)
    before = kept_of(tmp_path, garbage)
    pieces = find_garbage(run.storage, -1, time.time())
    cut = Storage.delete
    calls = 0

    def dies(storage: Storage, keys: Any) -> None:
        nonlocal calls
        calls += 1
        some = list(keys)
        cut(storage, some[: len(some) // 2])
        raise KeyboardInterrupt

    for piece in pieces:
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(Storage, "delete", dies)
            sweep(piece)
    assert calls == len(pieces) == 8
    for piece in find_garbage(run.storage, -1, time.time()):
        sweep(piece)
    assert kept_of(tmp_path, set()) == before


@pytest.mark.parametrize("age", ["", "24", "-1h", "1w", "1.5h", "99999999999h"])
def test_odd_ages_are_refused(age: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_run(tmp_path, n=10)
    refused(["gc", str(tmp_path), f"--older-than={age}"], capsys, "--older-than")


def test_a_place_without_a_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / f".probe-{'c' * 16}").touch()
    refused(["gc", str(tmp_path)], capsys, "not a run")
    assert list(tmp_path.iterdir())


def test_an_index_is_repaired_on_the_way(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = make_run(tmp_path, n=50)
    assert json_of(capsys, ["gc", str(tmp_path)])["found"]["index"]["pieces"] == 0
    assert len(index_files(run)) == 1


def test_a_run_in_a_bucket_is_swept_as_on_a_disk(bucket: str, capsys: pytest.CaptureFixture[str]) -> None:
    place = f"{bucket}/run"
    run = make_run(place, n=50, shards=[0, 1, 2])  # type: ignore[arg-type]
    attempt(run, 1, "late")
    write(run, 3, "never-committed")
    run.storage.put(f"{shard_folder(2, 'a-2')}/{REMOVING}", b"")
    run.storage.put(f".probe-{'c' * 16}", b"first")
    refresh(run)
    before = sorted(f.key for f in run.storage.list("") if "late/" not in f.key and "never" not in f.key)
    assert json_of(capsys, ["gc", place])["removed"]["files"] == 0
    time.sleep(1.0)  # times in a bucket are whole seconds
    done = json_of(capsys, ["gc", place, "--older-than", "0s"])
    assert {kind: found["pieces"] for kind, found in done["found"].items()} == {
        "attempts": 2, "drafts": 1, "probes": 1, "index": 0,
    }  # fmt: skip
    kept = {f.key for f in run.storage.list("")}
    assert {key for key in before if REMOVING not in key and ".probe-" not in key} == kept
    spending = account_for([run])
    run.storage.delete(index_files(run))
    assert account_for([run]) == spending and spending.useful.attempts == 3
    for shard in range(3):
        check_digests(run, run.commit_of(shard))


def test_a_merged_place_is_swept_with_its_parts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for seed in (0, 1):
        run = make_run(tmp_path / f"run-{seed}", n=20, spec=small_spec(seed=seed))
        attempt(run, 1, "late")
    merged = tmp_path / "merged"
    assert cli.run(["merge", *(str(tmp_path / f"run-{seed}") for seed in (0, 1)), "--out", str(merged)]) == 0
    parts = open_runs(merged)
    write(parts[0], 0, "other")
    (merged / f".probe-{'c' * 16}").touch()
    before = files_of(merged)
    done = json_of(capsys, ["gc", str(merged), "--older-than", "0s"])
    assert (done["found"]["attempts"]["pieces"], done["found"]["probes"]["pieces"]) == (1, 1)
    after = files_of(merged)
    gone = {key for key in before if key not in after}
    assert all("/other/" in key or ".probe-" in key for key in gone) and len(gone) > 2
    assert {key: before[key] for key in after if key in before} == {
        k: v for k, v in after.items() if k in before
    }


class Turns:
    """Lets two threads reach the store one call at a time, in the order of a script."""

    def __init__(self, script: list[bool]) -> None:
        self.script, self.at, self.ended = script, 0, set[bool]()
        self.changed = threading.Condition()

    def whose(self) -> bool:
        turn = self.script[self.at] if self.at < len(self.script) else bool(self.at % 2)
        return (not turn) if turn in self.ended else turn

    def take(self, who: bool, do: Callable[[], Any]) -> Any:
        with self.changed:
            assert self.changed.wait_for(lambda: self.whose() == who, timeout=600)
            try:
                return do()
            finally:
                self.at += 1
                self.changed.notify_all()

    def end(self, who: bool) -> None:
        with self.changed:
            self.ended.add(who)
            self.changed.notify_all()


class Turned(Storage):
    """A storage whose calls wait for their turn; it dies at its call number `dies_at`."""

    def __init__(self, storage: Storage, turns: Turns, who: bool, dies_at: int | None = None) -> None:
        super().__init__(storage._files)
        self.turns, self.who, self.dies_at, self.calls = turns, who, dies_at, list[str]()

    def _turn(self, name: str, do: Callable[[], Any]) -> Any:
        def step() -> Any:
            if len(self.calls) == self.dies_at:
                raise KeyboardInterrupt
            self.calls.append(name)
            return do()

        return self.turns.take(self.who, step)

    def put(self, key: str, data: bytes) -> None:
        self._turn("put", lambda: super(Turned, self).put(key, data))

    def put_new(self, key: str, data: bytes) -> bool:
        return self._turn("put_new", lambda: Storage(self._files).put_new(key, data))

    def get(self, key: str, limit_bytes: int) -> bytes | None:
        return self._turn("get", lambda: super(Turned, self).get(key, limit_bytes))

    def exists(self, key: str) -> bool:
        return self._turn("exists", lambda: super(Turned, self).exists(key))

    def list(self, prefix: str) -> Iterator[StoredFile]:
        return iter(self._turn("list", lambda: [*super(Turned, self).list(prefix)]))

    def delete(self, keys: Any) -> None:
        for key in keys:  # file by file, as an interrupted one goes
            self._turn("delete", lambda key=key: super(Turned, self).delete([key]))


@settings(max_examples=150, deadline=None)
@given(st.lists(st.booleans(), max_size=120), st.sampled_from([None, None, *range(6)]))
def test_a_commit_that_stands_has_its_files(script: list[bool], dies_at: int | None) -> None:
    """gc races with the very attempt that it removes, call by call; the attempt may die at any of them."""
    storage, commit = RACED
    for key in [f.key for f in storage.list("shards")] + [commit_key(3)]:
        storage.delete([key])
    for key, data in FILES.items():
        storage.put(key, data)
    turns = Turns(script)
    theirs = Turned(storage, turns, True, dies_at)
    piece = next(p for p in find_garbage(storage, -1, time.time()) if p.kind == "attempts")
    ours = Turned(storage, turns, False)
    answers: dict[str, Any] = {"commit": None}

    def commits() -> None:
        run = Run(theirs, Run.open(storage).manifest)
        try:
            answers["commit"] = run.commit(commit)
        except (InputError, KeyboardInterrupt) as error:
            answers["commit"] = error
        finally:
            turns.end(True)

    def collects() -> None:
        try:
            answers["swept"] = sweep(type(piece)(**{**vars(piece), "storage": ours}))
        finally:
            turns.end(False)

    threads = [threading.Thread(target=commits), threading.Thread(target=collects)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(600)
    run, swept = Run.open(storage), answers["swept"]
    died_after_its_put = isinstance(answers["commit"], KeyboardInterrupt) and "put_new" in theirs.calls
    if run.committed() == {3}:
        if died_after_its_put and not swept.spared:
            assert dies_at is not None  # the one case that only `repair` repairs
        else:
            run.check_files(run.commit_of(3))
            assert swept.spared == 1
    else:
        assert answers["commit"] is not True
    assert REMOVING not in {f.key.rsplit("/", 1)[-1] for f in storage.list("shards")}
    if answers["commit"] is True:
        assert run.committed() == {3} and swept.files == 0 and swept.damaged == ()


@pytest.fixture(autouse=True, scope="module")
def _raced(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    global RACED, FILES
    folder = tmp_path_factory.mktemp("raced")
    run = make_run(folder, n=50, shards=())
    run.ledger.start("raced", 3)
    made = write(run, 3, "raced")
    kept = made.files[:3]  # enough to be half removed
    RACED = (open_storage(folder), made.model_copy(update={"files": kept}))
    FILES = {f"{shard_folder(3, 'raced')}/{e.path}": (folder / shard_folder(3, "raced") / e.path).read_bytes()
             for e in kept}  # fmt: skip
    yield


RACED: tuple[Storage, Any]
FILES: dict[str, bytes]
