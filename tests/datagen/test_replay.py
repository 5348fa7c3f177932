"""`datagen replay`: scenes from their records, compared stage by stage, and shards with nothing caught."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from datagen import cli
from datagen.commands.replay import find_sample
from datagen.regeneration.single_shard import ShardFailed
from datagen.regeneration.stage_comparison import STAGES
from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMAS
from datagen.schemas.run import Run
from datagen.schemas.run_records import QuarantineRecord
from datagen.workers.labels import heuristic_source
from tests.datagen.forged import forge
from tests.refusals import refused
from tests.small_runs import PER_SCENE, arrays_of, files_of, json_of, make_small_run

SCENES = 4
N = SCENES * PER_SCENE - 3  # the last scene is cut

Columns = dict[str, np.ndarray[Any, Any]]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four scenes, one a shard. Tests only read it."""
    return make_small_run(tmp_path_factory.mktemp("source") / "run", N)


def id_of(run: Path, row: int) -> str:
    """The id of a row of the sealed store, as a user reads it there."""
    return arrays_of(run)["sample_id"][row].tobytes().hex()


@pytest.mark.parametrize("name", sorted(SCHEMAS))
def test_every_field_belongs_to_one_stage(name: str) -> None:
    schema = SCHEMAS[name]
    fields = {f.name for f in (*schema.scene_fields, *schema.sample_fields)}
    staged = [field for names in STAGES.values() for field in names]
    assert len(staged) == len(set(staged)) and fields <= set(staged)


