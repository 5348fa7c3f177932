"""Exports of any format: equal bytes, resumed exports, their check against the run, and what is refused."""

from __future__ import annotations

import json
import shutil
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pandas
import pytest
import yaml

import datagen
from datagen import cli
from datagen.exports import FORMATS, export_run, webdataset
from datagen.schemas.run import Run
from datagen.schemas.shard_files import assets_of
from datagen.schemas.specification import ArmParams, Source
from datagen.schemas.storage import Storage, open_storage
from tests.made_runs import make_run, small_spec
from tests.refusals import refused
from tests.small_runs import PER_SCENE, json_of, make_small_run
from tests.train.conftest import sim_run
from tests.train.stream_runs import make_stream_run

__all__ = ["sim_run"]

ENDS = "Run the same `datagen export` again"


def export(run: Path | str, out: Path | str, to: str = "parquet", *more: str) -> int:
    return cli.run(["export", str(run), "--to", to, "--out", str(out), *more])


def bytes_of(out: Path | str) -> dict[str, bytes]:
    storage = open_storage(out, create=False)
    return {file.key: storage.get(file.key, 2**30) or b"" for file in storage.list("")}


@pytest.fixture
def many_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """A file for each scene, of formats that put many into one."""
    for module in (export_run, webdataset):
        monkeypatch.setattr(module, "SCENES_PER_FILE", 1)


@pytest.mark.parametrize("to", sorted(FORMATS))
def test_equal_runs_give_equal_bytes(to: str, finished: Path, tmp_path: Path, request: pytest.FixtureRequest):
    if to == "rerun" and not find_spec("rerun"):
        pytest.skip("the extra `rerun` is not installed: 500 MB")
    run = request.getfixturevalue("sim_run") if to in ("lerobot", "rerun") else finished
    scenes = ("--scenes", "3:4") if to in ("lerobot", "rerun") else ()
    for out in ("first", "again"):
        assert export(run, tmp_path / out, to, *scenes) == 0
    first, again = bytes_of(tmp_path / "first"), bytes_of(tmp_path / "again")
    assert first == again and len(first) > 1


