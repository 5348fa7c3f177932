"""A stored scene to draw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from datagen.schemas.fields import SceneRows
from datagen.schemas.identity import Stream, generator
from datagen.schemas.specification import Specification
from datagen.workers.rendering.frame import Frame
from datagen.workers.scenes.generate import render_frame
from datagen.workers.scenes.reconstruct import ReconstructedScene

Columns = Mapping[str, Any]
Lines = list[tuple[str, str]]  # printed next to a picture


@dataclass(frozen=True, eq=False)
class Shown:
    """A scene of a run: its rows, and the scene made from them again."""

    run: str
    spec: Specification
    rows: SceneRows
    recalled: ReconstructedScene

    @property
    def samples(self) -> Columns:
        """The candidates, one row each."""
        return self.rows.samples

    @property
    def title(self) -> str:
        return f"Scene {self.recalled.index} of {self.run}: {self.target}"

    @cached_property
    def frame(self) -> Frame:
        """The RGB-D frame, rendered again."""
        rng = generator(self.spec.seed, Stream.NOISE, self.recalled.index, self.recalled.retry)
        return render_frame(self.spec.observation, self.recalled.geometry, self.recalled.camera, rng)

    def place(self, row: int) -> str:
        """Position of a candidate's base as text."""
        x, y = self.samples["base_xy_m"][row]
        return f"({x:.3f}, {y:.3f}) m"

    @property
    def target(self) -> str:
        record = self.rows.record
        return f"{self.recalled.models[0].name} on {record['support_type']}, {record['room_type']}"
