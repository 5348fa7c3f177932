"""Which links of a robot touch each other, and which pairs are worth checking."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio

from datagen.workers.geometry.mesh import F64
from datagen.workers.kinematics.tree import Coordinates
from datagen.workers.robots.gripper import Parts
from datagen.workers.robots.hulls import polyhedron

# Its binary module has no types.
pin: Any = pinocchio
# Configurations in which pairs of links are checked, and the share of them in which a pair may touch.
_SAMPLES = 300
_MOST = 0.5


class SelfCollision:
    """Narrow-phase checks of pairs of bodies, each made of convex parts fixed to a joint.

    Bodies that are fixed to one another, bodies on both sides of one joint and the segments of one telescope
    may always touch. Other pairs that touch in most of 300 random configurations (fixed seed) are left out
    too: their coarse hulls overlap.
    """

    def __init__(
        self,
        model: Any,
        coordinates: Coordinates,
        parts_m: Sequence[Parts],  # one entry a body, body frame
        joint: Sequence[int],  # the model's joint that each body is fixed to
        T_joint_body: Sequence[F64],
    ) -> None:
        self._model, self._data, self._coordinates = model, model.createData(), coordinates
        self._geometry = pin.GeometryModel()
        body_of: list[int] = []
        for b, parts in enumerate(parts_m):
            placement = pin.SE3(T_joint_body[b])
            for part in parts:
                name = f"{b}.{len(body_of)}"
                shape = pin.GeometryObject(name, joint[b], placement, polyhedron(part))
                self._geometry.addGeometryObject(shape)
                body_of.append(b)
        free = {
            (a, b)
            for a in range(len(parts_m))
            for b in range(a + 1, len(parts_m))
            if joint[a] != joint[b] and not self._is_telescope(joint[a], joint[b])
        }
        self._keep(free, body_of)
        self.pairs = tuple(sorted(free - self._touching_often(body_of)))
        self._keep(set(self.pairs), body_of)
        self._results = self._geometry.createData()

    def _is_telescope(self, upper: int, lower: int) -> bool:
        """Whether one joint lies between two joints' bodies, or several that slide with one coordinate."""
        between = list[int]()
        while lower > upper:
            between.append(lower - 1)
            lower = self._model.parents[lower]
        moved = self._coordinates.matrix[between].any(axis=0).sum()
        slides = all("Prismatic" in self._model.joints[j + 1].shortname() for j in between)
        return lower == upper and (len(between) == 1 or (slides and moved == 1))

    def _keep(self, pairs: set[tuple[int, int]], body_of: list[int]) -> None:
        self._geometry.removeAllCollisionPairs()
        for i in range(len(body_of)):
            for j in range(i + 1, len(body_of)):
                if (body_of[i], body_of[j]) in pairs:
                    self._geometry.addCollisionPair(pin.CollisionPair(i, j))

    def _touching_often(self, body_of: list[int]) -> set[tuple[int, int]]:
        results = self._geometry.createData()
        rng = np.random.Generator(np.random.PCG64(0))
        low, high = self._coordinates.lower, self._coordinates.upper
        pairs = [(body_of[p.first], body_of[p.second]) for p in self._geometry.collisionPairs]
        touched: dict[tuple[int, int], int] = {}
        for left, q in zip(
            reversed(range(_SAMPLES)), rng.uniform(low, high, (_SAMPLES, len(low))), strict=True
        ):
            joints = self._coordinates(q)
            pin.computeCollisions(self._model, self._data, self._geometry, results, joints, False)
            found = zip(pairs, results.collisionResults, strict=True)
            for pair in {pair for pair, result in found if result.isCollision()}:
                touched[pair] = touched.get(pair, 0) + 1
            # Stop when the remaining samples cannot change the result of any pair.
            most = _MOST * _SAMPLES
            if left <= most and all(not most - left < count <= most for count in touched.values()):
                break
        return {pair for pair, count in touched.items() if count > _MOST * _SAMPLES}

    def touches(self, q_rad: F64) -> bool:
        """Whether any of `pairs` touch at the joints (A,)."""
        joints = self._coordinates(q_rad)
        return bool(
            pin.computeCollisions(self._model, self._data, self._geometry, self._results, joints, True)
        )
