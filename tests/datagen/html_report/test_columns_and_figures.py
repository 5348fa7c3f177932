"""What a report reads of a run, and the numbers behind its figures, against other readers and formulas."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest

from datagen.html_report import part_columns
from datagen.html_report.part_columns import PartColumns, chosen_shards, read_columns
from datagen.html_report.report_paths import ReportedPart, open_report_paths
from datagen.html_report.run_figures import angles_deg, rate_by_scene
from tests.made_runs import make_run
from tests.small_runs import PER_SCENE, arrays_of


def part_of(path: Path) -> ReportedPart:
    ((_, (part,)),) = open_report_paths([str(path)]).runs
    return part


def columns_of(path: Path) -> PartColumns:
    columns = read_columns(part_of(path), 0, lambda: None)
    assert columns is not None
    return columns


def test_columns_are_those_of_the_store(reported: Path) -> None:
    stored = arrays_of(reported)
    for path in (reported, reported / "data.zarr"):
        columns = columns_of(path)
        for name, values in (columns.scenes | columns.samples).items():
            np.testing.assert_array_equal(values, stored[name], err_msg=name)
        assert (columns.scenes["scene_index"][columns.scene] == stored["sample_scene_index"]).all()
        assert not columns.is_sampled and columns.sample_words == f"all {len(stored['label'])} labels"


def test_a_scene_is_read_whole(reported: Path) -> None:
    stored = arrays_of(reported)
    for path in (reported, reported / "data.zarr"):
        columns = columns_of(path)
        rows = columns.part.scene(int(columns.shard[4]), int(columns.row[4]))
        assert int(rows.record["scene_index"]) == 4
        np.testing.assert_array_equal(rows.record["points_m"], stored["points_m"][4])
        np.testing.assert_array_equal(rows.samples["label"], stored["label"].reshape(-1, PER_SCENE)[4])


def test_a_run_that_is_cut_within_a_shard_has_its_n_labels(tmp_path: Path) -> None:
    make_run(tmp_path / "run", n=23, scenes_per_shard=2, candidates_per_scene=5)
    columns = columns_of(tmp_path / "run")
    assert len(columns) == columns.part.labels == 23 and columns.per_scene(np.ones(23))[-1] == 3


def test_large_runs_are_sampled_evenly_and_say_so(reported: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part = part_of(reported)
    assert chosen_shards(part, 0) == tuple(range(10))
    monkeypatch.setattr(part_columns, "MOST_SHARDS", 4)
    chosen = chosen_shards(part, 0)
    assert len(set(chosen)) == 4 and chosen == tuple(sorted(chosen)) == chosen_shards(part, 0)
    assert len({chosen_shards(part, seed) for seed in range(20)}) > 10
    words = "a random 4 of 10 shards: 32 of 80 labels"
    assert columns_of(reported).sample_words == words
    monkeypatch.setattr(part_columns, "MOST_LABELS", 24)
    assert len(chosen_shards(part, 0)) == 3


def test_no_shard_gives_no_columns(tmp_path: Path) -> None:
    make_run(tmp_path / "run", shards=[])
    assert read_columns(part_of(tmp_path / "run"), 0, lambda: None) is None


def made_columns(reported: Path, **samples: Any) -> PartColumns:
    columns = columns_of(reported)
    columns.samples.update(samples)
    return columns


def test_angles_are_measured_from_the_cameras_side(reported: Path) -> None:
    columns = columns_of(reported)
    target, camera = columns.scenes["target_center_m"], columns.scenes["T_world_camera"][:, :3, 3]
    to_camera = (camera - target)[columns.scene, :2]
    left = np.stack([-to_camera[:, 1], to_camera[:, 0]], axis=1)
    for offset, angle in ((to_camera, 0), (left, 90), (-left, -90), (to_camera + left, 45)):
        columns.samples["base_xy_m"] = target[columns.scene, :2] + offset
        assert angles_deg(columns) == pytest.approx(np.full(len(columns), angle), abs=1e-6)


def test_intervals_hold_the_rate_of_correlated_labels(reported: Path) -> None:
    """95% intervals over ten scenes of labels that agree within their scene: 85% to 99% hold the rate."""
    rng, held, n = np.random.default_rng(5), 0, 400
    columns = columns_of(reported)
    for _ in range(n):
        of_scene = rng.beta(2, 2, 10)
        columns.samples["label"] = (rng.random(len(columns)) < of_scene[columns.scene]).astype(np.uint8)
        rate, low, high = rate_by_scene(columns, np.ones(len(columns), np.bool_))
        assert low <= rate <= high and rate == columns.samples["label"].mean()
        held += low <= 0.5 <= high
    assert 0.85 < held / n < 0.99


def test_intervals_of_extreme_rates_are_exact(reported: Path) -> None:
    every = np.ones(10 * PER_SCENE, np.bool_)
    for label, k in ((0, 0), (1, 10)):
        columns = made_columns(reported, label=np.full(len(every), label, np.uint8))
        exact = binomtest(k, 10).proportion_ci(method="exact")
        assert rate_by_scene(columns, every) == pytest.approx((label, exact.low, exact.high))
    assert np.isnan(rate_by_scene(columns_of(reported), ~every)).all()
