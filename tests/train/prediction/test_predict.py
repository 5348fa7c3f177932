"""The whole way from a frame to scores, held against the stored cloud of the same scene."""

from __future__ import annotations

import re
from dataclasses import replace
from io import BytesIO
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import datagen
from datagen import released
from datagen.schemas.errors import InputError
from datagen.schemas.specification import CandidateParams
from datagen.train.baselines.rules import Analytic
from datagen.train.inputs import Array, Batch
from datagen.train.prediction import RobotSize, predict
from datagen.train.prediction.answer import Prediction
from datagen.train.prediction.base_cells import STATES
from datagen.train.prediction.frames import SensorFrame, image_frame
from datagen.train.prediction.ground import level_pose
from datagen.train.prediction.pictures import draw_prediction
from datagen.train.prediction.prediction_report import report_rows
from datagen.train.scorers import ModelScorer, Scorer
from datagen.workers.bases.clearance import base_clearance_m
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import look_at, yaw_pose
from tests.train.prediction.checkpoints import write_untrained
from tests.train.prediction.seen_scenes import MODEL, Seen, draw_seen, sensor_frame, write_frame

ROBOT = RobotSize(camera_height_m=1.2, base_height_m=0.7, arm_reach_m=0.9)
GRID = 9
DOCS = Path(__file__).resolve().parents[3] / "docs" / "guides" / "predict.md"


def of(scorer: Scorer, *frames: object, **more: object) -> Prediction:
    return predict(scorer, list(frames), ROBOT, grid=GRID, **more)  # type: ignore[arg-type]


def stored_scores(scorer: Scorer, seen: Seen, prediction: Prediction) -> F64:
    """Scores on the cloud that the scene stores, of bases at the same offsets from the target."""

    class Kept:
        name, threshold = "kept", 0.5
        batch: Batch[Array]

        def score(self, batch: Batch[Array]) -> F64:
            cloud = seen.scene.cloud
            clouds = replace(
                batch.clouds,
                points_m=cloud.points_m[None].astype(np.float32),
                rgb=cloud.rgb[None],
                target_mask=cloud.target_mask[None],
                n_points=np.array([cloud.n], np.int64),
                target_height_m=np.array([seen.scene.target_center_m[2]], np.float32),
                target_radius_m=np.array([seen.scene.rays.radii_m[0]], np.float32),
            )
            return scorer.score(replace(batch, clouds=clouds))

    return predict(Kept(), prediction.frames, ROBOT, grid=GRID).score


def off(ours: F64, theirs: F64) -> float:
    """How far apart two score maps of one grid are: mean difference over what they vary by."""
    assert theirs.std() > 1e-3
    return float(np.abs(ours - theirs).mean() / theirs.std())


@pytest.fixture(scope="module")
def sampling(seen: Seen, scorer: ModelScorer) -> float:
    """What another random sample of the same points does to the scores of this untrained model."""
    maps = [of(scorer, sensor_frame(seen), seed=seed).score for seed in range(4)]
    return max(off(a, b) for a, b in combinations(maps, 2))


def test_a_frame_gives_the_scores_of_the_stored_cloud(
    seen: Seen, scorer: ModelScorer, sampling: float
) -> None:
    centre = seen.scene.target_center_m
    exact = of(scorer, sensor_frame(seen), target_center_m=centre)
    theirs = stored_scores(scorer, seen, exact)
    assert off(exact.score, theirs) < 1.3 * sampling
    assert exact.cloud.n == seen.scene.cloud.n == 4096
    assert exact.target_points >= 256
    estimated = of(scorer, sensor_frame(seen))
    assert np.linalg.norm(estimated.center_m - centre) < 0.015
    assert estimated.target.radius_m == pytest.approx(seen.scene.rays.radii_m[0], rel=0.15)
    assert off(estimated.score, theirs) < 1.5 * sampling
    noisy = of(scorer, sensor_frame(seen.noisy()))
    assert np.linalg.norm(noisy.center_m - centre) < 0.03
    assert noisy.missing_depth is not None and noisy.missing_depth > 0.005
    assert off(noisy.score, theirs) < 2 * sampling


