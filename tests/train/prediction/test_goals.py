"""Goals for a robot's base: what is written, read back by other readers."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from PIL import Image
from rosbags.rosbag2 import Reader
from scipy.special import ndtri

import datagen.workers.robots
from datagen.schemas.errors import InputError
from datagen.train.inputs import Array, Batch
from datagen.train.prediction import KnownFloor, RobotSize, predict
from datagen.train.prediction.answer import Prediction
from datagen.train.prediction.base_cells import STATES
from datagen.train.prediction.goals import ALIKE, ALIKE_M, MOUNTS_M, alternatives, in_turn, write_goal
from datagen.workers.geometry.transforms import yaw_pose
from datagen.workers.robots import robot_source
from tests.sim_extra import named_robots, needs_sim
from tests.train.prediction.recorded_scenes import STORE
from tests.train.prediction.seen_scenes import Seen, sensor_frame
from tests.train.prediction.test_occupancy import FREE, mapped

STAMP_NS = 1_700_000_001_500_000_000


class ByDistance:
    """Scores that fall with the distance from the target: good ones, medium ones and bad ones."""

    name, threshold = "by distance", 0.5

    def score(self, batch: Batch[Array]) -> Array:
        return np.clip(1.3 - 0.5 * np.linalg.norm(batch.candidates.base_xy_m, axis=1), 0, 1).astype(
            np.float64
        )


@pytest.fixture(scope="module")
def answer(seen: Seen) -> Prediction:
    frame = sensor_frame(seen)
    robot = RobotSize(1.2, 0.7, 0.9)
    return predict(ByDistance(), [frame], robot, known=KnownFloor((mapped(FREE, frame),)))


def written(file: Path, answer: Prediction) -> dict[str, Any]:
    assert write_goal(file, answer, "map", STAMP_NS)
    return yaml.safe_load(file.read_text())


def pose_of(pose: Any) -> tuple[float, float, float]:
    """x, y and yaw of a level pose on the floor, as a document or as a message."""
    p, q = (
        pose[name] if isinstance(pose, dict) else getattr(pose, name) for name in ("position", "orientation")
    )
    (x, y, z), (a, b, c, d) = (
        [each[n] if isinstance(each, dict) else getattr(each, n) for n in names]
        for each, names in ((p, "xyz"), (q, "xyzw"))
    )
    assert z == a == b == 0 and math.hypot(c, d) == pytest.approx(1)
    return x, y, 2 * math.atan2(c, d)


def row_pose(answer: Prediction, row: int) -> tuple[float, ...]:
    return (*answer.base_xy_m[row].tolist(), float(answer.yaw_rad[row]))


def test_a_goal_with_its_alternatives_as_yaml(answer: Prediction, tmp_path: Path) -> None:
    goal = written(tmp_path / "goal.yaml", answer)
    assert goal["goal"]["header"] == {
        "frame_id": "map",
        "stamp": {"sec": 1_700_000_001, "nanosec": 500_000_000},
    }
    assert answer.best is not None and goal["child_frame_id"] == "base_link"
    assert pose_of(goal["goal"]["pose"]) == pytest.approx(row_pose(answer, answer.best))
    assert goal["may_miss_m"] == answer.choice.miss_m and goal["level"] == answer.level
    assert goal["reasons"] == [code for code, _ in answer.coded_reasons]
    rows = alternatives(answer)
    assert [pose_of(each["pose"]) for each in goal["alternatives"]] == [
        pytest.approx(row_pose(answer, row)) for row in rows
    ]
    assert len({answer.best, *rows}) == 6 and all(answer.score[row] >= 0.5 for row in rows)


def test_alternatives_on_floor_that_was_seen_come_first(answer: Prediction) -> None:
    # Unseen cells may have the higher scores.
    ranked, state = answer.choice.ranked, answer.cells.state.copy()
    low = ranked[-2:]  # the lowest of the good scores
    state[np.setdiff1d(ranked, low)] = STATES.index("unseen")
    unseen = replace(answer, cells=replace(answer.cells, state=state))
    rows = alternatives(unseen)
    assert set(rows[:2]) == set(low) and answer.score[low].max() < answer.score[ranked[1]]
    assert len(rows) == 5 and (state[rows[2:]] == STATES.index("unseen")).all()
    state[ranked] = STATES.index("unseen")
    assert alternatives(unseen) == alternatives(answer) and len(alternatives(answer)) == 5


def test_after_a_failure_a_base_pose_elsewhere_is_likelier_than_a_better_one_beside_it() -> None:
    xy = np.array([[0.6, 0.0], [0.6, 0.05], [-0.6, 0.0], [0.0, 5.0]])
    assert in_turn(np.array([0.95, 0.94, 0.9, 0.2]), xy, 4) == [0, 2, 1, 3]
    far = 10.0 * np.arange(5)[:, None] * [1.0, 0.0]  # nothing in common: by chance alone
    assert in_turn(np.array([0.5, 0.9, 0.1, 0.99, 0.7]), far, 9) == [3, 1, 4, 0, 2]


@pytest.mark.parametrize("seed", range(4))
def test_each_pose_in_turn_is_the_likeliest_after_the_failures_of_those_before(seed: int) -> None:
    """By simulation of the outcomes."""
    rng = np.random.default_rng(seed)
    xy, chance = rng.uniform(-0.8, 0.8, (8, 2)), rng.uniform(0.3, 0.95, 8)
    far_m = np.linalg.norm(xy[:, None] - xy[None], axis=2)
    covariance = ALIKE * np.exp(-((far_m / ALIKE_M) ** 2) / 2) + (1 - ALIKE) * np.eye(8)
    drawn = rng.standard_normal((500_000, 8)) @ np.linalg.cholesky(covariance).T > -ndtri(chance)
    for row in in_turn(chance, xy, 4):
        assert drawn.mean(axis=0)[row] > drawn.mean(axis=0).max() - 0.02
        drawn = drawn[~drawn[:, row]]


def test_messages_that_other_readers_read(answer: Prediction, tmp_path: Path) -> None:
    goal, file = written(tmp_path / "goal.yaml", answer), tmp_path / "goal.mcap"
    assert write_goal(file, answer, "map", STAMP_NS)
    with file.open("rb") as opened:
        reader = make_reader(opened, decoder_factories=[DecoderFactory()])
        theirs = {channel.topic: message for _, channel, _, message in reader.iter_decoded_messages()}
    with Reader(file) as bag:
        ours = {c.topic: STORE.deserialize_cdr(data, c.msgtype) for c, _, data in bag.messages()}
    for messages in (theirs, ours):
        found: Any = messages["/goal"]
        assert found.header.frame_id == "map" and found.header.stamp.sec == 1_700_000_001
        assert pose_of(found.pose) == pytest.approx(pose_of(goal["goal"]["pose"]))
        expected = [pytest.approx(pose_of(each["pose"])) for each in goal["alternatives"]]
        others: Any = messages["/alternatives"]
        assert [pose_of(each) for each in others.poses] == expected
        grid: Any = messages["/scores"]
        cells = np.array(grid.data).reshape(grid.info.height, grid.info.width)
        corner = np.array([grid.info.origin.position.x, grid.info.origin.position.y])
        assert_costs(answer, cells, corner, grid.info.resolution)


def assert_costs(answer: Prediction, cells: np.ndarray, corner: np.ndarray, cell_m: float) -> None:
    """Each position's cost is found in the cell that it lies in."""
    column, row = np.floor((answer.base_xy_m - corner) / cell_m).astype(int).T
    clear = answer.cells.state == STATES.index("clear")
    expected = np.where(clear, np.rint(100 * (1 - answer.score)), -1)
    assert cells.size == len(expected) and clear.any() and not clear.all()
    np.testing.assert_array_equal(cells[row, column], expected)


