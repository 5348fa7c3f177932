"""A machine that cannot make a run's shards is named before the first one."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from datagen.cluster.preflight import problem_here, refuse_unfit_machines
from datagen.cluster.protocol import ShardTask
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.storage import open_storage
from tests.small_runs import files_of, make_small_run

Ask = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("fitness") / "run"
    make_small_run(folder, 8)
    return Run.open(folder)


def task_of(made: Run, run: str = "", houses: str = "builtin", objects: str = "builtin") -> ShardTask:
    place, spec = run or made.storage.url, made.manifest.spec
    return ShardTask(place, spec, made.layout, 0, "probe", houses, objects, deadline_s=0.0)


def one_machine(seen: ShardTask | None = None) -> Ask:
    """A cluster of one other machine, which is this one, or sees other places."""

    def ask(function: Any, task: ShardTask, *arguments: Any, patience_s: float) -> dict[str, Any]:
        assert function is problem_here and patience_s > 0
        return {"192.0.2.7 (node abc)": problem_here(seen or task, *arguments)}

    return ask


def test_a_machine_that_sees_run_and_sources_is_fit_and_leaves_nothing_behind(run: Run) -> None:
    before = files_of(Path(run.storage.url))
    refuse_unfit_machines(one_machine(), run, task_of(run))
    assert files_of(Path(run.storage.url)) == before
    refuse_unfit_machines(lambda *arguments, patience_s: {}, run, task_of(run))  # nobody answers in time


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"run": "/no/such/run"}, "no such folder"),
        ({"houses": "procthor:/no/such/houses"}, "/no/such/houses"),
        ({"objects": "ycb:/no/such/objects"}, "/no/such/objects"),
    ],
)
def test_a_machine_that_lacks_something_is_named(run: Run, changes: dict[str, str], problem: str) -> None:
    words = rf"^machine 192\.0\.2\.7 \(node abc\): .*{problem}.* or on s3://$"
    with pytest.raises(InputError, match=words):
        refuse_unfit_machines(one_machine(task_of(run, **changes)), run, task_of(run))


def test_another_folder_of_the_same_name_is_not_the_run(run: Run, tmp_path: Path) -> None:
    shutil.copytree(run.storage.url, tmp_path, dirs_exist_ok=True)
    assert Run.open(tmp_path).manifest == run.manifest
    copy = task_of(run, run=open_storage(tmp_path).url)
    with pytest.raises(InputError, match="is another folder there"):
        refuse_unfit_machines(one_machine(copy), run, task_of(run))


def test_a_machine_with_other_versions_is_named(run: Run) -> None:
    problem = problem_here(task_of(run), ".probe", {"numpy": "1.0"})
    assert "is another folder" in problem  # a probe that is not there
    run.storage.put_new(".probe", b"")
    problem = problem_here(task_of(run), ".probe", {"numpy": "1.0", "scenes": ""})
    run.storage.delete([".probe"])
    with pytest.raises(InputError, match=r"numpy: is .* there, but 1\.0 on the .* Install"):
        refuse_unfit_machines(lambda *arguments, patience_s: {"another": problem}, run, task_of(run))