def test_a_rule_on_the_observed_cloud_scores_both_alike(seen: Seen) -> None:
    rule = Analytic(only_clear=False)
    exact = (seen, seen.scene.target_center_m, 0.1)
    for shot, centre, most in (exact, (seen, None, 0.15), (seen.noisy(), None, 0.3)):
        ours = of(rule, sensor_frame(shot), target_center_m=centre)
        theirs = stored_scores(rule, seen, ours)
        assert off(ours.score, theirs) < most
        shifted = np.roll(theirs.reshape(GRID, GRID), 1, axis=1).ravel()
        assert off(ours.score, shifted) > 2 * most or most > 0.2


def test_the_cloud_has_the_shape_of_a_stored_one(seen: Seen, scorer: ModelScorer) -> None:
    stored, cloud = seen.scene.cloud, of(scorer, sensor_frame(seen)).cloud
    assert cloud.points_m.dtype == stored.points_m.dtype and cloud.points_m.shape == stored.points_m.shape
    points = cloud.points_m[:512].astype(np.float64)
    gaps = [np.linalg.norm(points[:k] - points[k], axis=1).min() for k in range(1, 512)]
    assert all(b <= a + 2e-3 for a, b in pairwise(gaps)), "not in farthest-point order"
    assert np.linalg.norm(cloud.points_m.astype(np.float64), axis=1).max() < 1.001
    share = cloud.target_mask.sum() / stored.target_mask.sum()
    assert 0.9 < share < 1.1


def test_a_real_house_gives_the_scores_of_its_stored_cloud(
    assets: Path, real_objects: str, scorer: ModelScorer
) -> None:
    real = draw_seen(5, 77, f"procthor:{assets / 'procthor'}", real_objects)
    answer = of(scorer, sensor_frame(real))
    assert np.linalg.norm(answer.center_m - real.scene.target_center_m) < 0.03
    again = of(scorer, sensor_frame(real), seed=1)
    theirs = stored_scores(scorer, real, answer)
    assert off(answer.score, theirs) < 2 * max(off(again.score, answer.score), off(again.score, theirs))
    rule = Analytic(only_clear=False)
    by_rule = of(rule, sensor_frame(real))
    assert off(by_rule.score, stored_scores(rule, real, by_rule)) < 0.3


@pytest.mark.parametrize(("quarters", "x", "y"), [(1, 0.0, 0.0), (2, -3.0, 17.5), (3, 8.0, -0.3)])
def test_scores_rotate_with_the_world(
    quarters: int, x: float, y: float, seen: Seen, scorer: ModelScorer
) -> None:
    before = of(scorer, sensor_frame(seen))
    T = yaw_pose(x, y, 0.0, quarters * np.pi / 2)
    after = of(scorer, sensor_frame(seen, T @ seen.camera.T_world_camera))
    np.testing.assert_allclose(after.center_m, (T @ [*before.center_m, 1])[:3], atol=1e-4)
    # The grid's places are turned into one another, and each takes its score along.
    turned = before.cells.offset_m @ T[:2, :2].T.astype(np.float32)
    gaps = np.linalg.norm(turned[:, None] - after.cells.offset_m, axis=2)
    row = gaps.argmin(axis=1)
    assert gaps.min(axis=1).max() < 1e-5
    assert off(after.score[row], before.score) < 0.05
    assert off(after.score, before.score) > 0.2
    away = np.linalg.norm(before.cells.offset_m, axis=1) > 0.01
    turns = (after.yaw_rad[row] - before.yaw_rad - quarters * np.pi / 2)[away]
    np.testing.assert_allclose(np.cos(turns), 1, atol=1e-5)
    assert (after.cells.state[row] == before.cells.state).mean() > 0.95


