"""Credentials of detached jobs: each job has its own, and no other user can see them."""

from __future__ import annotations

import hashlib
import json
import secrets
import sys
import time
from pathlib import Path
from urllib.request import Request, urlopen

import pytest

from datagen import cli
from datagen.cluster.ray_head import Head, running_head, state_folder, stop_head
from datagen.cluster.ray_jobs import ENDED, RayJobs, open_ray_jobs
from datagen.cluster.ray_settings import JOB_ENVIRONMENT
from datagen.jobs.detach import hand_over
from datagen.schemas.jobs import Jobs
from datagen.schemas.storage import open_storage
from tests.datagen.jobs.conftest import SECRET, Detached
from tests.other_user import as_another_user, needs_root, traces_of
from tests.refusals import refused
from tests.small_runs import PER_SCENE, submit_arguments

# A job: says which credentials its driver and a worker have, and ends when it is let go.
PROGRAM = f"""
import hashlib, json, os, sys, time
from pathlib import Path
from datagen.cluster.ray_settings import job_environment
from datagen.cluster.ray_cluster import RaySettings, ray_cluster
def seen():
    return hashlib.sha256(os.environ["{SECRET}"].encode()).hexdigest()
with job_environment(), ray_cluster(RaySettings(address="auto")) as ray:
    answer = [seen(), ray.get(ray.remote(num_cpus=0)(seen).remote())]
    Path(sys.argv[1]).write_text(json.dumps(answer))
    while not Path(sys.argv[2]).exists():
        time.sleep(0.1)
"""


@pytest.fixture
def run(detached: Detached) -> Path:
    """A run made by a detached job of a shell with a key, which has ended."""
    while not (jobs := Jobs(open_storage(detached.run)).all()) or jobs[0].health() != "ended":
        time.sleep(0.2)
    head, _ = head_and_jobs()
    while Path(head.folder, f"{jobs[0].record.submission}.json").exists():  # removed as the job's last act
        time.sleep(0.2)
    return detached.run


def head_and_jobs() -> tuple[Head, RayJobs]:
    head = running_head()
    assert head is not None
    return head, open_ray_jobs(head.jobs_api, head.token)


def await_end(jobs: RayJobs, submission: str) -> str:
    while (state := jobs.state(submission)) not in ENDED:
        time.sleep(0.2)
    return state


def test_each_job_on_a_head_has_its_own_credentials_and_nothing_shows_them(
    run: Path, detached: Detached, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    head, jobs = head_and_jobs()
    keys, submissions = [detached.key, secrets.token_hex(16)], ["datagen-a", "datagen-b"]
    program, go = tmp_path / "program.py", tmp_path / "go"
    program.write_text(PROGRAM)
    for key, submission in zip(keys, submissions, strict=True):
        monkeypatch.setenv(SECRET, key)
        file = hand_over(jobs, Path(head.folder), submission)
        assert file.stat().st_mode & 0o777 == 0o600
        command = f"{sys.executable} {program} {tmp_path / submission} {go}"
        jobs.submit(command, submission, {JOB_ENVIRONMENT: str(file)})
    answers = [tmp_path / submission for submission in submissions]
    while not all(answer.exists() for answer in answers):
        assert not {jobs.state(s) for s in submissions} & {"FAILED", "STOPPED"}, jobs.output("datagen-a")
        time.sleep(0.2)
    for key, answer in zip(keys, answers, strict=True):
        assert json.loads(answer.read_text()) == [hashlib.sha256(key.encode()).hexdigest()] * 2
    own = [Path(head.folder, f"{submission}.json") for submission in submissions]
    for key, file in zip(keys, own, strict=True):  # at work, the key is in the job's own file alone
        assert traces_of(key, [Path(head.folder), state_folder(), run.parent]) == [str(file)]
    request = Request(f"{head.jobs_api}/api/jobs/", headers={"Authorization": f"Bearer {head.token}"})
    with urlopen(request, timeout=120) as answer:
        answered = answer.read().decode()
    assert "datagen-b" in answered and not [key for key in keys if key in answered]
    assert traces_of(head.token, [Path(head.folder), run]) == []
    assert traces_of(head.token, [state_folder()]) == [str(state_folder() / "head.json")]
    go.touch()
    assert [await_end(jobs, submission) for submission in submissions] == ["SUCCEEDED"] * 2
    for key in keys:
        assert traces_of(key, [Path(head.folder), state_folder(), run.parent]) == []


def test_a_killed_job_s_credentials_go_with_the_next_job(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    head, jobs = head_and_jobs()
    monkeypatch.setenv(SECRET, "left")
    left = hand_over(jobs, Path(head.folder), "datagen-killed")
    jobs.submit("kill -9 $$", "datagen-killed", {JOB_ENVIRONMENT: str(left)})
    assert await_end(jobs, "datagen-killed") == "FAILED" and left.exists()
    waiting = hand_over(jobs, Path(head.folder), "datagen-not-yet-submitted")
    hand_over(jobs, Path(head.folder), "datagen-next")
    assert not left.exists() and waiting.exists()


def test_nothing_of_the_shell_travels_to_another_cluster(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    head, _ = head_and_jobs()
    key = secrets.token_hex(16)
    monkeypatch.setenv(SECRET, key)
    monkeypatch.setenv("RAY_AUTH_TOKEN", head.token)
    words = submit_arguments(tmp_path / "run", PER_SCENE, workers=1)
    # The cluster may have no `datagen` on its PATH: then the job has ended at once, and been handed over too.
    assert cli.run([*words, "--detach", "--address", head.jobs_api]) in (0, 2)
    said = capsys.readouterr()
    assert "datagen-2" in said.out + said.err and key not in said.out + said.err
    assert traces_of(key, [Path(head.folder), state_folder(), tmp_path]) == []


@needs_root
def test_another_user_sees_nothing_of_a_head(run: Path) -> None:
    head, _ = head_and_jobs()
    tried = as_another_user(
        "from pathlib import Path\n"
        "for place in sys.argv[1:]:\n"
        "    try: print(list(Path(place).iterdir()))\n"
        "    except PermissionError: print('refused')\n"
        "for place in Path('/proc').glob('[0-9]*/environ'):\n"
        "    try: print(place if sys.argv[1].encode() in place.read_bytes() else '')\n"
        "    except OSError: pass\n",
        head.folder, state_folder(),
    ).split()  # fmt: skip
    assert tried == ["refused"] * 2


def test_a_state_folder_that_others_can_write_to_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    monkeypatch.setenv("DATAGEN_STATE", str(shared))
    words = submit_arguments(tmp_path / "run", PER_SCENE, workers=1)
    refused([*words, "--detach"], capsys, "shared", "other users can write to it")
    assert list(shared.iterdir()) == []
    # A head that another user describes is none: its address and its folder would be that user's.
    shared.chmod(0o700)
    head = Head(jobs_api="http://127.0.0.1:1", token="0" * 64, group=2, folder="/tmp/datagen-head-theirs")
    (shared / "head.json").write_text(head.model_dump_json())
    (shared / "head.json").chmod(0o666)
    assert not stop_head() and cli.run(["cancel", "--head"]) == 0
    assert "none runs" in capsys.readouterr().out


def test_a_password_in_an_address_is_refused_and_not_repeated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["submit", "heuristic", "--n", "8", "--out", str(tmp_path / "run"), "--detach"]
    told = refused(
        [*words, "--address", "http://me:hidden@127.0.0.1:9"], capsys, "--address", "RAY_AUTH_TOKEN"
    )
    assert "hidden" not in told and not list(tmp_path.iterdir())
