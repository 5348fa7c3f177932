"""Whole files that exchanged their places: found, and repaired where something names what they belong to."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from datagen import cli
from datagen.schemas.errors import InputError
from datagen.schemas.record_files import commit_key
from datagen.schemas.run import Run, open_runs
from tests.faults.crash_points_operations import remake
from tests.faults.damage_campaign import content, fewer_arrays, findings_at, repair_at
from tests.faults.swap_campaign import Swap, Swaps, exchange, make_world, swaps, try_swap
from tests.made_runs import attempt, files_of, make_run, small_spec


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """Runs of few files."""
    with fewer_arrays():
        yield


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three sound places. Tests only copy them."""
    world = tmp_path_factory.mktemp("swaps") / "clean"
    make_world(world)
    return world


def test_a_swap_of_each_kind_is_found_and_repaired_or_left_whole(clean: Path, tmp_path: Path) -> None:
    found = Swaps()
    for swap in swaps(clean, 1, np.random.default_rng(3)):
        try_swap(clean, tmp_path / "world", swap, found)
    assert found.wrong == []
    assert {"manifest.json", "plans", "copy of plans", "sealed file"} <= found.restored.keys()
    assert found.left.keys() == {"end"} and {"commits", "object", "quarantine"} <= found.set_aside.keys()


def test_the_campaign_sees_what_is_missed(clean: Path, tmp_path: Path) -> None:
    found, equal = Swaps(), Swap("plans", "run/plans/1.json", "run/copies/plans/1.json")
    try_swap(clean, tmp_path / "world", equal, found)
    assert len(found.wrong) == 1 and "missed" in found.wrong[0]


@pytest.mark.parametrize("folders", [("plans",), ("plans", "copies/plans")], ids=str)
def test_merged_runs_are_not_sealed_over_exchanged_plans(
    folders: tuple[str, ...], clean: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(clean / "merged", tmp_path / "merged")
    one, other = (Path(run.storage.url) for run in open_runs(tmp_path / "merged"))
    whole = files_of(tmp_path / "merged")
    for folder in folders:
        exchange(one / f"{folder}/1.json", other / f"{folder}/1.json")
    before = files_of(tmp_path / "merged")
    has_copies = len(folders) == 1
    with pytest.raises(InputError, match=r"spec_hash.*datagen verify --repair"):
        _ = Run.open(one).n
    assert cli.run(["verify", str(tmp_path / "merged")]) == 1
    assert cli.run(["verify", str(tmp_path / "merged"), "--repair"]) == (0 if has_copies else 1)
    assert files_of(tmp_path / "merged") == (whole if has_copies else before)
    assert has_copies or "plans/1.json" in capsys.readouterr().out


def test_a_manifest_of_another_part_is_not_read(clean: Path, tmp_path: Path) -> None:
    shutil.copytree(clean / "merged", tmp_path / "merged")
    whole = files_of(tmp_path / "merged")
    one, other = (Path(run.storage.url) for run in open_runs(tmp_path / "merged"))
    exchange(one / "manifest.json", other / "manifest.json")
    with pytest.raises(InputError, match=r"spec_hash.*datagen verify --repair"):
        open_runs(tmp_path / "merged")
    assert repair_at(tmp_path / "merged").left == []
    assert files_of(tmp_path / "merged") == whole


def test_commits_of_two_runs_of_one_specification_are_told_apart(tmp_path: Path) -> None:
    for name in ("run", "twin"):
        run = make_run(tmp_path / name, 20, shards=[], spec=small_spec(4))
        for shard in run.missing():
            assert attempt(run, shard, f"{name}-{shard}")
    whole = content(tmp_path / "run")
    exchange(tmp_path / "run" / commit_key(0), tmp_path / "twin" / commit_key(0))
    for name in ("run", "twin"):
        folder = tmp_path / name
        assert {finding.shard for finding in findings_at(folder)} == {0}
        assert repair_at(folder).left == []
        remake(folder)
        assert findings_at(folder) == []
        assert {key: content(folder)[key] for key in whole if "json" not in key} == {
            key: data for key, data in whole.items() if "json" not in key
        }
