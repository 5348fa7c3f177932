"""The specification of a run: a frozen, validated model whose hash covers all that changes a sample.

Paths, worker counts, shard size and n are not part of it. A specification defines an infinite sequence of
scenes, of which a run makes the first n samples.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from datagen.schemas.identity import digest_of
from datagen.schemas.intervals import Corner, Fraction, Frozen, Interval, Metres, Range, Turns

# Scenes are decisive where between these shares of the clear candidates in reach are good.
DECISIVE_SHARES = (0.05, 0.6)
# The reach that Franka Emika states for the Panda.
PANDA_REACH_M = 0.855


class Source(Frozen):
    """The source of houses or objects: the registry name and a digest of the content."""

    kind: str
    digest: str = Field(pattern=r"^[0-9a-f]{64}$")


PlaceKind = Literal["top", "shelf", "inside", "seat", "floor", "sink"]
PLACE_KINDS: tuple[PlaceKind, ...] = get_args(PlaceKind)


class Places(Frozen):
    """Shares of the scenes by the kind of place where the target stands; they need not sum to 1.

    `top` is the open top of a table or chest, `shelf` an inner board, `inside` a cupboard, fridge or
    microwave with its door open, `seat` a bed, sofa or chair, `floor` the floor beside and below furniture,
    and `sink` the basin of a sink.
    """

    top: float = Field(default=0.0, ge=0, le=1000)
    shelf: float = Field(default=0.0, ge=0, le=1000)
    inside: float = Field(default=0.0, ge=0, le=1000)
    seat: float = Field(default=0.0, ge=0, le=1000)
    floor: float = Field(default=0.0, ge=0, le=1000)
    sink: float = Field(default=0.0, ge=0, le=1000)

    @model_validator(mode="after")
    def _some(self) -> Places:
        if not sum(self.weights().values()) > 0:
            raise ValueError("no kind of place has a weight above 0")
        return self

    def weights(self) -> dict[str, float]:
        """The weights by kind, in the order of `PLACE_KINDS`."""
        return {kind: getattr(self, kind) for kind in PLACE_KINDS}


class SceneParams(Frozen):
    """Choice of support surface, target and clutter."""

    # Kinds of places with their weights. With it, doors of cupboards and fridges stand open, and clutter
    # numbers 0 to n_clutter. None: tops alone, and n_clutter objects.
    places: Places | None = None
    # Share of the scenes that are drawn until between 5 and 60 % of their clear candidates in reach are
    # good; None: none are.
    decisive: Fraction | None = None
    n_clutter: int = Field(default=6, ge=0, le=30)
    support_height_m: Range = Range(low=0.3, high=1.2)
    # Clutter is dropped within this distance of the target, so that it sometimes occludes it.
    clutter_radius_m: Metres = 0.22
    drop_height_m: Metres = 0.01
    edge_margin_m: Metres = 0.02
    max_retries: int = Field(default=200, ge=1, le=10_000)


class SettleParams(Frozen):
    """Physics until rest."""

    engine: str = "sapien"
    max_steps: int = Field(default=5000, ge=10, le=1_000_000)
    timestep_s: float = Field(default=1 / 240, gt=0, le=0.05)
    friction: float = Field(default=0.6, ge=0, le=5)
    rest_speed_mps: float = Field(default=0.005, gt=0)
    rest_angular_speed_radps: float = Field(default=0.05, gt=0)
    rest_steps: int = Field(default=20, ge=1, le=1000)
    max_penetration_m: Metres = 0.005
    max_drop_m: Metres = 0.05


class NoiseParams(Frozen):
    """Stereo-like depth noise; `enabled=False` leaves the frame exact."""

    enabled: bool = False
    disparity_std_px: float = Field(default=0.08, ge=0, le=5)
    baseline_m: float = Field(default=0.05, gt=0, le=1)
    grazing_dropout_cos: Fraction = 0.15
    edge_dropout: Fraction = 0.5
    hole_rate: Fraction = 0.002


class ObservationParams(Frozen):
    """One RGB-D frame; intrinsics like a RealSense D435 colour stream at 640x480."""

    renderer: str = "embree"
    width_px: int = Field(default=640, ge=32, le=4096)
    height_px: int = Field(default=480, ge=32, le=4096)
    fx_px: float = Field(default=615.0, gt=0)
    fy_px: float = Field(default=615.0, gt=0)
    distance_m: Range = Range(low=0.8, high=2.5)
    camera_height_m: Range = Range(low=0.8, high=1.5)
    min_target_fraction: Fraction = 0.3
    max_viewpoints: int = Field(default=64, ge=1, le=10_000)
    crop_radius_m: Metres = 1.0
    n_points: int = Field(default=4096, ge=64, le=65_536)
    min_target_points: int = Field(default=256, ge=0, le=65_536)
    n_farthest: int = Field(default=512, ge=0, le=65_536)
    noise: NoiseParams = NoiseParams()


class CandidateParams(Frozen):
    """Base poses around the target and their robots (paper, Sec. IV-A)."""

    per_scene: Annotated[int, Field(ge=1, le=625)] | Literal["grid"] = 60
    grid_cells: int = Field(default=25, ge=2, le=200)
    grid_half_width_m: Metres = 1.0
    jitter: bool = True
    # Only where the base is clear, or also within the arm's reach; None: all cells.
    within: Literal["clear", "in-range"] | None = None
    # In-range where the reachable set of the arm's robot holds the target's centre; None: where it is within
    # arm_reach_m of the mount.
    in_range_by: Literal["reachable-set"] | None = None
    robots_per_scene: int = Field(default=4, ge=1, le=625)
    robot_per_candidate: bool = False
    camera_height_m: Range = Range(low=0.8, high=1.5)
    base_height_m: Range = Range(low=0.5, high=1.0)
    arm_reach_m: Range = Range(low=0.3, high=1.0)
    # Reaches are sampled in whole steps, so that workers open few arms; 0: any reach.
    arm_reach_step_m: float = Field(default=0.0, ge=0, le=0.1)
    base_radius_m: Metres = 0.25
    # Bases of arms shorter than the Panda are narrower in proportion; None: all alike.
    scaled_base: bool | None = None
    # Corners of the base around the mount, x ahead, of which the convex hull counts; None: the circle.
    footprint_m: Annotated[tuple[Corner, ...], Field(strict=False, min_length=3, max_length=100)] | None = (
        None
    )
    mast_radius_m: Metres = 0.05
    # Heading of the base, relative to the direction from it to the target; None: the base faces the target.
    yaw_rad: Turns | None = None

    @model_validator(mode="after")
    def _is_in_range(self) -> CandidateParams:
        if self.in_range_by is not None and self.within != "in-range":
            raise ValueError("in_range_by is for within = 'in-range'")
        return self

    @model_validator(mode="after")
    def _holds_mount(self) -> CandidateParams:
        if self.footprint_m is not None:
            x, y = np.array(self.footprint_m).T
            angle = np.sort(np.arctan2(y, x))
            if np.diff(angle, append=angle[0] + 2 * np.pi).max() >= np.pi:
                raise ValueError("footprint_m does not hold the mount, its origin")
        return self

    @property
    def samples_yaw(self) -> bool:
        """Whether headings differ between candidates with one direction to the target."""
        return self.yaw_rad is not None and self.yaw_rad.low < self.yaw_rad.high

    @property
    def count(self) -> int:
        return self.grid_cells**2 if self.per_scene == "grid" else self.per_scene

    def radius_of_base_m(self, arm_reach_m: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Radii of the bases that carry arms of these reaches, of the same shape (m)."""
        reach_m = np.asarray(arm_reach_m, np.float64)
        share = np.minimum(1.0, reach_m / PANDA_REACH_M) if self.scaled_base else np.ones_like(reach_m)
        return self.base_radius_m * share