@pytest.mark.parametrize("noise", [False, True])
def test_the_floor_in_the_picture_serves_as_well_as_a_pose(
    noise: bool, seen: Seen, scorer: ModelScorer, sampling: float
) -> None:
    shot = seen.noisy() if noise else seen
    up = seen.camera.T_world_camera[2, :3]
    level = of(scorer, sensor_frame(shot, level_pose(up, seen.height_m)))
    found = of(scorer, sensor_frame(shot, posed=False), camera_height_m=seen.height_m + 0.01)
    fallen = of(scorer, sensor_frame(shot, posed=False), camera_height_m=seen.height_m, gravity=-9.8 * up)
    for other in (found, fallen):
        T = other.grounds[0].T_world_camera
        assert np.degrees(np.arccos(min(1.0, T[2, :3] @ up))) < 0.7
        assert np.linalg.norm(other.center_m - level.center_m) < 0.02
        assert off(other.score, level.score) < 1.5 * sampling
    assert "floor's plane" in found.grounds[0].how
    assert found.grounds[0].residual_m is not None and found.grounds[0].residual_m < 0.02


def test_a_frame_fused_with_itself_gives_the_same_scores_and_a_second_one_shows_more(
    seen: Seen, scorer: ModelScorer, sampling: float
) -> None:
    one, twice = of(scorer, sensor_frame(seen)), of(scorer, sensor_frame(seen), sensor_frame(seen))
    assert len(twice.seen.points_m) < len(one.seen.points_m)
    assert np.linalg.norm(twice.center_m - one.center_m) < 0.005
    assert off(twice.score, one.score) < 2 * sampling
    centre, eye = seen.scene.target_center_m, seen.camera.T_world_camera[:3, 3]
    across = np.array([-(eye - centre)[1], (eye - centre)[0], 0.6])
    other = seen.turned_to(centre + across)
    both = of(scorer, sensor_frame(seen), sensor_frame(other, mask=False))
    assert both.crop_seen > one.crop_seen
    assert np.linalg.norm(both.center_m - centre) < 0.015
    # The frame without a mask adds what it saw of the target's other side, and of nothing else.
    singly = [of(scorer, sensor_frame(shot)).seen for shot in (seen, other)]
    truth = np.concatenate([cloud.points_m[cloud.on_target] for cloud in singly])
    marked = both.seen.points_m[both.seen.on_target]
    gaps = np.linalg.norm(marked[:, None] - truth[None, ::3], axis=2).min(axis=1)
    assert (gaps < 0.01).mean() > 0.95
    assert len(marked) > int(one.seen.on_target.sum()) * 0.5


def test_cell_states_agree_with_the_house(seen: Seen, scorer: ModelScorer) -> None:
    answer = predict(scorer, [sensor_frame(seen)], ROBOT)
    sizes = ROBOT.base_height_m, ROBOT.camera_height_m, ROBOT.outline.radius_m
    each = (np.full(len(answer.score), size, np.float32) for size in sizes)
    mast_radius_m = CandidateParams().mast_radius_m
    free = base_clearance_m(
        answer.base_xy_m.astype(np.float32), *each, seen.scene.house.obstacles, mast_radius_m
    )
    blocked, clear = (answer.cells.state == STATES.index(name) for name in ("blocked", "clear"))
    assert blocked.sum() > 20 and clear.sum() > 5
    assert (free[blocked] < 0.02).mean() > 0.95
    assert (free[clear] > -0.05).mean() > 0.95


def test_the_best_is_clear_and_its_poses_agree(seen: Seen, scorer: ModelScorer) -> None:
    answer = of(scorer, sensor_frame(seen))
    assert answer.best is not None
    clear = answer.rows("clear")
    assert answer.best in clear and answer.score[answer.best] >= answer.score[clear].max() - 0.05
    T = answer.T_world_base(answer.best)
    np.testing.assert_allclose(T[:3, 3], [*answer.base_xy_m[answer.best], ROBOT.base_height_m], atol=1e-6)
    towards = answer.center_m[:2] - T[:2, 3]
    np.testing.assert_allclose(T[:2, 0], towards / np.linalg.norm(towards), atol=1e-5)
    back = answer.grounds[0].T_world_camera @ answer.T_camera_base(answer.best)
    np.testing.assert_allclose(back, T, atol=1e-9)


