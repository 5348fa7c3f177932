"""Encodes what a robot sees once, and scores all its candidates on that encoding."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from pydantic import Field
from torch import Tensor, nn

from train.inputs import Candidates, Clouds, Robots
from train.models.model import Model, ModelConfig, read_config


class SharedConfig(ModelConfig):
    """Sizes of the shared model."""

    width: int = Field(default=128, ge=4, le=1024)


class SharedModel(Model):
    """Scalars of candidate and robot through an MLP."""

    name = "shared"

    def __init__(self, config: Mapping[str, Any]) -> None:
        sizes = read_config(SharedConfig, self.name, config)
        super().__init__(sizes)
        w = sizes.width
        self.head = nn.Sequential(nn.Linear(6, w), nn.ReLU(), nn.Linear(w, w), nn.ReLU(), nn.Linear(w, 2))

    def forward(
        self, clouds: Clouds[Tensor], candidates: Candidates[Tensor], robots: Robots[Tensor]
    ) -> Tensor:
        """Logits (N, 2)."""
        robot = candidates.robot_row
        cloud = robots.cloud_row[robot]
        planar_m = torch.linalg.vector_norm(candidates.base_xy_m, dim=1)
        rise_m = clouds.target_height_m[cloud] - robots.base_height_m[robot]
        reach_m = robots.arm_reach_m[robot]
        camera_m = robots.camera_height_m[robot] - clouds.target_height_m[cloud]
        scalars = [planar_m, rise_m, reach_m, torch.hypot(planar_m, rise_m) / reach_m, camera_m]
        return self.head(torch.stack([*scalars, clouds.target_radius_m[cloud]], dim=1))
