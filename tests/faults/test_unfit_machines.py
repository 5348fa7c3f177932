"""Machines that cannot make a run's shards: each is named and left out, and the job goes on without it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import datagen
from datagen import cli
from datagen.cluster.ray_cluster import forget_former_token
from datagen.cluster.ray_settings import OBJECT_STORE_BYTES, head_environment, new_token
from datagen.schemas.run import Run
from tests.small_runs import arrays_of, assert_equal_runs, make_small_run, submit_arguments

pytestmark = pytest.mark.slow

LABELS = 64
# Decides on each machine where `datagen` comes from; Python runs it when a worker starts.
REDIRECT = """
import importlib.machinery, sys
class Redirect:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name == "datagen" and {folder!r}:
            return importlib.machinery.PathFinder.find_spec(name, [{folder!r}])
        if name == "datagen":
            raise ModuleNotFoundError("No module named 'datagen'")
sys.meta_path.insert(0, Redirect)
"""


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A head without slots, where the driver is."""
    for name, value in head_environment(new_token()).items():
        monkeypatch.setenv(name, value)
    from ray.cluster_utils import Cluster

    forget_former_token()
    made = Cluster()
    made.add_node(num_cpus=0, object_store_memory=OBJECT_STORE_BYTES, include_dashboard=False)
    yield made
    made.shutdown()


def add(cluster: Any, **environment: str) -> Any:
    return cluster.add_node(
        num_cpus=1, object_store_memory=OBJECT_STORE_BYTES, include_dashboard=False, env_vars=environment
    )


def python_path(folder: Path, package_in: Path | None) -> str:
    """A PYTHONPATH with which a machine's workers find the package in that folder, or do not find it."""
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(REDIRECT.format(folder=str(package_in or "")))
    return os.pathsep.join([str(folder), os.environ["PYTHONPATH"]])


def changed_package(folder: Path, file: str, old: str, new: str) -> Path:
    """A copy of the package in which one text is another."""
    shutil.copytree(Path(datagen.__file__).parent, folder / "datagen")
    path = folder / "datagen" / file
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    return folder


def submit(cluster: Any, out: Path) -> int:
    return cli.run([*submit_arguments(out, LABELS, workers=1), "--address", cluster.address])


def started(cluster: Any, out: Path, folder: Path, n: int = LABELS) -> tuple[subprocess.Popen[bytes], Path]:
    """The same job as a program of its own, and the file of what it says."""
    words = [*submit_arguments(out, n, workers=1), "--address", cluster.address]
    said = folder / "said"
    with said.open("wb") as file:
        command = [sys.executable, "-m", "datagen.cli", *words]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=file), said


def wait_for(job: subprocess.Popen[bytes], is_so: Callable[[], object]) -> None:
    while not is_so():
        assert job.poll() is None, "the job has ended"
        time.sleep(0.05)


@pytest.fixture
def undisturbed(tmp_path: Path) -> Path:
    return make_small_run(tmp_path / "undisturbed", LABELS)


FORMULA = ("workers/labels/distance_visibility_score.py", "score32 >= np", "score32 < np")


def inverts_labels(tmp_path: Path) -> dict[str, str]:
    return {"PYTHONPATH": python_path(tmp_path / "path", changed_package(tmp_path / "other", *FORMULA))}


def has_no_package(tmp_path: Path) -> dict[str, str]:
    return {"PYTHONPATH": python_path(tmp_path / "path", None)}


@pytest.mark.parametrize(
    ("unfit", "why"),
    [(inverts_labels, "the code here differs"), (has_no_package, "No module named 'datagen'")],
)
def test_an_unfit_machine_is_left_out_and_named(
    unfit: Callable[[Path], dict[str, str]],
    why: str,
    cluster: Any,
    tmp_path: Path,
    undisturbed: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    bad = add(cluster, **unfit(tmp_path))
    add(cluster)
    assert submit(cluster, tmp_path / "run") == 0
    said = capfd.readouterr().err
    lines = [line for line in said.splitlines() if "left out: machine" in line]
    assert len(lines) == 1 and bad.node_id[:12] in lines[0] and why in lines[0], said
    assert_equal_runs(arrays_of(tmp_path / "run"), arrays_of(undisturbed))
    run = Run.open(tmp_path / "run")
    lost = [end for end in run.ledger.ends() if end.outcome == "lost"]
    assert lost and all(bad.node_id[:12] in end.cause for end in lost)
    assert run.quarantined() == set()
    assert cli.run(["verify", str(tmp_path / "run")]) == 0


def test_a_machine_that_joins_later_is_checked_too(cluster: Any, tmp_path: Path) -> None:
    environment, run = inverts_labels(tmp_path), tmp_path / "run"
    add(cluster)
    job, said = started(cluster, run, tmp_path, n=20 * LABELS)
    wait_for(job, lambda: list((run / "commits").glob("*.json")))
    add(cluster, **environment)
    wait_for(job, lambda: "left out: machine" in said.read_text())
    assert job.wait(timeout=600) == 0, said.read_text()
    assert said.read_text().count("left out: machine") == 1
    made = Run.open(run)
    assert {commit.code_digest for commit in made.commits()} == {made.manifest.code_digest}
    assert cli.run(["verify", str(run)]) == 0


def test_a_job_without_a_fit_machine_ends(
    cluster: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        add(cluster, **inverts_labels(tmp_path / name))
    assert submit(cluster, tmp_path / "run") == 2
    said = capfd.readouterr().err
    assert (
        said.count("left out: machine") == 2 and "no machine of the cluster is fit" in said.splitlines()[-1]
    )
    assert "Traceback" not in said and Run.open(tmp_path / "run").quarantined() == set()


def test_a_cluster_without_a_slot_says_so_once(cluster: Any, tmp_path: Path) -> None:
    job, said = started(cluster, tmp_path / "run", tmp_path)
    line = "waiting for a machine of the cluster with a CPU and 1 GiB of memory"
    wait_for(job, lambda: line in said.read_text())
    add(cluster)
    assert job.wait(timeout=600) == 0, said.read_text()
    assert said.read_text().count("waiting for") == 1
