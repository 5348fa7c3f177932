"""Whether a robot is of the sizes that a model was trained on."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from datagen.train.prediction.base_cells import RobotSize
from datagen.train.program_scorer import ProgramScorer
from datagen.train.scorers import ModelScorer, Scorer

if TYPE_CHECKING:
    from datagen.train.training.checkpoints import CheckpointHead

_SLACK_M = 0.01


def trained_robots(head: CheckpointHead) -> dict[str, tuple[float, float]]:
    """The least and the largest of `ROBOT_SIZES` in the training data; empty for older checkpoints."""
    from datagen.train.dataset import ROBOT_SIZES  # imports the store, which prediction does not need

    known = [origin["robots"] for origin in head.data if "robots" in origin]
    return {
        name: (min(sizes[name][0] for sizes in known), max(sizes[name][1] for sizes in known))
        for name in ROBOT_SIZES
        if known and all(name in sizes for sizes in known)
    }


def robot_notes(scorer: Scorer, robot: RobotSize) -> Iterator[str]:
    """A note for each size of the robot that is a centimetre or more beyond those of the training data."""
    if not isinstance(scorer, (ModelScorer, ProgramScorer)):
        return
    for name, (low, high) in scorer.robots.items():
        size_m, words = getattr(robot, name), name.removesuffix("_m").replace("_", " ")
        if not low - _SLACK_M < size_m < high + _SLACK_M:
            trained = f"{low:g} to {high:g} m" if low < high else f"{low:g} m"
            yield f"{words} {size_m:g} m, but the model was trained on {trained}: scores may be wrong"