def test_unseen_base_poses_are_chosen_only_with_allow_unseen(seen: Seen, scorer: ModelScorer) -> None:
    table = sensor_frame(seen)
    low = np.flatnonzero((table.points_m @ seen.camera.T_world_camera[:3, :3].T)[:, 2] + seen.height_m > 0.3)
    assert table.on_target is not None
    frame = replace(
        table, points_m=table.points_m[low], rgb=table.rgb[low], on_target=table.on_target[low], image=None
    )
    strict, lax = of(scorer, frame), of(scorer, frame, allow_unseen=True)
    assert strict.best is None and strict.level == "none"
    assert strict.reasons[0] == "no clear base pose was observed around the target"
    assert lax.best is not None and lax.best in strict.rows("unseen")
    assert lax.score[lax.best] >= lax.score[strict.rows("unseen")[0]] - 0.05
    assert lax.level == "doubtful" and any("not visible" in reason for reason in lax.reasons)


@pytest.mark.parametrize(("side_m", "is_held"), [(0.06, True), (0.16, False)])
def test_a_cube_wider_than_the_hand_opens_is_doubtful(
    scorer: ModelScorer, side_m: float, is_held: bool
) -> None:
    rng = np.random.default_rng(0)
    faces = rng.uniform(0, side_m, (3, 1500, 3))
    for axis, face in enumerate(faces):
        face[:, axis] = 0.0 if axis < 2 else side_m  # as seen from (-1, -1, 1)
    cube = np.concatenate(faces) + [0.0, 0.0, 0.7]
    table = np.column_stack([rng.uniform(-0.3, 0.5, (4000, 2)), np.full(4000, 0.7)])
    T = look_at(np.array([-0.7, -0.7, 1.3]), np.array([0.0, 0.0, 0.7]))
    points = (np.concatenate([cube, table]) - T[:3, 3]) @ T[:3, :3]
    on_target = np.arange(len(points)) < len(cube)
    grey = np.full(points.shape, 128, np.uint8)
    frame = SensorFrame("cube", points.astype(np.float32), grey, on_target, T, None)
    answer = of(scorer, frame, allow_unseen=True)
    assert answer.target.narrowest_m == pytest.approx(side_m, abs=0.015)
    assert any("only a rim or a handle" in reason for reason in answer.reasons) != is_held


def test_a_look_where_it_is_advised_shows_that_floor(seen: Seen, scorer: ModelScorer) -> None:
    first = of(scorer, sensor_frame(seen))
    assert first.look_next is not None
    pan, tilt = first.look_next
    T = seen.camera.T_world_camera
    yaw = np.arctan2(T[1, 2], T[0, 2]) + pan
    ahead = np.array([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), -np.sin(tilt)])
    there = np.append(first.base_xy_m, np.zeros((len(first.base_xy_m), 1)), axis=1) - T[:3, 3]
    there /= np.linalg.norm(there, axis=1)[:, None]
    advised = int((there @ ahead).argmax())
    np.testing.assert_allclose(ahead, there[advised], atol=1e-9)
    assert advised in first.rows("unseen") and first.score[advised] >= 0.5
    # Of a picture that has that floor, but no depth there, the same look again would show no more.
    T_turned = look_at(T[:3, 3], T[:3, 3] + ahead)
    frames = (*first.frames, replace(first.frames[0], T_world_camera=T_turned))
    grounds = (*first.grounds, replace(first.grounds[0], T_world_camera=T_turned))
    after = replace(first, frames=frames, grounds=grounds).look_next
    assert after is None or np.abs(np.subtract(after, first.look_next)).max() > 0.1


def test_missing_depth_on_the_target_is_filled_and_reported(seen: Seen, scorer: ModelScorer) -> None:
    whole = sensor_frame(seen)
    assert whole.image is not None and whole.image.mask is not None
    holes = whole.image.mask & (np.random.default_rng(0).random(whole.image.mask.shape) < 0.5)
    shot = Seen(seen.scene, replace(seen.frame, depth_m=np.where(holes, np.float32(0), seen.frame.depth_m)))
    answer = of(scorer, sensor_frame(shot))
    assert answer.filled is not None and answer.filled.missing_pixels == holes.sum()
    assert any("without depth" in note for note in answer.notes)
    assert np.linalg.norm(answer.center_m - of(scorer, whole).center_m) < 0.01


