"""Score a grid of base poses around the target from frames."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from datagen.released import RELEASED, released_program
from datagen.schemas.errors import InputError
from datagen.schemas.specification import CandidateParams
from datagen.train.arrivals import Arrival
from datagen.train.headings import refuse_other_heading, trained_side_deg
from datagen.train.inputs import F64, Array, Batch, CandidateInputs, Clouds, RobotInputs
from datagen.train.prediction.answer import CROP, Prediction
from datagen.train.prediction.base_cells import (
    CLEAR,
    STATES,
    UNSEEN,
    BaseCells,
    Choice,
    RobotSize,
    choose,
    observe_cells,
    within_reach,
)
from datagen.train.prediction.clicks import Box, box_mask, click_mask
from datagen.train.prediction.frames import SensorFrame, image_frame
from datagen.train.prediction.fusing import SeenPoints, crop_cloud, fuse, join_target
from datagen.train.prediction.ground import Ground, find_ground
from datagen.train.prediction.occupancy import KnownFloor
from datagen.train.prediction.target import Filled, TargetBox, fill_target, locate
from datagen.train.program_scorer import ProgramScorer
from datagen.train.scorers import ModelScorer, Scorer, scored
from datagen.workers.rendering.cloud import Cloud

if TYPE_CHECKING:
    from datagen.train.training.checkpoints import CheckpointHead

_SLACK_M = 0.01  # how far a robot's sizes may be beyond those of the training data
# Base poses along each side of the grid, 0.08 m apart, 0.04 m where fewer than enough are good, 0.02 m where
# none is: narrow gaps need it. Not where enough can be scored and none is better than hopeless.
_COARSE, _FINE, _FINEST, _ENOUGH, _HOPELESS = 26, 51, 101, 10, 0.3
_ALIKE = 0.05  # scores of a model that differ by this or less
# Poses that far out of reach of the target's centre have scores: it is estimated, and grasps lie around it.
_BEYOND_M = 0.06


def load_scorer(checkpoint: str | Path | None = None) -> ModelScorer | ProgramScorer:
    """The model of a checkpoint, ready to predict many frames: `datagen.predict` accepts it as `checkpoint`.

    Args:
        checkpoint: Checkpoint of `datagen train`; the released model where none is given, or for "released".

    Returns:
        A scorer with `name`, `threshold` and `score(batch)`.

    Raises:
        InputError: The file is no checkpoint.

    Examples:
        >>> scorer = datagen.load_scorer(checkpoint)
        >>> answers = [
        ...     datagen.predict(scorer, frame=[each], base_height=0.7, reach=0.9) for each in [frame, frame]
        ... ]
        >>> len(answers)
        2
    """
    if checkpoint is None or checkpoint == RELEASED:
        return ProgramScorer(released_program(), "the released model, ", only_clear=True)
    # Imported here: the released model needs no torch.
    from datagen.train.training.checkpoints import load_model

    model, head = load_model(str(checkpoint))
    name, side_deg = f"{head.model} ({head.stage})", trained_side_deg(head)
    return ModelScorer(model, name, only_clear=True, robots=trained_robots(head), side_deg=side_deg)


def trained_robots(head: CheckpointHead) -> dict[str, tuple[float, float]]:
    """The least and the largest of `ROBOT_SIZES` in the training data; empty for older checkpoints."""
    from datagen.train.dataset import ROBOT_SIZES  # imports the store, which prediction does not need

    known = [origin["robots"] for origin in head.data if "robots" in origin]
    return {
        name: (min(sizes[name][0] for sizes in known), max(sizes[name][1] for sizes in known))
        for name in ROBOT_SIZES
        if known and all(name in sizes for sizes in known)
    }


def predict(
    scorer: Scorer,
    frames: Sequence[SensorFrame],
    robot: RobotSize,
    *,
    camera_height_m: float | None = None,
    gravity: F64 | None = None,
    click: tuple[int, int] | None = None,
    box: Box | None = None,
    target_center_m: F64 | None = None,
    allow_unseen: bool = False,
    arrival: Arrival | None = None,
    known: KnownFloor | None = None,
    grid: int | None = None,
    seed: int = 0,
) -> Prediction:
    """Score a square grid of base poses around the target that the frames show.

    A model's score is 0 where the base cannot stand, and where the arm is over 6 cm too short for the
    target's centre. Several frames need a pose each. `camera_height_m` is that of the camera that took the
    frame; with `gravity` (3,), in its frame, or floor in sight it gives the pose of a frame that has none.
    The target is given by masks, by one click or a box in the first frame, or by a cloud's own marks;
    `target_center_m` (3,), world, replaces the estimated centre. With an `arrival` error the best is the cell
    with the highest expected success; without one, of a model's scores within 0.05 of the highest, the cell
    with the most room. A map of the floor that is `known` is in the frame of the poses of the frames. `grid`
    cells lie along each side of the square: without it 26; 51 where few of those are good; 101 where none of
    51 is good and one of 101 is. No finer grid is tried where ten or more have scores and all are below 0.3.
    InputError where arguments are missing or invalid.
    """
    if is_model := isinstance(scorer, (ModelScorer, ProgramScorer)):
        side_deg = 0.0 - math.degrees(robot.yaw_rad)
        refuse_other_heading("datagen predict", "--robot", side_deg, scorer.name, scorer.side_deg)
    if known is not None and any(frame.T_world_camera is None for frame in frames):
        fix = "Give its frames T_world_camera in the map: pose.json in a folder, or in the .npz"
        raise InputError("--map", "", "says nothing of frames without a pose", fix)
    grounds = _grounds(frames, camera_height_m, gravity)
    frames = _with_target(frames, grounds, click, box)
    prepared, filled = _fill(frames)
    poses = [ground.T_world_camera for ground in grounds]
    seen = fuse(prepared, poses)
    target = _locate(seen)
    if len(frames) > 1:
        seen = join_target(seen, np.array(target.center_m), target.radius_m, target.support_height_m)
        target = _locate(seen)
    if target_center_m is not None:
        x, y, z = (float(c) for c in target_center_m)
        target = replace(target, center_m=(x, y, z), how="given")
    centre = np.array(target.center_m)
    cloud = crop_cloud(seen, centre, CROP, np.random.default_rng(seed))
    yaw_rad = 0.0 if arrival is None else arrival.yaw_std_rad
    allowed = (CLEAR, UNSEEN) if allow_unseen else (CLEAR,)

    def on_grid(side: int) -> tuple[BaseCells, F64, Choice]:
        params = CandidateParams(per_scene="grid", grid_cells=side)
        cells = observe_cells(seen, centre, robot, params, yaw_rad, known)
        score = scored(scorer, _batch(cloud, target, robot, cells))
        alike = _ALIKE if is_model else 0.0
        return cells, score, choose(score, cells, allowed, scorer.threshold, arrival, alike)

    cells, score, choice = on_grid(_COARSE if grid is None else grid)

    def has_few(enough: int) -> bool:
        has_score = score[choice.can_stand & (score > 0)]
        is_hopeless = len(has_score) >= _ENOUGH and has_score.max() < _HOPELESS
        return grid is None and len(choice.ranked) < enough and not is_hopeless

    if has_few(_ENOUGH):
        cells, score, choice = on_grid(_FINE)
    if has_few(1) and (found := on_grid(_FINEST))[-1].best is not None:
        cells, score, choice = found
    read = (note for frame in frames if frame.image is not None for note in frame.image.notes)
    notes = (*read, *_notes(grounds, filled, cloud))
    sizes = (("untrained_size", note) for note in robot_notes(scorer, robot))
    doubts = (*sizes, *_hand_doubts(target, robot))
    given = (scorer.name, robot, tuple(frames), tuple(grounds), seen, target, filled, cloud, cells)
    return Prediction(*given, score, choice, arrival, known, doubts, notes)


def robot_notes(scorer: Scorer, robot: RobotSize) -> Iterator[str]:
    """A note for each size of the robot that is a centimetre or more beyond those of the training data."""
    if not isinstance(scorer, (ModelScorer, ProgramScorer)):
        return
    for name, (low, high) in scorer.robots.items():
        size_m, words = getattr(robot, name), name.removesuffix("_m").replace("_", " ")
        if not low - _SLACK_M < size_m < high + _SLACK_M:
            trained = f"{low:g} to {high:g} m" if low < high else f"{low:g} m"
            yield f"{words} {size_m:g} m, but the model was trained on {trained}: scores may be wrong"


def _hand_doubts(target: TargetBox, robot: RobotSize) -> tuple[tuple[str, str], ...]:
    from datagen.train.hands.reach import UNKNOWN_ROBOT
    from datagen.train.hands.sizes import hand_size

    opens_m = hand_size(robot.name or UNKNOWN_ROBOT).stroke_m
    if target.narrowest_m <= opens_m:
        return ()
    size = (
        f"all sides of the target are at least {target.narrowest_m:.2f} m, and the hand opens {opens_m:.2f} m"
    )
    return (("target_too_wide", f"{size}: only a rim or a handle could be held"),)


def _grounds(
    frames: Sequence[SensorFrame], camera_height_m: float | None, gravity: F64 | None
) -> list[Ground]:
    if not frames:
        raise InputError("frames", "", "are missing", "Give at least one frame")
    for frame in frames:
        if len(frames) > 1 and frame.T_world_camera is None:
            fix = "Give each of several frames its T_world_camera: pose.json in its folder, or in the .npz"
            raise InputError(frame.place, "pose", "missing", fix)
    if gravity is not None and (posed := next((f for f in frames if f.T_world_camera is not None), None)):
        raise InputError("--gravity", "", f"is given with the pose of {posed.place}", "Give one of them")
    height_m = camera_height_m if len(frames) == 1 else None
    return [find_ground(frame, height_m, gravity) for frame in frames]


def _with_target(
    frames: Sequence[SensorFrame], grounds: Sequence[Ground], click: tuple[int, int] | None, box: Box | None
) -> list[SensorFrame]:
    """The frames, the first with the mask of the object that was clicked or boxed."""
    found = [marked(frames[0], grounds[0].T_world_camera, click, box), *frames[1:]]
    if not any(frame.on_target is not None for frame in found):
        fix = "Give --click u,v, --box, or a mask (in a .ply: a vertex property `target`, 1 on the target)"
        raise InputError(frames[0].place, "target", "is not marked", fix)
    return found


def marked(
    frame: SensorFrame, T_world_camera: F64, click: tuple[int, int] | None, box: Box | None
) -> SensorFrame:
    """The frame with the mask of the object that was clicked or boxed; as it is where neither was."""
    image = frame.image
    if click is None and box is None:
        return frame
    if click is not None and box is not None:
        raise InputError("--box", "", "is given with --click", "Give one of them")
    option = "--box" if click is None else "--click"
    if image is None:
        raise InputError(option, "", "needs an image, not a cloud", "Give a frame with an image first")
    if image.mask is not None:
        raise InputError(option, "", "is given for a frame with a mask", f"Omit {option}, or the mask")
    if click is not None:
        mask = click_mask(image, click, T_world_camera)
    else:
        assert box is not None
        mask = box_mask(image, box, T_world_camera)
    where = {"depth": frame.place, "mask": option}
    return image_frame(replace(image, mask=mask), frame.T_world_camera, where)


def _fill(frames: Sequence[SensorFrame]) -> tuple[list[SensorFrame], Filled | None]:
    done, counts = list[SensorFrame](), list[Filled]()
    for frame in frames:
        if frame.image is not None and frame.image.mask is not None:
            frame, filled = fill_target(frame)
            counts.append(filled)
        done.append(frame)
    if not counts:
        return done, None
    return done, Filled(sum(c.mask_pixels for c in counts), sum(c.missing_pixels for c in counts))


def _locate(seen: SeenPoints) -> TargetBox:
    target = seen.points_m[seen.on_target].astype(np.float64)
    return locate(target, seen.points_m[~seen.on_target], seen.eyes_m[0])


def _batch(cloud: Cloud, target: TargetBox, robot: RobotSize, cells: BaseCells) -> Batch[Array]:
    """The base poses as input of a scorer; `base_is_clear` is false where it cannot stand or get to."""
    n, longer = len(cells.offset_m), replace(robot, arm_reach_m=robot.arm_reach_m + _BEYOND_M)
    near = within_reach(cells.offset_m, target.center_m[2], longer)

    def one(value: float) -> Array:
        return np.array([value], np.float32)

    return Batch(
        Clouds(
            cloud.points_m[None].astype(np.float32),
            cloud.rgb[None],
            cloud.target_mask[None],
            np.array([cloud.n], np.int64),
            one(target.center_m[2]),
            one(target.radius_m),
        ),
        RobotInputs(
            np.zeros(1, np.int64),
            one(robot.camera_height_m),
            one(robot.base_height_m),
            one(robot.arm_reach_m),
            name=np.array([robot.name], np.str_),
        ),
        CandidateInputs(
            np.zeros(n, np.int64), cells.offset_m, turn_rad=np.full(n, robot.yaw_rad, np.float32)
        ),
        np.zeros(n, np.int64),
        np.zeros((n, 16), np.uint8),
        {"base_is_clear": np.isin(cells.state, (STATES.index(CLEAR), STATES.index(UNSEEN))) & near},
    )


def _notes(grounds: Sequence[Ground], filled: Filled | None, cloud: Cloud) -> tuple[str, ...]:
    notes: list[str] = []
    for ground in grounds:
        if ground.doubt is not None:
            notes.append(f"the detected floor is uncertain: {ground.doubt}; give --gravity or a pose")
        if ground.offset_m is not None and abs(ground.offset_m) > 0.03:
            notes.append(
                f"the observed floor is at {ground.offset_m:+.3f} m, not at 0: check the camera's pose"
            )
    if filled is not None and filled.missing_pixels:
        share = filled.missing_pixels / filled.mask_pixels
        notes.append(
            f"{filled.missing_pixels} target pixels without depth ({share:.0%}) were filled from neighbours"
        )
    if cloud.n < CROP.n_points:
        notes.append(
            f"only {cloud.n} points within {CROP.crop_radius_m:g} m of the target, of {CROP.n_points}"
        )
    few = int(cloud.target_mask.sum())
    if few < CROP.min_target_points:
        notes.append(f"only {few} points on the target, of {CROP.min_target_points}")
    return tuple(notes)
