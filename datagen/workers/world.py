"""Data that a worker keeps between scenes: sources, geometry and ray meshes, each built once."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.specification import PlaceKind, Specification
from datagen.workers.bases.clearance import HouseObstacles
from datagen.workers.content_cache import CacheFolder
from datagen.workers.houses import ids_of_split, open_houses
from datagen.workers.houses.house import House, HouseSource
from datagen.workers.objects import open_objects
from datagen.workers.objects.convex import GRIPPER_VERSION
from datagen.workers.objects.model import ObjectModel, ObjectSource
from datagen.workers.robots import remember

if TYPE_CHECKING:
    from datagen.workers.grasps.targets import Targets

# Houses are drawn at random, so few are seen twice in a row; this bounds a worker's memory.
_HOUSES_KEPT = 16
_TARGETS = CacheFolder("targets", most_files=64)


@dataclass(frozen=True, eq=False)
class PreparedHouse:
    """A house and the geometry derived from it, built on first use: many tries end before."""

    house: House

    @cached_property
    def obstacles(self) -> HouseObstacles:
        """The floor plan that bases must keep clear of."""
        return HouseObstacles(self.house)


@dataclass(eq=False)
class World:
    """Houses and objects of one specification, loaded when first needed."""

    spec: Specification
    houses: HouseSource
    objects: ObjectSource
    house_ids: list[str]
    object_names: list[str]
    target_names: list[str]
    # By house seen before: kinds of places that it lacks, with the reason. It is not loaded for them again.
    lacking: dict[str, dict[PlaceKind, str]] = field(default_factory=dict)
    _houses: OrderedDict[str, PreparedHouse] = field(default_factory=OrderedDict)
    _objects: dict[str, ObjectModel] = field(default_factory=dict)
    _bad_houses: dict[str, tuple[str, str, str, str]] = field(default_factory=dict)

    def house(self, house_id: str) -> PreparedHouse:
        if house_id in self._houses:
            self._houses.move_to_end(house_id)
            return self._houses[house_id]
        if house_id in self._bad_houses:
            raise InputError(*self._bad_houses[house_id])
        try:
            house = self.houses.load(house_id)
            if self.spec.scene.places is not None and house.open_doors is not None:
                house = house.open_doors()
            prepared = PreparedHouse(house)
        except InputError as error:
            # Stored, because later tries may draw the same house.
            self._bad_houses[house_id] = (error.place, error.field, error.problem, error.fix)
            raise
        self._houses[house_id] = prepared
        if len(self._houses) > _HOUSES_KEPT:
            self._houses.popitem(last=False)
        return prepared

    def object(self, name: str) -> ObjectModel:
        if name not in self._objects:
            self._objects[name] = self.objects.load(name)
        return self._objects[name]

    def draw_target(self, rng: np.random.Generator) -> str:
        """A target's name, each equally likely.

        With an arm, targets are the objects that its gripper can grasp. The first check of an object on
        a machine takes seconds, so only objects that are drawn are checked. Raises InputError if no
        object can be grasped.
        """
        if self.spec.arm is None:
            return self.target_names[rng.integers(len(self.target_names))]
        found = self._arm_targets.draw(rng)
        if found is not None:
            return found
        raise InputError(
            "--objects",
            self.objects.kind,
            f"none of {len(self.object_names)} objects can be grasped by {self.spec.arm.robot}",
            "Add smaller or lighter objects, or choose another robot",
        )

    @cached_property
    def _arm_targets(self) -> Targets:
        # Imported here: labels without an arm need neither robots nor grasps.
        from datagen.workers.grasps.targets import Targets
        from datagen.workers.robots import gripper_of

        assert self.spec.arm is not None
        gripper = gripper_of(self.spec.arm.robot_key)
        return Targets(self.object_names, self.objects.load, gripper, self.spec.arm.grasps)


def _target_names(objects: ObjectSource) -> list[str]:
    """Names of the objects that fit a gripper, cached by the source's content: a check loads them all."""
    key = f"{objects.kind}-{objects.digest}-{GRIPPER_VERSION}"
    stored = _TARGETS.computed(
        key,
        lambda: {"names": np.array([n for n in objects.names() if objects.load(n).can_be_target], np.str_)},
    )
    return stored["names"].tolist()


def open_world(spec: Specification, houses: str, objects: str, robot: str = "") -> World:
    """Open the sources that `houses` and `objects` name, and check that they are the specified ones.

    `robot` is the place of the robot's file, "" for one of the registry. Raises InputError if the content of
    a source or of a robot differs from the specification, or if it holds no house, object or target.
    """
    if spec.arm is not None and spec.arm.robot_digest is not None:
        remember(robot or spec.arm.robot, spec.arm.robot, spec.arm.robot_digest)
    house_source, object_source = open_houses(houses), open_objects(objects)
    for option, ref, source, wanted in (
        ("--houses", houses, house_source, spec.houses),
        ("--objects", objects, object_source, spec.objects),
    ):
        if (source.kind, source.digest) != (wanted.kind, wanted.digest):
            found = f"{source.kind} {source.digest[:12]}"
            raise InputError(
                option,
                ref,
                f"holds {found}, but the run was made with {wanted.kind} {wanted.digest[:12]}",
                "Give the folder that the run was started with, or start a new run",
            )
    return assemble_world(spec, house_source, object_source, houses, objects)


def assemble_world(
    spec: Specification, houses: HouseSource, objects: ObjectSource, houses_ref: str, objects_ref: str
) -> World:
    """A world over opened sources. Raises InputError if they hold too little for the specification."""
    house_ids = ids_of_split(houses, spec.split)
    if not house_ids:
        raise InputError(
            "--houses", houses_ref, f"has no house in split {spec.split}", "Add houses, or use --split all"
        )
    names = objects.names()
    targets = _target_names(objects)
    if not targets:
        raise InputError(
            "--objects", objects_ref, "has no object that a gripper can grasp", "Add smaller objects"
        )
    return World(spec, houses, objects, house_ids, names, targets)
