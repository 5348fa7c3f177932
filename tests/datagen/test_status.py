"""`datagen status`, with and without --log, of runs with many failures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from datagen import cli
from datagen.schemas.quarantine import lift_quarantine
from datagen.schemas.run import Run
from datagen.schemas.run_records import LedgerEntry, Outcome
from datagen.schemas.sealing import seal
from tests.made_runs import attempt, give_up, make_run
from tests.small_runs import json_of

SEGFAULT = "Fatal Python error: Segmentation fault"
STACK = "Current thread (most recent call first):\n  File settle.py, line 3 in settle"


def at(minute: int) -> str:
    return f"2026-01-01T00:{minute:02d}:00.000+00:00"


def end(run: Run, shard: int, minute: int, outcome: Outcome, cause: str, stack: str = "") -> str:
    attempt = f"{shard:06d}-aaaaaaaa-{minute:06d}"
    run.ledger.end(
        LedgerEntry(
            attempt=attempt, shard=shard, outcome=outcome, cause=cause, stack=stack,
            started=at(minute), ended=at(minute + 1),
        )
    )  # fmt: skip
    return attempt


@pytest.fixture(scope="module")
def troubled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Shard 1 crashed twice and was given up; shard 3 was lost and ran out of memory; others are fine."""
    run = make_run(tmp_path_factory.mktemp("troubled") / "run", n=50, shards=[0, 2, 4])
    causes = (f"crashed: {SEGFAULT}", "failed: ValueError: no rays")
    attempts = (end(run, 1, 2, "crashed", SEGFAULT, STACK), end(run, 1, 6, "failed", "ValueError: no rays"))
    end(run, 3, 4, "lost", "node died")
    end(run, 3, 8, "out_of_memory", "MemoryError")
    give_up(run, 1, *causes, attempts=attempts, stack=STACK, at=at(9))
    return Path(run.storage.url)


def lines_of(capture: pytest.CaptureFixture[str], *arguments: str) -> list[Any]:
    capture.readouterr()
    assert cli.run(["status", *arguments, "--log", "--json"]) == 0
    return json.loads(capture.readouterr().out)["events"]


def test_log_lists_failures_and_retries_in_order_of_time(
    troubled: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    events = lines_of(capsys, str(troubled))
    assert [(e["event"], e["shard"]) for e in events] == [
        ("attempt_begins", 1),
        ("attempt_crashed", 1),
        ("attempt_begins", 3),
        ("attempt_lost", 3),
        ("attempt_begins", 1),  # the retry
        ("attempt_failed", 1),
        ("attempt_begins", 3),
        ("attempt_out_of_memory", 3),
        ("quarantined", 1),
    ]
    assert [e["at"] for e in events] == sorted(e["at"] for e in events)
    assert "Segmentation fault" in events[1]["text"] and "stack" not in events[1]


def test_an_attempt_that_no_worker_began_has_no_begin(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run(tmp_path / "run", n=20, shards=[0])
    run.ledger.end(
        LedgerEntry(
            attempt="000001-aaaaaaaa-000002", shard=1, outcome="cancelled", cause="the job was stopped",
            started="", ended=at(3),
        )
    )  # fmt: skip
    (event,) = lines_of(capsys, run.storage.url)
    assert event["event"] == "attempt_cancelled" and event["at"] == at(3)


def test_log_has_stacks_when_asked(troubled: Path, capsys: pytest.CaptureFixture[str]) -> None:
    events = lines_of(capsys, str(troubled), "--stacks")
    assert [e["event"] for e in events if "stack" in e] == ["attempt_crashed"]
    assert cli.run(["status", str(troubled), "--log", "--stacks"]) == 0
    told = capsys.readouterr().out
    assert "    Current thread" in told and "2026-01-01 00:03:00.000  shard 1 crashed" in told


def test_status_lists_failures_stacks_and_quarantine(
    troubled: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = json_of(capsys, ["status", str(troubled), "--stacks"])
    assert report["quarantine"] == [{"shard": 1, "attempts": 2, "cause": "failed: ValueError: no rays"}]
    assert report["stacks"] == {f"crashed: {SEGFAULT}": STACK}
    assert report["shards"] == {"planned": 5, "committed": 3, "quarantined": [1], "missing": 1}
    assert cli.run(["status", str(troubled), "--stacks"]) == 0
    told = capsys.readouterr().out
    for words in ("lost 1", "line 3 in settle", "no rays", f"datagen resume {troubled} --quarantined"):
        assert words in told


def test_log_of_a_run_without_events_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = make_run(tmp_path / "run", n=20, shards=[0])
    assert cli.run(["status", run.storage.url, "--log"]) == 0
    told = capsys.readouterr()
    assert told.out == "" and "no attempt has failed" in told.err and len(told.err.splitlines()) == 1


def test_a_lifted_quarantine_stays_in_the_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = make_run(tmp_path / "run", n=20, shards=[0])
    give_up(run, 1, "x", "y", attempts=("a", "b"), at=at(1))
    assert lift_quarantine(run) == [1]
    (event,) = lines_of(capsys, run.storage.url)
    assert event["event"] == "quarantined" and "tried again later" in event["text"]


def test_status_names_what_seals_a_store_that_is_out_of_date(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run(tmp_path / "run", n=20)
    seal(run.storage)
    run.grow(40)
    for shards, verb in (((), "resume"), (run.missing(), "verify --repair")):
        for shard in shards:
            assert attempt(run, shard, f"later-{shard}")
        assert cli.run(["status", run.storage.url]) == 0
        assert f"`datagen {verb}` seals it" in capsys.readouterr().out
