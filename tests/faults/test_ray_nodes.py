"""Several machines: what dies on another one is seen, ended and accounted for as if it were here."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from datagen.cluster.attempt import run_attempt
from datagen.cluster.attempt_guard import notes_of_a_job
from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.protocol import ShardTask, StopRequest
from datagen.cluster.ray_cluster import RaySettings, forget_former_token, ray_cluster
from datagen.cluster.ray_executor import RayExecutor
from datagen.cluster.ray_settings import OBJECT_STORE_BYTES, head_environment, new_token
from datagen.cluster.run_recorder import RunRecorder
from datagen.cluster.shard_policy import RetryPolicy
from datagen.schemas.run import Run
from tests.cluster.simulated import Heard, PaperRecorder
from tests.faults.scripted import ScriptedTask, perform
from tests.small_runs import make_small_run

pytestmark = pytest.mark.slow


@dataclass
class Machines:
    """A head without slots, where the driver is, and two machines of one slot with folders of their own."""

    ray: Any
    cluster: Any
    folder: Path
    settings: RaySettings
    first: Any
    second: Any


@pytest.fixture(scope="module")
def machines(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machines]:
    folder = tmp_path_factory.mktemp("machines")
    with pytest.MonkeyPatch.context() as patch:
        for name, value in head_environment(new_token()).items():
            patch.setenv(name, value)
        # A machine that is gone is noticed within two seconds instead of twenty.
        patch.setenv("RAY_health_check_period_ms", "500")
        patch.setenv("RAY_health_check_failure_threshold", "3")
        from ray.cluster_utils import Cluster

        forget_former_token()
        cluster = Cluster()

        def add(name: str, slots: int) -> Any:
            for part in ("tmp", "home"):
                (folder / name / part).mkdir(parents=True)
            own = {"TMPDIR": str(folder / name / "tmp"), "HOME": str(folder / name / "home")}
            return cluster.add_node(
                num_cpus=slots, object_store_memory=OBJECT_STORE_BYTES, include_dashboard=False, env_vars=own
            )

        add("head", 0)
        first, second = add("first", 1), add("second", 1)
        settings = RaySettings(address=cluster.address)
        with ray_cluster(settings) as ray:
            yield Machines(ray, cluster, folder, settings, first, second)
        cluster.shutdown()


def test_deaths_on_another_machine_leave_their_stacks_in_the_ledger(
    machines: Machines, tmp_path: Path
) -> None:
    words = {0: ("segfault",), 1: ("hang_with_lock",), 2: ("stop",), 3: ("silent_exit",), 4: ("raise",)}
    (tmp_path / "tries").mkdir()
    executor, recorder = RayExecutor(perform, machines.settings, machines.ray), PaperRecorder()
    with notes_of_a_job() as notes:

        def make_task(order: AttemptOrder) -> ScriptedTask:
            script = words.get(order.shard, ())
            # A stopped process has no clock; the driver's own deadline comes for it.
            return ScriptedTask(order.shard, order.attempt, 5.0, notes, script, str(tmp_path / "tries"))

        policy = RetryPolicy(
            max_quarantined_share=1.0, backoff_s=0.05, initial_deadline_s=15, grace_s=0.5, kill_s=60
        )
        summary = drive(range(8), make_task, executor, recorder, policy, Heard(), StopRequest())
        left = [str(p) for p in machines.folder.rglob("*.stack")]
        executor.close()
    assert summary.totals.committed == 8
    ends = {s: [e for e in recorder.entries if e.shard == s] for s in words}
    assert {s: [e.outcome for e in of] for s, of in ends.items()} == {
        0: ["crashed", "committed"],
        1: ["hung", "committed"],
        2: ["hung", "committed"],
        3: ["crashed", "committed"],
        4: ["failed", "committed"],
    }
    first = {s: of[0] for s, of in ends.items()}
    assert first[0].cause == "Fatal Python error: Segmentation fault" and "misbehave" in first[0].stack
    assert "deadline of 5 s" in first[1].cause and "misbehave" in first[1].stack
    assert "ended by the driver" in first[2].cause
    assert all(e.host is not None and e.host.pid > 0 and e.cost is not None for e in first.values())
    assert left == [] and list(machines.folder.rglob("datagen-notes-*")) == []


def test_a_machine_that_does_not_see_the_run_is_named_and_left_out(
    machines: Machines, tmp_path: Path
) -> None:
    run = Run.open(make_small_run(tmp_path / "run", 8))
    run.grow(64)
    # One name, which each machine takes for a folder of its own: the first has the run there.
    (machines.folder / "first" / "home" / "run").symlink_to(tmp_path / "run")
    said: list[str] = []
    executor = RayExecutor(run_attempt, replace(machines.settings, tell=said.append), machines.ray)

    def make_task(order: AttemptOrder) -> ShardTask:
        opened = {"run": "~/run", "spec": run.manifest.spec, "layout": run.layout}
        return ShardTask(order.shard, order.attempt, 600.0, **opened, houses="builtin", objects="builtin")

    recorder = RunRecorder(run)
    summary = drive(run.missing(), make_task, executor, recorder, RetryPolicy(), Heard(), StopRequest())
    second = executor.others.alive()[machines.second.node_id]
    assert summary.end == "complete" and not run.missing() and not run.quarantined()
    assert len(said) == 1 and said[0].startswith(f"left out: machine {second}: ")
    assert "no such folder" in said[0]
