"""The optimiser, its rate as a function of the step, and its state as named tensors."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from datagen.schemas.errors import InputError
from datagen.train.models import Model


def make_optimiser(model: Model, lr: float, weight_decay: float) -> torch.optim.AdamW:
    """AdamW; weight decay acts on matrices alone, not on biases and norms."""
    matrices = [p for p in model.parameters() if p.ndim > 1]
    others = [p for p in model.parameters() if p.ndim <= 1]
    groups = [{"params": matrices, "weight_decay": weight_decay}, {"params": others, "weight_decay": 0.0}]
    return torch.optim.AdamW([group for group in groups if group["params"]], lr=lr)


def set_rate(optimiser: torch.optim.Optimizer, lr: float) -> None:
    """Set the learning rate of the next step."""
    for group in optimiser.param_groups:
        group["lr"] = lr


def rate_at(step: int, steps: int, highest: float, warmup: float) -> float:
    """Rate of step 0 .. steps - 1: up on a line over the share `warmup`, then a cosine down to 1%."""
    rising = max(1, round(warmup * steps))
    if step < rising:
        return highest * ((step + 1) / rising)
    along = (step - rising) / max(1, steps - rising)
    return highest * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * along)))


def optimiser_tensors(optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Its moments and counts as `<parameter>.<name>`; rates and groups follow from the options."""
    state = optimiser.state_dict()["state"]
    return {f"{k}.{name}": value for k, values in state.items() for name, value in values.items()}


def put_optimiser_tensors(
    optimiser: torch.optim.Optimizer, tensors: Mapping[str, Tensor], place: str
) -> None:
    """Restore tensors of `optimiser_tensors`. InputError where they do not fit the parameters."""
    document = optimiser.state_dict()
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        index, _, what = name.partition(".")
        known = index.isdecimal() and int(index) < len(parameters)
        wanted = {"step": (), "exp_avg": None, "exp_avg_sq": None}
        shape = tuple(parameters[int(index)].shape) if known else ()
        if not known or what not in wanted or tuple(tensor.shape) != (() if what == "step" else shape):
            raise InputError(
                place, name, "does not fit the model's optimiser", "Train it again to another file"
            )
        state.setdefault(int(index), {})[what] = tensor
    if state and (len(state) != len(parameters) or any(len(values) != 3 for values in state.values())):
        raise InputError(place, "optimiser", "incomplete", "Train it again to another file")
    optimiser.load_state_dict({**document, "state": state})
