"""Transforms of a recording, as tf2 has them: a tree of frames that move."""

from __future__ import annotations

import math
from array import array
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from datagen.schemas.errors import InputError
from datagen.train.inputs import F64
from datagen.train.prediction.bags import Bag, stamp_ns
from datagen.workers.geometry.transforms import pose

_TYPE = "tf2_msgs/msg/TFMessage"
_STALE_S = 0.1  # how old the last transform may be
_MOST = 1_000_000


class NoTransformError(InputError):
    """Where a frame was is unknown, at that time or at all."""


class TransformTree:
    """The transforms of a recording in a window of time (ns), and all that are static."""

    def __init__(self, bag: Bag, window_ns: tuple[int, int] | None) -> None:
        # By child and parent: rows of time (s), x, y, z, and quaternion x, y, z, w.
        self._edges: dict[str, dict[str, array[float]]] = {}
        self._bag, self._fixed, count = bag, set[str](), 0
        names = [topic for topic, kind in bag.types.items() if kind == _TYPE]
        for fixed in (True, False):
            topics = [name for name in names if name.endswith("tf_static") == fixed]
            for topic, _, data in bag.messages(topics, None if fixed else window_ns):
                transforms = bag.read(topic, data).transforms
                count += len(transforms)
                if count > _MOST:
                    raise bag.error(topic, f"has more than {_MOST:,} transforms", "Record a shorter one")
                for each in transforms:
                    self._add(topic, each, fixed)

    def _add(self, topic: str, each: Any, fixed: bool) -> None:
        parent, child = each.header.frame_id.strip("/"), each.child_frame_id.strip("/")
        p, q = each.transform.translation, each.transform.rotation
        row = [stamp_ns(each.header) / 1e9, p.x, p.y, p.z, q.x, q.y, q.z, q.w]
        if not math.isfinite(sum(row)) or not 0.99 < math.hypot(*row[4:]) < 1.01:
            problem = f"the transform {parent} -> {child} is no rotation and translation"
            raise self._bag.error(topic, problem, "Correct its publisher")
        rows = self._edges.setdefault(child, {}).setdefault(parent, array("d"))
        if fixed:
            self._fixed.add(child)
            del rows[:]
        rows.extend(row)

    def lacks(self, which: str) -> NoTransformError:
        """The error for a transform that is not there."""
        pairs = sorted(f"{parent} -> {child}" for child, rows in self._edges.items() for parent in rows)
        fix = f"Record /tf and /tf_static; it has {', '.join(pairs[:30])[:1000] or 'no transforms'}"
        return NoTransformError(self._bag.path, "tf", f"has no transform {which}", fix)

    def poses(self, frame: str, time_ns: int) -> dict[str, F64]:
        """`T_ancestor_frame` (4, 4) by ancestor, the nearest first. InputError where one is unknown."""
        found, T = {frame: np.eye(4)}, np.eye(4)
        if frame not in self._edges:
            raise self.lacks(f"of the camera's frame {frame!r}")
        while frame in self._edges:
            (parent, rows), *others = self._edges[frame].items()
            if others or parent in found:
                names = ", ".join(self._edges[frame])
                raise self._bag.error(
                    "tf", f"{frame} has the parents {names}", "Frames form a tree (REP 105)"
                )
            T = self._at(f"{parent} -> {frame}", frame in self._fixed, rows, time_ns / 1e9) @ T
            found[parent], frame = T, parent
        return found

    def _at(self, name: str, fixed: bool, row: array[float], time_s: float) -> F64:
        """`T_parent_child` (4, 4), interpolated between two stamps."""
        rows = np.frombuffer(row).reshape(-1, 8)
        rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
        k = int(np.searchsorted(rows[:, 0], time_s))
        low, high = rows[max(k - 1, 0)], rows[min(k, len(rows) - 1)]
        if not 0 < k < len(rows):
            if not fixed and abs(low[0] - time_s) > _STALE_S:
                raise self.lacks(f"{name} within {_STALE_S:g} s of the frame")
            return pose(low[1:4], low[[7, 4, 5, 6]])
        share = (time_s - low[0]) / (high[0] - low[0])
        q = Slerp([0.0, 1.0], Rotation.from_quat(np.stack([low[4:], high[4:]])))(share).as_quat()
        return pose((1 - share) * low[1:4] + share * high[1:4], q[[3, 0, 1, 2]])
