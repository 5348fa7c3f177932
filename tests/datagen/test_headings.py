"""Headings of bases from the command line: sampled ones, and a robot that shows its side to the target."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import datagen.workers.robots
from datagen import cli
from datagen.replaying import open_sources
from datagen.reports.agreement import read_labels
from datagen.schemas.fields import OUTCOMES
from datagen.schemas.run import Run, open_runs
from datagen.schemas.run_records import StageClock
from datagen.schemas.shard_reading import read_scene
from datagen.train.dataset import SampleStream
from datagen.train.headings import trained_side_deg
from datagen.train.scorers import ModelScorer
from datagen.train.training.checkpoints import load_model, read_checkpoint
from datagen.workers.bases.clearance import Footprint, base_clearance_m
from datagen.workers.geometry.transforms import yaw_pose
from datagen.workers.labels.arm_labelling import arm_in_scene
from datagen.workers.labels.arrival_trial import try_arrival
from datagen.workers.motion.reachable_sampling import reachable_set_of
from datagen.workers.robots import ROBOTS, robot_limits
from datagen.workers.scenes.reconstruct import reconstruct_candidates, reconstruct_scene
from tests.refusals import refused
from tests.sim_extra import needs_sim
from tests.small_runs import CONFIG, HERE, OPEN_TOPS, PER_SCENE, arrays_of, make_small_run
from tests.train.prediction.checkpoints import document_of, stored_with, write_untrained
from tests.train.prediction.seen_scenes import MODEL
from tests.train.prediction.test_trained_robots import SIZES, origin
from tests.train.training.small import TINY, equal

OUTLINE = [[0.3, 0.2], [-0.25, 0.2], [-0.25, -0.2], [0.3, -0.2]]
SAMPLED = CONFIG + "[candidates]\nyaw_rad = {low = -0.5, high = 1.0}\n"
ROWS = 12


def relative(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Headings relative to the direction to the target."""
    scene = np.searchsorted(arrays["scene_index"], arrays["sample_scene_index"])
    towards = arrays["target_center_m"][scene, :2] - arrays["base_xy_m"]
    return np.angle(np.exp(1j * (arrays["base_yaw_rad"] - np.arctan2(towards[:, 1], towards[:, 0]))))


def test_sampled_headings_are_stored_and_no_model_trains_on_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_small_run(tmp_path / "run", 3 * PER_SCENE, config=SAMPLED)
    found, plain = relative(arrays_of(run)), arrays_of(make_small_run(tmp_path / "plain", 3 * PER_SCENE))
    assert found.min() > -0.5 - 1e-5 and found.max() < 1.0 + 1e-5 and np.ptp(found) > 0.9
    np.testing.assert_allclose(relative(plain), 0.0, atol=1e-6)
    np.testing.assert_array_equal(arrays_of(run)["base_xy_m"], plain["base_xy_m"])
    assert cli.run(["verify", str(run), "--replay", "1"]) == 0
    words = ("candidates.yaw_rad", "headings of the base are sampled")
    for trained, validated in ((run, tmp_path / "plain"), (tmp_path / "plain", run)):
        line = ["train", "stage1", str(trained), "--val", str(validated)]
        refused([*line, "--out", str(tmp_path / "a.ckpt")], capsys, str(run), *words)