def test_scores_as_a_map_of_nav2(answer: Prediction, tmp_path: Path) -> None:
    assert write_goal(tmp_path / "scores.pgm", answer, "map", STAMP_NS)
    described = yaml.safe_load((tmp_path / "scores.yaml").read_text())
    assert described["image"] == "scores.pgm" and described["mode"] == "raw" and described["origin"][2] == 0
    with Image.open(tmp_path / "scores.pgm") as image:
        cells = np.asarray(image)[::-1].astype(np.int16)
    cells = np.where(cells > 100, -1, cells)
    assert_costs(answer, cells, np.array(described["origin"][:2]), described["resolution"])


def test_the_base_of_a_robot_is_not_its_mount(answer: Prediction, tmp_path: Path) -> None:
    named = replace(answer, robot=replace(answer.robot, name="pr2"))
    goal = written(tmp_path / "goal.yaml", named)
    x, y, yaw = pose_of(goal["goal"]["pose"])
    assert named.best is not None and goal["child_frame_id"] == "base_footprint"
    # PR2's arm is mounted 5 cm behind and 18.8 cm to the right of the middle of its base.
    mount = yaw_pose(x, y, 0.0, yaw) @ [-0.05, -0.188, 0.0, 1.0]
    np.testing.assert_allclose(mount[:2], named.base_xy_m[named.best], atol=1e-9)
    assert yaw == pytest.approx(named.yaw_rad[named.best])


@needs_sim
@pytest.mark.parametrize("name", named_robots())
def test_mounts_are_those_of_the_urdfs(name: str) -> None:
    from datagen.workers.robots.assembly import assemble

    T = assemble(robot_source(name), None).base.T_root_mount
    np.testing.assert_allclose(T[:3, :3], np.eye(3), atol=1e-9)
    np.testing.assert_allclose(T[:2, 3], MOUNTS_M.get(name, (0.0, 0.0)), atol=1e-4)


@needs_sim
def test_the_mount_of_an_own_robot_is_read_from_its_urdf(answer: Prediction, tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text((Path(datagen.workers.robots.__file__).parent / "fetch.toml").read_text())
    goals = [
        written(tmp_path / "goal.yaml", replace(answer, robot=replace(answer.robot, name=name)))
        for name in ("fetch", str(own))
    ]
    fetch, copied = (pose_of(goal["goal"]["pose"]) for goal in goals)
    assert fetch == pytest.approx(copied, abs=1e-4) and fetch[:2] != pytest.approx(
        row_pose(answer, answer.best or 0)[:2], abs=0.01
    )


def test_no_good_pose_leaves_no_goal(answer: Prediction, tmp_path: Path) -> None:
    none = replace(answer, choice=replace(answer.choice, best=None))
    for name in ("goal.yaml", "goal.mcap", "scores.pgm"):
        assert write_goal(tmp_path / name, answer, "map", STAMP_NS)
        assert not write_goal(tmp_path / name, none, "map", STAMP_NS)
    assert not list(tmp_path.iterdir())


def test_a_goal_needs_a_pose_in_the_map(answer: Prediction, tmp_path: Path) -> None:
    frames = tuple(replace(frame, T_world_camera=None) for frame in answer.frames)
    with pytest.raises(InputError, match="needs frames with poses"):
        write_goal(tmp_path / "goal.yaml", replace(answer, frames=frames), "map", STAMP_NS)
