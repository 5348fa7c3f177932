"""A mixture of Gaussians over base positions, predicted from the local cloud in one pass, as in N2M.

N2M (Chai, Lee and Lim 2025, arXiv 2509.18671) encodes an egocentric cloud and decodes a Gaussian mixture over
base poses, fitted by maximum likelihood to poses from which rollouts succeeded; poses are sampled from it
until one is free. Here the mixture is a rate: with

    rate(x) = sum_k w_k N(x; m_k, C_k),    P(label 1 at x) = 1 - exp(-rate(x)),

labels are those of a Poisson process of good positions that is observed where candidates were proposed. The
usual loss is their likelihood: that of the good positions, as in N2M, times that of their number. The rate is
a density ratio: it counts in units of the density with which candidates were proposed, so no weights are
needed. The score thus also predicts whether any position is good, which a normalised density cannot.

Further differences: a PointNet (Qi et al. 2017, arXiv 1612.00593) without pretraining in place of Point-BERT;
the robot's heights and reach as inputs, since runs hold many robots; positions alone, since bases face the
target; and frames along the principal axes of the points in place of clouds rendered from many viewpoints.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor, nn

from datagen.train.inputs import CandidateInputs, Clouds, RobotInputs
from datagen.train.models.crop import Crop, crop_clouds
from datagen.train.models.model import Model, ModelConfig, layers, read_config
from datagen.train.models.tokens import target_frame_points, turned

_MIN_REACH_M = 0.05
# Standard deviations of components, in units of the reach: the smallest, and where training begins.
_MIN_STD, _FIRST_STD = 0.03, 0.3
_FIRST_RING = 0.6  # distance of the components' means from the target where training begins
_N_POINT, _N_ROBOT, _PER_COMPONENT = 8, 4, 6
# Logarithms of rates: below the first 1 - exp(-rate) is the rate; beyond the second the label is sure.
_SMALL, _LARGE = -9.0, 20.0
# Frames along an axis: both directions, and both mirrored.
_SIGNS = ((1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0))

Width = Annotated[int, Field(ge=1, le=1024)]


class N2mConfig(ModelConfig):
    """Sizes of the encoder and of the mixture."""

    n_points: int = Field(default=512, ge=1, le=65_536)
    components: int = Field(default=16, ge=1, le=256)
    widths: tuple[Width, ...] = Field(default=(64, 64, 128), min_length=1, max_length=8)
    head: tuple[Width, ...] = Field(default=(128,), max_length=8)
    dropout: float = Field(default=0.3, ge=0, lt=1)


class N2mModel(Model):
    """A PointNet over the robot's crop, and a layer that gives the mixture.

    The rate is the mean over the four frames along the principal axes, two of them mirrored, so that it is
    the same for every direction of the scene (frame averaging, Puny et al. 2022, arXiv 2110.03336). In
    training each robot has one of them, sampled in each step.
    """

    name = "n2m"

    def __init__(self, config: Mapping[str, Any]) -> None:
        self.sizes = read_config(N2mConfig, self.name, config)
        super().__init__(self.sizes)
        # Without norms, which would take most of the time: there are many points.
        self.points = layers(_N_POINT, self.sizes.widths, norm=False)
        width = 2 * self.sizes.widths[-1] + _N_ROBOT
        last = self.sizes.head[-1] if self.sizes.head else width
        self.head = nn.Sequential(layers(width, self.sizes.head), nn.Dropout(self.sizes.dropout))
        self.mixture = nn.Linear(last, self.sizes.components * _PER_COMPONENT)
        self._begin_on_a_ring()

    def _begin_on_a_ring(self) -> None:
        """Let the components lie around the target, with a rate of about 1 between them."""
        k = self.sizes.components
        angle = torch.arange(k) / k * 2 * torch.pi
        bias = torch.zeros(k, _PER_COMPONENT)
        bias[:, 1], bias[:, 2] = _FIRST_RING * torch.cos(angle), _FIRST_RING * torch.sin(angle)
        bias[:, 0] = 1.0 - torch.log(torch.tensor(float(k)))
        with torch.no_grad():
            self.mixture.weight.mul_(0.1)
            self.mixture.bias.copy_(bias.flatten())

    def forward(
        self, clouds: Clouds[Tensor], candidates: CandidateInputs[Tensor], robots: RobotInputs[Tensor]
    ) -> Tensor:
        """Logits (N, 2): logarithms of both probabilities."""
        with torch.no_grad():
            crop = crop_clouds(clouds, robots, self.sizes.n_points)
            points = target_frame_points(crop)
            reach_m = robots.arm_reach_m.clamp(min=_MIN_REACH_M)
            axes = _principal_axes(points, crop.valid)
            signs = axes.new_tensor(_SIGNS).expand(len(axes), -1, -1)  # (R, V, 2)
            if self.training:
                drawn = torch.randint(len(_SIGNS), (len(axes),), device=axes.device)
                signs = signs[torch.arange(len(axes), device=axes.device), drawn][:, None]
            views = turned(points[..., :2], axes[:, None])[:, None] * signs[:, :, None]  # (R, V, K, 2)
        mixture = self._mixture(crop, points[..., 2], views, reach_m)  # (R, V, components, 6)
        row = candidates.robot_row
        at = turned(candidates.base_xy_m, axes[row])[:, None] * signs[row] / reach_m[row, None, None]
        return _log_chances(_log_rate(mixture[row], at))

    def _mixture(self, crop: Crop, height_m: Tensor, views: Tensor, reach_m: Tensor) -> Tensor:
        above_mount_m, on_target = crop.points_m[..., 2], crop.target_mask.to(height_m.dtype)
        alike = torch.cat([torch.stack([height_m, above_mount_m, on_target], dim=2), crop.rgb], dim=2)
        features = torch.cat([views, alike[:, None].expand(-1, views.shape[1], -1, -1)], dim=3)
        valid = crop.valid[:, None, :, None]
        hidden = self.points(features) * valid
        mean = hidden.sum(2) / valid.sum(2).clamp(min=1)
        distance = torch.linalg.vector_norm(target_frame_points(crop), dim=2)
        radius = distance.masked_fill(~crop.target_mask, 0.0).amax(1)  # of the target around its centre
        rise = crop.target_rise_m
        of_robot = torch.stack([reach_m, rise, rise / reach_m, 10 * radius], dim=1)
        of_robot = of_robot[:, None].expand(-1, views.shape[1], -1)
        known = self.head(torch.cat([hidden.amax(2), mean, of_robot], dim=2))
        return self.mixture(known).unflatten(2, (self.sizes.components, _PER_COMPONENT)).float()


def _principal_axes(points_m: Tensor, valid: Tensor) -> Tensor:
    """Unit vectors (R, 2) along which the points (R, K, 3) spread most, horizontally around the target."""
    x, y = (points_m[..., :2] * valid[..., None]).unbind(2)
    angle = torch.atan2(2 * (x * y).sum(1), (x * x - y * y).sum(1)) / 2
    return torch.stack([angle.cos(), angle.sin()], dim=1)


def _log_rate(mixture: Tensor, at: Tensor) -> Tensor:
    """Logarithm (N,) of the rate, the mean over V frames, at (N, V, 2) of mixtures (N, V, components, 6)."""
    weight, mean, spread, tilt = mixture.split([1, 2, 2, 1], dim=3)
    std = _MIN_STD + _FIRST_STD * torch.exp(spread.clamp(-6, 3))
    # Inverse of the lower triangular root of the covariance.
    x, y = ((at[:, :, None] - mean) / std).unbind(3)
    y = y - tilt[..., 0] * x
    peak = weight[..., 0] - torch.log(std / _FIRST_STD).sum(3)
    components = peak - (x * x + y * y) / 2
    return torch.logsumexp(components.flatten(1), dim=1) - torch.log(components.new_tensor(at.shape[1]))


def _log_chances(log_rate: Tensor) -> Tensor:
    """Logarithms (N, 2) of exp(-rate) and of 1 - exp(-rate)."""
    rate = torch.exp(log_rate.clamp(max=_LARGE))
    usual = torch.log(-torch.expm1(-torch.exp(log_rate.clamp(_SMALL, _LARGE))))
    return torch.stack([-rate, torch.where(log_rate < _SMALL, log_rate, usual)], dim=1)
