"""`datagen resume --n`: longer runs keep their shards; the parts of merged runs share the new labels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen import cli
from datagen.commands.resume import shares
from datagen.schemas.run import open_runs
from tests.refusals import refused
from tests.small_runs import (
    HERE,
    PER_SCENE,
    arrays_of,
    assert_equal_runs,
    files_of,
    json_of,
    make_small_run,
)

N, LONG_N = 2 * PER_SCENE, 4 * PER_SCENE


@settings(max_examples=300, deadline=None)
@given(
    st.lists(st.tuples(st.integers(1, 10**6), st.integers(1, 2000)), min_size=1, max_size=6),
    st.integers(0, 10**12),
)
def test_shares_are_whole_shards_as_even_as_these_allow(parts: list[tuple[int, int]], more: int) -> None:
    have, per_shard = [h for h, _ in parts], [s for _, s in parts]
    wanted = shares(have, per_shard, sum(have) + more)
    given_labels = [w - h for w, h in zip(wanted, have, strict=True)]
    assert sum(given_labels) == more and min(given_labels) >= 0
    whole = all(labels % size == 0 for labels, size in zip(given_labels[:-1], per_shard, strict=False))
    assert whole  # a store is cut at its end alone
    assert max(given_labels) - min(given_labels) <= 3 * max(per_shard)


def test_a_longer_run_keeps_every_byte_and_is_the_one_made_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_small_run(tmp_path / "run", N)
    before = files_of(run, "shards", "commits", "ledger", "plans")
    refused(["resume", str(run), "--n", str(N - 1), *HERE], capsys, "--n", "never shrinks", f"Give {N}")
    refused(["resume", str(run), "--n", "0", *HERE], capsys, "--n")
    assert files_of(run, "shards", "commits", "ledger", "plans") == before
    assert cli.run(["resume", str(run), "--n", str(LONG_N), *HERE]) == 0
    assert before.items() <= files_of(run, "shards", "commits", "ledger", "plans").items()
    assert_equal_runs(arrays_of(run), arrays_of(make_small_run(tmp_path / "long", LONG_N)))
    assert cli.run(["resume", str(run), "--n", str(LONG_N), *HERE]) == 0  # again is to resume


def test_a_run_over_stored_scenes_is_not_extended_beyond_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = make_small_run(tmp_path / "source", N)
    run = tmp_path / "run"
    again = ["submit", "heuristic", "--scenes-from", str(source), "--out", str(run), *HERE]
    assert cli.run([*again, "--n", str(PER_SCENE)]) == 0
    refused(["resume", str(run), "--n", str(LONG_N), *HERE], capsys, "--n", "is more than the")
    report = json_of(capsys, ["status", str(run)])
    assert (report["n"], report["scenes_from"]) == (PER_SCENE, str(source))
    assert cli.run(["resume", str(run), "--n", str(N), *HERE]) == 0
    np.testing.assert_array_equal(arrays_of(run)["label"], arrays_of(source)["label"])


def test_merged_runs_share_what_is_to_come(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seeds = ("0", "9")
    runs = [make_small_run(tmp_path / f"run{seed}", N, "--seed", seed) for seed in seeds]
    place = tmp_path / "merged"
    assert cli.run(["merge", *map(str, runs), "--out", str(place)]) == 0
    total = 2 * N + 3 * PER_SCENE - 3
    assert cli.run(["resume", str(place), "--n", str(total), *HERE]) == 0
    parts = open_runs(place)
    assert [run.n - N for run in parts] == [PER_SCENE, 2 * PER_SCENE - 3]
    report = json_of(capsys, ["status", str(place)])
    assert report["complete"] and report["sealed"] and report["labels"] == report["n"] == total
    assert [part["n"] for part in report["parts"]] == [run.n for run in parts]
    assert cli.run(["status", str(place)]) == 0
    assert "one per part" in capsys.readouterr().out
    labels, last = arrays_of(place)["label"], parts[-1]
    assert len(labels) == total
    alone = make_small_run(tmp_path / "alone", last.n, "--seed", str(last.manifest.spec.seed))
    np.testing.assert_array_equal(labels[-last.n :], arrays_of(alone)["label"])
