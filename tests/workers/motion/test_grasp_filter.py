"""The hand alone among things, and the choice of grasps that differ."""

from __future__ import annotations

import numpy as np

from datagen.workers.geometry.transforms import translation
from datagen.workers.motion.collision import object_hulls, place, place_object
from datagen.workers.motion.grasp_filter import can_be_lifted, free_grasps, hand_of, line_offsets_m
from tests.workers.motion.tables import BOX_M, PARAMS, arm, box_grasps
from tests.workers.worlds import box_model, box_vertices


def free_with(
    *boxes: tuple[tuple[float, float, float], tuple[float, float, float]],
    target_m: tuple[float, float, float] = BOX_M,
) -> np.ndarray:
    """Which of the box's grasps stay free among boxes given by size and centre in the target's frame."""
    grasps = box_grasps()
    around = place([box_vertices(size, centre) for size, centre in boxes])
    target = place_object(box_model("box", target_m), np.eye(4))
    openings = grasps.opening_m.astype(np.float64)
    return free_grasps(hand_of(arm().gripper), grasps.T_object_tcp, openings, around, target, PARAMS)


def test_neighbours_block_grasps() -> None:
    assert free_with().all()
    approach = box_grasps().T_object_tcp[:, :3, 2]
    above = free_with(((0.3, 0.3, 0.02), (0, 0, 0.2)))
    assert not above[approach[:, 2] < -0.5].any()
    assert above[approach[:, 2] > -0.5].all()
    # The hand of a grasp along +x comes from -x.
    beside = free_with(((0.02, 0.3, 0.3), (-0.15, 0, 0)))
    assert not beside[approach[:, 0] > 0.5].any()
    assert beside[approach[:, 0] < -0.5].all()
    assert not free_with(((2.0, 2.0, 2.0), (0, 0, 0))).any()  # the whole hand within a block


def test_fingers_do_not_fit_around_what_is_wider_than_their_opening() -> None:
    assert not free_with(target_m=(0.09, 0.09, 0.12)).any()


def test_fingers_follow_the_opening() -> None:
    hand = hand_of(arm().gripper)
    T = np.stack([np.eye(4), translation(1, 2, 3)])
    poses = hand.poses(T, np.array([0.04, 0.08]))
    np.testing.assert_allclose(poses[:, 0], T)
    np.testing.assert_allclose(poses[0, 1, :3, 3], [0, 0.02, 0])
    np.testing.assert_allclose(poses[1, 2, :3, 3], [1, 1.96, 3])


def test_a_target_is_lifted_off_its_support_but_not_through_a_board() -> None:
    box = object_hulls(box_model("box", BOX_M))
    table = place([box_vertices((1, 1, 0.04), (0, 0, -BOX_M[2] / 2 - 0.02 + 0.005))])  # settled 5 mm deep
    assert can_be_lifted(box, np.eye(4), table, 0.1)
    board = place([box_vertices((1, 1, 0.04), (0, 0, BOX_M[2] / 2 + 0.02 + 0.08))])
    assert not can_be_lifted(box, np.eye(4), board, 0.1)
    assert can_be_lifted(box, np.eye(4), board, 0.07)


def test_line_offsets_span_the_line_in_small_steps() -> None:
    for length_m in (0.01, 0.08, 0.1, 0.105):
        offsets = line_offsets_m(length_m)
        assert (offsets[0], offsets[-1]) == (0.0, length_m)
        assert 0 < np.diff(offsets).max() <= 0.02 + 1e-9
    np.testing.assert_array_equal(line_offsets_m(0.0), [0.0])
