"""Which objects a gripper can take from a table, by the grasps that were found and tried."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from schemas.specification import GraspParams
from workers.grasps.keep import scored_grasps
from workers.objects.convex import MAX_TARGET_MASS_KG
from workers.objects.model import ObjectModel
from workers.robots.robot import Gripper

MIN_CLEAR_GRASPS = 20
MIN_HELD_SHARE = 0.25
PER_FAMILY = 2
# Things that come in sizes and fit into one another: "065-a_cups" to "065-j_cups".
_FAMILY = re.compile(r"^(\d+)-[a-z]_(.+)$")


@dataclass(frozen=True)
class Graspability:
    """One object's line in the table of graspability; a target where `reason` is empty."""

    name: str
    n_tried: int  # poses of the hand checked against the object
    n_free: int  # those that touch nothing of it
    n_clear: int  # and also keep above what it stands on, upright
    n_scored: int  # varied ones of them, with their flips, tried in physics
    n_clear_held: int  # of these, clear of the table and with `min_score` or more
    held_share: float  # mean score
    reason: str

    @property
    def is_target(self) -> bool:
        return not self.reason


def graspability(model: ObjectModel, gripper: Gripper, params: GraspParams) -> Graspability:
    """What the grasps of one object come to. Never raises for what an object is."""
    scored = scored_grasps(model, gripper, params)
    good = scored.score >= params.min_score
    n_clear_held = int((good & scored.is_clear).sum())
    share = float(scored.score.mean()) if len(scored) else 0.0
    reason = scored.reason
    if model.mass_kg > MAX_TARGET_MASS_KG:
        reason = f"heavier than {MAX_TARGET_MASS_KG} kg"
    elif not reason and scored.n_clear < MIN_CLEAR_GRASPS:
        reason = "the table is in the way of the hand"
    elif not reason and share < MIN_HELD_SHARE:
        reason = "most grasps slip"
    elif not reason and n_clear_held == 0:
        reason = "no grasp above the table holds"
    return Graspability(
        model.name,
        scored.n_tried,
        scored.n_free,
        scored.n_clear,
        len(scored),
        n_clear_held,
        share,
        reason,
    )


def targets_of(
    names: Sequence[str], load: Callable[[str], ObjectModel], gripper: Gripper, params: GraspParams
) -> list[str]:
    """The names, sorted, of the objects that can be targets of this gripper.

    At most `PER_FAMILY` of each family of sizes: the smallest and the largest that are graspable, and
    so on inwards. What lies between is not worked out.
    """
    families: dict[str, list[str]] = {}
    for name in sorted(names):
        match = _FAMILY.match(name)
        families.setdefault(f"{match[1]} {match[2]}" if match else name, []).append(name)
    # Workers that start together begin at different places, and find what the others have kept.
    groups = list(families.values())
    begin = os.getpid() % max(len(groups), 1)
    chosen: list[str] = []
    for group in (*groups[begin:], *groups[:begin]):
        inwards = sorted((load(name) for name in group), key=lambda model: (model.radius_m, model.name))
        ends = [inwards[k // 2] if k % 2 == 0 else inwards[-1 - k // 2] for k in range(len(inwards))]
        chosen += _first_graspable(ends, gripper, params)
    return sorted(chosen)


def _first_graspable(models: Sequence[ObjectModel], gripper: Gripper, params: GraspParams) -> list[str]:
    found: list[str] = []
    for model in models:
        if len(found) < PER_FAMILY and graspability(model, gripper, params).is_target:
            found.append(model.name)
    return found
