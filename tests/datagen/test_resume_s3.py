"""Jobs of a run on S3: resumed, extended, watched and stopped as on a disk."""

from __future__ import annotations

import shlex
import subprocess
import sys
import time
from pathlib import Path

import pytest

from datagen import cli
from datagen.schemas.jobs import Jobs
from datagen.schemas.record_files import commit_key
from datagen.schemas.run import Run
from datagen.schemas.run_records import QuarantineRecord
from datagen.schemas.storage import open_storage
from tests.small_runs import CONFIG, HERE, PER_SCENE, json_of, make_small_run

REPOSITORY = Path(__file__).resolve().parents[2]
N = 3 * PER_SCENE


def test_a_run_on_s3_is_resumed_extended_and_told_of(
    bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, config = f"{bucket}/some/run", tmp_path / "config.toml"
    config.write_text(CONFIG)
    submit = [
        "submit", "heuristic", "--n", str(N), "--out", run, "--candidates-per-scene", str(PER_SCENE),
        "--config", str(config), *HERE,
    ]  # fmt: skip
    with monkeypatch.context() as patched:
        patched.setattr("datagen.jobs.job.InProcessExecutor", _interrupting)
        assert cli.run(submit) == 130
    (line,) = [x for x in capsys.readouterr().err.splitlines() if x.strip().startswith("datagen ")]
    assert shlex.split(line) == ["datagen", "resume", run, *HERE]
    assert cli.run(shlex.split(line)[1:]) == 0
    assert "data.zarr" in capsys.readouterr().out

    storage = open_storage(run)
    storage.delete([commit_key(1)])
    Run.open(run).quarantine(
        QuarantineRecord(
            shard=1, seed=0, first_scene=1, scenes=1, attempts=("a",), causes=("hung: x",), stacks=("",),
            created="2026-01-01T00:00:00.000+00:00",
        )
    )  # fmt: skip
    assert cli.run(["resume", run, *HERE]) == 1
    assert f"datagen resume {run} --quarantined" in " ".join(capsys.readouterr().out.split())
    assert cli.run(["resume", run, "--quarantined", *HERE]) == 0
    assert cli.run(["resume", run, "--n", str(N + PER_SCENE), *HERE]) == 0
    report = json_of(capsys, ["status", run])
    assert report["complete"] and report["sealed"] and report["taken_out_of_quarantine"] == 1
    ends = [job["state"]["end"] for job in report["jobs"]]
    assert ends == ["interrupted", "complete", "complete", "complete"]
    assert cli.run(["status", run, "--log"]) == 0
    assert "tried again later" in capsys.readouterr().out
    here = make_small_run(tmp_path / "run", N + PER_SCENE)
    assert digests_of(Run.open(run)) == digests_of(Run.open(here))


def digests_of(run: Run) -> dict[str, str]:
    """Digests of all data files, by shard and path."""
    return {f"{c.shard}/{f.path}": f.sha256 for c in run.commits() for f in c.files}


def test_a_job_on_s3_heeds_a_request_that_is_left_there(
    bucket: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, config = f"{bucket}/run", tmp_path / "config.toml"
    config.write_text(CONFIG)
    arguments = [
        "submit", "heuristic", "--n", str(64 * PER_SCENE), "--out", run, "--candidates-per-scene",
        str(PER_SCENE), "--config", str(config), *HERE,
    ]  # fmt: skip
    with subprocess.Popen(
        [sys.executable, "-m", "datagen.cli", *arguments], cwd=REPOSITORY, stderr=subprocess.PIPE, text=True
    ) as process:
        while not Jobs(open_storage(run, probe=False)).all():
            assert process.poll() is None, process.communicate()
            time.sleep(0.1)
        assert cli.run(["cancel", run, "--now"]) == 0
        assert process.wait(600) == 130
    assert "ended interrupted, exit code 130" in capsys.readouterr().out


def _interrupting(*arguments: object) -> None:
    raise KeyboardInterrupt
