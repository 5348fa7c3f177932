"""Record schemas: the fields of a scene and of a sample.

Store creation, checks of batches, attributes of stored arrays and the data-format page all derive from the
tables below.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from datagen.schemas.errors import InputError, choices
from datagen.schemas.specification import PLACE_KINDS, Specification

Table = Literal["scene", "sample"]
TABLES: tuple[Table, Table] = ("scene", "sample")

# Causes for resampling a scene; their order is part of the data format.
REDRAW_CAUSES = (
    "bad_house",  # the house's record in its source is broken
    "no_surface",  # the house has no support surface of the required height and size
    "no_placement",  # target or clutter found no free place on the surface
    "not_at_rest",  # still moving after the last step
    "fell_off",  # an object left its support
    "penetration",  # a body ended inside another
    "not_finite",  # the physics returned NaN or infinite poses
    "no_viewpoint",  # no free viewpoint from which enough of the target is visible
    "no_base",  # no candidate of the required set (clear, in-range) around the target
)

# Outcome of a candidate of `plan` and `sim`, and the stage that decided it; the order is part of the data
# format. Where several grasps failed, the one that came furthest counts.
OUTCOMES: dict[str, str] = {
    "success": "execute",  # lifted and held; for `plan`: a whole plan was found
    "base_collision": "base",  # the robot's body does not fit where it would stand
    "out_of_reach": "reach",  # the target is farther from the mount than the arm is long
    "no_grasp": "grasps",  # the hand alone collides with the scene in every grasp of the target
    "no_ik": "ik",  # no joint configuration puts the hand at pregrasp and grasp
    "arm_collision": "collision",  # at every such configuration the arm hits the scene or itself
    "no_start": "path",  # every tucked start pose collides
    "no_path": "path",  # no collision-free path to the pregrasp within the iteration cap
    "no_approach": "path",  # the straight line to the grasp jumps, leaves the limits or collides
    "no_lift": "path",  # the straight line up jumps, leaves the limits or collides
    "not_reached": "execute",  # the arm did not arrive: it was blocked or its drives fell behind
    "missed": "execute",  # closed, with nothing between the fingers
    "slipped": "execute",  # held after closing, not lifted with the hand
    "dropped": "execute",  # lifted, and lost before the end of holding
    "unstable": "execute",  # the physics diverged: NaN, impossible speeds, or an object thrown
}

# Outcome of the last execution, where the first failed; the order is part of the data format.
RETRY_OUTCOMES = ("none", *OUTCOMES)

# Version of all schemas, and the oldest that is read.
SCHEMA_VERSION, OLDEST_SCHEMA = 6, 4


@dataclass(frozen=True)
class Field:
    """One array of a store.

    `dims` names the axes after the table's own ("scene" or "sample"); `RecordSchema.sizes` has their lengths.
    `low` and `high` bound every finite value (closed interval). Stores of a version before `since` lack it:
    readers compute it (`stored_arrays.COMPUTED`).
    """

    name: str
    dtype: str  # a numpy dtype name, or "string"
    dims: tuple[str, ...]
    unit: str  # "m", "kg", "px", "1" for numbers without a unit, "" for names
    frame: str  # "world", "target", "camera", "" where none applies
    doc: str
    low: float | None = None
    high: float | None = None
    codes: tuple[str, ...] = ()  # meanings of the values 0, 1, ...
    since: int = OLDEST_SCHEMA

    @property
    def is_text(self) -> bool:
        return self.dtype == "string"


@dataclass(frozen=True)
class RecordSchema:
    """The arrays of one label source and the lengths of their axes."""

    name: str
    version: int
    scene_fields: tuple[Field, ...]
    sample_fields: tuple[Field, ...]
    sizes: Mapping[str, int] = field(default_factory=dict, hash=False)

    def table(self, table: Table) -> tuple[Field, ...]:
        return self.scene_fields if table == "scene" else self.sample_fields

    @property
    def fields(self) -> tuple[tuple[Table, Field], ...]:
        """Every field with its table, scenes first."""
        return tuple((table, f) for table in TABLES for f in self.table(table))

    def shape(self, f: Field, rows: int) -> tuple[int, ...]:
        return (rows, *(self.sizes[d] for d in f.dims))

    def of_version(self, version: int) -> RecordSchema:
        """The schema as it was in an older version."""
        if version == self.version:
            return self
        scene, sample = (tuple(f for f in self.table(table) if f.since <= version) for table in TABLES)
        return replace(self, version=version, scene_fields=scene, sample_fields=sample)

    def check(self, table: Table, rows: int, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Raise InputError for a batch with missing or unknown fields, or a wrong dtype, shape or range."""
        fields = {f.name: f for f in self.table(table)}
        place = f"batch of {self.name} {table}s"
        fix = "This is a defect of the label source: its output must follow its schema."
        if set(arrays) != set(fields):
            odd = sorted(set(arrays) ^ set(fields))
            raise InputError(place, ", ".join(odd), "are missing or unknown fields", fix)
        for name, f in fields.items():
            a = arrays[name]
            if a.shape != self.shape(f, rows):
                raise InputError(place, name, f"shape {a.shape}, not {self.shape(f, rows)}", fix)
            if f.is_text:
                continue
            if a.dtype != np.dtype(f.dtype):
                raise InputError(place, name, f"dtype {a.dtype}, not {f.dtype}", fix)
            if a.dtype.kind == "f" and not np.isfinite(a).all():
                raise InputError(place, name, "has NaN or infinite values", fix)
            if a.size and f.low is not None and a.min() < f.low:
                raise InputError(place, name, f"value {a.min()} below {f.low}", fix)
            if a.size and f.high is not None and a.max() > f.high:
                raise InputError(place, name, f"value {a.max()} above {f.high}", fix)