class GraspParams(Frozen):
    """Grasps of the target: the number to search, and the number to look at for all candidates of a scene."""

    per_object: int = Field(default=4000, ge=1, le=10_000)
    # The others are tried only for candidates where all of these fail.
    per_scene: int = Field(default=400, ge=1, le=10_000)
    # Grasps below this share of successful floating-hand trials are not used.
    min_score: Fraction = 0.5


class MotionParams(Frozen):
    """The kinematic stage: IK, collisions, path, straight approach and lift."""

    ik_seeds: int = Field(default=4, ge=1, le=100)
    pregrasp_m: float = Field(default=0.08, ge=0, le=0.5)
    lift_m: float = Field(default=0.10, ge=0.01, le=0.5)
    # Largest joint motion between neighbouring points of a straight line.
    max_joint_jump_rad: float = Field(default=0.6, gt=0, le=6.3)
    # Spacing of the configurations at which a path is checked for collisions.
    check_step_rad: float = Field(default=0.05, ge=0.001, le=1.0)
    # Counts, not times: labels must not depend on the speed of a machine. Both are per candidate.
    max_grasps_tried: int = Field(default=150, ge=1, le=10_000)
    path_iterations: int = Field(default=2000, ge=1, le=1_000_000)
    # Rounds of a search near the grasps that came furthest, where none has a plan. None, in specifications
    # older than label version 4: no such search.
    nearby_rounds: int | None = Field(default=None, ge=0, le=50)
    # Distance of the arm from all obstacles, and of the hand up to the pregrasp.
    margin_m: float = Field(default=0.005, ge=0, le=0.2)


