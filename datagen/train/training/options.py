"""Options of a training, and the three stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from datagen.schemas.errors import InputError


@dataclass(frozen=True)
class TrainingStage:
    """One row of the paper's schedule (GBPP, Sec. III-D): which labels, and which loss."""

    label_sources: tuple[str, ...]
    weighted: bool  # cross-entropy weighted by class, so that both classes count alike
    lr: float
    weight_decay: float
    epochs: int


# The paper gives the losses and the order; rates, decay and epochs are ours.
STAGES: dict[str, TrainingStage] = {
    "stage1": TrainingStage(("heuristic",), True, 2e-3, 0.0, 12),
    "stage2": TrainingStage(("plan", "sim"), False, 1e-3, 1e-2, 20),
    "sim-only": TrainingStage(("plan", "sim"), False, 2e-3, 1e-2, 20),
}


@dataclass(frozen=True)
class Options:
    """All options that affect the weights, besides the data and the checkpoint to begin from."""

    stage: str
    model: str
    model_config: Mapping[str, Any]
    epochs: int
    house_share: float = 1.0  # of the houses that could be trained on; a larger share includes a smaller
    lr: float = 2e-3  # the highest of the schedule
    seed: int = 0
    augment: Mapping[str, Any] = field(default_factory=dict)  # always {}: older checkpoints may hold effects
    batch_scenes: int = 16
    weight_decay: float = 0.0  # on matrices alone: not on biases and norms
    warmup: float = 0.05  # share of the steps in which the rate rises from 0
    clip_norm: float = 1.0  # bounds the norm of all gradients together
    patience: int = 8  # epochs without a lower validation loss

    def __post_init__(self) -> None:
        """Raise InputError for values out of range, by the option's name."""
        rules = {
            "epochs": (self.epochs, self.epochs >= 1, "Give 1 or more"),
            "seed": (self.seed, self.seed >= 0, "Give 0 or more"),
            "house-share": (self.house_share, 0 < self.house_share <= 1, "Give a share above 0, at most 1"),
            "lr": (self.lr, 0 < self.lr <= 1000, "Give a positive number, below 1000"),
        }
        for name, (value, valid, fix) in rules.items():
            if not valid:
                raise InputError("datagen train", f"--{name}", f"{value}", fix)

    def document(self) -> dict[str, Any]:
        """The options as plain data, without the model, which a checkpoint stores separately."""
        return {k: v for k, v in asdict(self).items() if k not in ("stage", "model", "model_config")}