@dataclass(frozen=True, eq=False)
class SceneRows:
    """The stored rows of one scene by field name: its record, and its samples, one per candidate."""

    record: Mapping[str, Any]
    samples: Mapping[str, np.ndarray[Any, Any]]


_EXTENT = 1000.0  # no house is larger; a larger coordinate is an error

# One field per line reads best.
# fmt: off
SCENE_FIELDS = (
    Field("scene_index", "int64", (), "1", "", "index of the scene in the run's sequence", 0),
    Field("retry", "int32", (), "1", "", "retry index that succeeded; 0 is the first draw", 0),
    Field("redraws", "uint16", ("redraw_cause",), "1", "", "redraws before it, by cause"),
    Field("house_id", "string", (), "", "", "house, as its source names it"),
    Field("house_digest", "string", (), "", "", "sha256 of the house's bytes in its source"),
    Field("room_id", "string", (), "", "", "room that holds the support surface"),
    Field("room_type", "string", (), "", "", "type of that room"),
    Field("support_id", "string", (), "", "", "support surface within the house"),
    Field("support_type", "string", (), "", "", "type of furniture that carries it"),
    Field("place", "uint8", (), "1", "",
          "kind of place where the objects stand", 0, len(PLACE_KINDS) - 1, PLACE_KINDS, since=6),
    Field("good_share", "float32", (), "1", "",
          "share of good labels among the clear candidates in reach, in the run that drew the scene", 0, 1,
          since=6),
    Field("decisive_draws", "int32", (), "1", "",
          "scenes labelled until good_share was between 0.05 and 0.6; 0 where any was taken", 0, since=6),
    Field("T_world_support", "float64", ("row", "column"), "m", "world",
          "support surface, origin at its centre, z up"),
    Field("support_size_m", "float32", ("xy",), "m", "support",
          "extent of the support rectangle", 0, _EXTENT),
    Field("object_name", "string", ("object",), "", "", "objects on the support; the target is first"),
    Field("object_digest", "string", ("object",), "", "", "sha256 of what each object is made from"),
    Field("object_mass_kg", "float32", ("object",), "kg", "", "mass used by the physics", 0, 100),
    Field("T_world_object", "float64", ("object", "row", "column"), "m", "world", "settled object poses"),
    Field("settle_steps", "int32", (), "1", "", "physics steps until rest", 0),
    Field("residual_speed_mps", "float32", (), "m/s", "world", "largest object speed at the end", 0, 100),
    Field("penetration_m", "float32", (), "m", "", "deepest contact at the end", 0, 10),
    Field("target_center_m", "float64", ("xyz",), "m", "world",
          "origin of the target's frame: the centre of its bounding box", -_EXTENT, _EXTENT),
    Field("target_radius_m", "float32", (), "m", "",
          "radius of the sphere around target_center_m that holds the target", 0, 10),
    Field("T_world_camera", "float64", ("row", "column"), "m", "world",
          "observation camera: x right, y down, z forward"),
    Field("intrinsics_px", "float32", ("fx_fy_cx_cy",), "px", "camera", "pinhole intrinsics", 0, 1e5),
    Field("image_size_px", "int32", ("width_height",), "px", "camera", "frame size", 1, 1e5),
    Field("target_visible_fraction", "float32", (), "1", "camera",
          "target pixels seen / target pixels alone", 0, 1),
    Field("points_m", "float16", ("point", "xyz"), "m", "target",
          "cloud, world axes, origin at target_center_m", -10, 10),
    Field("rgb", "uint8", ("point", "channel"), "1", "", "colour of each point", 0, 255),
    Field("target_mask", "bool", ("point",), "1", "", "whether the point lies on the target"),
    Field("n_points", "int32", (), "1", "", "rows of the cloud that hold points; the rest are zero", 0),
)

