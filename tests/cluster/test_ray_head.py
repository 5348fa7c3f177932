"""The head for detached jobs where Ray does not start: tried again, and then one line."""

from __future__ import annotations

import os
from pathlib import Path

import psutil
import pytest

from datagen import cli
from datagen.cluster import ray_head
from datagen.cluster.cluster_folders import new_folder
from datagen.cluster.ray_head import ensure_head, running_head, stop_head
from datagen.schemas.errors import InputError


@pytest.fixture
def folders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Path]:
    """A state folder of its own, and the private folders that are made."""
    made: list[Path] = []

    def noted(kind: str) -> Path:
        made.append(new_folder(kind))
        return made[-1]

    monkeypatch.setenv("DATAGEN_STATE", str(tmp_path / "state"))
    monkeypatch.setattr(ray_head, "new_folder", noted)
    return made


def test_a_head_that_ray_gives_up_is_started_again(
    folders: list[Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = iter([["start", "--head", "--num-cpus=none"]])
    right = ray_head.head_arguments
    monkeypatch.setattr(ray_head, "head_arguments", lambda workers: next(arguments, None) or right(workers))
    try:
        head = ensure_head(1)
        assert running_head() == head and [f.exists() for f in folders] == [False, True]
        assert "Ray did not start; trying again: " in capsys.readouterr().err
        assert cli.run(["cancel", "--head"]) == 0
        assert running_head() is None
        assert not [p for p in psutil.process_iter() if group_of(p) == head.group]
        assert cli.run(["cancel", "--head"]) == 0
        assert "none runs" in capsys.readouterr().out
    finally:
        stop_head()
    assert not folders[1].exists()


def group_of(process: psutil.Process) -> int:
    try:
        return os.getpgid(process.pid)
    except ProcessLookupError:
        return 0


def test_a_head_that_never_starts_is_one_line_and_leaves_nothing(
    folders: list[Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(ray_head, "_START_WITHIN_S", 0.0)
    with pytest.raises(InputError, match=r"^ray: does not start: .*\. Submit again .* without --detach"):
        ensure_head(1)
    assert [f.exists() for f in folders] == [False] and not (tmp_path / "state" / "head.json").exists()
