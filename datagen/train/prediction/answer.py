"""The answer of a prediction: scored base poses, the chosen one, and what speaks against it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from typing import Literal

import numpy as np

from datagen.schemas.specification import ObservationParams
from datagen.train.arrivals import Arrival
from datagen.train.inputs import F64, I64, Bools
from datagen.train.prediction.base_cells import (
    STATES,
    UNSEEN,
    BaseCells,
    Choice,
    RobotSize,
    headings,
    seen_share,
    within_reach,
)
from datagen.train.prediction.frames import SensorFrame, moved
from datagen.train.prediction.fusing import SeenPoints
from datagen.train.prediction.ground import Ground
from datagen.train.prediction.occupancy import KnownFloor
from datagen.train.prediction.target import Filled, TargetBox
from datagen.workers.geometry.transforms import inverse, yaw_pose
from datagen.workers.rendering.cloud import Cloud

CROP = ObservationParams()  # of the cloud that is scored
_SURE, _LIKELY = 0.8, 0.5
# Robots stop that far from their goals; less of the surroundings seen than this share says little.
_LEAST_MISS_M, _LEAST_SEEN = 0.03, 0.1


@dataclass(frozen=True, eq=False, repr=False)
class Prediction:
    """A scored grid of base poses around the target, with its explanation. World: floor z = 0."""

    scorer: str
    robot: RobotSize
    frames: tuple[SensorFrame, ...]
    grounds: tuple[Ground, ...]  # one a frame
    seen: SeenPoints
    target: TargetBox
    filled: Filled | None  # None where no mask was given or clicked
    cloud: Cloud
    cells: BaseCells
    score: F64  # (N,)
    choice: Choice
    arrival: Arrival | None
    known: KnownFloor | None
    # Codes and texts about the robot: its sizes, and whether its hand can hold the target.
    doubts: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        if self.best is None:
            return f"Prediction(none: {'; '.join(self.reasons)})"
        x, y = self.base_xy_m[self.best]
        pose = f"x {x:.3f} m, y {y:.3f} m, yaw {math.degrees(self.yaw_rad[self.best]):.1f} deg"
        return f"Prediction({self.level}: {pose}, score {self.score[self.best]:.3f})"

    def _repr_png_(self) -> bytes:
        """What notebooks show: the picture of `datagen predict --out`."""
        from datagen.train.prediction.pictures import draw_prediction

        with BytesIO() as drawn:
            draw_prediction(self, drawn)
            return drawn.getvalue()

    @property
    def best(self) -> int | None:
        """Row of the best allowed base pose; None where there is none, or none with a good score."""
        return self.choice.best

    @property
    def center_m(self) -> F64:
        """The target's centre (3,)."""
        return np.array(self.target.center_m)

    @cached_property
    def base_xy_m(self) -> F64:
        """Base positions (N, 2)."""
        return self.center_m[:2] + self.cells.offset_m

    @cached_property
    def yaw_rad(self) -> F64:
        """Headings (N,), counter-clockwise from x: towards the target, or with the robot's side to it."""
        return headings(self.cells.offset_m, self.robot)

    def T_world_base(self, row: int) -> F64:
        """Pose (4, 4) of the arm's mount at one base pose: at base height, x to the front of the base."""
        x, y = self.base_xy_m[row]
        return yaw_pose(float(x), float(y), self.robot.base_height_m, float(self.yaw_rad[row]))

    def T_camera_base(self, row: int) -> F64:
        """The same pose in the frame of the first camera."""
        return inverse(self.grounds[0].T_world_camera) @ self.T_world_base(row)

    def rows(self, state: str) -> I64:
        """Rows of the base poses of one state, best first."""
        rows = np.flatnonzero(self.cells.state == STATES.index(state))
        return rows[np.argsort(-self.score[rows], kind="stable")]

    @property
    def look_next(self) -> tuple[float, float] | None:
        """How to turn the first camera to the floor of the best unseen pose; None where none scores well.

        Radians: pan, counter-clockwise about the vertical from where it looks now, and tilt below level. Not
        to floor that is in a picture already, hidden or without depth.
        """
        unseen = self.rows(UNSEEN)
        unseen = unseen[~self._is_in_view(unseen)]
        if not len(unseen) or self.score[unseen[0]] < _LIKELY:
            return None
        T = self.grounds[0].T_world_camera
        x, y = self.base_xy_m[unseen[0]] - T[:2, 3]
        pan = math.atan2(y, x) - math.atan2(T[1, 2], T[0, 2])
        return (pan + math.pi) % (2 * math.pi) - math.pi, math.atan2(T[2, 3], math.hypot(x, y))

    def _is_in_view(self, rows: I64) -> Bools:
        """Mask (N,) of base poses whose floor lies whole in a frame's picture, seen or hidden."""
        corners_m = self.robot.outline.radius_m * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
        floor_m = np.insert((self.base_xy_m[rows, None] + corners_m).reshape(-1, 2), 2, 0.0, axis=1)
        found = np.zeros(len(rows), np.bool_)
        for frame, ground in zip(self.frames, self.grounds, strict=True):
            if (image := frame.image) is not None:
                local_m = moved(floor_m, inverse(ground.T_world_camera))
                pixels = image.pinhole.pixels(local_m)
                inside = (pixels >= 0).all(axis=1) & (pixels < image.depth_m.shape[::-1]).all(axis=1)
                found |= (inside & (local_m[:, 2] > 0)).reshape(-1, 4).all(axis=1)
        return found

    @property
    def good_share(self) -> float | None:
        """Share of the clear base poses within the arm's reach that score good; None where there are none.

        Within reach: from the arm's mount to the target's centre. Where it is high, parking decides little.
        """
        rows = self.rows("clear")
        near = rows[within_reach(self.cells.offset_m[rows], self.target.center_m[2], self.robot)]
        return float((self.score[near] >= _LIKELY).mean()) if len(near) else None

    @cached_property
    def crop_seen(self) -> float:
        """Share of the floor plan around the target in which anything was measured."""
        return seen_share(self.cloud.points_m[: self.cloud.n].astype(np.float32), CROP.crop_radius_m)

    @property
    def target_points(self) -> int:
        """Points of the target in the cloud that was scored."""
        return int(self.cloud.target_mask.sum())

    @property
    def missing_depth(self) -> float | None:
        """Share of the frames' pixels without depth; None for clouds without pictures."""
        shares = [(f.image.depth_m == 0).mean() for f in self.frames if f.image is not None]
        return float(np.mean(shares)) if shares else None

    @property
    def level(self) -> Literal["good", "doubtful", "none"]:
        """Whether to drive there: "none" without a best pose, "doubtful" where `reasons` speak against it."""
        return "none" if self.best is None else "doubtful" if self.reasons else "good"

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why the answer is no better than it is; empty for a good one."""
        return tuple(text for _, text in self.coded_reasons)

    @property
    def coded_reasons(self) -> tuple[tuple[str, str], ...]:
        """The reasons, each with a short code for programs."""
        if self.best is not None:
            return self.doubts_about(self.best)
        nominal, unseen = self.choice.nominal, self.rows(UNSEEN)
        reasons = [("no_clear_pose", "no clear base pose was observed around the target")]
        if nominal is not None:
            text = f"the highest score of a clear base pose is only {self.score[nominal]:.3f}"
            reasons = [("low_score", text)]
        if len(unseen) and (nominal is None or self.score[unseen[0]] >= _LIKELY):
            reasons.append(("unseen_left", "unseen ones are left: show their floor in more frames"))
        return tuple(reasons)

    def doubts_about(self, row: int) -> tuple[tuple[str, str], ...]:
        """Codes and texts of what speaks against one base pose; how far it may be missed only of the best."""
        score, expected = self.score[row], self.choice.expected
        miss_m = self.choice.miss_m if row == self.best else None
        is_unseen = self.cells.state[row] == STATES.index(UNSEEN)
        is_tight = expected is None and miss_m is not None and miss_m < _LEAST_MISS_M
        fails = expected is not None and expected[row] < _LIKELY
        few = self.target_points < CROP.min_target_points
        doubts = (
            ("medium_score", f"a medium score, {score:.3f}", score < _SURE),
            ("floor_not_visible", "the floor there or on the way is not visible", is_unseen),
            ("small_tolerance", f"scores stay good only within {miss_m or 0.0:.2f} m of it", is_tight),
            ("failure_likely", "with the arrival error, failure is likelier than success", fails),
            ("floor_uncertain", "the floor is uncertain", any(g.doubt is not None for g in self.grounds)),
            ("few_target_points", "few points of the target", few),
            ("few_surroundings", "few surroundings were observed", self.crop_seen < _LEAST_SEEN),
        )
        return (*((code, text) for code, text, holds in doubts if holds), *self.doubts)
