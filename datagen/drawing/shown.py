"""Pictures of one scene for `datagen show`, each with its lines of text."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from datagen.drawing.arm_picture import best_success, draw_arm_picture, robots_of
from datagen.drawing.scene_picture import best_clear, draw_scene_picture
from datagen.schemas.fields import SceneRows
from datagen.schemas.identity import Stream, generator
from datagen.schemas.specification import Specification
from datagen.workers.rendering.frame import Frame
from datagen.workers.robots import open_robot
from datagen.workers.scenes.generate import render_frame
from datagen.workers.scenes.reconstruct import ReconstructedScene

Lines = list[tuple[str, str]]


@dataclass(frozen=True, eq=False)
class Shown:
    """A stored scene to draw."""

    run: str
    spec: Specification
    rows: SceneRows
    recalled: ReconstructedScene

    @property
    def title(self) -> str:
        return f"Scene {self.recalled.index} of {self.run}: {self.target}"

    @property
    def frame(self) -> Frame:
        """The RGB-D frame, rendered again."""
        rng = generator(self.spec.seed, Stream.NOISE, self.recalled.index, self.recalled.retry)
        return render_frame(self.spec.observation, self.recalled.geometry, self.recalled.camera, rng)

    def place(self, row: int) -> str:
        """Position of a candidate's base as text."""
        x, y = self.rows.samples["base_xy_m"][row]
        return f"({x:.3f}, {y:.3f}) m"

    @property
    def target(self) -> str:
        record = self.rows.record
        return f"{self.recalled.models[0].name} on {record['support_type']}, {record['room_type']}"


def draw_heuristic(shown: Shown, out: Path) -> Lines:
    """Draw frame, depth, floor plans by label and by score, point cloud and numbers."""
    record, samples = shown.rows.record, shown.rows.samples
    tau = shown.spec.heuristic.tau
    draw_scene_picture(shown.title, shown.recalled, shown.frame, record, samples, tau, out)
    score, label = samples["heuristic_score"], samples["label"]
    best = best_clear(score, samples["base_is_clear"])
    return [
        ("positive", f"{int(label.sum())} of {len(label)} candidates"),
        (
            "best clear base",
            "none is clear" if best is None else f"{shown.place(best)}, H = {score[best]:.3f}",
        ),
    ]


def draw_arm(shown: Shown, out: Path) -> Lines:
    """Frame, maps of outcomes and of scores, grasps, numbers."""
    record, samples = shown.rows.record, shown.rows.samples
    assert shown.spec.arm is not None
    name = shown.spec.arm.robot
    robots = [open_robot(name, reach_m, height_m) for reach_m, height_m in robots_of(samples)]
    tau = shown.spec.heuristic.tau
    draw_arm_picture(shown.title, shown.recalled, shown.frame, record, samples, robots, tau, out)
    label, best = samples["label"], best_success(samples)
    return [
        ("positive", f"{int(label.sum())} of {len(label)} candidates"),
        ("best success", "none" if best is None else f"candidate {best} at {shown.place(best)}"),
    ]
