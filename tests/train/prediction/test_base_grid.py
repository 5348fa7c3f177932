"""Which base poses are tried: finer grids where few are good, gaps, and of equal scores those with room."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import ndimage

import datagen
from datagen import released
from datagen.schemas.specification import CandidateParams
from datagen.train.inputs import Array, Batch
from datagen.train.prediction import RobotSize, predict
from datagen.train.prediction.base_cells import STATES, BaseCells, choose
from datagen.train.prediction.occupancy import KnownFloor
from datagen.workers.bases.candidates import grid_offsets
from datagen.workers.geometry.mesh import F64
from datagen.workers.occupancy_map import FREE, OCCUPIED, OccupancyMap
from tests.train.prediction.seen_scenes import Seen, sensor_frame

ROBOT = RobotSize(camera_height_m=1.2, base_height_m=0.7, arm_reach_m=0.9)


@given(st.integers(9, 41), st.data())
def test_of_about_equal_scores_the_pose_with_room_is_taken(side: int, data: st.DataObject) -> None:
    """A lone pose with the highest score loses to the middle of a patch that is nearly as good."""
    offsets = grid_offsets(CandidateParams(grid_cells=side)).astype(np.float32)
    x, y = (data.draw(st.integers(0, side - 3)) for _ in range(2))
    patch = np.zeros((side, side), np.bool_)
    patch[y : y + 3, x : x + 3] = True
    rows = np.flatnonzero(~ndimage.binary_dilation(patch, np.ones((3, 3))).ravel())
    lone = int(data.draw(st.sampled_from(rows.tolist())))
    stands = patch.ravel() | (np.arange(side**2) == lone)
    state = np.where(stands, STATES.index("clear"), STATES.index("blocked"))
    score = np.where(np.arange(side**2) == lone, 0.93, np.where(stands, 0.92, 0.0))
    cells = BaseCells(offsets, state)
    assert choose(score, cells, ("clear",), 0.5, None, 0.02).best == (y + 1) * side + x + 1
    assert choose(score, cells, ("clear",), 0.5, None, 0.005).best == lone


@dataclass
class Flat:
    value: float = 1.0
    name, threshold = "flat", 0.5

    def score(self, batch: Batch[Array]) -> F64:
        return np.full(len(batch), self.value)


@given(st.floats(0, 1), st.sampled_from([0, 1]))
@settings(max_examples=15)
def test_a_gap_a_little_wider_than_the_base_has_a_pose(seen: Seen, shift: float, axis: int) -> None:
    """Between two walls that leave the base 6 cm, wherever they are."""
    frame, camera = sensor_frame(seen), seen.camera.T_world_camera[:2, 3]
    cells = np.full((600, 600), FREE, np.int8)  # 12 m around the camera
    across = (np.arange(600) + 0.5) * 0.02 - 6.0
    half_m, side_m = ROBOT.outline.radius_m + 0.03, 0.1 * shift
    cells[abs(across - side_m) >= half_m] = OCCUPIED  # rows go along y: the gap leads along x
    cells = cells if axis else np.ascontiguousarray(cells.T)
    known = KnownFloor((OccupancyMap("gap", cells, 0.02, (camera[0] - 6, camera[1] - 6, 0.0)),))
    target = np.append(camera + [[0.0, 0.7], [0.7, 0.0]][axis], 0.8)
    points = frame.points_m[:1]  # nothing else is in the way
    alone = replace(frame, points_m=np.repeat(points, 50, axis=0), rgb=np.zeros((50, 3), np.uint8))
    alone = replace(alone, on_target=np.ones(50, np.bool_), image=None)
    answer = predict(Flat(), [alone], ROBOT, known=known, target_center_m=target)
    assert len(answer.rows("clear"))


@pytest.mark.parametrize(("value", "side"), [(1.0, 26), (0.4, 51), (0.2, 26)])
def test_the_grid_is_fine_where_few_poses_are_good_but_not_all_hopeless(value: float, side: int) -> None:
    frame = released.sample_frame()
    answer = datagen.predict(
        Flat(value), frame=[frame], map=[frame / released.MAP], base_height=0.7, reach=0.9
    )
    assert len(answer.score) == side**2


@dataclass
class Spot:
    """Good within 1.5 cm of one offset from the target, elsewhere neither good nor hopeless."""

    offset_m: F64
    name, threshold = "spot", 0.5

    def score(self, batch: Batch[Array]) -> F64:
        off_m = np.linalg.norm(np.asarray(batch.candidates.base_xy_m) - self.offset_m, axis=1)
        return np.where(off_m < 0.015, 1.0, 0.4)


@given(st.floats(-0.04, 0.04), st.floats(-0.04, 0.04))
@example(0.02, 0.02)
@settings(max_examples=10, deadline=None)
def test_a_good_pose_between_those_of_the_fine_grid_is_found(x_m: float, y_m: float) -> None:
    frame = released.sample_frame()
    asked: Any = {"frame": [frame], "map": [frame / released.MAP], "base_height": 0.7, "reach": 0.9}
    roomy = datagen.predict(Flat(), **asked)
    assert roomy.best is not None
    spot_m = roomy.cells.offset_m[roomy.best].astype(np.float64) + np.array([x_m, y_m])
    found, none = (datagen.predict(Spot(each_m), **asked) for each_m in (spot_m, spot_m + 5.0))
    assert found.best is not None and found.score[found.best] == 1.0
    assert np.linalg.norm(found.cells.offset_m[found.best] - spot_m) < 0.015
    assert none.best is None and len(none.score) == 51**2


def test_scores_are_of_poses_where_the_base_can_stand_and_the_arm_reaches() -> None:
    frame = released.sample_frame()
    answer = datagen.predict(frame=[frame], map=[frame / released.MAP], base_height=0.7, reach=0.6)
    far_m = np.hypot(np.linalg.norm(answer.cells.offset_m, axis=1), answer.center_m[2] - 0.7)
    can = (far_m <= 0.66) & np.isin(answer.cells.state, [STATES.index(name) for name in ("clear", "unseen")])
    assert can.any() and (answer.score[can] > 0).all() and (answer.score[~can] == 0).all()
    assert len(answer.score) == 26**2  # of which enough are good
