"""A worker refuses the first attempt where its machine cannot make shards of the run, and says why."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from datagen.cluster.attempt import open_task, probe_in
from datagen.cluster.attempt_guard import Meter, guarded
from datagen.cluster.protocol import AttemptResult, ShardTask, UnfitMachine
from datagen.schemas.run import Run
from datagen.schemas.storage import open_storage
from datagen.schemas.storage.errors import StoreRefuses, StoreUnavailable
from tests.faults.scripted import ScriptedTask
from tests.made_runs import make_run, small_spec
from tests.small_runs import files_of, make_small_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return Run.open(make_small_run(tmp_path_factory.mktemp("fitness") / "run", 8))


def task_of(made: Run, **changes: Any) -> ShardTask:
    opened = {"run": made.storage.url, "spec": made.manifest.spec, "layout": made.layout}
    task = ShardTask(0, "a", 60.0, **opened, houses="builtin", objects="builtin")
    return replace(task, **changes)


def test_a_machine_that_sees_run_and_sources_is_fit_and_leaves_nothing_behind(run: Run) -> None:
    before = files_of(Path(run.storage.url))
    with probe_in(run) as probe:
        assert open_task(task_of(run, probe=probe))[0].manifest == run.manifest
    assert files_of(Path(run.storage.url)) == before


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"run": "/no/such/run"}, "no such folder"),
        ({"houses": "procthor:/no/such/houses"}, "/no/such/houses"),
        ({"objects": "ycb:/no/such/objects"}, "/no/such/objects"),
        ({"code_digest": "0" * 64}, "the code here differs from that of the job's driver"),
        ({"probe": ".probe-of-another"}, "is another folder here than on the driver's machine"),
    ],
)
def test_a_machine_that_lacks_something_is_unfit(run: Run, changes: dict[str, str], problem: str) -> None:
    with pytest.raises(UnfitMachine, match=problem):
        open_task(task_of(run, **changes))


def test_another_folder_of_the_same_name_is_not_the_run(run: Run, tmp_path: Path) -> None:
    shutil.copytree(run.storage.url, tmp_path, dirs_exist_ok=True)
    with probe_in(run) as probe, pytest.raises(UnfitMachine, match="is another folder here"):
        open_task(task_of(run, run=open_storage(tmp_path).url, probe=probe))


@pytest.mark.parametrize(("name", "text"), [("labels", "9"), ("scenes", "0"), ("numpy", "1.0")])
def test_a_machine_with_other_engines_is_unfit(run: Run, tmp_path: Path, name: str, text: str) -> None:
    spec = run.manifest.spec
    spec = spec.model_copy(update={"engines": {**spec.engines, name: text}})
    other = make_run(tmp_path / "run", spec=spec, shards=())
    with pytest.raises(UnfitMachine, match=f"{name}: the run has {text}, this machine "):
        open_task(task_of(other))


@pytest.mark.parametrize(
    ("error", "is_unfit"),
    [
        (ImportError("libGL.so.1: cannot open shared object file"), True),
        (ModuleNotFoundError("No module named 'trimesh'"), True),
        (OSError(28, "No space left on device"), True),  # of a cache: the run's own disk ends the job
        (StoreRefuses("s3://bucket/run", "", "access denied", "Check the keys"), True),
        (StoreUnavailable("s3://bucket/run", "", "the store responds 503", "Wait"), False),
    ],
)
def test_errors_of_a_machine_count_against_no_shard(error: Exception, is_unfit: bool, tmp_path: Path) -> None:
    def fail(task: ScriptedTask, meter: Meter) -> AttemptResult:
        raise error

    report = guarded(fail, ScriptedTask(0, "a", 60.0, str(tmp_path)), deadline=False)
    assert (report.outcome, report.ends_job, report.is_unfit) == ("failed", True, is_unfit)


def test_a_specification_without_engines_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnfitMachine, match="engines: "):
        open_task(task_of(make_run(tmp_path / "run", spec=small_spec(), shards=())))
