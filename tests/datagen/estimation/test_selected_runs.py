"""Runs of selected candidates: the labels of those, with their probabilities, and all that reads them."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from datagen import cli
from datagen.estimation.mixed_labels import read_mixed
from datagen.released import released_checkpoint
from datagen.schemas.run import Run
from datagen.schemas.selection import selection_of
from datagen.train.dataset import SampleStream
from datagen.train.training.checkpoints import read_checkpoint
from tests.refusals import refused
from tests.sim_extra import needs_sim
from tests.small_runs import CONFIG, arrays_of, files_of, json_of, make_small_run
from tests.train.prediction.checkpoints import write_untrained
from tests.train.prediction.seen_scenes import MODEL

pytestmark = needs_sim

SCENES, PER_SCENE, EACH, N = 8, 8, 2, 8
REACHING = CONFIG + "[candidates]\narm_reach_m = {low = 0.9, high = 1.0}\nrobots_per_scene = 1\n"
FEW_GRASPS = "[arm.grasps]\nper_object = 40\nper_scene = 10\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A heuristic run, its candidates planned (`all`), some of them (`some`), and a checkpoint."""
    folder = tmp_path_factory.mktemp("selected")
    make_small_run(folder / "cheap", SCENES * PER_SCENE, "--candidates", "in-range", config=REACHING)
    (folder / "arm.toml").write_text(FEW_GRASPS)
    write_untrained(folder / "model.ckpt", MODEL)
    words = ["--config", str(folder / "arm.toml"), "--workers", "0"]
    cheap = str(folder / "cheap")
    every = ["--n", str(SCENES * PER_SCENE), "--out", str(folder / "all")]
    assert cli.run(["submit", "plan", *every, "--scenes-from", cheap, *words]) == 0
    assert cli.run(select_words(folder, "some")) == 0
    return folder


def select_words(folder: Path, out: str, *more: str, by: str = "margin") -> list[str]:
    model = [] if by == "random" else ["--model", str(folder / "model.ckpt")]
    return [
        "submit", "plan", "--n", str(N), "--out", str(folder / out),
        "--candidates-from", str(folder / "cheap"),
        "--candidates-per-scene", str(EACH), "--select", by, *model, "--config", str(folder / "arm.toml"),
        "--workers", "0", *more,
    ]  # fmt: skip


def test_selected_labels_are_those_of_the_whole_run(folder: Path) -> None:
    every, some = arrays_of(folder / "all"), arrays_of(folder / "some")
    rows = some["sample_scene_index"] * PER_SCENE + some["candidate_index"]
    assert len(rows) == N and len(set(some["sample_scene_index"].tolist())) == N // EACH
    for name in every.keys() - {"sample_id"}:
        if len(every[name]) == SCENES * PER_SCENE:
            np.testing.assert_array_equal(every[name][rows], some[name], err_msg=name)
    selection = selection_of(Run.open(folder / "some"))
    assert selection is not None
    np.testing.assert_array_equal(np.ravel(selection.probability), some["selection_probability"])
    assert "selection_probability" not in every


