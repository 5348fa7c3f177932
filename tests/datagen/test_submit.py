"""Whole runs through the command line: made, resumed, extended, killed, interrupted, read."""

from __future__ import annotations

import shlex
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import xarray
import zarr

from datagen import cli
from datagen.schemas.fields import sized_schema
from datagen.schemas.run import Run
from datagen.schemas.run_records import QuarantineRecord
from tests.refusals import refused
from tests.small_runs import (
    PER_SCENE,
    arrays_of,
    assert_equal_runs,
    files_of,
    json_of,
    make_small_run,
    submit_arguments,
)
from tests.workers.objects.toy_set import write_bundle

REPOSITORY = Path(__file__).resolve().parents[2]
N, LONG_N = 8 * PER_SCENE, 16 * PER_SCENE


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight scenes, one a shard. Tests only read it."""
    return make_small_run(tmp_path_factory.mktemp("finished") / "run", N)


@pytest.fixture(scope="module")
def finished_long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen scenes of the same specification, two a shard, made without interruption."""
    return make_small_run(tmp_path_factory.mktemp("long") / "run", LONG_N)


def test_stock_readers_read_it_without_a_warning(finished: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        group = zarr.open(str(finished / "data.zarr"), mode="r")
        data = xarray.open_zarr(finished / "data.zarr")
    assert isinstance(group, zarr.Group)
    run = Run.open(finished)
    schema = sized_schema("heuristic", run.manifest.spec)
    fields = {**dict.fromkeys(schema.scene_fields, "scene"), **dict.fromkeys(schema.sample_fields, "sample")}
    assert set(group.array_keys()) == {f.name for f in fields}
    assert data.sizes["sample"] == N and data.sizes["scene"] == N // PER_SCENE
    for f, table in fields.items():
        array, seen = group[f.name], data[f.name]
        assert isinstance(array, zarr.Array)
        assert array.metadata.dimension_names == (table, *f.dims) == seen.dims
        assert array.shape == seen.shape
        assert array.attrs.get("units", "") == f.unit == seen.attrs.get("units", "")
        assert array.attrs["long_name"] == f.doc
    assert set(np.unique(data["label"].values)) == {0, 1}
    assert {"spec_hash", "specification", "schema_version"} <= set(group.attrs)


def test_the_same_command_again_does_nothing_and_says_so(
    copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = ("plans", "shards", "commits", "ledger")
    before, arrays = files_of(copied, *folders), arrays_of(copied)
    capsys.readouterr()
    assert cli.run(submit_arguments(copied, N)) == 0
    told = capsys.readouterr()
    assert "nothing to do" in told.out and f"{N} labels" in told.out
    assert files_of(copied, *folders) == before
    assert_equal_runs(arrays_of(copied), arrays)
    assert cli.run(submit_arguments(copied, N - PER_SCENE)) == 0  # a run never shrinks
    assert_equal_runs(arrays_of(copied), arrays)


def test_a_run_with_shards_given_up_says_so_again(copied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, arrays = Run.open(copied), arrays_of(copied)
    for shard in (2, 5):
        (copied / f"commits/{shard:06d}.json").unlink()
        run.quarantine(
            QuarantineRecord(
                shard=shard, seed=0, first_scene=shard, scenes=1, attempts=(), causes=("failed: no luck",),
                stacks=(), created="",
            )
        )  # fmt: skip
    capsys.readouterr()
    assert cli.run(submit_arguments(copied, N)) == 1
    told = capsys.readouterr()
    assert "committed or quarantined" in told.out and "2 shards (2, 5)" in told.out and "no luck" in told.err
    assert arrays_of(copied)["label"].shape == (N - 2 * PER_SCENE,)
    shutil.rmtree(copied / "quarantine")  # as the message says
    assert cli.run(submit_arguments(copied, N)) == 0
    assert_equal_runs(arrays_of(copied), arrays)


def test_a_larger_n_extends_and_shard_size_changes_no_array(copied: Path, finished_long: Path) -> None:
    before = files_of(copied, "shards", "commits", "ledger", "plans")
    assert cli.run(submit_arguments(copied, LONG_N)) == 0
    after = files_of(copied, "shards", "commits", "ledger", "plans")
    assert before.items() <= after.items() and len(after) > len(before)
    layouts = [Run.open(place).layout.scenes_per_shard for place in (copied, finished_long)]
    assert layouts == [1, 2]
    assert_equal_runs(arrays_of(copied), arrays_of(finished_long))


@pytest.mark.parametrize(
    ("more", "fields"),
    [
        (["--seed", "5"], ["seed: 0, but 5 was given"]),
        (["--split", "val", "--candidates", "clear"], ["split", "'all'", "'val'", "candidates.within"]),
        (["--candidates-per-scene", "9"], ["candidates_per_scene", "8", "9"]),
    ],
)
def test_another_specification_is_refused_and_changes_nothing(
    finished: Path, more: list[str], fields: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = submit_arguments(finished, N)
    if more[0] in arguments:
        at = arguments.index(more[0])
        del arguments[at : at + 2]
    before = files_of(finished)
    refused([*arguments, *more], capsys, str(finished), *fields)
    assert files_of(finished) == before


def test_status_counts_what_is_there(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = json_of(capsys, ["status", str(finished)])
    labels = arrays_of(finished)["label"]
    assert report["complete"] and report["sealed"]
    assert (report["n"], report["labels"], report["positives"]) == (N, N, int(labels.sum()))
    assert report["shards"] == {"planned": 8, "committed": 8, "quarantined": [], "missing": 0}
    assert report["attempts"] == {"committed": 8} and report["attempts_without_end"] == 0
    assert cli.run(["status", str(finished)]) == 0
    assert "64 of 64" in capsys.readouterr().out


def test_status_tells_an_older_seal(copied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Run.open(copied).grow(2 * N)
    report = json_of(capsys, ["status", str(copied)])
    assert not report["sealed"] and report["sealed_labels"] == N
    assert cli.run(["status", str(copied)]) == 0
    assert "data.zarr is out of date" in capsys.readouterr().out
    # Sealed unfinished, it holds no more labels than before.
    assert cli.run(["verify", str(copied), "--repair"]) == 0
    Run.open(copied).grow(3 * N)
    capsys.readouterr()
    assert json_of(capsys, ["status", str(copied)])["sealed_labels"] == N


def test_two_ray_workers_make_the_same_arrays(finished_long: Path, tmp_path: Path) -> None:
    # In a process of its own: Ray keeps threads and handlers in the process that started it.
    run = tmp_path / "run"
    done = subprocess.run(
        [sys.executable, "-m", "datagen.cli", *submit_arguments(run, LONG_N, workers=2)],
        cwd=REPOSITORY, capture_output=True, text=True, timeout=900, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert_equal_runs(arrays_of(run), arrays_of(finished_long))
    assert len({commit.host.pid for commit in Run.open(run).commits()}) == 2


class Job:
    """`datagen submit` in a process of its own, to be stopped from outside."""

    def __init__(self, run: Path) -> None:
        self.run = run
        arguments = [sys.executable, "-m", "datagen.cli", *submit_arguments(run, LONG_N)]
        self.process = subprocess.Popen(
            arguments, cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def wait_until_committed(self, shards: int) -> None:
        while len(list(self.run.glob("commits/*.json"))) < shards:
            assert self.process.poll() is None, self.process.communicate()
            time.sleep(0.02)


def test_a_killed_driver_resumes_to_the_same_arrays(finished_long: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    job = Job(run)
    job.wait_until_committed(2)
    while True:  # look at it while it stands still, and kill it in the middle of an attempt
        job.process.send_signal(signal.SIGSTOP)
        lost = Run.open(run).ledger.unfinished()
        if lost and lost[0].shard not in Run.open(run).committed():
            break
        job.process.send_signal(signal.SIGCONT)
        time.sleep(0.05)
        assert job.process.poll() is None, job.process.communicate()
    job.process.kill()
    assert job.process.wait(600) == -signal.SIGKILL
    kept = files_of(run, "commits", "shards")
    assert not (run / "data.zarr").exists() and Run.open(run).missing()

    assert cli.run(submit_arguments(run, LONG_N)) == 0
    assert kept.items() <= files_of(run, "commits", "shards").items()
    assert_equal_runs(arrays_of(run), arrays_of(finished_long))
    ends = {entry.attempt: entry for entry in Run.open(run).ledger.ends()}
    assert Counter(entry.outcome for entry in ends.values()) == {"committed": 8, "lost": 1}
    assert ends[lost[0].attempt].outcome == "lost" and ends[lost[0].attempt].cost is None
    assert Run.open(run).ledger.unfinished() == []


def test_ctrl_c_says_how_to_resume_and_that_command_completes(finished_long: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    job = Job(run)
    job.wait_until_committed(2)
    job.process.send_signal(signal.SIGINT)
    _, told = job.process.communicate(timeout=600)
    assert job.process.returncode == 130
    assert "Traceback" not in told and "interrupted" in told
    assert 2 <= len(Run.open(run).committed()) < 8 and Run.open(run).ledger.unfinished() == []
    (line,) = [line for line in told.splitlines() if line.strip().startswith("datagen ")]
    assert cli.run(shlex.split(line)[1:]) == 0
    assert_equal_runs(arrays_of(run), arrays_of(finished_long))


def test_a_count_of_built_in_houses_and_a_relative_folder_reach_the_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_small_run(tmp_path / "run", PER_SCENE, "--houses", "builtin:30")
    sources = Run.open(run).manifest.sources
    assert sources == {"houses": "builtin:30", "objects": "builtin", "n_houses": "30", "n_objects": "58"}
    folder = tmp_path / "objects"
    folder.mkdir()
    monkeypatch.chdir(tmp_path)
    arguments = submit_arguments(tmp_path / "other", PER_SCENE, "--objects", "ycb:objects")
    assert cli.run(arguments) == 2  # an empty folder, found from here
    write_bundle(folder, *(f"{k:03d}_cube" for k in range(8)))
    assert cli.run(arguments) == 0
    monkeypatch.chdir("/")
    assert cli.run(["show", str(tmp_path / "other"), "--out", str(tmp_path / "a.png")]) == 0
