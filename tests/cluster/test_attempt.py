"""One attempt by itself: what ends the job, and what concerns the attempt alone."""

from __future__ import annotations

import errno
import os
import resource
import subprocess
from pathlib import Path

import pytest

from datagen.cluster import attempt
from datagen.cluster.attempt import run_attempt
from datagen.cluster.attempt_guard import Meter, guarded
from datagen.cluster.protocol import AttemptReport, JobCannotContinue, ShardTask
from datagen.schemas.record_files import object_key
from datagen.schemas.run import Run
from datagen.schemas.run_records import Layout
from datagen.schemas.specification import CandidateParams, Source, Specification
from datagen.workers.engine_versions import label_engines, scene_engines
from datagen.workers.houses import open_houses
from datagen.workers.objects import open_objects
from tests.made_runs import make_run, small_spec

BUILTIN = {"houses": "builtin", "objects": "builtin"}


def test_a_run_or_sources_that_cannot_be_opened_end_the_job(tmp_path: Path) -> None:
    spec, layout = small_spec(), Layout(scenes_per_shard=2, candidates_per_scene=5)
    task = ShardTask(3, "a", 60, run=str(tmp_path / "none"), spec=spec, layout=layout, **BUILTIN)
    assert list(task.scene_indices) == [6, 7]
    with pytest.raises(JobCannotContinue, match="no such folder"):
        run_attempt(task, Meter())
    run = make_run(tmp_path / "run", shards=())
    other = ShardTask(0, "a", 60, run=run.storage.url, spec=small_spec(seed=9), layout=layout, **BUILTIN)
    with pytest.raises(JobCannotContinue, match="another specification"):
        run_attempt(other, Meter())


@pytest.fixture(scope="module")
def spec() -> Specification:
    """Two clutter objects and few points on the built-in world: small, but the whole path."""
    opened = {"houses": open_houses("builtin"), "objects": open_objects("builtin")}
    sources = {name: Source(kind=source.kind, digest=source.digest) for name, source in opened.items()}
    few = CandidateParams(per_scene=5)
    plain = small_spec(n_points=256, candidates=few).model_copy(update=sources)
    return plain.model_copy(update={"engines": label_engines("heuristic") | scene_engines(plain)})


def attempt_at(run: Run, name: str = "a", notes: str = "") -> AttemptReport:
    """How an attempt at the first shard ends."""
    opened = {"run": run.storage.url, "spec": run.manifest.spec, "layout": run.layout}
    task = ShardTask(0, name, 300, notes=notes, **opened, **BUILTIN)
    return guarded(run_attempt, task, deadline=False)


def test_an_attempt_commits_and_a_second_one_is_superseded(spec: Specification, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", shards=(), spec=spec)
    first, second = (attempt_at(run, name) for name in ("first", "second"))
    assert (first.outcome, second.outcome) == ("committed", "superseded"), first.stack + second.stack
    commit = run.commit_of(0)
    assert commit.attempt == "first" and commit.cost == first.cost and commit.positives == first.positives
    assert commit.samples == first.labels == 10 and commit.cost.stage_wall_s["write"] > 0
    assert commit.cost.written_bytes == len(run.read_object(commit)) > 0
    # One that comes too late makes nothing.
    assert [file.key for file in run.storage.list("shards")] == [object_key("first")]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a small disk to fill")
def test_a_full_disk_ends_the_job_and_commits_nothing(spec: Specification, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=48k", "tmpfs", str(disk)], capture_output=True, check=False
    )
    if mounted.returncode != 0:
        pytest.skip("mounting a small disk is not allowed here")
    try:
        run = make_run(disk / "run", shards=(), spec=spec)
        report = attempt_at(run)
        assert report.ends_job and "No space left on device" in report.cause
        assert "Free disk space" in report.cause and "\n" not in report.cause
        assert run.committed() == set()
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.parametrize(
    ("code", "ends_job"),
    [(errno.ENOSPC, True), (errno.EDQUOT, True), (errno.EFBIG, True), (errno.EIO, False)],
)
def test_a_disk_that_is_full_while_scenes_are_made_ends_the_job(
    code: int, ends_job: bool, spec: Specification, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path / "run", shards=(), spec=spec)

    def full(*arguments: object) -> None:
        raise OSError(code, os.strerror(code), str(tmp_path / "arm.urdf"))

    monkeypatch.setattr(attempt, "run_shard", full)
    report = attempt_at(run)
    assert report.outcome == "failed" and report.ends_job == ends_job and "arm" in report.cause


def test_a_limit_of_file_sizes_ends_the_job_as_a_full_disk_does(spec: Specification, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", shards=(), spec=spec)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        # Records fit, and chunks do not; then not even the note of an attempt.
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
        large = attempt_at(run)
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
        small = attempt_at(run, notes=str(tmp_path / "notes"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    for report in (large, small):
        assert report.ends_job and "File too large. Raise the limit of file sizes" in report.cause, (
            report.stack
        )
    assert str(tmp_path / "run") in large.cause and run.committed() == set()
