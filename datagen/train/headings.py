"""How bases stand to the target, in runs and for models.

Models with `kinematics` have the heading as an input; all others are of bases that stand alike.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from datagen.schemas.errors import InputError
from datagen.schemas.specification import Specification

if TYPE_CHECKING:
    from datagen.train.training.checkpoints import CheckpointHead

_SAME_DEG = 0.1


def side_deg_of(spec: Specification) -> float:
    """Angle of the target from the front of a run's bases, counter-clockwise; 0 where they face it."""
    turns = spec.candidates.yaw_rad
    return 0.0 if turns is None else 0.0 - math.degrees(turns.low)


def knows_headings(model: str, config: Mapping[str, object]) -> bool:
    """Whether a model has headings, and the robot's own kinematics, as inputs."""
    return model == "shared" and bool(config.get("kinematics"))


def trained_side_deg(head: CheckpointHead) -> float | None:
    """The same of the bases that a model was trained on; None for one that knows headings.

    Those of older checkpoints face the target.
    """
    if knows_headings(head.model, head.model_config):
        return None
    return next((origin["side_deg"] for origin in head.data if "side_deg" in origin), 0.0)


def is_other_side(a_deg: float, b_deg: float) -> bool:
    """Whether two such angles differ."""
    return abs((a_deg - b_deg + 180) % 360 - 180) > _SAME_DEG


def stands(side_deg: float) -> str:
    """What bases do at such an angle."""
    if not is_other_side(side_deg, 0.0):
        return "face the target"
    return f"have the target {side_deg:.4g} deg from their front"


def refuse_sampled_yaw(parts: Iterable[tuple[str, Specification]]) -> None:
    """Raise InputError where a run, (path, specification), samples headings."""
    for place, spec in parts:
        if spec.candidates.samples_yaw:
            problem = "headings of the base are sampled, and are no input here"
            raise InputError(place, "candidates.yaw_rad", problem, "Use runs with one heading to the target")


def refuse_mixed_headings(parts: Sequence[tuple[str, Specification]]) -> None:
    """Raise InputError where headings of a run, (path, specification), are sampled or differ."""
    refuse_sampled_yaw(parts)
    for place, spec in parts[1:]:
        (at, first), own_deg = parts[0], side_deg_of(spec)
        if is_other_side(own_deg, side_deg_of(first)):
            problem = f"its bases {stands(own_deg)}, and those of {at} {stands(side_deg_of(first))}"
            fix = "Train a model for each, or one of shared with --model-config kinematics=true"
            raise InputError(place, "candidates.yaw_rad", problem, fix)


def refuse_other_heading(place: str, field: str, side_deg: float, model: str, head_deg: float | None) -> None:
    """Raise InputError where bases stand to the target otherwise than those that a model was trained on."""
    if head_deg is not None and is_other_side(side_deg, head_deg):
        problem = f"its bases {stands(side_deg)}, and those that {model} was trained on {stands(head_deg)}"
        fix = "Train a model on runs of such bases, or give a robot of the same base.presents and side_deg"
        raise InputError(place, field, problem, fix)
