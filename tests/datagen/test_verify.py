"""`datagen verify` as a user meets it: exit codes, the table, JSON, and rows computed again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen import cli
from datagen.schemas.run import Run
from datagen.schemas.run_records import LedgerEntry
from tests.datagen.forged import forge
from tests.refusals import refused
from tests.small_runs import PER_SCENE, files_of


def verified(run: Path, capture: pytest.CaptureFixture[str], code: int, *more: str) -> dict[str, Any]:
    """What verify says, with the exit code that it must have."""
    capture.readouterr()
    assert cli.run(["verify", str(run), "--json", *more]) == code
    return json.loads(capture.readouterr().out)


def test_a_finished_run_is_clean_also_when_its_rows_are_computed_again(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = files_of(finished)
    report = verified(finished, capsys, 0, "--deep", "3", "--seed", "5")
    assert (report["clean"], report["findings"], report["sealed"]) == (True, [], True)
    assert report["deep"] == {"asked": 3, "done": True, "seed": 5}
    assert report["samples"] == 3 * PER_SCENE
    assert report["files"] == sum(len(c.files) for c in Run.open(finished).commits())
    ledger = report["ledger"]
    assert ledger["wall_s"] == ledger["commits_wall_s"] + ledger["waste_wall_s"] > 0
    assert files_of(finished) == before
    assert cli.run(["verify", str(finished)]) == 0
    assert "clean" in capsys.readouterr().out


def test_findings_are_told_with_file_problem_and_fix(
    copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (copied / "plans/1.json").unlink()
    chunk = next((copied / "shards/000000").glob("*/rgb/c.0.0.0"))
    chunk.chmod(0o644)
    chunk.write_bytes(chunk.read_bytes()[:-1])
    report = verified(copied, capsys, 1, "--deep", "1")
    assert report["counts"] == {"file": 1, "record": 1} and not report["deep"]["done"]
    assert [f["file"] for f in report["findings"]] == ["plans/1.json", str(chunk.relative_to(copied))]
    assert all(f["repairable"] for f in report["findings"])
    assert cli.run(["verify", str(copied)]) == 1
    told = capsys.readouterr().out
    for word in ("2 findings", "plans/1.json", "missing", "datagen repair"):
        assert word in told


def test_rows_that_were_forged_are_found_by_computing_them_again(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def change(arrays: dict[str, np.ndarray[Any, Any]]) -> None:
        arrays["visibility"][:] = 1 - arrays["visibility"]

    run = forge(finished, tmp_path / "run", 1, change)
    run.ledger.start("forged", 1)
    run.ledger.end(LedgerEntry(attempt="forged", shard=1, outcome="committed", cost=run.commit_of(1).cost))
    assert cli.run(["seal", str(tmp_path / "run")]) == 0
    assert verified(tmp_path / "run", capsys, 0)["clean"]
    report = verified(tmp_path / "run", capsys, 1, "--deep", "12", "--seed", "1")
    assert set(report["counts"]) == {"deep"}
    assert all(f["shard"] == 1 and not f["repairable"] for f in report["findings"])
    assert all(f["file"].startswith("shards/000001/forged") for f in report["findings"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["{out}"], ["no such folder"]),
        (["{empty}"], ["not a run"]),
        (["{file}"], ["not a folder"]),
        (["{foreign}"], ["not a run"]),
        (["{run}", "--deep", "-1"], ["--deep"]),
        (["{run}", "--deep", "many"], ["--deep"]),
        (["{run}", "--deep", "1", "--houses", "builtin:3"], ["--houses"]),
    ],
)
@pytest.mark.parametrize("verb", ["verify", "repair"])
def test_bad_input(
    verb: str,
    arguments: list[str],
    words: list[str],
    finished: Path,
    places: dict[str, Path],
    capsys: pytest.CaptureFixture[str],
) -> None:
    if verb == "repair" and "--deep" in arguments:
        arguments, words = [arguments[0], "--workers", "-1"], ["--workers"]
    before = files_of(finished)
    refused([verb, *(a.format(run=finished, **places) for a in arguments)], capsys, *words)
    assert files_of(finished) == before and not places["out"].exists()
