"""`--scenes-from`: the scenes and candidates of a run labelled again, and what is refused beside it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from datagen import cli
from datagen.schemas.run import Run
from datagen.schemas.run_records import QuarantineRecord
from tests.made_runs import flip, object_of
from tests.refusals import refused
from tests.small_runs import CONFIG, PER_SCENE, arrays_of, files_of, json_of, make_small_run
from tests.workers.objects.toy_set import write_bundle

SCENES = 6
N = SCENES * PER_SCENE
OWN = ("sample_id", "label_source", "label_version")  # what a run says of itself
SEEN = {"T_world_camera", "target_visible_fraction", "points_m", "rgb", "target_mask", "n_points"}
OTHER_RULE = "[heuristic]\nmu = 0.7\ndistance = 'mount-over-reach'\n"


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six scenes, one a shard. Tests only read it."""
    return make_small_run(tmp_path_factory.mktemp("source") / "run", N)


@pytest.fixture(scope="module")
def again(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same candidates by another rule. Tests only read it."""
    folder = tmp_path_factory.mktemp("again")
    (folder / "rule.toml").write_text(OTHER_RULE)
    assert cli.run(again_arguments(source, folder / "run", N, "--config", str(folder / "rule.toml"))) == 0
    return folder / "run"


def again_arguments(source: Path, out: Path, n: int, *more: str) -> list[str]:
    return [
        "submit", "heuristic", "--n", str(n), "--out", str(out), "--scenes-from", str(source),
        "--workers", "0", *more,
    ]  # fmt: skip


def test_scene_and_candidate_rows_are_the_stored_ones_and_labels_are_new(source: Path, again: Path) -> None:
    before, after = arrays_of(source), arrays_of(again)
    assert before.keys() == after.keys()
    for name in before.keys() - {*OWN, "heuristic_score", "label"}:
        np.testing.assert_array_equal(before[name], after[name], err_msg=name)
        assert before[name].dtype == after[name].dtype
    assert (before["label"] != after["label"]).any()
    ids = {row.tobytes() for arrays in (before, after) for row in arrays["sample_id"]}
    assert len(ids) == 2 * N


def test_the_specification_is_the_sources_with_another_rule(source: Path, again: Path) -> None:
    before, after = Run.open(source).manifest.spec, Run.open(again).manifest.spec
    assert after.scenes_from is not None and after.scenes_from.spec_hash == before.hash()
    assert after.heuristic.mu == 0.7 and after.hash() != before.hash()
    same = {"heuristic": before.heuristic, "scenes_from": None}
    assert after.model_copy(update=same) == before  # equal engines among the rest
    assert Run.open(again).manifest.sources["scenes_from"] == Run.open(source).storage.url


def test_the_same_rule_gives_the_same_labels_whatever_the_shards(source: Path, tmp_path: Path) -> None:
    long = make_small_run(tmp_path / "long", 16 * PER_SCENE)  # two scenes a shard, the first six the same
    short = tmp_path / "short"
    assert cli.run(again_arguments(long, short, N)) == 0
    layouts = [Run.open(place).layout.scenes_per_shard for place in (long, short)]
    assert layouts == [2, 1]
    before, after = arrays_of(source), arrays_of(short)
    for name in before.keys() - {"sample_id"}:
        np.testing.assert_array_equal(before[name], after[name], err_msg=name)


def test_a_run_of_stored_scenes_is_itself_a_source_of_the_same_scenes(again: Path, tmp_path: Path) -> None:
    third = tmp_path / "third"
    assert cli.run(again_arguments(again, third, 2 * PER_SCENE)) == 0
    specs = [Run.open(place).manifest.spec for place in (again, third)]
    assert specs[0].scenes_hash == specs[1].scenes_hash
    assert specs[0].heuristic == specs[1].heuristic  # what is not given is as in the source
    np.testing.assert_array_equal(arrays_of(third)["label"], arrays_of(again)["label"][: 2 * PER_SCENE])


def test_another_viewpoint_changes_what_is_seen_and_no_label(source: Path, tmp_path: Path) -> None:
    first, second, again = (tmp_path / name for name in ("first", "second", "again"))
    for out, view, workers in ((first, "1", "0"), (second, "2", "0"), (again, "1", "2")):
        arguments = again_arguments(source, out, N, "--view", view)
        arguments[arguments.index("--workers") + 1] = workers
        assert cli.run(arguments) == 0
    before, one, two, three = map(arrays_of, (source, first, second, again))
    assert {name for name in before if not np.array_equal(before[name], one[name])} <= SEEN | {"sample_id"}
    cameras = np.stack([arrays["T_world_camera"] for arrays in (before, one, two)])
    moved = (np.diff(cameras, axis=0) != 0).any(axis=(2, 3))
    assert moved.mean() > 0.5  # a scene with one viewpoint keeps it
    for name in one:
        np.testing.assert_array_equal(one[name], three[name], err_msg=name)
    assert cli.run(["verify", str(first), "--replay", "3"]) == 0
    specs = [Run.open(place).manifest.spec for place in (source, first, second)]
    assert len({spec.scenes_hash for spec in specs}) == 3


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--view", "1", "--draws", "2"), ("--draws: 2", "Omit it")),
        (("--view", "1", "--config", "c.toml"), ("--config", "Omit it")),
        (("--view", "0"), ("--view", "greater than or equal to 1")),
    ],
)
def test_what_decides_labels_is_refused_with_another_viewpoint(
    more: tuple[str, ...], words: tuple[str, ...], source: Path, tmp_path: Path,
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "c.toml").write_text("")
    refused(again_arguments(source, tmp_path / "run", N, *more), capsys, *words)
    assert not (tmp_path / "run").exists()


def test_a_viewpoint_needs_stored_scenes_with_these_labels(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    new = ["submit", "heuristic", "--n", "8", "--view", "1", "--out", str(tmp_path / "run")]
    refused(new, capsys, "--view: 1", "Give --scenes-from")
    other = [word.replace("heuristic", "plan") for word in again_arguments(source, tmp_path / "run", N)]
    refused([*other, "--view", "1"], capsys, "--view: plan", "Submit heuristic")


def test_more_than_the_source_has_is_refused_with_how_many_there_are(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fix = f"datagen resume {source} --n {N + PER_SCENE}"  # the source has all that it planned
    out, words = tmp_path / "run", (f"--n: {N + 1}", f"is more than the {N} candidates", fix)
    refused(again_arguments(source, out, N + 1), capsys, *words)
    assert not out.exists()
    # A gap ends what can be used.
    holey = tmp_path / "holey"
    shutil.copytree(source, holey)
    (holey / "commits/000002.json").unlink()
    refused(again_arguments(holey, out, N), capsys, f"is more than the {2 * PER_SCENE} candidates")
    assert cli.run(again_arguments(holey, out, 2 * PER_SCENE)) == 0


@pytest.mark.parametrize(
    ("more", "section", "place"),
    [
        (("--seed", "3"), "", "error: --seed: "),
        (("--split", "val"), "", "error: --split: "),
        (("--candidates", "clear"), "", "error: --candidates: "),
        (("--candidates-per-scene", "9"), "", "error: --candidates-per-scene: "),
        ((), "[candidates]\nper_scene = 9", "c.toml"),
        ((), "seed = 3", "c.toml"),
        ((), "[observation]\nn_points = 64", "c.toml"),
    ],
)
def test_what_decides_scenes_is_refused_with_scenes_from(
    more: tuple[str, ...], section: str, place: str, source: Path, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    (tmp_path / "c.toml").write_text(section)
    arguments = again_arguments(source, tmp_path / "run", N, "--config", str(tmp_path / "c.toml"), *more)
    refused(arguments, capsys, place, "--scenes-from")
    assert not (tmp_path / "run").exists()


def test_a_robot_of_another_reach_is_refused_with_how_to_make_scenes_for_it(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = again_arguments(source, tmp_path / "run", N, "--robot", "panda")
    refused(arguments, capsys, str(source), "arm_reach_m", "submit heuristic --robot panda")
    fitting = make_small_run(tmp_path / "fitting", PER_SCENE, "--robot", "panda")
    assert cli.run(again_arguments(fitting, tmp_path / "run", PER_SCENE, "--robot", "panda")) == 0


def test_resume_says_how_to_name_scenes_that_have_moved(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, moved, out = (tmp_path / name for name in ("first", "moved", "run"))
    shutil.copytree(source, first)
    assert cli.run(again_arguments(first, out, PER_SCENE)) == 0
    first.rename(moved)
    words = ["resume", str(out), "--n", str(2 * PER_SCENE), "--workers", "0"]
    refused(words, capsys, f"{out}/manifest.json: scenes_from", f"names {first}", "Give --scenes-from")
    assert cli.run([*words, "--scenes-from", str(moved)]) == 0
    assert len(arrays_of(out)["label"]) == 2 * PER_SCENE


def test_objects_may_have_moved_but_not_changed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, moved, other = (tmp_path / name for name in ("first", "moved", "other"))
    for folder, names in ((first, "abcdefgh"), (other, "bcdefghi")):
        folder.mkdir()
        write_bundle(folder, *(f"{k:03d}_{name}" for k, name in enumerate(names)))
    source = make_small_run(tmp_path / "source", PER_SCENE, "--objects", f"ycb:{first}")
    first.rename(moved)
    out = tmp_path / "run"
    refused(again_arguments(source, out, PER_SCENE), capsys, str(first), "does not exist")
    arguments = again_arguments(source, out, PER_SCENE, "--objects", f"ycb:{other}")
    refused(arguments, capsys, "--objects", "the run was made with")
    assert not out.exists()
    assert cli.run(again_arguments(source, out, PER_SCENE, "--objects", f"ycb:{moved}")) == 0
    assert Run.open(out).manifest.sources["objects"] == f"ycb:{moved}"


def test_a_damaged_source_gives_its_shard_up_and_no_label(source: Path, tmp_path: Path) -> None:
    damaged, out = tmp_path / "damaged", tmp_path / "run"
    shutil.copytree(source, damaged, ignore=shutil.ignore_patterns("data.zarr"))
    flip(object_of(damaged, 3))
    assert cli.run(again_arguments(damaged, out, N)) == 1
    run = Run.open(out)
    assert run.quarantined() == {3} and len(run.committed()) == SCENES - 1
    (record,) = run.quarantine_records()
    assert isinstance(record, QuarantineRecord) and "another sha256" in record.causes[-1]


@pytest.mark.parametrize("within", ["clear", "in-range"])
def test_a_run_takes_only_the_asked_candidates_and_counts_redraws_for_want_of_them(
    within: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = "[candidates]\narm_reach_m = {low = 0.55, high = 0.6}\nrobots_per_scene = 1\n"
    config = CONFIG + (short if within == "in-range" else "")
    run = make_small_run(tmp_path / "run", 3 * PER_SCENE, "--candidates", within, config=config)
    arrays = arrays_of(run)
    assert arrays["base_is_clear"].all()
    if within == "in-range":
        assert (arrays["mount_distance_m"] <= arrays["arm_reach_m"]).all()
        assert json_of(capsys, ["audit", str(run)])["sources"][0]["rejected_scenes"]["no_base"] > 0
    assert Run.open(run).manifest.spec.candidates.within == within
    before = files_of(run, "commits")
    assert cli.run(["submit", "heuristic", "--n", "8", "--out", str(run)]) == 2  # another specification
    assert files_of(run, "commits") == before
