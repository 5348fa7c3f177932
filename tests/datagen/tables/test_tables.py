"""Runs as an xarray Dataset and as a pandas table, held against what zarr reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray

import datagen
from datagen.schemas.merging import merge_runs, plan_merge
from datagen.schemas.run import open_runs
from datagen.schemas.sealing import seal
from datagen.schemas.shard_reading import ShardPlace
from datagen.schemas.specification import PLACE_KINDS
from datagen.workers.houses import split_of
from tests.train.conftest import sim_run
from tests.train.stream_runs import make_stream_run

__all__ = ["sim_run"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two runs, the first sealed and cut within its last scene."""
    folder = tmp_path_factory.mktemp("tables")
    seal(make_stream_run(folder / "a", 40).storage)
    make_stream_run(folder / "b", 24, seed=2)
    return folder / "a", folder / "b"


def test_a_dataset_has_every_array_as_it_is_stored(runs: tuple[Path, Path]) -> None:
    ours = datagen.open_dataset(runs[0])
    theirs = xarray.open_zarr(runs[0] / "data.zarr", chunks=None).rename(sample="candidate")
    assert set(theirs.variables) <= set(ours.variables)
    for name in theirs.variables:
        assert ours[name].dims == theirs[name].dims
        assert ours[name].dtype in (theirs[name].dtype, object)  # texts
        np.testing.assert_array_equal(ours[name].values, theirs[name].values, err_msg=str(name))
        assert ours[name].attrs["long_name"] == theirs[name].attrs["long_name"]
    assert ours.attrs["license"] == theirs.attrs["license"]


def test_several_runs_follow_each_other_and_candidates_name_their_scene(runs: tuple[Path, Path]) -> None:
    both = datagen.open_dataset(*runs)
    assert (both.sizes["scene"], both.sizes["candidate"]) == (7 + 4, 64)
    alone = [datagen.open_dataset(run) for run in runs]
    np.testing.assert_array_equal(both["label"], np.concatenate([each["label"] for each in alone]))
    owners = both["scene_index"].values[both["scene_row"].values]
    np.testing.assert_array_equal(owners, both["sample_scene_index"])
    assert both["run"].values.tolist() == [str(runs[0])] * 7 + [str(runs[1])] * 4


@pytest.mark.parametrize(
    "pick",
    [
        {"scene": 3},
        {"scene": slice(1, 8, 3), "point": slice(None, None, 7)},
        {"scene": [9, 0, 9, 4], "point": 5, "xyz": [2, 0]},
        {"xyz": -1, "point": [1, 0]},
    ],
)
def test_indexing_reads_what_numpy_would_give(runs: tuple[Path, Path], pick: dict) -> None:  # type: ignore[type-arg]
    lazy = datagen.open_dataset(*runs)["points_m"]
    whole = xarray.DataArray(datagen.open_dataset(*runs)["points_m"].values, dims=lazy.dims)
    np.testing.assert_array_equal(lazy.isel(pick).values, whole.isel(pick).values)


