"""Scenes: placement, settling and observation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias

from datagen.schemas.specification import Specification

if TYPE_CHECKING:  # they load renderers, which a base installation lacks
    from datagen.workers.geometry.mesh import F64
    from datagen.workers.houses.house import Surface
    from datagen.workers.objects.model import ObjectModel
    from datagen.workers.rendering import Camera
    from datagen.workers.rendering.cloud import Cloud
    from datagen.workers.rendering.embree import RayScene
    from datagen.workers.scenes.reconstruct import ReconstructedScene
    from datagen.workers.settling import SettleResult
    from datagen.workers.world import PreparedHouse

# Raise it whenever the same specification would give other scenes: a change in how houses and objects
# are read, in placement, viewpoints or clouds. Part of every specification.
VERSION = 1
# The same for specifications with `candidates.within`. 2: robots are drawn given that the target has room.
VERSION_WITHIN = 2
# The same for specifications with `scene.places`.
VERSION_PLACES = 3


def scenes_version(spec: Specification) -> int:
    """The version of the scenes that this specification gives."""
    if spec.scene.places is not None:
        return VERSION_PLACES
    return VERSION if spec.candidates.within is None else VERSION_WITHIN


# The input of a label source: a new scene, or one read from a store. Object 0 is the target.
SettledScene: TypeAlias = "Scene | ReconstructedScene"


@dataclass(frozen=True, eq=False)
class Scene:
    """A settled scene with the camera that observes it. Object 0 is the target."""

    index: int
    retry: int
    redraws: dict[str, int]
    house: PreparedHouse
    surface: Surface
    models: tuple[ObjectModel, ...]
    settled: SettleResult
    rays: RayScene
    camera: Camera
    target_visible_fraction: float
    draw_cloud: Callable[[], Cloud]  # to be called once

    @cached_property
    def cloud(self) -> Cloud:
        """What the camera sees, computed on first use: most scenes that are labelled to find a decisive one
        are not kept."""
        return self.draw_cloud()

    @property
    def T_world_object(self) -> F64:
        """Settled poses (K, 4, 4)."""
        return self.settled.T_world_object

    @property
    def target_center_m(self) -> F64:
        """World position (3,) of the target's frame: the centre of its bounding box."""
        return self.settled.T_world_object[0, :3, 3]
