"""Bad command lines, configurations and houses: one line that names place and fix, and no trace."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import pytest

from tests.refusals import refused
from tests.small_runs import CONFIG, PER_SCENE, files_of, submit_arguments
from tests.workers.houses.house_files import write_houses

OPTIONS: list[tuple[str, list[str]]] = [
    ("--n 0", ["--n", "0", "10^12"]),
    ("--n -5", ["--n", "-5"]),
    ("--n 10000000000000", ["--n", "10000000000000", "10^12"]),
    ("--n many", ["--n", "many", "whole number"]),
    ("--n 2.5", ["--n", '"2.5" is not a whole number', "--help"]),
    ("--n " + "9" * 5000, ["--n", "999..."]),
    ("--workers -1", ["--workers", "-1", "4096"]),
    ("--workers 5000", ["--workers", "5000", "4096"]),
    ("--workers two", ["--workers", "two"]),
    ("--workers 0.5", ["--workers", "0.5"]),
    ("--workers 0 --address auto", ["--workers: 0: is given with --address auto"]),
    ("--seed 1.5", ["--seed", "1.5"]),
    ("--seed -1", ["seed", "-1", "0"]),
    ("--seed 9223372036854775808", ["seed", "9223372036854775808"]),
    ("--split dev", ["--split", "dev", "train"]),
    ("--candidates-per-scene 0", ["--candidates-per-scene", "0", "625"]),
    ("--candidates-per-scene 626", ["--candidates-per-scene", "626", "625"]),
    ("--candidates-per-scene all", ["--candidates-per-scene", "all", "grid"]),
    ("--candidates-per-scene ٣", ["--candidates-per-scene"]),
    ("--candidates-per-scene ²", ["--candidates-per-scene", "625"]),
    ("--candidates all", ["--candidates", "all", "in-range"]),
    ("--robot hal", ["--robot", "hal", "panda-scaled"]),
    ("--perturb 3", ["--perturb", "3", "heuristic", "sim"]),
    ("--perturb often", ["--perturb", "often"]),
    ("--scenes-from {missing}", ["{missing}", "no such folder"]),
    ("--scenes-from {file}", ["{file}"]),
    ("--scenes-from {foreign}", ["{foreign}", "not a run"]),
    ("--houses castle", ["--houses", "castle", "builtin"]),
    ("--houses {empty}", ["--houses", "Write KIND:{empty}", "procthor"]),
    ("--objects {empty}", ["--objects", "Write KIND:{empty}", "ycb"]),
    ("--houses builtin:many", ["builtin", "many"]),
    ("--houses builtin:0", ["builtin"]),
    ("--houses procthor:", ["procthor", "no such folder"]),
    ("--houses procthor:{missing}", ["{missing}", "no such folder"]),
    ("--houses procthor:{file}", ["{file}", "no such folder"]),
    ("--houses procthor:{empty}", ["{empty}", "asset_sizes.json"]),
    ("--houses ai2thor:{empty}", ["{empty}", "ai2thor-hab"]),
    ("--objects toys", ["toys", "builtin, folder, ycb"]),
    ("--objects builtin:x", ["builtin:x", "no folder"]),
    ("--objects ycb", ["ycb", "ycb:DIR"]),
    ("--objects ycb:{missing}", ["{missing}"]),
    ("--objects ycb:{empty}", ["{empty}", "objects.json"]),
    ("--objects ycb:{file}", ["{file}"]),
    ("--out {file}", ["{file}", "is a file"]),
    ("--out {file}/below", ["{file}/below", "Not a directory"]),
    ("--out {foreign}", ["{foreign}", "thesis.tex", "--out"]),
    ("--out {missing}\0", ["not the name of a folder"]),
    ("--out ftp://key:secret@example.org/run", ["ftp://...", "s3://"]),
    ("--config {missing}", ["{missing}", "No such file"]),
    ("--config {empty}", ["{empty}", "not a file"]),
    ("--config /dev/zero", ["/dev/zero", "not a file"]),
    ("--config {file}\0", ["not a file"]),
    ("--confg {file}", ["--confg"]),
    ("--candidates grid --candidates-per-scene 60", ["grid"]),
    ("--candidates clear --candidates-per-scene grid", ["clear"]),
    ("--candidates in-range --candidates-per-scene grid", ["in-range"]),
    *(
        (f"--workers 2 --address {address}", ["--address", address, "--address local"])
        for address in ("127.0.0.1:1", "here", "", ":", "a:b", "127.0.0.1:99999")
    ),
]


@pytest.mark.parametrize(("more", "words"), OPTIONS, ids=[o[:60] for o, _ in OPTIONS])
def test_a_bad_option(
    more: str, words: list[str], places: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    before = files_of(places["out"].parent)
    options = more.format(**places).split(" ")
    chosen = {"--n": "16", "--out": str(places["out"]), "--workers": "0"}
    chosen |= dict(zip(options[::2], options[1::2], strict=True))
    arguments = ["submit", "heuristic", *(text for pair in chosen.items() for text in pair)]
    refused(arguments, capsys, *(word.format(**places) for word in words))
    assert files_of(places["out"].parent) == before
    assert not places["out"].exists() and not places["missing"].exists()


@pytest.mark.parametrize("renderer", ["sapien", "tests.none:render"])
def test_an_unknown_renderer(renderer: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "config.toml"
    config.write_text(f"[observation]\nrenderer = '{renderer}'\n")
    out = tmp_path / "out"
    arguments = ["submit", "heuristic", "--n", "16", "--out", str(out), "--config", str(config)]
    refused(arguments, capsys, "observation.renderer", renderer, "unknown", "embree")
    assert not out.exists()


@pytest.mark.parametrize("source", ["planned", "Heuristic", "", "--n"])
def test_an_unknown_label_source(source: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refused(["submit", source, "--n", "16", "--out", str(tmp_path / "out"), "--workers", "0"], capsys)
    assert list(tmp_path.iterdir()) == []


CONFIGS: list[tuple[str, list[str]]] = [
    ("n_clutter = 3", ["n_clutter", "Remove or correct the key"]),
    ("[scene]\nclutter = 3", ["scene.clutter", "docs/reference/specification.md"]),
    ("[scene]\nn_clutter = -1", ["scene.n_clutter", "-1"]),
    ("[scene]\nmax_retries = 0", ["scene.max_retries"]),
    ("[observation]\nn_points = 10", ["observation.n_points", "64"]),
    ("[observation.noise]\nbaseline_m = 0", ["observation.noise.baseline_m"]),
    ("[visibility]\nwindow_px = 4", ["visibility.window_px", "8"]),
    ("[candidates]\ngrid_cells = 1", ["candidates.grid_cells"]),
    ("[heuristic]\nalpha = 1.5", ["heuristic.alpha", "1"]),
    ("[scene]\nn_clutter = 31", ["scene.n_clutter", "30"]),
    ("[scene]\nn_clutter = 'six'", ["scene.n_clutter", "six", "integer"]),
    ("[scene]\nn_clutter = 2.5", ["scene.n_clutter", "2.5"]),
    ("scene = 3", ["scene", "3"]),
    ("candidates = 'all'", ["candidates"]),
    ("[scene]\nclutter_radius_m = nan", ["scene.clutter_radius_m", "finite"]),
    ("[scene]\nsupport_height_m = {low = 1.0, high = 0.5}", ["scene.support_height_m", "below"]),
    ("[scene]\nsupport_height_m = {low = nan, high = nan}", ["scene.support_height_m", "finite"]),
    ("[settle]\nengine = 'havok'", ["settle.engine", "havok", "pybullet"]),
    ("[settle]\nmax_steps = 1e400", ["settle.max_steps"]),
    ("[observation]\nwidth_px = 100000", ["observation.width_px", "4096"]),
    ("[observation]\nfx_px = -inf", ["observation.fx_px"]),
    ("[candidates]\nper_scene = 'most'", ["candidates.per_scene"]),
    ("[heuristic]\nd_min = 0.5\nd_max = 0.4", ["heuristic", "d_max"]),
    ("[heuristic]\ndistance = 'manhattan'", ["heuristic.distance", "planar"]),
    ("split = 'none'", ["split"]),
    ("seed = true", ["seed", "integer"]),
    ("[heuristic]\nmu = '0.5'", ["heuristic.mu", "number"]),
    ("[observation.noise]\nenabled = 1", ["observation.noise.enabled", "boolean"]),
    ("seed = " + "1" * 5000, ["not TOML"]),
    ("[candidates]\nwithin = 'near'", ["candidates.within", "in-range"]),
    ("[candidates]\nper_scene = 'grid'\nwithin = 'clear'", ["--candidates-per-scene 60"]),
    ("[arm]\nrobot = 'panda'", ["arm", "heuristic has no arm"]),
    ("[scenes_from]\nspec_hash = 'a'", ["scenes_from", "command line"]),
    ("label_source = 'sim'", ["label_source", "command line"]),
    ("[houses]\nkind = 'builtin'", ["houses", "command line"]),
    ("[engines]\nsapien = '2'", ["engines", "command line"]),
    ("[scene", ["not TOML"]),
    ("a = 1\na = 2", ["not TOML"]),
    ("x = " + "[" * 20_000, ["not TOML"]),
    ("# " + "x" * (1 << 20), ["more than the 1,048,576 allowed"]),
    ("\x00", ["not TOML"]),
]


@pytest.mark.parametrize(("text", "words"), CONFIGS, ids=[t[:40].replace("\n", " ") for t, _ in CONFIGS])
def test_a_bad_configuration(
    text: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = submit_arguments(tmp_path / "run", 16, config=text)
    at = arguments.index("--candidates-per-scene")
    refused(arguments[:at] + arguments[at + 2 :], capsys, str(tmp_path / "run.toml"), *words)
    assert not (tmp_path / "run").exists()


def test_a_configuration_of_random_bytes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = submit_arguments(tmp_path / "run", 16)
    (tmp_path / "run.toml").write_bytes(bytes(range(128, 256)))
    refused(arguments, capsys, "run.toml", "not TOML")
    assert not (tmp_path / "run").exists()


# Folders of houses -------------------------------------------------------------------------------


def bare_house(**changes: Any) -> dict[str, Any]:
    """A house of one empty room, 4 x 4 m, in ProcTHOR's own form."""
    floor = [{"x": x, "y": 0, "z": z} for x, z in ((0, 0), (0, 4), (4, 4), (4, 0))]
    walls = []
    for k, (a, b) in enumerate(zip(floor, floor[1:] + floor[:1], strict=True)):
        polygon = [a, b, {**a, "y": 2.5}, {**b, "y": 2.5}]
        walls.append({"id": f"wall|{k}", "roomId": "room|1", "polygon": polygon})
    room = {"id": "room|1", "roomType": "Kitchen", "floorPolygon": floor}
    return {
        "_id": "bare",
        "rooms": [room],
        "walls": walls,
        "doors": [],
        "windows": [],
        "objects": [],
    } | changes


