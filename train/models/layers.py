"""Layers that models share."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class PointMlp(nn.Module):
    """The same linear layers with BatchNorm and ReLU for every row (..., F) -> (..., widths[-1])."""

    def __init__(self, width_in: int, widths: Sequence[int]) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for width in widths:
            # BatchNorm has a bias of its own.
            layers += [nn.Linear(width_in, width, bias=False), nn.BatchNorm1d(width), nn.ReLU(inplace=True)]
            width_in = width
        self.layers = nn.Sequential(*layers)

    def forward(self, rows: Tensor) -> Tensor:
        """Features of rows."""
        flat = rows.flatten(0, -2)
        alone = self.training and len(flat) == 1
        if alone:
            # One row has no spread to be normalised by: what was seen before serves.
            self.layers.eval()
        features = self.layers(flat)
        if alone:
            self.layers.train()
        return features.unflatten(0, rows.shape[:-1])


def mlp(width_in: int, widths: Sequence[int], width_out: int) -> nn.Sequential:
    """Linear layers with LayerNorm and ReLU between them; the last one is linear alone."""
    layers: list[nn.Module] = []
    for width in widths:
        layers += [nn.Linear(width_in, width), nn.LayerNorm(width), nn.ReLU()]
        width_in = width
    return nn.Sequential(*layers, nn.Linear(width_in, width_out))


def empty_logits(like: Tensor) -> Tensor:
    """Logits (0, 2) of no candidate, on the device of `like`."""
    return torch.zeros((0, 2), dtype=torch.float32, device=like.device)