class TrialParams(Frozen):
    """Execution in physics: the whole planned path, close, lift, hold."""

    timestep_s: float = Field(default=1 / 200, ge=1e-4, le=0.02)
    control_period_s: float = Field(default=1 / 20, ge=0.005, le=0.2)
    object_friction: float = Field(default=0.6, ge=0, le=5)
    finger_friction: float = Field(default=2.0, ge=0, le=5)
    grip_force_n: float = Field(default=40.0, gt=0, le=1000)
    hulls_per_object: int = Field(default=16, ge=1, le=1024)
    approach_s: float = Field(default=0.6, gt=0, le=60)
    close_s: float = Field(default=0.5, gt=0, le=60)
    lift_s: float = Field(default=0.8, gt=0, le=60)
    hold_s: float = Field(default=0.5, gt=0, le=60)
    # Allowed motion of the object in the hand from the end of closing to the end of holding.
    max_slip_m: Metres = 0.03
    # Grasps to execute one after the other, each in a new scene, until one lifts the target. The label is
    # that of the first; the outcome of the last is stored.
    max_attempts: int = Field(default=1, ge=1, le=100)

    @model_validator(mode="after")
    def _ordered(self) -> TrialParams:
        if self.control_period_s < self.timestep_s:
            raise ValueError(
                f"control_period_s {self.control_period_s} is below timestep_s {self.timestep_s}"
            )
        return self


class DisturbanceParams(Frozen):
    """Disturbed labels: the robot arrives near a candidate `repeats` times and plans from there.

    It knows its pose, but not the errors of the target's pose, friction and mass, which only trials show.
    """

    repeats: int = Field(default=5, ge=1, le=1000)
    target_position_std_m: Metres = 0.005
    target_yaw_std_rad: float = Field(default=0.05, ge=0, le=3.2)
    base_position_std_m: Metres = 0.03
    base_yaw_std_rad: float = Field(default=0.05, ge=0, le=3.2)
    object_friction: Interval = Interval(low=0.3, high=0.9)
    mass_scale: Interval = Interval(low=0.8, high=1.2)

    @model_validator(mode="after")
    def _heavy(self) -> DisturbanceParams:
        # An engine treats mass 0 as immovable.
        if self.mass_scale.low < 0.001:
            raise ValueError(f"mass_scale.low {self.mass_scale.low} is below 0.001")
        return self


class ArmParams(Frozen):
    """The arm of the label sources `plan` and `sim`; `trial` is None for `plan`."""

    robot: str = "panda-scaled"
    # sha256 of all that the robot is made from; None for robots that come with ManiSkill.
    robot_digest: str | None = Field(default=None, pattern=r"^[0-9a-f]{64}$")
    joints: int | None = Field(default=None, ge=1, le=9)  # coordinates of the arm; None: seven
    grasps: GraspParams = GraspParams()
    motion: MotionParams = MotionParams()
    # Independent draws of grasps, seeds and paths that the planner makes for a candidate; None: one.
    draws: int | None = Field(default=None, ge=2, le=100)
    trial: TrialParams | None = None
    disturbance: DisturbanceParams | None = None

    @model_validator(mode="after")
    def _one_repeats(self) -> ArmParams:
        if self.draws is not None and (self.trial is not None or self.disturbance is not None):
            raise ValueError("draws are for plan labels without disturbance")
        return self

    @property
    def robot_key(self) -> str:
        """The robot as `open_robot` accepts it, once its file has been read."""
        return self.robot if self.robot_digest is None else f"{self.robot}@{self.robot_digest}"


