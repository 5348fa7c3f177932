"""A run whose folder another run of the same name takes during its job: nothing is written there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import datagen.cluster.attempt
import datagen.jobs.job
from datagen import cli
from datagen.cluster.run_recorder import RunRecorder
from datagen.jobs.job import Job
from datagen.schemas.run import Run
from datagen.schemas.storage import Storage, open_storage
from tests.datagen.test_resume_s3 import arguments, digests_of
from tests.small_runs import HERE, PER_SCENE, make_small_run

N = 4 * PER_SCENE
# Where a function is called during the job, before or in the middle of writing.
MOMENTS: dict[str, tuple[Any, str]] = {
    "while a shard is made": (datagen.cluster.attempt, "run_shard"),
    "between shards": (RunRecorder, "close"),
    "after the last shard": (Run, "close_lost_attempts"),
    "before it is sealed": (Job, "_judged"),
}


def content(storage: Storage) -> dict[str, bytes]:
    return {file.key: storage.get(file.key, 2**30) or b"" for file in storage.list("")}


def fill(storage: Storage, files: dict[str, bytes]) -> None:
    storage.delete(list(content(storage)))
    for key, data in files.items():
        storage.put(key, data)


def error_of(capture: pytest.CaptureFixture[str], arguments: list[str]) -> str:
    """The one error of a command line that ends with 2; lines of progress may come before."""
    capture.readouterr()
    assert cli.run(arguments) == 2
    told = capture.readouterr().err
    assert "Traceback" not in told
    (line,) = [line for line in told.splitlines() if line.startswith("error: ")]
    return line


@pytest.fixture(scope="module")
def theirs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of the other run."""
    return content(open_storage(make_small_run(tmp_path_factory.mktemp("theirs") / "run", N, "--seed", "7")))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The run of a job that ends undisturbed."""
    return Run.open(make_small_run(tmp_path_factory.mktemp("whole") / "run", N))


@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize("kind", ["disk", "s3"])
def test_a_job_ends_where_another_run_takes_its_folder(
    kind: str, moment: str, bucket: str, theirs: dict[str, bytes], whole: Run, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    path = str(tmp_path / "run") if kind == "disk" else f"{bucket}/run"
    ours = dict[str, bytes]()
    place, name = MOMENTS[moment]
    call: Callable[..., Any] = getattr(place, name)

    def replacing(*given: Any, **named: Any) -> Any:
        if not ours:
            ours.update(content(open_storage(path)))
            fill(open_storage(path), theirs)
        return call(*given, **named)

    with monkeypatch.context() as patched:
        patched.setattr(place, name, replacing)
        told = error_of(capsys, arguments(path, N, tmp_path))
    fill(moved := open_storage(tmp_path / "moved"), ours)
    for run in (moved, open_storage(path)):
        assert f"run {Run.open(run).manifest.spec_hash[:12]} of" in told
    assert content(open_storage(path)) == theirs
    assert cli.run(["resume", str(tmp_path / "moved"), *HERE]) == 0
    assert digests_of(Run.open(moved)) == digests_of(whole)


@pytest.mark.parametrize("moment", ["while a shard is made", "between shards"])
def test_a_job_ends_where_its_folder_is_gone(
    moment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    place, name = MOMENTS[moment]
    call: Callable[..., Any] = getattr(place, name)

    def moving(*given: Any, **named: Any) -> Any:
        if (run := tmp_path / "run").exists():
            run.rename(tmp_path / "moved")
        return call(*given, **named)

    monkeypatch.setattr(place, name, moving)
    told = error_of(capsys, arguments(str(tmp_path / "run"), N, tmp_path))
    assert "the folder now has none" in told
    assert not (tmp_path / "run").exists()
