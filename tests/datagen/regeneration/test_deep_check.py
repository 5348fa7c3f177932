"""Deep checks find rows that are not what the specification means, though every digest is right."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen import cli
from datagen.regeneration.deep_check import deep_findings
from datagen.regeneration.scenes import open_sources
from datagen.schemas.checking.finding import Finding
from datagen.schemas.record_files import encode_record
from datagen.schemas.run import Run
from tests.datagen.forged import forge
from tests.sim_extra import needs_sim
from tests.small_runs import CONFIG, PER_SCENE, json_of, make_small_run

SCENES = 4
N = SCENES * PER_SCENE
ALL = 200  # draws that leave none of so few samples and scenes out

Columns = dict[str, np.ndarray[Any, Any]]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four scenes, one a shard. Tests only read it."""
    return make_small_run(tmp_path_factory.mktemp("source") / "run", N)


def findings(run: Run, k: int = ALL, seed: int = 0) -> list[Finding]:
    return list(deep_findings(run, k, open_sources(run), np.random.default_rng(seed)))


def test_a_sound_run_has_no_findings(source: Path) -> None:
    assert findings(Run.open(source)) == []


def test_nothing_is_checked_where_nothing_is_asked_or_committed(source: Path, tmp_path: Path) -> None:
    run = forge(source, tmp_path / "run", 0, flip_label)
    assert findings(run, 0) == []
    for record in (tmp_path / "run/commits").iterdir():
        record.unlink()
    assert findings(Run.open(tmp_path / "run")) == []


def flip_label(a: Columns) -> None:
    a["label"][3] ^= 1


def move_object(a: Columns) -> None:
    a["T_world_object"][0, 1, 0, 3] += 1e-9


def nudge_score(a: Columns) -> None:
    a["heuristic_score"][5] = np.nextafter(a["heuristic_score"][5], np.float32(2))


def see_more(a: Columns) -> None:
    a["visible_px"][0] += 1


def take_other_id(a: Columns) -> None:
    a["sample_id"][2] += 1


def move_base(a: Columns) -> None:
    a["base_xy_m"][4] += np.float32(0.01)


def recolour(a: Columns) -> None:
    a["rgb"][0, 0] ^= 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (flip_label, "recomputed from stored poses: labels: label: 1 differ, by up to 1"),
        (nudge_score, "labels: heuristic_score: 1 differ"),
        (see_more, "visibility: visible_px: 1 differ, by up to 1 px"),
        (take_other_id, "candidates: sample_id: 16 differ"),
        (move_base, "sampled again: candidates: base_xy_m: 2 differ, by up to 0.01 m"),
        (move_object, "sampled again: settle: T_world_object: 1 differ, by up to 1e-09 m"),
        (recolour, "sampled again: observe: rgb: 3 differ, by up to 1"),
    ],
)
def test_a_forged_row_is_found(
    change: Callable[[Columns], None], words: str, source: Path, tmp_path: Path
) -> None:
    run = forge(source, tmp_path / "run", 2, change)
    found = findings(run)
    assert any(words in f.problem for f in found), found
    assert {f.shard for f in found} == {2}
    assert all(f.key.startswith("shards/000002/forged/") for f in found)


def test_poses_that_nothing_can_have_are_a_finding_and_no_crash(source: Path, tmp_path: Path) -> None:
    def shear(a: Columns) -> None:
        a["T_world_object"][0, 0, 0, 1] += 0.5

    found = findings(forge(source, tmp_path / "run", 1, shear))
    assert any("has impossible values" in f.problem for f in found), found
    assert {f.shard for f in found} == {1}


def made_elsewhere(run: Run) -> Run:
    """The same run as if another machine had made it."""
    other = run.manifest.model_copy(update={"platform": "OtherOS-1.0-riscv64"})
    run.storage.put("manifest.json", encode_record(other))
    return Run.open(run.storage)


def test_runs_of_another_platform_are_held_to_the_stated_tolerances(source: Path, tmp_path: Path) -> None:
    def a_little(a: Columns) -> None:
        a["distance_m"] += np.float32(1e-6)
        a["T_world_camera"][:, 0, 3] += 1e-6
        a["points_m"][0] = a["points_m"][0][::-1]

    assert findings(made_elsewhere(forge(source, tmp_path / "little", 0, a_little))) == []

    def too_much(a: Columns) -> None:
        a["distance_m"][1] += np.float32(1e-4)
        a["label"][7] ^= 1
        a["target_px"][6] += 9

    found = findings(made_elsewhere(forge(source, tmp_path / "much", 3, too_much)))
    told = " ".join(f.problem for f in found)
    for words in ("distance_m differs by 0.0001 m", "label differs by 1", "target_px differs by 9 px"):
        assert words in told, told
    assert {f.shard for f in found} == {3}


def test_scenes_that_were_labelled_again_are_drawn_from_where_they_came(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "again"
    (tmp_path / "rule.toml").write_text("[heuristic]\nmu = 0.7\n")
    config = ["--config", str(tmp_path / "rule.toml"), "--workers", "0"]
    again = ["submit", "heuristic", "--n", str(N), "--out", str(out), "--scenes-from", str(source), *config]
    assert cli.run(again) == 0
    assert findings(Run.open(out)) == []
    run = forge(out, tmp_path / "forged", 1, move_object)
    assert any("sampled again: settle" in f.problem for f in findings(run))


@needs_sim
def test_trials_are_planned_and_executed_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arm = "[candidates]\narm_reach_m = {low = 0.9, high = 1.0}\nrobots_per_scene = 1\n"
    source = make_small_run(tmp_path / "run", 6, "--candidates", "in-range", config=CONFIG + arm, per_scene=6)
    (tmp_path / "arm.toml").write_text("[arm.grasps]\nper_object = 40\nper_scene = 10\n")
    out = tmp_path / "sim"
    more = ["--scenes-from", str(source), "--config", str(tmp_path / "arm.toml"), "--workers", "0"]
    assert cli.run(["submit", "sim", "--n", "6", "--out", str(out), *more]) == 0
    assert findings(Run.open(out), 3) == []
    told = json_of(capsys, ["replay", str(out), "--scene", "0"])
    assert told["equal"] and {"grasps", "plan", "execute"} <= {s["stage"] for s in told["stages"]}
    assert [s["fields"] for s in told["recomputed"] if s["stage"] == "labels"] == [6]

    def other_outcome(a: Columns) -> None:
        a["grasps_tried"] += 1

    found = findings(forge(out, tmp_path / "forged", 0, other_outcome), 3)
    assert any("recomputed from stored poses: plan: grasps_tried" in f.problem for f in found)