def test_a_sample_is_found_by_its_id_and_its_scene_is_equal(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    held = files_of(source)
    row = 2 * PER_SCENE + 3
    picture = tmp_path / "replay.png"
    told = json_of(capsys, ["replay", str(source), id_of(source, row), "--out", str(picture)])
    arrays = arrays_of(source)
    assert told["equal"] and told["drawn_again"] and (told["scene"], told["shard"]) == (2, 2)
    assert told["sample"]["id"] == id_of(source, row) and told["sample"]["candidate"] == 3
    assert told["sample"]["label"] == arrays["label"][row]
    assert [stage["stage"] for stage in told["stages"]] == [
        "draw", "settle", "observe", "candidates", "visibility", "labels",
    ]  # fmt: skip
    assert sum(stage["fields"] for stage in told["stages"]) == len(arrays)
    assert {s["stage"] for s in told["recomputed"]} == {"candidates", "visibility", "labels"}
    assert told["differs_here"] == []
    with Image.open(picture) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert pixels.shape == (984, 1320, 3)
    # The frames of both sides are the same picture.
    assert np.abs(pixels[140:380, 80:400] - pixels[140:380, 515:835]).mean() < 8
    assert files_of(source) == held


def test_a_prefix_that_is_unique_is_enough(source: Path) -> None:
    run = Run.open(source)
    found, scene, row = find_sample([run], id_of(source, 11)[:6].upper())
    assert (found, scene, row) == (run, 1, 3)


def test_ids_that_name_nothing_or_more_are_refused(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    refused(["replay", str(source), "0" * 32], capsys, "is not a sample of")
    refused(["replay", str(source), "12345"], capsys, "6 to 32 hexadecimal digits")
    refused(["replay", str(source), "../../etc"], capsys, "hexadecimal digits")
    beyond = Run.open(source)
    last = id_of(make_small_run(tmp_path / "longer", N + 3), N)
    with pytest.raises(InputError, match="is not a sample"):
        find_sample([beyond], last)
    monkeypatch.setattr("datagen.commands.replay._PREFIX_AT_LEAST", 1)
    with pytest.raises(InputError, match=r"matches several samples .*Give more digits"):
        find_sample([beyond], id_of(source, 0)[:1])


def test_samples_of_merged_runs_are_found_in_their_part(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = make_small_run(tmp_path / "other", PER_SCENE, "--seed", "4")
    assert cli.run(["merge", str(source), str(other), "--out", str(tmp_path / "both")]) == 0
    told = json_of(capsys, ["replay", str(tmp_path / "both"), id_of(other, 5)])
    assert told["equal"] and told["run"].startswith(str(tmp_path / "both/parts/"))
    assert (told["scene"], told["sample"]["candidate"]) == (0, 5)
    refused(["replay", str(tmp_path / "both"), "--scene", "0"], capsys, "--scene", "name a part", "parts/")


def move_object(a: Columns) -> None:
    a["T_world_object"][0, 2, 1, 3] += 0.03


def test_what_differs_is_named_with_its_size_and_drawn(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    forge(source, tmp_path / "run", 1, move_object)
    arguments = ["replay", str(tmp_path / "run"), "--scene", "1", "--out", str(tmp_path / "scene.png")]
    capsys.readouterr()
    assert cli.run(arguments) == 1
    told = capsys.readouterr().out
    assert "T_world_object in 1, by up to 0.03 m" in told and "different" in told
    assert (tmp_path / "scene.png").stat().st_size > 10_000
    capsys.readouterr()
    assert cli.run(["replay", str(tmp_path / "run"), "--scene", "0"]) == 0
    assert "equal, bit for bit" in capsys.readouterr().out


def test_a_forged_label_differs_from_its_stored_poses(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def flip(a: Columns) -> None:
        a["label"][2] ^= 1

    forge(source, tmp_path / "run", 0, flip)
    capsys.readouterr()
    assert cli.run(["replay", str(tmp_path / "run"), id_of(source, 2)]) == 1
    assert "label in 1, by up to 1" in capsys.readouterr().out
    # Its neighbour's scene differs, its own label does not.
    assert cli.run(["replay", str(tmp_path / "run"), id_of(source, 3)]) == 1
    assert cli.run(["replay", str(tmp_path / "run"), id_of(source, PER_SCENE)]) == 0


def test_scenes_of_another_run_are_drawn_by_it_or_recalled(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    origin, out = tmp_path / "origin", tmp_path / "run"
    shutil.copytree(source, origin)
    assert cli.run(["relabel", str(origin), "--out", str(out), "--mu", "0.8"]) == 0
    assert json_of(capsys, ["replay", str(out), "--scene", "2"])["drawn_again"]
    origin.rename(tmp_path / "elsewhere")
    moved = ["--scenes-from", str(tmp_path / "elsewhere")]
    assert json_of(capsys, ["replay", str(out), "--scene", "2", *moved])["drawn_again"]
    told = json_of(capsys, ["replay", str(out), "--scene", "2"])
    assert told["equal"] and not told["drawn_again"] and told["stages"] == []
    capsys.readouterr()
    assert cli.run(["replay", str(out), "--scene", "2", "--out", str(tmp_path / "scene.png")]) == 0
    assert "not sampled again" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ((), ("one of three ways",)),
        (("abcdef", "--scene", "0"), ("one of three ways",)),
        (("--scene", "4"), ("--scene", "4 is not in this run")),
        (("--shard", "9"), ("--shard", "9 is not in this run", "0 to 3")),
        (("--scene", "0", "--out", "missing/scene.png"), ("--out", "folder does not exist")),
        (("--scene", "0", "--out", "scene.gif"), ("--out", ".png")),
        (("--shard", "0", "--out", "scene.png"), ("--out", "no picture")),
        (("--scene", "0", "--houses", "builtin:7"), ("--houses",)),
    ],
)
def test_what_cannot_be_replayed_is_refused(
    more: tuple[str, ...], words: tuple[str, ...], source: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    refused(["replay", str(source), *more], capsys, *words)


# Shards.


def give_up(run: Run, shard: int) -> None:
    record = QuarantineRecord(
        shard=shard,
        seed=0,
        first_scene=shard,
        scenes=1,
        attempts=("a-1", "a-2"),
        causes=("ValueError: first", "ValueError: the last cause"),
        stacks=("", "Traceback of the worker\n"),
        created="2026-01-01",
    )
    assert run.quarantine(record)


@pytest.fixture
def given_up(source: Path, tmp_path: Path) -> Path:
    """A copy of the run whose shard 1 is in quarantine."""
    shutil.copytree(source, tmp_path / "run")
    (tmp_path / "run/commits/000001.json").unlink()
    give_up(Run.open(tmp_path / "run"), 1)
    return tmp_path / "run"


def test_a_shard_that_runs_here_says_how_to_lift_its_quarantine(
    given_up: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    held = files_of(given_up)
    capsys.readouterr()
    assert cli.run(["replay", str(given_up), "--shard", "1"]) == 0
    told = capsys.readouterr().out
    for words in (
        "the last cause", "Traceback of the worker", f"{PER_SCENE} labels", "no file was written",
        "--quarantined", "quarantined at 2026-01-01",
    ):  # fmt: skip
        assert words in told, told
    assert told.index("the last cause") < told.index("no file was written")
    assert files_of(given_up) == held
    report = json_of(capsys, ["replay", str(given_up), "--shard", "1"])
    assert report["fix"] == f"datagen resume {given_up} --quarantined" and not report["committed"]


def test_a_committed_shard_is_compared_with_its_files(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = json_of(capsys, ["replay", str(source), "--shard", "2"])
    assert report["committed"] and report["differing_files"] == [] and report["recorded"] == []
    forge(source, tmp_path / "run", 2, move_object)
    capsys.readouterr()
    assert cli.run(["replay", str(tmp_path / "run"), "--shard", "2"]) == 1
    assert "1 differ, first T_world_object/c.0" in capsys.readouterr().out


def test_a_defect_reaches_the_debugger_as_it_was_raised(
    given_up: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: Any) -> Any:
        raise ZeroDivisionError("a defect of the label source")

    monkeypatch.setattr(heuristic_source, "HEURISTIC", replace(heuristic_source.HEURISTIC, label=broken))
    with pytest.raises(ZeroDivisionError, match="a defect of the label source") as caught:
        cli.run(["replay", str(given_up), "--shard", "1"])
    assert caught.traceback[-1].name == "broken"
    assert "the last cause" in capsys.readouterr().out


def test_a_batch_that_breaks_its_schema_keeps_its_traceback_too(
    given_up: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = heuristic_source.HEURISTIC

    def broken(*given: Any) -> Any:
        return {**source.label(*given), "visibility": np.full(PER_SCENE, np.nan, np.float32)}

    monkeypatch.setattr(heuristic_source, "HEURISTIC", replace(source, label=broken))
    with pytest.raises(ShardFailed, match="visibility: has NaN") as caught:
        cli.run(["replay", str(given_up), "--shard", "1"])
    assert isinstance(caught.value.__cause__, InputError)


def test_the_command_ends_with_1_and_the_traceback(given_up: Path) -> None:
    code = (
        "import sys; from dataclasses import replace; from datagen import cli;"
        "from datagen.workers.labels import heuristic_source as d\n"
        "def broken(*_): raise ZeroDivisionError('a defect')\n"
        "d.HEURISTIC = replace(d.HEURISTIC, label=broken)\n"
        "sys.exit(cli.run(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", code, "replay", str(given_up), "--shard", "1"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert "Traceback" in ended.stderr and "ZeroDivisionError: a defect" in ended.stderr
    assert "in broken" in ended.stderr