@pytest.mark.parametrize(("known", "is_enough"), [(14, True), (8, False)])
def test_a_target_of_few_pixels_is_answered_with_doubts(
    known: int, is_enough: bool, seen: Seen, scorer: ModelScorer
) -> None:
    whole = sensor_frame(seen)
    assert whole.image is not None and whole.image.mask is not None
    pixels = np.random.default_rng(0).permutation(np.flatnonzero(whole.image.mask.ravel()))[:25]
    mask, depth_m = np.zeros(whole.image.mask.size, np.bool_), whole.image.depth_m.copy()
    mask[pixels] = True
    depth_m.ravel()[pixels[known:]] = 0.0
    image = replace(whole.image, mask=mask.reshape(depth_m.shape), depth_m=depth_m)
    frame = image_frame(image, whole.T_world_camera, {})
    if not is_enough:
        with pytest.raises(InputError, match=f"only {known} of the target's 25 pixels have depth"):
            of(scorer, frame)
        return
    answer = of(scorer, frame)
    assert np.linalg.norm(answer.center_m - of(scorer, whole).center_m) < 0.02
    assert answer.level != "good" and answer.target_points == 25


def test_the_lines_of_the_page_run(seen: Seen, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_frame(tmp_path / "FOLDER", seen)
    write_untrained(tmp_path / "model.ckpt", MODEL)
    monkeypatch.chdir(tmp_path)
    code = re.search(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)
    assert code is not None
    assert len([line for line in code[1].splitlines() if line.strip()]) <= 6
    names: dict[str, object] = {}
    exec(code[1], names)
    assert isinstance(names["answer"], Prediction)


@pytest.fixture(scope="module")
def demonstration() -> Prediction:
    """The answer for the package's frame and map by a rule in place of a model."""

    class Nearest:
        name, threshold = "nearest", 0.5

        def score(self, batch: Batch[Array]) -> F64:
            far_m = np.hypot(*np.asarray(batch.candidates.base_xy_m, np.float64).T)
            return np.where(far_m < 0.7, 0.9, 0.1)

    frame = released.sample_frame()
    return datagen.predict(Nearest(), frame=[frame], map=[frame / released.MAP], base_height=0.7, reach=0.9)


def test_the_picture_has_room_for_every_reason(demonstration: Prediction) -> None:
    heights = []
    for n in (0, 10):
        doubts = tuple(
            (f"code_{k}", "a reason that takes a whole line of the picture or more") for k in range(n)
        )
        draw_prediction(replace(demonstration, doubts=doubts), file := BytesIO())
        with Image.open(file) as picture:
            heights.append(picture.height)
    assert heights[1] > heights[0] + 10 * 0.19 * 120  # inches of a line, pixels of an inch


def test_the_share_of_good_poses_is_of_clear_ones_within_reach(demonstration: Prediction) -> None:
    answer = demonstration
    rise_m = answer.center_m[2] - 0.7
    rows = answer.rows("clear").tolist()
    near = [k for k in rows if np.hypot(*answer.cells.offset_m[k]) ** 2 + rise_m**2 <= 0.81]
    good = [k for k in near if answer.score[k] > 0.5]
    assert 0 < len(good) < len(near) < len(rows) and answer.good_share == len(good) / len(near)
    assert replace(answer, robot=replace(answer.robot, arm_reach_m=0.05)).good_share is None
    all_good = replace(answer, score=np.full(len(answer.score), 0.9))
    for doubts in ((), (("small_tolerance", ""),)):
        (row,) = (text for head, text in report_rows(replace(all_good, doubts=doubts)) if head == "choice")
        assert row.startswith("100%") and ("little" in row) == (not doubts)
    none = replace(demonstration, choice=replace(demonstration.choice, best=None))
    told = [dict(report_rows(each))["choice"] for each in (demonstration, none)]
    assert "parking decides here" in told[0] and "parking" not in told[1]
