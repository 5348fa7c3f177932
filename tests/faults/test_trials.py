"""Jobs of `sim`: the same arrays whoever makes them, and one attempt lost where a trial kills its worker."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from datagen import cli
from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.protocol import StopRequest
from datagen.cluster.ray_cluster import RaySettings, ray_cluster
from datagen.cluster.ray_executor import RayExecutor
from datagen.cluster.run_recorder import RunRecorder
from datagen.cluster.shard_policy import RetryPolicy
from datagen.schemas.run import Run
from tests.cluster.simulated import Heard
from tests.faults.trials import FaultyTrials, attempt_with_faults
from tests.sim_extra import needs_sim
from tests.small_runs import CONFIG, arrays_of, assert_equal_runs, make_small_run

pytestmark = [needs_sim, pytest.mark.slow]

SHARDS, PER_SCENE = 6, 6
N = SHARDS * PER_SCENE
LONG_ARMS = "[candidates]\narm_reach_m = {low = 0.9, high = 1.0}\nrobots_per_scene = 1\n"
FEW_GRASPS = "[arm.grasps]\nper_object = 40\nper_scene = 8\n[arm.trial]\nmax_attempts = 1\n"
# By shard: what happens in the first trial of its attempts. A hang is given as long as a cold start takes.
WORDS = {0: ("segfault",), 1: ("hang_with_lock",), 2: ("kill",), 3: ("raise",), 4: ("segfault",) * 3}
HANG_S, PATIENCE_S = 20.0, 300.0


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    more = ("--candidates", "in-range", "--seed", "3")
    return make_small_run(folder / "run", N, *more, config=CONFIG + LONG_ARMS, per_scene=PER_SCENE)


def arguments(source: Path, out: Path, workers: int) -> list[str]:
    config = source.parent / "arm.toml"
    config.write_text(FEW_GRASPS)
    return [
        "submit", "sim", "--n", str(N), "--out", str(out), "--scenes-from", str(source),
        "--config", str(config), "--workers", str(workers),
    ]  # fmt: skip


@pytest.fixture(scope="module")
def whole(source: Path) -> Path:
    """Made in this process, one shard after another."""
    out = source.parent / "whole"
    assert cli.run(arguments(source, out, 0)) == 0
    arrays = arrays_of(out)
    tried = arrays["trials"].reshape(SHARDS, PER_SCENE).sum(axis=1)
    assert (tried[: len(WORDS)] > 0).all(), "every shard that shall fail needs a trial"
    assert 0 < arrays["label"].sum() < N
    return out


def test_arrays_of_two_workers_are_those_of_this_process(source: Path, whole: Path, tmp_path: Path) -> None:
    assert cli.run(arguments(source, tmp_path / "run", 2)) == 0
    assert_equal_runs(arrays_of(tmp_path / "run"), arrays_of(whole))


def test_a_trial_that_kills_its_worker_costs_one_attempt_and_a_resumed_run_is_the_same(
    source: Path, whole: Path, tmp_path: Path
) -> None:
    out, notes = tmp_path / "run", tmp_path / "notes"
    notes.mkdir()
    shutil.copytree(whole, out, ignore=shutil.ignore_patterns("shards", "commits", "ledger", "data.*"))
    run = Run.open(out)
    assert run.missing() == list(range(SHARDS))
    sources = run.manifest.sources
    ordered: set[int] = set()

    def make_task(order: AttemptOrder) -> FaultyTrials:
        is_first, words = order.shard not in ordered, WORDS.get(order.shard, ())
        ordered.add(order.shard)
        return FaultyTrials(
            run=run.storage.url,
            spec=run.manifest.spec,
            layout=run.layout,
            shard=order.shard,
            attempt=order.attempt,
            houses=sources["houses"],
            objects=sources["objects"],
            deadline_s=HANG_S if is_first and "hang_with_lock" in words else PATIENCE_S,
            notes=str(notes),
            scenes_from=sources["scenes_from"],
            words=words,
        )

    settings = RaySettings(workers=2)
    policy = RetryPolicy(max_quarantined_share=1.0, backoff_s=0.05, initial_deadline_s=PATIENCE_S)
    with ray_cluster(settings) as ray:
        executor = RayExecutor(attempt_with_faults, settings, ray)
        summary = drive(run.missing(), make_task, executor, RunRecorder(run), policy, Heard(), StopRequest())
    assert summary.end == "complete" and not run.close_lost_attempts()

    ends = {shard: [e.outcome for e in run.ledger.ends() if e.shard == shard] for shard in range(SHARDS)}
    assert ends == {0: ["crashed"], 1: ["hung"], 2: ["crashed"], 3: ["failed"], 4: ["crashed"] * 3, 5: []}
    assert run.quarantined() == {4} and run.committed() == set(range(SHARDS)) - {4}
    (given_up,) = run.quarantine_records()
    # The native stack says where: inside the trial.
    assert "Segmentation fault" in given_up.causes[-1]
    assert any("run_trial" in stack or "_attempt" in stack for stack in given_up.stacks)

    shutil.rmtree(out / "quarantine")
    assert cli.run(arguments(source, out, 0)) == 0
    assert_equal_runs(arrays_of(out), arrays_of(whole))
    np.testing.assert_array_equal(arrays_of(out)["heuristic_label"], arrays_of(source)["label"])
