"""`datagen seal` and `datagen unseal`, as called."""

from __future__ import annotations

from pathlib import Path

import pytest
import zarr

from datagen import cli
from tests.made_runs import files_of, make_run
from tests.refusals import refused


def test_a_partial_run_is_sealed_and_told_what_it_lacks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run(tmp_path, n=48, shards=[1, 4])
    before = files_of(tmp_path)
    assert cli.run(["seal", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    assert "48 labels wanted; without 3 of its shards: 0, 2, 3" in told
    assert run.manifest.spec_hash[:16] in told and str(tmp_path / "data.zarr") in told
    assert zarr.open_group(tmp_path / "data.zarr", mode="r")["label"].shape == (18,)
    assert cli.run(["unseal", str(tmp_path)]) == 0
    assert "without 3 of its shards: 0, 2, 3" in capsys.readouterr().out
    assert files_of(tmp_path) == before
    assert cli.run(["unseal", str(tmp_path)]) == 0
    assert "nothing to do" in capsys.readouterr().out


def test_a_store_of_which_nothing_is_known_is_removed_all_the_same(tmp_path: Path) -> None:
    make_run(tmp_path, n=20)
    before = files_of(tmp_path)
    assert cli.run(["seal", str(tmp_path)]) == 0
    (tmp_path / "data.zarr" / "zarr.json").write_text("broken")
    assert cli.run(["unseal", str(tmp_path)]) == 0
    assert files_of(tmp_path) == before


@pytest.mark.parametrize("verb", ["seal", "unseal"])
def test_what_is_no_run_is_refused_and_left_alone(
    verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other" / "data.zarr"
    other.mkdir(parents=True)
    (other / "zarr.json").write_text("{}")
    refused([verb, str(other.parent)], capsys, "manifest.json", "not a run")
    refused([verb, str(tmp_path / "none")], capsys, "no such folder")
    assert (other / "zarr.json").read_text() == "{}"