def test_the_released_model_selects_and_is_estimated(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["released" if word.endswith("model.ckpt") else word for word in select_words(folder, "released")]
    assert cli.run(words) == 0
    selection = Run.open(folder / "released").manifest.spec.selection
    assert selection is not None and selection.models == (read_checkpoint(released_checkpoint()).head.digest,)
    runs = [str(folder / "cheap"), "--with", str(folder / "released")]
    estimates = json_of(capsys, ["estimate", *runs, "--methods", "released"])["estimates"]
    assert [each["population"] for each in estimates][-1] == "picks of released"


def test_a_selected_run_is_sound_and_is_made_again_alike(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(["verify", str(folder / "some"), "--deep", "2"]) == 0
    assert cli.run(["replay", str(folder / "some"), "--scene", "1"]) == 0
    assert cli.run(select_words(folder, "again")) == 0
    capsys.readouterr()
    one, two = (
        {k: v for k, v in files_of(folder / name).items() if k.startswith("data.zarr")}
        for name in ("some", "again")
    )
    assert one.keys() == two.keys() and one
    assert {k for k in one if one[k] != two[k]} <= {"data.zarr/zarr.json"}
    # The same command does nothing more, and another selection is refused.
    assert cli.run(select_words(folder, "some")) == 0
    refused(select_words(folder, "some", by="uncertain"), capsys, "selection.method")
    refused(["extend", str(folder / "some"), "--n", "40", "--workers", "0"], capsys, "no more selected")


@pytest.mark.parametrize("by", ["random", "uncertain", "disagree"])
def test_every_rule_selects_with_known_probabilities(folder: Path, by: str) -> None:
    assert cli.run(select_words(folder, by, by=by)) == 0
    probability = arrays_of(folder / by)["selection_probability"]
    assert len(probability) == N and (probability > 0).all() and (probability <= 1).all()
    least = (1.0 if by == "random" else 0.2) * N / (SCENES * PER_SCENE)
    assert (probability >= least - 1e-12).all()


def test_selected_labels_are_read_trained_on_and_labelled_again(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    labels = read_mixed([str(folder / "cheap")], [str(folder / "some")])
    assert labels.is_selected and labels.population.is_dear.sum() == N
    report = json_of(capsys, ["estimate", str(folder / "cheap"), "--with", str(folder / "some"),
                              "--methods", "proximity"])  # fmt: skip
    assert report["estimates"][-1]["population"] == "picks of proximity" and report["selected"]
    assert report["estimates"][-1]["candidates"] == SCENES  # one robot a scene
    stream = SampleStream([folder / "some"], extra=("selection_probability",))
    (batch,) = stream.epoch(0)
    assert len(batch) == N and batch.extra["selection_probability"].shape == (N,)
    words = ["submit", "sim", "--n", str(N), "--scenes-from", str(folder / "some"), "--workers", "0"]
    words += ["--config", str(folder / "arm.toml")]
    assert cli.run([*words, "--out", str(folder / "tried")]) == 0
    assert cli.run(["verify", str(folder / "tried")]) == 0
    before, after = arrays_of(folder / "some"), arrays_of(folder / "tried")
    for name in ("scene_index", "candidate_index", "selection_probability", "base_xy_m"):
        np.testing.assert_array_equal(before[name], after[name])
    assert cli.run(["audit", str(folder / "cheap"), str(folder / "some")]) == 0


def test_a_lost_selection_is_found_and_restored(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "some", tmp_path / "run")
    (tmp_path / "run" / "selection.json").unlink()
    assert cli.run(["verify", str(tmp_path / "run")]) == 1
    assert cli.run(["repair", str(tmp_path / "run")]) == 0
    assert cli.run(["verify", str(tmp_path / "run")]) == 0
    assert (tmp_path / "run" / "selection.json").read_bytes() == (
        folder / "some" / "selection.json"
    ).read_bytes()


def test_what_cannot_be_selected_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def words(*more: str) -> list[str]:
        return ["submit", "plan", "--n", "9", "--out", str(folder / "no"), "--workers", "0", *more]

    cheap = ["--candidates-from", str(folder / "cheap")]
    for more, told in (
        ([*cheap, "--select", "margin"], "is needed to select by margin"),
        ([*cheap, "--model", "x.ckpt"], "is not used to select at random"),
        ([*cheap, "--select", "margin", "--model", "x.ckpt"], "no such file"),
        ([*cheap, "--candidates-per-scene", "9"], "is more than the 8 candidates of a scene"),
        ([*cheap, "--candidates-per-scene", "1", "--seed", "1"], "needs 9 scenes of 1 candidates"),
        ([*cheap, "--random-share", "0"], "--random-share"),
        ([*cheap, "--scenes-from", str(folder / "cheap")], "--candidates-from"),
        ([*cheap, "--split", "train"], "--split"),
        (["--select", "random"], "selects nothing without --candidates-from"),
        (["--candidates-from", str(folder / "some")], "has selected candidates alone"),
    ):
        refused(words(*more), capsys, told)
    assert not (folder / "no").exists()


def test_a_dry_run_forecasts_the_selected_candidates(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "apart").mkdir()
    forecast = json_of(capsys, [*select_words(folder, "apart/new"), "--dry-run"])
    assert (forecast["labels"], forecast["scenes"]) == (N, N // EACH)
    assert forecast["evidence"].startswith("a pilot of") and not (folder / "apart" / "new").exists()
