"""`datagen verify`: exit codes, table and JSON; repair, replay and clean on real runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen import cli
from datagen.schemas.jobs import JobRecord, Jobs, new_job_id
from datagen.schemas.record_files import utc_now
from datagen.schemas.run import Run
from tests.datagen.forged import forge
from tests.made_runs import object_of
from tests.refusals import refused
from tests.small_runs import HERE, PER_SCENE, arrays_of, assert_equal_runs, files_of


def verified(run: Path, capture: pytest.CaptureFixture[str], code: int, *more: str) -> dict[str, Any]:
    """The report of verify, with the exit code that it must have."""
    capture.readouterr()
    assert cli.run(["verify", str(run), "--json", *more]) == code
    return json.loads(capture.readouterr().out)


def truncate(file: Path) -> None:
    file.chmod(0o644)
    file.write_bytes(file.read_bytes()[:-1])


def test_a_finished_run_is_clean_and_its_scenes_are_made_again(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = files_of(finished)
    report = verified(finished, capsys, 0, "--replay", "9")
    assert (report["clean"], report["findings"], report["sealed"]) == (True, [], True)
    assert report["shards_of_other_code"] == 0
    assert report["replay"] == {"asked": 9, "scenes": 3, "done": True}
    assert cli.run(["verify", str(finished), "--replay", "9"]) == 0
    assert "3 scenes made again" in capsys.readouterr().out  # the run has no more
    assert report["samples"] == 3 * PER_SCENE
    ledger = report["ledger"]
    assert ledger["wall_s"] == ledger["commits_wall_s"] + ledger["waste_wall_s"] > 0
    assert files_of(finished) == before
    assert cli.run(["verify", str(finished)]) == 0
    assert "clean" in capsys.readouterr().out


def test_a_run_resumed_by_newer_code_of_the_same_versions_is_sound_and_says_so(
    copied: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    newer = "7" * 64
    monkeypatch.setattr("datagen.cluster.attempt.code_digest", lambda: newer)
    monkeypatch.setattr("datagen.cluster.attempt.refuse_other_code", lambda driver: None)  # the driver's too
    made = len(Run.open(copied).committed())
    assert cli.run(["resume", str(copied), "--n", str(4 * PER_SCENE), *HERE]) == 0
    report = verified(copied, capsys, 0)
    added = len(Run.open(copied).committed()) - made
    assert added > 0 and report["shards_of_other_code"] == added
    assert cli.run(["verify", str(copied)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"{added} shard" in said and "made by other code than began the run" in said


def test_damaged_shards_are_set_aside_and_made_again(
    finished: Path, copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (copied / "plans/1.json").unlink()
    rows = object_of(copied, 0)
    truncate(rows)
    report = verified(copied, capsys, 1, "--replay", "1")
    assert report["counts"] == {"file": 1, "record": 1} and not report["replay"]["done"]
    assert [f["file"] for f in report["findings"]] == ["plans/1.json", str(rows.relative_to(copied))]
    assert all(f["repairable"] for f in report["findings"])
    assert cli.run(["verify", str(copied)]) == 1
    told = capsys.readouterr().out
    for word in ("2 findings", "plans/1.json", "missing", "datagen verify --repair"):
        assert word in told
    report = verified(copied, capsys, 1, "--repair", "--clean")
    done, (left,) = report["repaired"], report["findings"]
    assert (done["restored"], done["set_aside"]) == (["plans/1.json"], ["commits/000000.json"])
    assert left["kind"] == "lost" and "datagen resume" in left["fix"]
    assert (copied / done["into"] / rows.relative_to(copied)).exists()
    assert cli.run(["resume", str(copied), *HERE]) == 0
    assert verified(copied, capsys, 0, "--replay", "3")["clean"]
    assert_equal_runs(arrays_of(copied), arrays_of(finished))


def test_a_merged_run_is_repaired_and_resumed(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "merged"
    assert cli.run(["merge", str(finished), "--out", str(out)]) == 0
    whole = arrays_of(out)
    object_of(out, 1).unlink()
    assert verified(out, capsys, 1, "--repair")["repaired"]["set_aside"] == ["commits/000001.json"]
    assert cli.run(["resume", str(out), *HERE]) == 0
    assert_equal_runs(arrays_of(out), whole)
    assert verified(out, capsys, 0)["clean"]


def test_replay_finds_rows_that_do_not_follow_from_the_specification(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def change(arrays: dict[str, np.ndarray[Any, Any]]) -> None:
        arrays["visibility"][:] = 1 - arrays["visibility"]
        arrays["settle_steps"] += 1

    run = forge(finished, tmp_path / "run", 1, change)
    run.ledger.start("forged", 1)
    assert verified(tmp_path / "run", capsys, 0, "--repair")["clean"]
    report = verified(tmp_path / "run", capsys, 1, "--replay", "3")
    (finding,) = report["findings"]
    assert (finding["kind"], finding["shard"], finding["repairable"]) == ("replay", 1, False)
    assert finding["file"] == "shards/forged.zip"
    assert "settle_steps: 1 differ, by up to 1" in finding["problem"] and "visibility: " in finding["problem"]


def test_a_run_that_labelled_other_scenes_is_replayed_with_and_without_them(
    copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "again"
    assert cli.run(["relabel", str(copied), "--out", str(out), "--mu", "0.5"]) == 0
    assert verified(out, capsys, 0, "--replay", "2")["replay"]["done"]
    copied.rename(tmp_path / "elsewhere")
    assert verified(out, capsys, 0, "--replay", "2")["replay"]["done"]


@pytest.mark.parametrize("option", ["--repair", "--clean"])
def test_a_run_with_a_living_job_is_not_changed(
    option: str, copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = JobRecord(id=new_job_id(), command=(), host="h", pid=1, started=utc_now(), address="local")
    Jobs(Run.open(copied).storage).begin(record)
    refused(["verify", str(copied), option], capsys, "is running", "datagen cancel")


@pytest.mark.parametrize(
    ("more", "word"),
    [
        (["--replay", "-1"], "--replay"),
        (["--replay", "many"], "--replay"),
        (["--replay", "1", "--houses", "builtin:3"], "--houses"),
    ],
)
def test_bad_options(more: list[str], word: str, finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = files_of(finished)
    refused(["verify", str(finished), *more], capsys, word)
    assert files_of(finished) == before
