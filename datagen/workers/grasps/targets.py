"""Select objects that a gripper can lift from a table, by their scored grasps."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from datagen.schemas.specification import GraspParams
from datagen.workers.grasps.grasp_cache import scored_grasps
from datagen.workers.objects.convex import MAX_TARGET_MASS_KG
from datagen.workers.objects.model import ObjectModel
from datagen.workers.robots.description import Gripper

# Only the first grasps of an object decide whether it is a target; arms may be offered more.
JUDGED_GRASPS = 64
MIN_CLEAR_GRASPS = 20
MIN_HELD_SHARE = 0.25
PER_FAMILY = 2
# Objects that come in several sizes and nest: "065-a_cups" to "065-j_cups".
_FAMILY = re.compile(r"^(\d+)-[a-z]_(.+)$")


@dataclass(frozen=True)
class Graspability:
    """One object's line in the table of graspability; a target where `reason` is empty."""

    name: str
    n_tried: int  # poses of the hand checked against the object
    n_free: int  # of these, the hand does not touch the object
    n_clear: int  # of the free ones, the hand is above the upright object's support
    n_scored: int  # free poses that were scored in physics
    n_clear_held: int  # scored ones that are clear and have at least `min_score`
    held_share: float  # n_clear_held over the scored ones that are clear
    reason: str

    @property
    def is_target(self) -> bool:
        return not self.reason


def graspability(model: ObjectModel, gripper: Gripper, params: GraspParams) -> Graspability:
    """Count the grasps of one object and decide whether it is a target. Never raises for any object."""
    scored = scored_grasps(model, gripper, min(params.per_object, JUDGED_GRASPS))
    good = scored.score >= params.min_score
    n_clear_held = int((good & scored.is_clear).sum())
    share = n_clear_held / max(int(scored.is_clear.sum()), 1)
    reason = scored.reason
    if model.mass_kg > MAX_TARGET_MASS_KG:
        reason = f"heavier than {MAX_TARGET_MASS_KG} kg"
    elif not reason and scored.n_clear < MIN_CLEAR_GRASPS:
        reason = "the table is in the way of the hand"
    elif not reason and share < MIN_HELD_SHARE:
        reason = "most grasps above the table slip"
    return Graspability(
        model.name, scored.n_tried, scored.n_free, scored.n_clear, len(scored), n_clear_held, share, reason
    )


class Targets:
    """The objects of a source that can be targets of one gripper, each computed on first use.

    A family of sizes has at most `PER_FAMILY` targets: its smallest and its largest graspable object, then
    the next ones inwards. The others are never computed.
    """

    def __init__(
        self, names: Sequence[str], load: Callable[[str], ObjectModel], gripper: Gripper, params: GraspParams
    ) -> None:
        self._load, self._gripper, self._params = load, gripper, params
        self._families: dict[str, list[str]] = {}
        for name in sorted(names):
            self._families.setdefault(_family(name), []).append(name)
        self._known: dict[str, list[str]] = {}

    def is_target(self, name: str) -> bool:
        """Whether the object of that name can be a target. Raises KeyError for an unknown name."""
        family = _family(name)
        if family not in self._known:
            self._known[family] = self._graspable(self._families[family])
        return name in self._known[family]

    def draw(self, rng: np.random.Generator) -> str | None:
        """A random target, all equally likely; None where there is none.

        Checks objects in random order until one is a target, so that a short run computes few.
        """
        names = [name for family in self._families.values() for name in family]
        return next((names[k] for k in rng.permutation(len(names)) if self.is_target(names[k])), None)

    def names(self) -> list[str]:
        """All targets, sorted; computes every object.

        Processes that start together begin at different objects and read the others' results from the cache.
        """
        families = list(self._families.values())
        begin = os.getpid() % max(len(families), 1)
        found = [n for f in (*families[begin:], *families[:begin]) for n in f if self.is_target(n)]
        return sorted(found)

    def _graspable(self, names: Sequence[str]) -> list[str]:
        sizes = sorted((self._load(name) for name in names), key=lambda model: (model.radius_m, model.name))
        inwards = [sizes[k // 2] if k % 2 == 0 else sizes[-1 - k // 2] for k in range(len(sizes))]
        found: list[str] = []
        for model in inwards:
            if len(found) < PER_FAMILY and graspability(model, self._gripper, self._params).is_target:
                found.append(model.name)
        return found


def _family(name: str) -> str:
    match = _FAMILY.match(name)
    return f"{match[1]} {match[2]}" if match else name