TABLE = {
    "Table_1": {
        "objectType": "DiningTable", "size": [1.2, 0.75, 0.8], "surface_height_m": 0.75,
        "receptacle": True, "pickupable": False,
    }
}  # fmt: skip


def procthor_folder(folder: Path, lines: list[str]) -> Path:
    """Houses as ProcTHOR JSON lines beside a size table."""
    folder.mkdir()
    (folder / "asset_sizes.json").write_text(json.dumps(TABLE))
    with gzip.open(folder / "houses.jsonl.gz", "wt") as file:
        file.write("\n".join(lines) + "\n")
    return folder


LOW_TABLE = {
    "id": "t", "assetId": "Table_1", "position": {"x": 1.5, "y": 0.375, "z": 1.5},
    "rotation": {"x": 0, "y": 0, "z": 0},
}  # fmt: skip


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([json.dumps(bare_house())], ["no_surface 7", "no support surface", "bare with no surface", "axes"]),
        (
            [json.dumps(bare_house(objects=[LOW_TABLE]))],
            [
                "no_surface 7",
                "with surfaces at 0.75 to 0.75 m, up to 0.80 m wide, not at 0.9 to 1.2 m",
                "scale",
            ],
        ),
        ([json.dumps(bare_house(rooms=[]))], ["bad_house 7", "$.rooms: has no rooms. Correct"]),
        (
            [json.dumps({"_id": "x"}), '{"_id": "y", "rooms": [[[', "[]"],
            ["bad_house 7", "houses cannot be used, as "],
        ),
    ],
    ids=["no receptacle", "low receptacle", "no room", "broken JSON only"],
)
def test_houses_that_give_no_scene_are_refused_with_the_causes(
    lines: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = procthor_folder(tmp_path / "houses", lines)
    config = CONFIG + "\n[scene]\nmax_retries = 7\nsupport_height_m = {low = 0.9, high = 1.2}\n"
    out = tmp_path / "run"
    arguments = submit_arguments(out, PER_SCENE, "--houses", f"procthor:{folder}", config=config)
    told = refused(arguments, capsys, f"procthor:{folder}", *words)
    assert " ." not in told and ".." not in told
    assert not out.exists()


EMPTY = gzip.compress(b"", mtime=0), gzip.compress(b"\n\n", mtime=0)


@pytest.mark.parametrize("data", [*EMPTY, b"not gzip at all"], ids=["empty", "blank", "not gzip"])
def test_a_folder_whose_files_hold_no_house(
    data: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = write_houses(tmp_path / "houses", []), tmp_path / "run"
    (folder / "houses.jsonl.gz").write_bytes(data)
    refused(submit_arguments(out, 16, "--houses", f"procthor:{folder}"), capsys, str(folder))
    assert not out.exists()