SAMPLE_FIELDS = (
    Field("sample_id", "uint8", ("byte",), "1", "", "128-bit id: hash of specification, scene and candidate"),
    Field("sample_scene_index", "int64", (), "1", "", "scene_index of the sample's scene", 0),
    Field("candidate_index", "int32", (), "1", "", "index of the candidate in its scene", 0),
    Field("robot_index", "int16", (), "1", "",
          "index of the robot in its scene; candidates of one robot share its numbers", 0),
    Field("base_xy_m", "float32", ("xy",), "m", "world", "base position", -_EXTENT, _EXTENT),
    Field("base_yaw_rad", "float32", (), "rad", "world",
          "heading of the base, counter-clockwise from x", -3.1416, 3.1416, since=5),
    Field("camera_height_m", "float32", (), "m", "world", "height of the robot's camera", 0, 10),
    Field("base_height_m", "float32", (), "m", "world", "height of the arm's mount", 0, 10),
    Field("arm_reach_m", "float32", (), "m", "", "reach of the arm, d_arm", 0, 10),
    Field("distance_m", "float32", (), "m", "world", "horizontal distance from base to target centre", 0, 10),
    Field("mount_distance_m", "float32", (), "m", "world",
          "distance from the arm's mount (x, y, base_height) to the target centre", 0, 10),
    Field("target_px", "int32", (), "px", "", "window pixels on the target when it is alone", 0),
    Field("visible_px", "int32", (), "px", "", "those of them on which the full scene shows the target", 0),
    Field("visibility", "float32", (), "1", "", "rho = visible_px / target_px (0 when target_px is 0)", 0, 1),
    Field("heuristic_score", "float32", (), "1", "", "H, the distance-visibility score", 0, 10),
    Field("base_clearance_m", "float32", (), "m", "world",
          "free distance around the robot's body; negative inside an obstacle or outside every room",
          -10, 10),
    Field("base_is_clear", "bool", (), "1", "", "base_clearance_m >= 0"),
    Field("label", "uint8", (), "1", "", "1 where the label source calls the base pose good", 0, 1),
    Field("label_source", "string", (), "", "", "name of the label source"),
    Field("label_version", "int16", (), "1", "", "version of the label source's code", 0),
)

_OUTCOME_CODES = tuple(OUTCOMES)

