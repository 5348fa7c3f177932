"""Select objects that a gripper can lift from a table, by their scored grasps."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import numpy as np

from datagen.schemas.specification import GraspParams
from datagen.workers.grasps.grasp_cache import scored_grasps
from datagen.workers.objects.convex import MAX_TARGET_MASS_KG
from datagen.workers.objects.model import ObjectModel
from datagen.workers.robots.gripper import Gripper

# Only the first grasps of an object decide whether it is a target; arms may be offered more.
JUDGED_GRASPS = 64
MIN_CLEAR_GRASPS = 20
MIN_HELD_SHARE = 0.25
PER_FAMILY = 2
# Objects that come in several sizes and nest: "065-a_cups" to "065-j_cups".
_FAMILY = re.compile(r"^(\d+)-[a-z]_(.+)$")


def is_graspable(model: ObjectModel, gripper: Gripper, params: GraspParams) -> bool:
    """Whether an object can be lifted from a table: light, with enough poses above it that hold."""
    if model.mass_kg > MAX_TARGET_MASS_KG:
        return False
    scored = scored_grasps(model, gripper, min(params.per_object, JUDGED_GRASPS))
    held = (scored.score >= params.min_score) & scored.is_clear
    share = held.sum() / max(scored.is_clear.sum(), 1)
    return bool(scored.n_clear >= MIN_CLEAR_GRASPS and share >= MIN_HELD_SHARE and scored.score.any())


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

    def _graspable(self, names: Sequence[str]) -> list[str]:
        sizes = sorted((self._load(name) for name in names), key=lambda model: (model.radius_m, model.name))
        inwards = [sizes[k // 2] if k % 2 == 0 else sizes[-1 - k // 2] for k in range(len(sizes))]
        found: list[str] = []
        for model in inwards:
            if len(found) < PER_FAMILY and is_graspable(model, self._gripper, self._params):
                found.append(model.name)
        return found


def _family(name: str) -> str:
    match = _FAMILY.match(name)
    return f"{match[1]} {match[2]}" if match else name
