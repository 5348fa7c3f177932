"""One head with one detached job for all tests of this folder."""

from __future__ import annotations

import os
import secrets
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from datagen.cluster.ray_head import stop_head
from tests.conftest import REPOSITORY
from tests.small_runs import PER_SCENE, submit_arguments

HERE = Path(__file__).resolve().parent
SECRET = "AWS_SECRET_ACCESS_KEY"
N = 2 * PER_SCENE


@dataclass(frozen=True)
class Detached:
    """A job that a shell with a key has handed over to the head that it started."""

    run: Path
    state: Path  # state folder of the head
    key: str
    shell: subprocess.Popen[str]  # at the head of a session of its own, and ended
    out: str


_now: list[Detached] = []  # while tests of this folder run


@pytest.fixture
def detached(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Detached:
    """The job and its head, started for the first who asks; the environment names the head."""
    if not _now:
        _now.append(_hand_over(tmp_path_factory.mktemp("detached")))
    monkeypatch.setenv("DATAGEN_STATE", str(_now[0].state))
    return _now[0]


def _hand_over(folder: Path) -> Detached:
    run, state, key = folder / "run", folder / "state" / "here", secrets.token_hex(16)
    shell = subprocess.Popen(
        [sys.executable, "-m", "datagen.cli", *submit_arguments(run, N, workers=2), "--detach"],
        cwd=REPOSITORY, env={**os.environ, "DATAGEN_STATE": str(state), SECRET: key},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    out, err = shell.communicate(timeout=600)
    assert shell.returncode == 0, err
    return Detached(run, state, key, shell, out)


def pytest_runtest_teardown(nextitem: pytest.Item | None) -> None:
    """Stop the head when the next test is not one of this folder: it would cost the others time."""
    if _now and (nextitem is None or not nextitem.path.is_relative_to(HERE)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("DATAGEN_STATE", str(_now.pop().state))
            stop_head()
