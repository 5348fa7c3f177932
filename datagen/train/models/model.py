"""The interface of models: a module with a name, a configuration and `score`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, TypeVar

import torch
from pydantic import BaseModel, ConfigDict, ValidationError
from torch import Tensor, nn

from datagen.schemas.errors import InputError
from datagen.train.inputs import CandidateInputs, Clouds, RobotInputs

ConfigT = TypeVar("ConfigT", bound="ModelConfig")


class ModelConfig(BaseModel):
    """The sizes and options of a model; every number has bounds, unknown fields are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Model(nn.Module, ABC):
    """Scores base positions from a robot's cloud.

    `config` has JSON values; `name` and `config` are all that `build_model` needs to rebuild the module.
    """

    name: ClassVar[str]

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config: dict[str, Any] = config.model_dump(mode="json")

    def score(
        self, clouds: Clouds[Tensor], candidates: CandidateInputs[Tensor], robots: RobotInputs[Tensor]
    ) -> Tensor:
        """Logits (N, 2), float32; column 1 is "good". All tensors on the model's device."""
        return self(clouds, candidates, robots) if len(candidates) else candidates.base_xy_m.new_zeros((0, 2))

    @abstractmethod
    def forward(
        self, clouds: Clouds[Tensor], candidates: CandidateInputs[Tensor], robots: RobotInputs[Tensor]
    ) -> Tensor:
        """As `score`; wrappers of modules, as of torch.compile, call it."""

    @property
    def logit_layer(self) -> nn.Module | None:
        """The linear layer whose outputs are the logits; None for a model that computes them otherwise."""
        return None

    def tempered(self, temperature: float) -> dict[str, Tensor]:
        """A copy of the parameters with which all logits are divided by `temperature`.

        Unchanged without a `logit_layer`. Decisions and the order of scores stay.
        """
        of_logits = () if self.logit_layer is None else tuple(map(id, self.logit_layer.parameters()))
        return {
            name: value.detach() / temperature if id(value) in of_logits else value.detach().clone()
            for name, value in self.state_dict(keep_vars=True).items()
        }

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device


def layers(width_in: int, widths: Sequence[int], norm: bool = True) -> nn.Sequential:
    """Linear layers with ReLU, and with LayerNorm before it."""
    made: list[nn.Module] = []
    for width in widths:
        made += [nn.Linear(width_in, width), *([nn.LayerNorm(width)] if norm else []), nn.ReLU()]
        width_in = width
    return nn.Sequential(*made)


def read_config(kind: type[ConfigT], name: str, config: Mapping[str, Any]) -> ConfigT:
    """Validate a configuration. InputError names the first field that is wrong."""
    try:
        return kind.model_validate(dict(config))
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"])
        valid = ", ".join(kind.model_fields)
        raise InputError(
            f"model {name}", field, first["msg"].lower(), f"Its configuration holds: {valid}"
        ) from None