def test_a_checkpoint_records_how_bases_stood_and_runs_that_differ_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    aside = CONFIG + "[candidates]\nyaw_rad = {low = 1.5707963, high = 1.5707963}\n"
    ahead = make_small_run(tmp_path / "ahead", 12 * PER_SCENE)
    right = make_small_run(tmp_path / "right", 12 * PER_SCENE, "--seed", "1", config=aside)
    (tmp_path / "tiny.toml").write_text("".join(f"{name} = {value}\n" for name, value in TINY.items()))
    more = [
        "--epochs",
        "1",
        "--device",
        "cpu",
        "--threads",
        "1",
        "--model-config",
        str(tmp_path / "tiny.toml"),
    ]
    words = ("candidates.yaw_rad", str(ahead), "face the target", "have the target -90 deg from their front")
    for runs in ([ahead, right], [right, ahead], [ahead, "--val", right], [right, "--val", ahead]):
        line = ["train", "stage1", *map(str, runs), "--out", str(tmp_path / "no.ckpt"), *more]
        refused(line, capsys, str(right), *words)
    for run, recorded in ((ahead, ("faces", 0.0)), (right, ("side", -90.0))):
        file = tmp_path / f"{run.name}.ckpt"
        assert cli.run(["train", "stage1", str(run), "--out", str(file), *more]) == 0
        head = read_checkpoint(file).head
        assert [(origin.get("presents"), round(origin.get("side_deg", 1.0), 3)) for origin in head.data] == [
            recorded
        ]
        assert trained_side_deg(head) == pytest.approx(recorded[1], abs=0.001)
        older = [{k: v for k, v in o.items() if k not in ("presents", "side_deg")} for o in head.data]
        assert trained_side_deg(replace(head, data=tuple(older))) == 0.0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("yaw_rad = {low = 0.5, high = -0.5}", ["candidates.yaw_rad", "high -0.5 is below low 0.5"]),
        ("yaw_rad = {low = -4.0, high = 0.0}", ["candidates.yaw_rad.low", "-3.14"]),
        ("yaw_rad = 1.0", ["candidates.yaw_rad"]),
        ("yaw_rad = {low = nan, high = 0.0}", ["candidates.yaw_rad.low"]),
        ("footprint_m = [[1, 1], [2, 1], [2, 2]]", ["candidates", "does not hold the mount"]),
        (
            "footprint_m = [[0.3, 0.2], [-0.3, -0.2], [-0.3, 0.2], [0.3, -0.2]]",
            ["candidates.footprint_m", "cro"],
        ),
        ("footprint_m = [[0.3, 0.2], [-0.3, 0.2]]", ["candidates.footprint_m", "3"]),
        ("footprint_m = [[0.3, 0.2], [-0.3, 0.2], [0.0, -30.0]]", ["candidates.footprint_m", "20"]),
        ("footprint_m = [[0.3], [-0.3, 0.2], [0.0, -0.3]]", ["candidates.footprint_m"]),
        ('footprint_m = "round"', ["candidates.footprint_m"]),
    ],
)
def test_headings_and_footprints_that_cannot_be_are_one_line(
    tmp_path: Path, text: str, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run.toml").write_text(f"[candidates]\n{text}\n")
    line = ["submit", "heuristic", "--n", "4", "--out", str(tmp_path / "a"), "--config"]
    refused([*line, str(tmp_path / "run.toml"), *HERE], capsys, "run.toml", *words)


@pytest.fixture(scope="module")
def sideways(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """A Panda on an oblong base that has the target at its right, and plans of it. Tests only read them."""
    folder = tmp_path_factory.mktemp("sideways")
    text = (
        (Path(datagen.workers.robots.__file__).parent / ROBOTS["panda"])
        .read_text()
        .replace('name = "panda"', 'name = "sideways"')
    )
    base = f'footprint_m = {OUTLINE}\nheight_m = 0.6\npresents = "side"\nside_deg = -90\n'
    robot = folder / "sideways.toml"
    robot.write_text(text.replace("pedestal = true\n", base))
    (folder / "run.toml").write_text(CONFIG + OPEN_TOPS + "[arm.grasps]\nper_object = 40\nper_scene = 10\n")
    line = ["submit", "plan", "--n", str(2 * ROWS), "--out", str(folder / "run"), "--robot", str(robot)]
    more = ["--candidates", "in-range", "--candidates-per-scene", str(ROWS), "--seed", "5", *HERE]
    assert cli.run([*line, *more, "--config", str(folder / "run.toml")]) == 0
    return str(robot), folder / "run"


@needs_sim
def test_a_robot_works_at_its_side(sideways: tuple[str, Path], tmp_path: Path) -> None:
    robot_file, run = sideways
    arrays, opened = arrays_of(run), Run.open(run)
    np.testing.assert_allclose(relative(arrays), np.pi / 2, atol=1e-5)  # the target at its right
    assert robot_limits(robot_file).yaw_rad == pytest.approx(np.pi / 2)
    spec, (world, _) = opened.manifest.spec, open_sources(opened)
    good = arrays["label"] == 1
    # The hand is at the planned grasp with the base at its heading.
    assert good.sum() >= 3
    for index in range(2):
        rows = read_scene(opened, index)
        scene = reconstruct_scene(world, rows.record)
        candidates = reconstruct_candidates(rows.samples, scene)
        at = arm_in_scene(scene, candidates, 0, spec, StageClock())
        clearance_m = base_clearance_m(
            candidates.base_xy_m, candidates.base_height_m, candidates.camera_height_m,
            spec.candidates.radius_of_base_m(candidates.arm_reach_m), scene.house.obstacles,
            spec.candidates.mast_radius_m, Footprint(OUTLINE), candidates.base_yaw_rad,
        )  # fmt: skip
        np.testing.assert_array_equal(clearance_m, candidates.clearance_m)
        assert (clearance_m >= 0).all()
        for row, outcome in enumerate(rows.samples["outcome"].tolist()):
            made = try_arrival(at, candidates, row, (0.0, 0.0, 0.0), None, spec)
            assert made == tuple(OUTCOMES)[outcome]
            if outcome == 0:
                (x, y), yaw = candidates.base_xy_m[row], candidates.base_yaw_rad[row]
                T_world_tcp = yaw_pose(float(x), float(y), 0.6, float(yaw)) @ at.robot.T_base_tcp(
                    rows.samples["q_grasp_rad"][row].astype(np.float64)
                )
                wanted = scene.T_world_object[0] @ rows.samples["T_target_tcp"][row]
                np.testing.assert_allclose(T_world_tcp, wanted, atol=0.002)
    out = ["--out", str(tmp_path / "a.png")]
    assert cli.run(["show", str(run), "--scene", "0", *out]) == 0
    assert cli.run(["show", str(run), "--scene", "0", "--trial", "best", *out]) == 0
    assert cli.run(["verify", str(run), "--replay", "1"]) == 0


@needs_sim
def test_candidates_of_such_a_robot_are_drawn_where_its_hand_gets(
    sideways: tuple[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot_file, run = sideways
    arrays, (spec,) = arrays_of(run), [part.manifest.spec for part in open_runs(run)]
    assert spec.candidates.in_range_by == "reachable-set"
    found = reachable_set_of(robot_file)
    T_world_object = arrays["T_world_object"][:, 0].astype(np.float64)
    good = arrays["label"] == 1
    for row, scene in enumerate(np.searchsorted(arrays["scene_index"], arrays["sample_scene_index"])):
        (x, y), yaw = arrays["base_xy_m"][row].tolist(), float(arrays["base_yaw_rad"][row])
        T_base_object = np.linalg.inv(yaw_pose(x, y, 0.6, yaw)) @ T_world_object[scene]
        assert found.holds(T_base_object[None, :3, 3]).all()
        if good[row]:
            T_base_tcp = T_base_object @ arrays["T_target_tcp"][row]
            assert found.holds(T_base_tcp[None, :3, 3], or_next=True).all()
    # All of them are in range for statistics, whatever a distance says.
    (labels,) = map(read_labels, open_runs(run))
    assert labels.within_reach.all()
    # Another robot of its numbers faces the target: there a distance is right.
    make_small_run(tmp_path / "plain", PER_SCENE, "--robot", "panda", "--candidates", "in-range")
    (plain,) = open_runs(tmp_path / "plain")
    assert plain.manifest.spec.candidates.in_range_by is None
    line = ["submit", "plan", "--n", "4", "--out", str(tmp_path / "a"), *HERE, "--config"]
    for robot, source, text, words in (
        ("panda", "heuristic", 'within = "in-range"', ["candidates.in_range_by", "heuristic has no arm"]),
        ("panda-scaled", "plan", 'within = "in-range"', ["candidates.in_range_by", "is scaled to reaches"]),
        ("panda", "plan", 'within = "clear"', ["candidates", "in_range_by is for within = 'in-range'"]),
        ("panda", "plan", 'within = "in-range"\nin_range_by = "ball"', ["candidates.in_range_by", "ball"]),
    ):
        key = "" if "ball" in text else 'in_range_by = "reachable-set"\n'
        (tmp_path / "run.toml").write_text(f"[candidates]\nper_scene = 4\n{key}{text}\n")
        line[1] = source
        refused([*line, str(tmp_path / "run.toml"), "--robot", robot], capsys, *words)


@needs_sim
def test_a_model_of_bases_that_face_the_target_is_refused_for_others(
    sideways: tuple[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, run = sideways
    write_untrained(tmp_path / "model.ckpt", MODEL)  # as older checkpoints, without a record
    words = (str(run), "candidates.yaw_rad", "-90 deg", "model.ckpt was trained on face the target")
    refused(["evaluate", str(tmp_path / "model.ckpt"), str(run)], capsys, *words)
    document = document_of(tmp_path / "model.ckpt")
    document["head"]["data"] = [origin(robots=SIZES, presents="side", side_deg=-90.0)]
    stored_with(tmp_path / "right.ckpt", tmp_path / "model.ckpt", head=document["head"])
    assert cli.run(["evaluate", str(tmp_path / "right.ckpt"), str(run), "--baselines", "proximity"]) == 0
    for value in (181.0, "left", None):
        document["head"]["data"] = [origin(robots=SIZES, side_deg=value)]
        stored_with(tmp_path / "bad.ckpt", tmp_path / "model.ckpt", head=document["head"])
        refused(["evaluate", str(tmp_path / "bad.ckpt"), str(run)], capsys, "bad.ckpt", "side_deg")


@needs_sim
def test_scenes_of_a_robot_that_faces_the_target_do_not_suit_it(
    sideways: tuple[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot_file, _ = sideways
    text = Path(robot_file).read_text().replace('presents = "side"\nside_deg = -90\n', "")
    (tmp_path / "ahead.toml").write_text(text.replace("sideways", "ahead"))
    make_small_run(tmp_path / "run", PER_SCENE, "--robot", str(tmp_path / "ahead.toml"))
    line = [
        "submit",
        "plan",
        "--n",
        "4",
        "--scenes-from",
        str(tmp_path / "run"),
        "--out",
        str(tmp_path / "b"),
        "--robot",
    ]
    refused([*line, robot_file], capsys, "candidates.yaw_rad", "stands at 1.5708 to the target")
    (tmp_path / "wide.toml").write_text(text.replace("[0.3, 0.2]", "[0.6, 0.2]").replace("sideways", "wide"))
    refused([*line, str(tmp_path / "wide.toml")], capsys, "candidates", "wide")


@needs_sim
def test_a_model_that_knows_kinematics_trains_on_robots_that_stand_otherwise(
    sideways: tuple[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    robot_file, run = sideways
    (tmp_path / "run.toml").write_text(CONFIG + OPEN_TOPS + "[arm.grasps]\nper_object = 40\nper_scene = 10\n")
    ahead = tmp_path / "ahead"
    line = ["submit", "plan", "--n", "40", "--out", str(ahead), "--robot", "panda", *HERE, "--seed", "2"]
    more = ["--candidates", "in-range", "--candidates-per-scene", "4", "--config", str(tmp_path / "run.toml")]
    assert cli.run([*line, *more]) == 0
    sizes = [f"{name}={value}" for name, value in TINY.items()]
    line = ["train", "sim-only", str(ahead), str(run), "--epochs", "2", "--device", "cpu", "--threads", "1"]
    line += [word for size in sizes for word in ("--model-config", size)]
    words = ("candidates.yaw_rad", "-90 deg", "kinematics=true")
    refused([*line, "--out", str(tmp_path / "no.ckpt")], capsys, *words)
    line += ["--model-config", "kinematics=true"]
    once, again, encoded = (tmp_path / f"{name}.ckpt" for name in ("once", "again", "encoded"))
    for out, of in ((once, []), (again, []), (encoded, ["--encoded", str(tmp_path / "encoded")])):
        assert cli.run([*line, "--out", str(out), *of]) == 0
    first, second, third = (read_checkpoint(out) for out in (once, again, encoded))
    assert third.head.finished
    assert first.head.model_config["kinematics"] is True
    assert equal(first.weights, second.weights)

    def scores(name: str = "") -> np.ndarray:
        model, _ = load_model(once)
        (batch,) = SampleStream([run], shuffle=False).epoch(0)
        robots = replace(batch.robots, name=np.full(len(batch.robots), name)) if name else batch.robots
        return ModelScorer(model, "model").score(replace(batch, robots=robots))

    # Each batch names its robot and its heading; a scaled arm of that reach scores otherwise.
    assert np.ptp(scores()) > 1e-4
    np.testing.assert_array_equal(scores(), scores("panda"))
    assert np.abs(scores() - scores("panda-scaled")).max() > 1e-6
    evaluated = ["evaluate", str(once), str(run), "--baselines", "proximity", "--allow-seen-houses"]
    assert cli.run(evaluated) == 0
    # Its file is needed again by each of these, and by no other model.
    moved = Path(robot_file).with_suffix(".moved")
    Path(robot_file).rename(moved)
    try:
        monkeypatch.setattr("datagen.workers.robots._read", {})
        refused(evaluated, capsys, "sideways.toml")
        refused([*line, "--out", str(tmp_path / "no.ckpt")], capsys, "sideways.toml")
    finally:
        moved.rename(robot_file)
