"""Clouds, robots and candidates of drawn numbers, and models small enough to build in every test."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from datagen.train.inputs import CandidateInputs, Clouds, RobotInputs
from datagen.train.models import Model, build_model

SMALL: dict[str, dict[str, Any]] = {
    "paper": {
        "n_points": 96,
        "centroids": (24, 8),
        "neighbours": (8, 8),
        "widths": ((16, 16), (16, 32), (32, 48)),
        "head": (16,),
        "dropout": 0.0,
    },
    "shared": {
        "n_points": 96,
        "tokens": (8, 12, 12),
        "width": 16,
        "embedding": 16,
        "head": (16,),
    },
    "n2m": {"n_points": 96, "components": 32, "widths": (32, 32), "head": (64,), "dropout": 0.0},
}
REACH_M = 0.8

Tables = tuple[Clouds[Tensor], CandidateInputs[Tensor], RobotInputs[Tensor]]


def small_model(name: str, seed: int = 0, **changes: Any) -> Model:
    """A model of few parameters, all drawn, in evaluation mode; BatchNorm has looked at something."""
    torch.manual_seed(seed)
    model = build_model(name, {**SMALL[name], **changes})
    model.train()
    with torch.no_grad():
        for _ in range(3):
            model.score(*drawn_tables(seed))
    return model.eval()


def drawn_tables(
    seed: int = 0, scenes: int = 2, robots: int = 3, candidates: int = 9, points: int = 96
) -> Tables:
    """A target of a few centimetres on a surface, clutter, and robots around, in random order.

    Robot r has cloud r modulo the scenes; reaches are REACH_M, of which the clouds keep away.
    """
    rng = np.random.default_rng(seed)
    target = rng.random((scenes, points)) < 0.25
    spread = np.where(target[..., None], [0.03, 0.03, 0.05], [0.3, 0.3, 0.08])
    points_m = rng.normal(0, 1, (scenes, points, 3)) * spread
    points_m *= np.minimum(1, 0.75 * REACH_M / np.linalg.norm(points_m, axis=2, keepdims=True))
    clouds = Clouds(
        points_m=torch.tensor(points_m, dtype=torch.float32),
        rgb=torch.tensor(rng.integers(0, 256, (scenes, points, 3)), dtype=torch.uint8),
        target_mask=torch.tensor(target),
        n_points=torch.full((scenes,), points),
        target_height_m=torch.tensor(rng.uniform(0.6, 1.0, scenes), dtype=torch.float32),
        target_radius_m=torch.tensor(rng.uniform(0.05, 0.1, scenes), dtype=torch.float32),
    )
    of_robots = RobotInputs(
        cloud_row=torch.arange(robots) % max(scenes, 1),
        camera_height_m=torch.tensor(rng.uniform(0.8, 1.5, robots), dtype=torch.float32),
        base_height_m=torch.tensor(rng.uniform(0.5, 1.0, robots), dtype=torch.float32),
        arm_reach_m=torch.full((robots,), REACH_M),
    )
    of_candidates = CandidateInputs(
        robot_row=torch.tensor(rng.integers(0, robots, candidates)),
        base_xy_m=torch.tensor(rng.uniform(-0.9, 0.9, (candidates, 2)), dtype=torch.float32),
    )
    return clouds, of_candidates, of_robots


def turned_about_z(tables: Tables, angle: float) -> Tables:
    clouds, candidates, robots = tables
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    points = (clouds.points_m.double() @ turn.T).float()
    base = (candidates.base_xy_m.double() @ turn[:2, :2].T).float()
    return replace(clouds, points_m=points), replace(candidates, base_xy_m=base), robots


def mirrored(tables: Tables) -> Tables:
    clouds, candidates, robots = tables
    flip = torch.tensor([1.0, -1.0, 1.0])
    base = candidates.base_xy_m * flip[:2]
    return replace(clouds, points_m=clouds.points_m * flip), replace(candidates, base_xy_m=base), robots
