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
from datagen.schemas.storage import open_storage
from tests.conftest import REPOSITORY
from tests.datagen.test_resume import interrupting
from tests.made_runs import give_up
from tests.s3_servers import Faults, environment, faulty_proxy
from tests.small_runs import HERE, PER_SCENE, json_of, make_small_run, submit_arguments

N = 3 * PER_SCENE


def arguments(run: str, n: int, folder: Path) -> list[str]:
    """The command line of a small run on S3; its configuration is written in `folder`."""
    words = submit_arguments(folder / "run", n)
    return [run if word == str(folder / "run") else word for word in words]


def test_a_run_on_s3_is_resumed_extended_and_told_of(
    bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = f"{bucket}/some/run"
    with monkeypatch.context() as patched:
        patched.setattr("datagen.jobs.job.InProcessExecutor", interrupting)
        assert cli.run(arguments(run, N, tmp_path)) == 130
    (line,) = [x for x in capsys.readouterr().err.splitlines() if x.strip().startswith("datagen ")]
    assert shlex.split(line) == ["datagen", "resume", run, *HERE]
    assert cli.run(shlex.split(line)[1:]) == 0
    assert "data.zarr" in capsys.readouterr().out

    open_storage(run).delete([commit_key(1)])
    give_up(Run.open(run), 1, "hung: x")
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


def test_a_shard_costs_six_requests(
    bucket: str, s3_port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five by its worker, of them two looks at the manifest, and its object by the seal."""
    seen = list[str]()

    class Seen(Faults):
        def kind(self, path: str, creates: bool) -> str:
            seen.append(path)
            return "pass"

    with faulty_proxy(s3_port, Seen()) as port:
        monkeypatch.setenv("AWS_ENDPOINT_URL", environment(port)["AWS_ENDPOINT_URL"])
        assert cli.run(arguments(f"{bucket}/run", 12 * PER_SCENE, tmp_path)) == 0
        paths = list(seen)
        shards = len(Run.open(f"{bucket}/run").committed())
    for folder, each in (("ledger", 1), ("shards", 2), ("commits", 1)):
        assert sum(f"/run/{folder}/" in path for path in paths) == each * shards, folder
    assert 0 <= sum(path.endswith("/run/manifest.json") for path in paths) - 2 * shards < 12


def digests_of(run: Run) -> dict[str, str]:
    """Digests of all objects, by shard."""
    return {f"{c.shard}": c.object.sha256 for c in run.commits()}


def test_a_job_on_s3_heeds_a_request_that_is_left_there(
    bucket: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = f"{bucket}/run"
    command = [sys.executable, "-m", "datagen.cli", *arguments(run, 64 * PER_SCENE, tmp_path)]
    with subprocess.Popen(command, cwd=REPOSITORY, stderr=subprocess.PIPE, text=True) as process:
        while not Jobs(open_storage(run, probe=False)).all():
            assert process.poll() is None, process.communicate()
            time.sleep(0.1)
        assert cli.run(["cancel", run, "--now"]) == 0
        assert process.wait(600) == 130
    assert "ended interrupted, exit code 130" in capsys.readouterr().out