@pytest.mark.usefixtures("many_files")
@pytest.mark.parametrize("to", ["parquet", "huggingface", "webdataset"])
def test_an_interrupted_export_continues_with_the_next_file(
    to: str,
    finished: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert export(finished, tmp_path / "whole", to) == 0
    put, written = Storage.put, list[str]()

    def failing(self: Storage, key: str, data: bytes, durably: bool = True) -> None:
        if key != "export.json":
            written.append(key)
            if len(written) == 3:
                raise KeyboardInterrupt
        put(self, key, data, durably)

    monkeypatch.setattr(Storage, "put", failing)
    assert export(finished, tmp_path / "out", to) == cli.EXIT_INTERRUPTED
    assert cli.run(["verify", str(tmp_path / "out")]) == 1
    assert "export.json: the export was interrupted" in capsys.readouterr().out
    damaged, first = written[1], set(written[:2])
    (tmp_path / "out" / damaged).write_bytes(b"torn")
    written[:] = ["", "", ""]  # no further interruption
    assert export(finished, tmp_path / "out", to) == 0
    assert set(written) & first == {damaged} and len(written) > 4
    assert bytes_of(tmp_path / "out") == bytes_of(tmp_path / "whole")


def test_verify_says_whether_an_export_is_still_its_run(
    copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert export(copied, out) == 0
    capsys.readouterr()
    assert cli.run(["verify", str(out)]) == 0
    assert capsys.readouterr().out == f"clean: {out} is the parquet export of ../run (1 file, every byte)\n"
    table, data = out / "candidates/00000.parquet", (out / "candidates/00000.parquet").read_bytes()
    for change in (data[:-1], None):
        table.write_bytes(change) if change is not None else table.unlink()
        assert cli.run(["verify", str(out)]) == 1
        assert capsys.readouterr().out == f"candidates/00000.parquet: is missing or was changed. {ENDS}\n"
    table.write_bytes(data)
    (out / "notes.txt").write_text("mine")
    report = json.loads(_verified(out, capsys))
    assert report["findings"] == [{"file": "notes.txt", "problem": "is not of this export. Move it away"}]
    (out / "notes.txt").unlink()
    refused(["verify", str(out), "--repair"], capsys, "is an export")
    make_small_run(copied, 4 * PER_SCENE)  # the run grows
    assert cli.run(["verify", str(out)]) == 1
    assert "export.json: the run has changed since" in capsys.readouterr().out
    shutil.move(copied, tmp_path / "elsewhere")
    refused(["verify", str(out)], capsys, "export.json", "no such folder")
    (out / "export.json").write_bytes(b"torn")
    refused(["verify", str(out)], capsys, "export.json", "Export again into a new --out")


def _verified(out: Path, capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert cli.run(["verify", str(out), "--json"]) == 1
    return capsys.readouterr().out


def test_a_run_on_s3_is_exported_there_as_on_a_disk(
    bucket: str, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for file in finished.rglob("*"):
        if file.is_file():
            open_storage(f"{bucket}/run").put(str(file.relative_to(finished)), file.read_bytes())
    report = json_of(capsys, ["export", f"{bucket}/run", "--to", "webdataset", "--out", f"{bucket}/out"])
    assert report["out"] == f"{bucket}/out" and report["scenes"] == 3
    assert cli.run(["verify", f"{bucket}/out"]) == 0
    assert export(finished, tmp_path / "out", "webdataset") == 0
    here, there = bytes_of(tmp_path / "out"), bytes_of(f"{bucket}/out")
    assert here.pop("export.json") != there.pop("export.json")  # they name the run
    assert here == there


def test_merged_runs_are_exported_as_one_and_scenes_are_counted_over_them(tmp_path: Path) -> None:
    parts = [
        str(make_stream_run(tmp_path / name, n, seed=seed).storage.url)
        for name, n, seed in (("a", 40, 0), ("b", 24, 2))
    ]
    datagen.merge(parts, out=tmp_path / "merged")
    assert datagen.export(tmp_path / "merged", to="parquet", out=tmp_path / "all")["scenes"] == 7 + 4
    table, ours = pandas.read_parquet(tmp_path / "all/candidates"), datagen.candidates(tmp_path / "merged")
    assert table["label"].tolist() == ours["label"].tolist() and table["scene_id"].nunique() == 11
    datagen.export(tmp_path / "merged", to="parquet", out=tmp_path / "some", scenes="5:9")
    some = pandas.read_parquet(tmp_path / "some/candidates")
    chosen = table["scene_id"].isin(table["scene_id"].unique()[5:9])
    pandas.testing.assert_frame_equal(some, table[chosen].reset_index(drop=True))
    number: Any = 6  # in place of its text
    one = datagen.export(tmp_path / "merged", to="parquet", out=tmp_path / "one", scenes=number)
    assert one["scenes"] == 1


def test_cards_and_stores_state_the_licences_of_what_was_used(tmp_path: Path) -> None:
    stated = {
        "objects_title": "Our scans",
        "objects_licence": "CC-BY-SA-4.0",
        "objects_attribution": "Us, 2025",
    }
    spec = small_spec()
    foreign = spec.model_copy(update={"objects": Source(kind="ycb", digest="2" * 64)})
    make_run(tmp_path / "run", spec=foreign, sources=stated)
    report = datagen.export(tmp_path / "run", to="huggingface", out=tmp_path / "out")
    assert report["license"] == "built-in houses: Apache-2.0; Our scans: CC-BY-SA-4.0"
    text = (tmp_path / "out/README.md").read_text()
    assert yaml.safe_load(text.split("---\n")[1])["license"] == ["apache-2.0", "cc-by-sa-4.0"]
    assert "- Our scans: CC-BY-SA-4.0 (Us, 2025)" in text
    assert json.loads((tmp_path / "out/croissant.json").read_text())["license"] == [
        "Apache-2.0",
        "CC-BY-SA-4.0",
    ]
    for digest, licence in ((None, "CC-BY-NC-4.0"), ("3" * 64, "not stated")):
        arm = ArmParams(robot="stretch3", robot_digest=digest)
        assert assets_of(spec.model_copy(update={"arm": arm}), {})[-1].licence == licence


def test_bad_input_is_refused_in_one_line(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["export", str(finished), "--out", str(tmp_path / "out")]
    refused(
        [*words, "--to", "parket"], capsys, "--to: parket", "Did you mean parquet?", "huggingface, lerobot"
    )
    refused([*words, "--to", "lerobot"], capsys, "heuristic labels have no executed trials")
    for scenes in ("3", "2:2", "0:4", "-1", "a"):
        refused(
            [*words, "--to", "parquet", f"--scenes={scenes}"], capsys, "range of the run's 3 scenes", "0:3"
        )
    assert not (tmp_path / "out").exists()
    refused(["export", str(tmp_path), "--to", "parquet", "--out", str(tmp_path / "out")], capsys, "not a run")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("text")
    for out in (tmp_path / "mine", finished):
        refused(
            ["export", str(finished), "--to", "parquet", "--out", str(out)], capsys, "is not of an export"
        )
    assert export(finished, tmp_path / "out") == 0
    refused([*words, "--to", "webdataset"], capsys, "an export with another format: parquet, not webdataset")
    refused([*words, "--to", "parquet", "--scenes", "0:2"], capsys, "another scenes", "Give a new --out")
    incomplete = Run.open(make_run(tmp_path / "less", shards=[0, 1]).storage)
    gone = ["export", incomplete.storage.url, "--to", "parquet", "--out", str(tmp_path / "new")]
    refused(gone, capsys, "30 of the 50 planned samples are missing", "datagen resume")