class ScenesFrom(Frozen):
    """The run whose scenes and candidates are labelled again, or keep their labels and get other clouds."""

    spec_hash: str = Field(pattern=r"^[0-9a-f]{64}$")
    # Number of the viewpoint from which scenes are observed; None for the clouds of that run.
    view: int | None = Field(default=None, ge=1, le=1000)


class VisibilityParams(Frozen):
    """Rays of the visibility window (n x n, fitted to the target's bounding sphere)."""

    window_px: int = Field(default=64, ge=8, le=512)


Distance = Literal["planar", "planar-over-reach", "mount-over-reach"]
DISTANCES: tuple[Distance, ...] = get_args(Distance)


class HeuristicParams(Frozen):
    """The distance-visibility label (paper, Sec. III-B).

    The paper gives the weights, the threshold, the distance bounds and the visibility score, but not a, mu,
    sigma_l and sigma_r. By default mu is the middle of the stated bounds, which are at two sigma.
    """

    distance: Distance = "planar"
    a: float = Field(default=1.0, gt=0, le=10)
    mu: float = Field(default=0.53, gt=0, le=10)
    sigma_l: float = Field(default=0.195, gt=0, le=10)
    sigma_r: float = Field(default=0.195, gt=0, le=10)
    d_min: float = Field(default=0.14, ge=0, le=10)
    d_max: float = Field(default=0.92, ge=0, le=10)
    alpha: Fraction = 0.51
    tau: float = Field(default=0.4546, ge=0, le=10)

    @model_validator(mode="after")
    def _ordered(self) -> HeuristicParams:
        if self.d_max <= self.d_min:
            raise ValueError(f"d_max {self.d_max} must be above d_min {self.d_min}")
        return self


class Specification(Frozen):
    """All that decides the samples of a run."""

    label_source: str = "heuristic"
    seed: int = Field(default=0, ge=0, lt=2**63)
    split: Literal["train", "val", "test", "all"] = "all"
    houses: Source
    objects: Source
    scene: SceneParams = SceneParams()
    settle: SettleParams = SettleParams()
    observation: ObservationParams = ObservationParams()
    candidates: CandidateParams = CandidateParams()
    visibility: VisibilityParams = VisibilityParams()
    heuristic: HeuristicParams = HeuristicParams()
    arm: ArmParams | None = None
    scenes_from: ScenesFrom | None = None
    # Versions of the label code and of the engines that can change bits, by name.
    engines: dict[str, str] = Field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """The fields as stored."""
        return self.model_dump(mode="json")

    def hash(self) -> str:
        """sha256 of the canonical JSON: the identity of the sequence of samples. None is omitted."""
        return digest_of(self.model_dump(mode="json", exclude_none=True))

    @property
    def is_disturbed(self) -> bool:
        """Whether each candidate has several trials with random disturbances."""
        return self.arm is not None and self.arm.disturbance is not None

    def summary(self) -> dict[str, Any]:
        """The fields that reports show, with the hash."""
        return {
            "spec_hash": self.hash(),
            "label_source": self.label_source,
            "disturbed": self.is_disturbed,
            "split": self.split,
            "seed": self.seed,
            "candidates": self.candidates.within or "grid",
            "per_scene": self.candidates.count,
        }

    @property
    def scenes_hash(self) -> str:
        """Hash of the scenes and candidates: equal for runs that label the same ones, from one viewpoint."""
        stored = self.scenes_from
        return stored.spec_hash if stored is not None and stored.view is None else self.hash()

    @property
    def candidates_hash(self) -> str:
        """Hash of the scenes and candidates: also equal for runs that see them from other viewpoints."""
        return self.hash() if self.scenes_from is None else self.scenes_from.spec_hash
