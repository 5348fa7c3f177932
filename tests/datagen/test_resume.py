"""`datagen resume`: what is missing is made, from the sources that the run names, and nothing twice."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import datagen.commands.submit
import datagen.jobs.start_job
from datagen import cli
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.quarantine import lifted_records
from datagen.schemas.record_files import encode_record
from datagen.schemas.run import Run
from datagen.schemas.run_records import Manifest, QuarantineRecord
from tests.refusals import refused
from tests.small_runs import (
    HERE,
    PER_SCENE,
    arrays_of,
    assert_equal_runs,
    files_of,
    json_of,
    make_small_run,
    submit_arguments,
)

N = 8 * PER_SCENE  # one scene a shard


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight shards. Tests only read it."""
    return make_small_run(tmp_path_factory.mktemp("finished") / "run", N)


def lose(run: Path, *shards: int) -> None:
    """As if these shards had never been made."""
    for shard in shards:
        (run / f"commits/{shard:06d}.json").unlink()
        shutil.rmtree(run / f"shards/{shard:06d}")
        for file in run.glob(f"ledger/{shard:06d}-*"):
            file.unlink()


def give_up(run: Path, *shards: int) -> None:
    for shard in shards:
        Run.open(run).quarantine(
            QuarantineRecord(
                shard=shard, seed=0, first_scene=shard, scenes=1, attempts=("a",), stacks=("",),
                causes=("failed: no luck",), created="2026-01-01T00:00:00.000+00:00",
            )
        )  # fmt: skip


def test_what_is_missing_is_made_and_what_is_there_stays(finished: Path, copied: Path) -> None:
    lose(copied, 1, 6)
    before = files_of(copied, "shards", "commits", "plans")
    assert cli.run(["resume", str(copied), *HERE]) == 0
    assert before.items() <= files_of(copied, "shards", "commits", "plans").items()
    assert_equal_runs(arrays_of(copied), arrays_of(finished))
    assert cli.run(["resume", str(copied), *HERE]) == 0  # and again does nothing


def test_merged_runs_are_resumed_part_by_part(finished: Path, copied: Path, tmp_path: Path) -> None:
    lose(copied, 3)
    whole, other = make_small_run(tmp_path / "whole", 2 * PER_SCENE, "--seed", "7"), tmp_path / "other"
    shutil.copytree(whole, other)
    lose(other, 0)
    place = tmp_path / "merged"
    assert cli.run(["merge", str(copied), str(other), "--out", str(place)]) == 0
    assert [list(run.missing()) for run in open_runs(place)] != [[], []]
    assert cli.run(["resume", str(place), *HERE]) == 0
    assert [list(run.missing()) for run in open_runs(place)] == [[], []]
    assert cli.run(["merge", str(finished), str(whole), "--out", str(tmp_path / "again")]) == 0
    assert_equal_runs(arrays_of(place), arrays_of(tmp_path / "again"))


@pytest.mark.parametrize(("option", "other"), [("--houses", "builtin:30"), ("--objects", "ycb:/nowhere")])
def test_other_sources_are_refused(
    copied: Path, option: str, other: str, capsys: pytest.CaptureFixture[str]
) -> None:
    lose(copied, 2)
    before = files_of(copied)
    refused(["resume", str(copied), option, other, *HERE], capsys, other.partition(":")[2])
    refused(["resume", str(copied), "--scenes-from", str(copied), *HERE], capsys, "has its own scenes")
    assert files_of(copied) == before


def test_another_engine_than_the_run_was_made_with_is_refused(
    copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lose(copied, 2)
    manifest = Run.open(copied).manifest
    spec = manifest.spec.model_copy(update={"engines": manifest.spec.engines | {"numpy": "1.0"}})
    odd = manifest.model_copy(update={"spec": spec, "spec_hash": spec.hash()})
    (copied / "manifest.json").write_bytes(encode_record(Manifest.model_validate(odd.model_dump())))
    refused(["resume", str(copied), *HERE], capsys, "engines", "numpy: the run has 1.0, this machine")


def test_shards_that_were_given_up_are_tried_again_only_when_asked(
    finished: Path, copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lose(copied, 2, 5)
    give_up(copied, 2, 5)
    assert cli.run(["resume", str(copied), *HERE]) == 1
    told = capsys.readouterr()
    assert "2 shards (2, 5)" in told.out and "no luck" in told.err
    (line,) = [line for line in told.out.splitlines() if line.startswith("quarantined")]
    assert f"datagen resume {copied} --quarantined" in " ".join(told.out.split()), line
    assert cli.run(["resume", str(copied), "--quarantined", *HERE]) == 0
    run = Run.open(copied)
    assert run.quarantined() == set() and [r.shard for r in lifted_records(run)] == [2, 5]
    assert_equal_runs(arrays_of(copied), arrays_of(finished))
    report = json_of(capsys, ["status", str(copied)])
    assert report["taken_out_of_quarantine"] == 2 and report["quarantine"] == []
    assert cli.run(["verify", str(copied)]) == 0  # the history is no finding


def test_the_share_of_the_whole_run_decides_the_exit_code(copied: Path) -> None:
    lose(copied, 2, 5, 7)
    give_up(copied, 2, 5)
    assert cli.run(["resume", str(copied), "--max-quarantined", "0.2", *HERE]) == 1
    assert cli.run(["resume", str(copied), "--max-quarantined", "0.25", *HERE]) == 0


@pytest.mark.parametrize("share", ["-0.1", "1.5", "nan", "all"])
def test_what_is_no_share_is_refused(finished: Path, share: str, capsys: pytest.CaptureFixture[str]) -> None:
    refused(["resume", str(finished), f"--max-quarantined={share}"], capsys, "quarantined")


def interrupting(*arguments: object) -> None:
    raise KeyboardInterrupt


def the_command(capture: pytest.CaptureFixture[str], call: Callable[[], int]) -> list[str]:
    """The command that an interrupted one says to go on with."""
    capture.readouterr()
    assert call() == 130
    (line,) = [x for x in capture.readouterr().err.splitlines() if x.strip().startswith("datagen ")]
    return shlex.split(line)[1:]


def test_an_early_ctrl_c_says_how_to_go_on(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    with monkeypatch.context() as patched:  # while the first scene is drawn
        patched.setattr(datagen.commands.submit, "generate_scene", interrupting)
        again = the_command(capsys, lambda: cli.run(submit_arguments(run, N)))
    assert again[:2] == ["submit", "heuristic"] and not run.exists()
    with monkeypatch.context() as patched:  # while workers start: the run is there
        patched.setattr("datagen.jobs.job.InProcessExecutor", interrupting)
        assert the_command(capsys, lambda: cli.run(again))[:2] == ["resume", str(run)]
    with monkeypatch.context() as patched:  # while sources are opened
        patched.setattr(datagen.jobs.start_job, "open_sources", interrupting)
        again = the_command(capsys, lambda: cli.run(["resume", str(run), *HERE]))
    jobs = json_of(capsys, ["status", str(run)])["jobs"]
    assert [job["state"]["end"] for job in jobs] == ["interrupted"]
    assert cli.run(again) == 0
    assert_equal_runs(arrays_of(run), arrays_of(finished))
