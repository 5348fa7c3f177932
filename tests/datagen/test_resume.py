"""`datagen resume`: what is missing is made, from the sources that the run names, and nothing twice."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import datagen.commands.resume
import datagen.commands.submit
from datagen import cli
from datagen.cluster.job_monitor import JobMonitor
from datagen.cluster.protocol import JobTotals
from datagen.cluster.shard_policy import RetryPolicy
from datagen.jobs.job import Job, JobOptions, JobRun
from datagen.schemas.quarantine import lifted_records
from datagen.schemas.record_files import encode_record
from datagen.schemas.run import Run, open_runs
from datagen.schemas.run_records import Manifest
from tests.conftest import REPOSITORY
from tests.made_runs import give_up, lose
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
IN_PROCESS = JobOptions(workers=0, quiet=True)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight shards. Tests only read it."""
    return make_small_run(tmp_path_factory.mktemp("finished") / "run", N)


def test_missing_shards_are_made_and_committed_ones_stay(finished: Path, copied: Path) -> None:
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


# `datagen`, which gets SIGTERM while it writes the sealed store, and prints its state first.
TERMINATED = """
import os, signal, sys
from pathlib import Path
from datagen import cli
from datagen.schemas import sealing
write, run = sealing._write, Path(sys.argv[2])
def terminated(*given):
    for number, entry in enumerate(write(*given)):
        if number == 3:
            (state,) = run.glob("jobs/*.state.json")
            print(state.read_text())
            os.kill(os.getpid(), signal.SIGTERM)
        yield entry
sealing._write = terminated
sys.exit(cli.run(sys.argv[1:]))
"""


@pytest.mark.parametrize("workers", ["0", "1"])
def test_sigterm_while_the_store_is_sealed_ends_the_job_as_ctrl_c_does(
    finished: Path, copied: Path, workers: str, capsys: pytest.CaptureFixture[str]
) -> None:
    lose(copied, 2, 5)
    for left in (*copied.glob("data*.claim"), copied / "data.json", *copied.glob("jobs/*")):
        left.unlink()
    shutil.rmtree(copied / "data.zarr")
    words = [sys.executable, "-c", TERMINATED, "resume", str(copied), "--workers", workers]
    done = subprocess.run(words, cwd=REPOSITORY, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 130 and f"datagen resume {copied} --workers {workers}" in done.stderr
    assert '"phase": "sealing"' in done.stdout and '"done": 2,' in done.stdout
    assert not list(copied.glob("data*"))
    (job,) = json_of(capsys, ["status", str(copied)])["jobs"]
    assert (job["state"]["end"], job["state"]["exit_code"]) == ("interrupted", 130)
    assert cli.run(["resume", str(copied), *HERE]) == 0
    assert_equal_runs(arrays_of(copied), arrays_of(finished))


def test_time_left_counts_the_labels_of_the_parts_to_come(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = [str(make_small_run(tmp_path / seed, PER_SCENE, "--seed", seed)) for seed in "12"]
    assert cli.run(["merge", *parts, "--out", str(tmp_path / "merged")]) == 0
    seen: list[JobMonitor] = []
    init = JobMonitor.__init__
    monkeypatch.setattr(JobMonitor, "__init__", lambda self, *given: seen.append(self) or init(self, *given))
    assert cli.run(["resume", str(tmp_path / "merged"), "--n", str(6 * PER_SCENE), *HERE]) == 0
    # Two parts of two new shards each: the first ends with the second to come, the second with none.
    left = [monitor.left_s(JobTotals(2, committed=2, labels=2 * PER_SCENE)) for monitor in seen]
    assert len(left) == 2 and left[0] is not None and left[0] > 0 and left[1] == 0


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


def test_quarantined_shards_are_tried_again_only_with_quarantined(
    finished: Path, copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lose(copied, 2, 5)
    for shard in (2, 5):
        give_up(Run.open(copied), shard, "failed: no luck")
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


@pytest.mark.parametrize(("share", "code"), [(0.2, 1), (0.25, 0)])
def test_the_quarantined_share_of_the_whole_run_decides_the_exit_code(
    copied: Path, share: float, code: int
) -> None:
    lose(copied, 2, 5, 7)
    for shard in (2, 5):
        give_up(Run.open(copied), shard, "failed: no luck")
    run = Run.open(copied)
    policy = RetryPolicy(max_quarantined_share=share)
    job = Job(run.storage, str(copied), [JobRun(run, "builtin", "builtin")], IN_PROCESS, 0.0, policy=policy)
    assert job.run().exit_code == code


def interrupting(*arguments: object) -> None:
    raise KeyboardInterrupt


def the_command(capture: pytest.CaptureFixture[str], call: Callable[[], int]) -> list[str]:
    """The command that an interrupted one says to resume with."""
    capture.readouterr()
    assert call() == 130
    (line,) = [x for x in capture.readouterr().err.splitlines() if x.strip().startswith("datagen ")]
    return shlex.split(line)[1:]


def test_an_early_ctrl_c_says_how_to_resume(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    with monkeypatch.context() as patched:  # while the first scene is made: nothing is written
        patched.setattr(datagen.commands.submit, "generate_scene", interrupting)
        assert cli.run(submit_arguments(run, N)) == 130 and not run.exists()
    with monkeypatch.context() as patched:  # while workers start: the run exists
        patched.setattr("datagen.jobs.job.InProcessExecutor", interrupting)
        again = the_command(capsys, lambda: cli.run(submit_arguments(run, N)))
    assert again == ["resume", str(run), *HERE]
    with monkeypatch.context() as patched:  # while sources are opened
        patched.setattr(datagen.commands.resume, "open_job_run", interrupting)
        assert the_command(capsys, lambda: cli.run(["resume", str(run), *HERE])) == again
    jobs = json_of(capsys, ["status", str(run)])["jobs"]
    assert [job["state"]["end"] for job in jobs] == ["interrupted"]
    assert cli.run(again) == 0
    assert_equal_runs(arrays_of(run), arrays_of(finished))


def test_a_dry_run_checks_everything_and_writes_nothing(
    finished: Path, copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lose(copied, 2)
    before = files_of(copied)
    dry = json_of(capsys, [*submit_arguments(copied, 2 * N), "--dry-run"])
    assert (dry["shards"], dry["scenes"], dry["n"]) == (9, 9, 2 * N)
    assert files_of(copied) == before
    new = submit_arguments(tmp_path / "new", N)
    assert cli.run([*new, "--dry-run"]) == 0
    command = capsys.readouterr().out.splitlines()[-1]
    assert not (tmp_path / "new").exists()
    refused([*submit_arguments(copied, N, "--seed", "5"), "--dry-run"], capsys, "seed: 0, but 5 was given")
    assert cli.run(shlex.split(command)[1:]) == 0  # the printed command makes the run
    assert_equal_runs(arrays_of(tmp_path / "new"), arrays_of(finished))
