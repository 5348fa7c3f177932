"""The paper's model: each candidate is added to the cloud as points, and PointNet++ reads the cloud.

GBPP, arXiv 2509.11594: points (x, y, z, r, g, b) within the arm's reach of the target, z shifted by the
height of the base, the target in one colour, the candidate as 50 black points at (x, y, 0); PointNet++
(Qi et al. 2017, arXiv 1706.02413) with three set-abstraction layers; a head 1024 -> 512 -> 256 -> 2 with
BatchNorm and Dropout. Every candidate costs a pass through the network.

Our choices where the paper gives none:

- The candidate's z = 0 is in the shifted frame, at the height of the arm's mount.
- Sizes and radii are those of PointNet++'s single-scale classifier, in metres.
- Colours are between 0 and 1. Only colour and position distinguish the candidate from a black object.
- The 50 points follow the cloud, so a ball query takes them after the surface's. Farthest-point sampling
  begins with the candidate as one point and continues in the robot's cloud: one sample per robot.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor, nn

from datagen.train.inputs import CandidateInputs, Clouds, RobotInputs
from datagen.train.models.crop import Crop, ball_query, crop_clouds, farthest_points, gather_rows, take_rows
from datagen.train.models.model import Model, ModelConfig, read_config

CANDIDATE_POINTS = 50
# Candidates in one pass without gradients: some 20 MB each at full size.
_CHUNK = 8

Width = Annotated[int, Field(ge=1, le=4096)]
Count = Annotated[int, Field(ge=2, le=8192)]
Radius = Annotated[float, Field(gt=0, le=10)]
Widths = Annotated[tuple[Width, ...], Field(min_length=1, max_length=8)]


class PaperConfig(ModelConfig):
    """Sizes of PointNet++; the defaults are those of its single-scale classifier."""

    n_points: int = Field(default=2048, ge=1, le=65_536)
    centroids: tuple[Count, Count] = (512, 128)
    neighbours: tuple[Width, Width] = (32, 64)
    radii_m: tuple[Radius, Radius] = (0.2, 0.4)
    widths: tuple[Widths, Widths, Widths] = ((64, 64, 128), (128, 128, 256), (256, 512, 1024))
    head: Widths = (512, 256)
    dropout: float = Field(default=0.5, ge=0, lt=1)


@dataclass(frozen=True, eq=False)
class _Groups:
    """The part of the grouping that is the same for all candidates of a robot."""

    crop: Crop
    first: Tensor  # (R, J1 - 1) rows of the cloud: its farthest-point sample
    first_valid: Tensor  # (R, J1 - 1)
    near: Tensor  # (R, J1 - 1, k1) rows of the cloud around each
    near_found: Tensor  # (R, J1 - 1)
    wide: Tensor  # (R, J2 - 1, k2) rows of `first` around the first J2 - 1 of them


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
        flat = rows.flatten(0, -2)
        alone = self.training and len(flat) == 1
        if alone:
            # One row has no variance: normalise by the running statistics.
            self.layers.eval()
        features = self.layers(flat)
        if alone:
            self.layers.train()
        return features.unflatten(0, rows.shape[:-1])


class PaperModel(Model):
    """PointNet++ over cloud and candidate.

    Because of BatchNorm all candidates of a batch are one pass in training, some 90 MB each at full size; in
    evaluation memory is bounded.
    """

    name = "paper"

    def __init__(self, config: Mapping[str, Any]) -> None:
        self.sizes = read_config(PaperConfig, self.name, config)
        super().__init__(self.sizes)
        first, second, third = self.sizes.widths
        self.first = PointMlp(3 + 3, first)
        self.second = PointMlp(3 + first[-1], second)
        self.third = PointMlp(3 + second[-1], third)
        layers: list[nn.Module] = []
        width = third[-1]
        for narrower in self.sizes.head:
            layers += [PointMlp(width, (narrower,)), nn.Dropout(self.sizes.dropout)]
            width = narrower
        self.head = nn.Sequential(*layers, nn.Linear(width, 2))

    @property
    def logit_layer(self) -> nn.Module:
        return self.head[-1]

    def forward(
        self, clouds: Clouds[Tensor], candidates: CandidateInputs[Tensor], robots: RobotInputs[Tensor]
    ) -> Tensor:
        """Logits (N, 2)."""
        with torch.no_grad():
            groups = self._group(crop_clouds(clouds, robots, self.sizes.n_points))
        chunk = len(candidates) if self.training else _CHUNK
        logits = [
            self._score(take_rows(groups, candidates.robot_row[rows]), candidates.base_xy_m[rows])
            for rows in _slices(len(candidates), chunk)
        ]
        return torch.cat(logits).float()

    def _group(self, crop: Crop) -> _Groups:
        """Groups of each robot, one robot at a time to bound memory."""
        (count, count_wide), (k_near, k_wide) = self.sizes.centroids, self.sizes.neighbours
        first = farthest_points(crop.points_m, crop.valid, count - 1)
        first_valid = torch.arange(count - 1, device=first.device) < crop.valid.sum(1, keepdim=True)
        near, wide = [], []
        for robot in _slices(len(first), 1):
            points, valid = crop.points_m[robot], crop.valid[robot]
            centres = gather_rows(points, first[robot])
            near.append(ball_query(points, valid, centres, self.sizes.radii_m[0], k_near))
            wide.append(
                ball_query(
                    centres, first_valid[robot], centres[:, : count_wide - 1], self.sizes.radii_m[1], k_wide
                )[0]
            )
        return _Groups(
            crop,
            first,
            first_valid,
            torch.cat([rows for rows, _ in near]),
            torch.cat([found for _, found in near]),
            torch.cat(wide),
        )

    def _score(self, groups: _Groups, base_xy_m: Tensor) -> Tensor:
        """Logits (C, 2) of C candidates with the groups of their robots."""
        crop = groups.crop
        clump = nn.functional.pad(base_xy_m, (0, 1))[:, None]  # (C, 1, 3)
        points = torch.cat([crop.points_m, clump], dim=1)
        colours = torch.cat([crop.rgb, torch.zeros_like(clump)], dim=1)
        centres, rows = self._first_groups(groups, clump)
        features = self._abstract(self.first, points, colours, centres, rows)
        wide, rows = self._second_groups(groups, clump, centres)
        features = self._abstract(self.second, centres, features, wide, rows)
        features = self.third(torch.cat([wide, features], dim=2)).amax(1)
        return self.head(features)

    def _first_groups(self, groups: _Groups, clump: Tensor) -> tuple[Tensor, Tensor]:
        """Centroids (C, J1, 3), the candidate first, and rows of cloud and clump around them."""
        k, radius = self.sizes.neighbours[0], self.sizes.radii_m[0]
        crop, n = groups.crop, groups.crop.points_m.shape[1]
        centres = gather_rows(crop.points_m, groups.first)
        # Missing centroids of a smaller cloud are the candidate.
        centres = torch.where(groups.first_valid[..., None], centres, clump)
        own, own_found = ball_query(crop.points_m, crop.valid, clump, radius, k)
        rows = torch.where(groups.first_valid[..., None], groups.near, own)
        found = torch.where(groups.first_valid, groups.near_found, own_found)
        rows, found = torch.cat([own, rows], dim=1), torch.cat([own_found, found], dim=1)
        centres = torch.cat([clump, centres], dim=1)
        close = (centres - clump).square().sum(2) <= radius**2
        slot = torch.arange(k, device=rows.device)
        room = (slot >= found[..., None]) & (slot < found[..., None] + CANDIDATE_POINTS) & close[..., None]
        rows = torch.where(room, n, rows)
        # A ball without a surface point holds the candidate alone.
        return centres, torch.where((found == 0)[..., None], n, rows)

    def _second_groups(self, groups: _Groups, clump: Tensor, centres: Tensor) -> tuple[Tensor, Tensor]:
        """Centroids (C, J2, 3) of the second layer, the candidate first, and rows of `centres`."""
        k, radius = self.sizes.neighbours[1], self.sizes.radii_m[1]
        wide = centres[:, : groups.wide.shape[1] + 1]
        everywhere = torch.ones_like(centres[..., 0], dtype=torch.bool)
        own, _ = ball_query(centres, everywhere, clump, radius, k)
        close = (wide[:, 1:] - clump).square().sum(2, keepdim=True) <= radius**2
        others = groups.wide + 1
        joined = torch.cat([torch.zeros_like(others[..., :1]), others[..., :-1]], dim=2)
        rows = torch.where(close, joined, others)
        rows = torch.where(groups.first_valid[:, : rows.shape[1], None], rows, own)
        return wide, torch.cat([own, rows], dim=1)

    @staticmethod
    def _abstract(layer: PointMlp, points: Tensor, features: Tensor, centres: Tensor, rows: Tensor) -> Tensor:
        """Features (C, J, F) of groups: their points relative to the centroid, through `layer`, max."""
        offsets = gather_rows(points, rows) - centres[:, :, None]
        return layer(torch.cat([offsets, gather_rows(features, rows)], dim=3)).amax(2)


def _slices(n: int, size: int) -> Iterator[slice]:
    return (slice(start, start + size) for start in range(0, n, size))
