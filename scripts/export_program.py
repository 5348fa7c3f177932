"""Write a checkpoint of the model `shared` as a program of NumPy's operations, which scores without torch.

    python -m scripts.export_program CKPT OUT

`scripts/release_model.py` writes that of the released model; `tests/train/test_programs.py` compares scores.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import save
from torch import Tensor, nn
from torch.fx import Node

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import whole_file
from datagen.train.hands.poses import HAND_WIDTH
from datagen.train.hands.reach import N_CODES
from datagen.train.headings import trained_side_deg
from datagen.train.inputs import Array, Clouds, RobotInputs
from datagen.train.models.crop import crop_clouds, take_rows
from datagen.train.models.frames import frames_of, target_features
from datagen.train.models.shared import SharedModel, stretched
from datagen.train.models.tokens import Tokens, tokens_of
from datagen.train.prediction.predict import trained_robots
from datagen.train.program_scorer import (
    AT_ONCE,
    CLOUD,
    ENCODE,
    MARK,
    OPERATIONS,
    POINTS,
    SCORE,
    TO_SCORE,
    TOKENS,
    Function,
    Step,
)
from datagen.train.scorers import weights_sha256
from datagen.train.training.checkpoints import load_model


class Encode(nn.Module):
    """`TOKENS` from `CLOUD`: what the candidates of one robot share."""

    def __init__(self, model: SharedModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        points, rgb, mask, count, height, base_height, reach = given
        clouds, sizes = Clouds(points, rgb, mask, count, height, height), self.model.sizes
        robots = RobotInputs(torch.zeros(1, dtype=torch.int64), height, base_height, reach)
        t = tokens_of(crop_clouds(clouds, robots, sizes.n_points), sizes.tokens, sizes.near_m, sizes.scales_m)
        of_target = (t.target_numbers, t.target_vectors, t.target_tensors, t.target_radius_m, t.target_rise_m)
        return *self.model.steered(t), t.centres_m, t.valid, *of_target


class Score(nn.Module):
    """Logits (AT_ONCE, 2) from `TOKENS` and `TO_SCORE`, as `SharedModel.score_tokens` computes them."""

    def __init__(self, model: SharedModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, *given: Tensor) -> Tensor:
        same, left, centres, valid, *of_target, radius, rise = given[: len(TOKENS)]
        camera_rise, reach, poses, base_xy, rho, codes = given[len(TOKENS) :]
        model, robot = self.model, torch.zeros(AT_ONCE, dtype=torch.int64)
        numbers, vectors, tensors = of_target
        target_of = (numbers, vectors, tensors, radius, rise)
        tokens = Tokens(centres, valid, same, same, same, *target_of)
        frames = frames_of(base_xy, *(each[robot] for each in (rise, camera_rise, reach, radius)))
        target, target_left = target_features(frames, tokens, robot)
        scalars = torch.cat([frames.scalars(), target, stretched(rho)], dim=1)
        rows = torch.arange(AT_ONCE)[None]
        conditions = model.condition(scalars)[rows], model.condition_left(target_left)[rows]
        sides = model.pool(same, left, take_rows(frames, rows), *conditions, centres, valid).flatten(0, 1)
        hands = model.hands(poses, robot, frames, scalars, codes, AT_ONCE)
        return model.head(torch.cat([model.pooled(sides).mean(1), model.scalars(scalars), hands], dim=1))


def exported(
    name: str, module: nn.Module, inputs: tuple[str, ...], given: tuple[Tensor, ...]
) -> tuple[Function, dict[str, Array]]:
    """The function of a module for inputs of these shapes, and the constants that it needs, by full name.

    Each input is a tensor of its own: torch joins those that are the same.
    """
    program = torch.export.export(module, given).run_decompositions()
    signature = program.graph_signature
    state: dict[str, Any] = {**program.state_dict, **program.constants}
    lifted = {**signature.inputs_to_parameters, **signature.inputs_to_buffers}
    lifted |= signature.inputs_to_lifted_tensor_constants
    names, known, steps = dict[Node, str](), dict[str, Any](), list[Step]()
    free = iter(inputs)

    def plain(value: Any) -> Any:
        if isinstance(value, Node):
            return MARK + names[value]
        if isinstance(value, torch.dtype):
            return str(value).removeprefix("torch.")
        return [plain(each) for each in value] if isinstance(value, list | tuple) else value

    outputs: tuple[str, ...] = ()
    for node in program.graph.nodes:
        if node.op == "output":
            outputs = tuple(names[each] for each in node.args[0])
        elif node.op == "placeholder" and node.name not in lifted:
            names[node] = next(free)
        elif node.op == "placeholder":
            names[node] = f"{name}.{node.name}"
            known[names[node]] = state[lifted[node.name]].detach().numpy()
        elif (op := _operation(node)) in OPERATIONS and all(each in names for each in node.all_input_nodes):
            options = {key: plain(value) for key, value in node.kwargs.items() if key == "dtype"}
            step = Step(f"{name}.{node.name}", op, tuple(plain(each) for each in node.args), options)
            names[node] = step.name
            if all(names[each] in known for each in node.all_input_nodes):  # no input changes it
                (known[step.name],) = Function((), (step.name,), (step,)).run(known, {})
            else:
                steps.append(step)
    function = Function(inputs, outputs, tuple(steps))
    return function, {n: np.ascontiguousarray(known[n]) for n in function.named() if n in known}


def _operation(node: Node) -> str:
    """Its name in `OPERATIONS`; others only check sizes, which are fixed."""
    target: Any = node.target
    return str(target).split(".")[1] if str(target).startswith("aten.") else target.__name__


def write_program(checkpoint: Path, out: Path) -> None:
    """Write the program of a checkpoint. InputError for a model without kinematics or visibility."""
    model, head = load_model(checkpoint)
    if not isinstance(model, SharedModel) or not (model.sizes.kinematics and model.sizes.observed_visibility):
        fix = "Train `shared` with --model-config kinematics=true"
        raise InputError(checkpoint, "model", "has no program of NumPy's operations", fix)
    model.eval()
    k, u8 = model.sizes.hand_poses, torch.uint8
    cloud = (torch.zeros(1, POINTS, 3), torch.zeros(1, POINTS, 3, dtype=u8), torch.zeros(1, POINTS).bool())
    cloud += (torch.ones(1, dtype=torch.int64), *(torch.ones(1) for _ in range(3)))
    with torch.no_grad():
        candidates = (torch.zeros(1), torch.ones(1), torch.zeros(1, k, HAND_WIDTH), torch.ones(AT_ONCE, 2))
        candidates += (torch.zeros(AT_ONCE), torch.zeros(AT_ONCE, k, N_CODES, dtype=u8))
        encode, constants = exported(ENCODE, Encode(model), CLOUD, cloud)
        of_cloud = tuple(each.clone() for each in Encode(model)(*cloud))
        score, more = exported(SCORE, Score(model), TOKENS + TO_SCORE, (*of_cloud, *candidates))
    functions = {
        name: {
            "inputs": each.inputs,
            "outputs": each.outputs,
            "steps": [[s.name, s.op, s.args, s.options] for s in each.steps],
        }
        for name, each in ((ENCODE, encode), (SCORE, score))
    }
    facts = {"name": f"{head.model} ({head.stage})", "hand_poses": k, "robots": trained_robots(head)}
    facts |= {"side_deg": trained_side_deg(head), "weights_sha256": weights_sha256(model)}
    with whole_file(out, alone=True) as file:
        file.write(save(constants | more, {"program": json.dumps({"functions": functions, "facts": facts})}))


if __name__ == "__main__":
    write_program(Path(sys.argv[1]), Path(sys.argv[2]))