_PLANNED_FIELDS = (
    *SAMPLE_FIELDS,
    Field("heuristic_label", "uint8", (), "1", "", "label of the distance-visibility rule", 0, 1),
    Field("outcome", "uint8", (), "1", "",
          "success, or the cause of the label 0", 0, len(_OUTCOME_CODES) - 1, _OUTCOME_CODES),
    Field("grasps_free", "int16", (), "1", "", "grasps of the target that the hand alone can take here", 0),
    Field("grasps_tried", "int16", (), "1", "", "grasps for which joint configurations were looked for", 0),
    Field("T_target_tcp", "float32", ("row", "column"), "m", "target",
          "grasp that was planned, target frame; the identity where none was", -10, 10),
    Field("grasp_score", "float32", (), "1", "", "share of floating-hand trials the grasp held", 0, 1),
    Field("q_grasp_rad", "float32", ("joint",), "rad", "", "joints at the grasp; zeros where none", -7, 7),
    Field("path_length_rad", "float32", (), "rad", "", "length in joint space, tucked to grasp", 0, 1000),
    Field("path_clearance_m", "float32", (), "m", "",
          "smallest distance of the arm to the scene on the way to the pregrasp", 0, 10),
)

PLAN_FIELDS = (
    *_PLANNED_FIELDS,
    Field("trials", "int16", (), "1", "",
          "what was planned: arrivals, draws, or 1, the candidate itself; 0 where nothing was planned",
          0),
    Field("successes", "int16", (), "1", "", "those with a whole plan; the label is the candidate's own", 0),
)

SIM_FIELDS = (
    *_PLANNED_FIELDS,
    Field("attempts", "int16", (), "1", "", "grasps that were executed", 0),
    Field("trials", "int16", (), "1", "", "what the label is a rate of: repeats, or 1; 0 without a plan", 0),
    Field("successes", "int16", (), "1", "", "those in which the target was lifted and held", 0),
    Field("lift_m", "float32", (), "m", "world", "rise of the target in the last execution", -100, 100),
    Field("slip_m", "float32", (), "m", "tcp", "motion of the target in the hand from closing on", 0, 100),
    Field("disturbed_m", "float32", (), "m", "world", "largest motion of any other object", 0, 100),
    Field("simulated_s", "float32", (), "s", "", "simulated time of all executions", 0, 1e6),
    Field("retry_outcome", "uint8", (), "1", "",
          "outcome of the last execution after a first that failed; the label is the first's",
          0, len(RETRY_OUTCOMES) - 1, RETRY_OUTCOMES),
)
# fmt: on

_SIZES = {
    "row": 4, "column": 4, "xy": 2, "xyz": 3, "channel": 3, "byte": 16, "fx_fy_cx_cy": 4,
    "width_height": 2, "redraw_cause": len(REDRAW_CAUSES), "object": 7, "point": 4096, "joint": 7,
}  # fmt: skip

SCHEMAS: dict[str, RecordSchema] = {
    "heuristic": RecordSchema("heuristic", SCHEMA_VERSION, SCENE_FIELDS, SAMPLE_FIELDS, _SIZES),
    "plan": RecordSchema("plan", SCHEMA_VERSION, SCENE_FIELDS, PLAN_FIELDS, _SIZES),
    "sim": RecordSchema("sim", SCHEMA_VERSION, SCENE_FIELDS, SIM_FIELDS, _SIZES),
}


def sized_schema(name: str, spec: Specification, version: int = SCHEMA_VERSION) -> RecordSchema:
    """Return the named schema with the specification's axis lengths. InputError for an unknown name."""
    if name not in SCHEMAS:
        raise InputError("specification", "label_source", f"no record schema {name!r}", choices(SCHEMAS))
    sizes = {"point": spec.observation.n_points, "object": 1 + spec.scene.n_clutter}
    if spec.arm is not None and spec.arm.joints is not None:
        sizes["joint"] = spec.arm.joints
    schema = SCHEMAS[name].of_version(version)
    return replace(schema, sizes={**schema.sizes, **sizes})


def facing_rad(towards_m: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Headings (...,) along vectors (..., 2), counter-clockwise from x."""
    return np.arctan2(towards_m[..., 1], towards_m[..., 0], dtype=np.float64)