def test_nothing_is_read_before_it_is_used(runs: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []
    real = ShardPlace.read

    def noting(self: ShardPlace, arrays):  # type: ignore[no-untyped-def]
        found = list(arrays)
        read.extend(f"{self.url} {array.name}" for array in found)
        return real(self, found)

    monkeypatch.setattr(ShardPlace, "read", noting)
    dataset = datagen.open_dataset(runs[1])
    assert read == []
    dataset["points_m"].isel(scene=0).load()
    arrays = ("scene_index", "house_id", "points_m")  # it, and its coordinates
    assert set(read) == {f"{runs[1]}/shards/a-0.zip {name}" for name in arrays}


def test_a_table_joins_candidates_with_their_scenes(runs: tuple[Path, Path]) -> None:
    table, dataset = datagen.candidates(*runs), datagen.open_dataset(*runs).load()
    rows = dataset["scene_row"].values
    assert len(table) == 64
    np.testing.assert_array_equal(table["label"], dataset["label"])
    np.testing.assert_array_equal(table["house"], dataset["house_id"].values[rows])
    np.testing.assert_array_equal(table["object"], dataset["object_name"].values[rows, 0])
    np.testing.assert_array_equal(table["run"], dataset["run"].values[rows])
    assert [split_of(house) for house in table["house"]] == table["split"].tolist()
    base, target = dataset["base_xy_m"].values, dataset["target_center_m"].values[rows]
    np.testing.assert_allclose(table[["base_x_world_m", "base_y_world_m"]], base)
    offset = table[["base_x_target_m", "base_y_target_m"]].to_numpy()
    np.testing.assert_allclose(offset, base - target[:, :2])
    np.testing.assert_array_equal(table["base_yaw_world_rad"], dataset["base_yaw_rad"])
    assert table["place"].tolist() == [PLACE_KINDS[code] for code in dataset["place"].values[rows]]
    assert table["robot"].isna().all()  # heuristic labels are of no particular arm
    np.testing.assert_allclose(table["cost_s"], 1 / 18)  # a second an attempt of 3 scenes of 6


def test_columns_are_chosen_by_name_and_wrong_ones_list_the_valid(runs: tuple[Path, Path]) -> None:
    table = datagen.candidates(runs[0], columns=["sample_id", "retry", "label", "retry"])  # once each
    assert table.columns.tolist() == ["sample_id", "retry", "label"]
    assert table["sample_id"].nunique() == 40 and len(str(table["sample_id"][0])) == 32
    with pytest.raises(datagen.InputError, match=r"columns: labels: .* Choose one of: arm_reach_m, base_"):
        datagen.candidates(runs[0], columns=["labels"])
    with pytest.raises(datagen.InputError, match="columns: nothing"):
        datagen.open_dataset(runs[0], columns=["nothing"])
    assert "points_m" not in datagen.open_dataset(runs[0], columns=["label"])


def test_sealed_and_merged_stores_give_the_same_table(runs: tuple[Path, Path], tmp_path: Path) -> None:
    merge_runs(plan_merge([str(run) for run in runs], str(tmp_path / "merged")))
    parts = [Path(run.storage.url) for run in open_runs(tmp_path / "merged")]
    columns = ["sample_id", "label", "house", "base_yaw_world_rad"]
    whole = datagen.candidates(*parts, columns=columns)
    assert whole.equals(datagen.candidates(tmp_path / "merged", columns=columns))
    store = datagen.candidates(runs[0] / "data.zarr")
    assert store.drop(columns=["run", "cost_s"]).equals(
        datagen.candidates(runs[0]).drop(columns=["run", "cost_s"])
    )
    assert store["cost_s"].isna().all()


def test_runs_named_twice_incomplete_or_absent_are_refused(runs: tuple[Path, Path], tmp_path: Path) -> None:
    for opened in (datagen.candidates, datagen.open_dataset):
        with pytest.raises(datagen.InputError, match="no run is given"):
            opened()
        with pytest.raises(datagen.InputError, match="has the specification of"):
            opened(runs[0], runs[0])
        with pytest.raises(datagen.InputError):
            opened(tmp_path)
    grown = make_stream_run(tmp_path / "c", 24)
    grown.grow(48)
    with pytest.raises(datagen.InputError, match="12 of the 48 planned samples"):
        datagen.candidates(tmp_path / "c")
    assert len(datagen.candidates(tmp_path / "c", allow_incomplete=True)) == 36


def test_outcomes_are_words_and_missing_where_labels_are_heuristic(
    sim_run: Path, runs: tuple[Path, Path]
) -> None:
    table = datagen.candidates(sim_run, runs[0])
    simulated = table[table["run"] == str(sim_run)]
    assert ((simulated["outcome"] == "success") == (simulated["label"] == 1)).all()
    assert set(simulated["robot"]) == {"panda-scaled"} and simulated["trials"].notna().all()
    rest = table[table["run"] != str(sim_run)]
    assert rest["outcome"].isna().all() and rest["trials"].isna().all() and rest["robot"].isna().all()
    assert datagen.open_dataset(sim_run, runs[0], columns=["label"]).sizes["candidate"] == len(table)
    with pytest.raises(datagen.InputError, match="columns: outcome"):
        datagen.open_dataset(sim_run, runs[0], columns=["outcome"])
