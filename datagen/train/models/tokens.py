"""Tokens of a robot's cloud: points, each with the shape and colour of its surroundings.

Nothing here depends on a candidate or has parameters. Features are grouped by how they rotate with the scene
about the vertical: numbers (invariant), vectors, and second-order tensors (with twice the angle), so that
rotation into a candidate's frame is a product (`frames.py`). In a mirror along a candidate's line to the
target numbers are invariant too, and components to the left change their sign.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import torch
from torch import Tensor

from datagen.train.inputs import CandidateInputs, Clouds
from datagen.train.models.crop import Crop, first_true, gather_rows

# Products of coordinates that make a second moment: xx, yy, zz, xy, xz, yz.
_LEFT, _RIGHT = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
# Standard deviations of a target of common size, in metres: brings its moments near 1.
_TARGET_SIZE_M = 0.04
# Within this distance of the target's axis the direction away from it fades out.
_AXIS_M = 0.02
N_KINDS = 3  # on the target, near it, further away


@dataclass(frozen=True, eq=False)
class Tokens:
    """J points in each of R robots' clouds, and the target as a whole. Rows not `valid` are zero.

    Vectors and tensors are pairs: a tensor (a, b) is that of a symmetric 2 x 2 matrix [[a, b], [b, -a]] / 2.
    """

    centres_m: Tensor  # (R, J, 3) target frame
    valid: Tensor  # (R, J) bool
    numbers: Tensor  # (R, J, n_numbers)
    vectors: Tensor  # (R, J, n_vectors, 2)
    tensors: Tensor  # (R, J, n_tensors, 2)
    target_numbers: Tensor  # (R, 6)
    target_vectors: Tensor  # (R, 2, 2)
    target_tensors: Tensor  # (R, 1, 2)
    target_radius_m: Tensor  # (R,) of the sphere around the target's centre that holds its points
    target_rise_m: Tensor  # (R,) of the target's centre above the mount
    hand_poses: Tensor | None = None  # (S, K, HAND_WIDTH) of the clouds, of `hand_poses`


@dataclass(frozen=True, eq=False)
class TokenSizes:
    """Numbers, vectors and tensors of a token, for a number of scales."""

    numbers: int
    vectors: int
    tensors: int


TARGET_NUMBERS, TARGET_VECTORS, TARGET_TENSORS = 6, 2, 1


def token_sizes(n_scales: int) -> TokenSizes:
    """Widths of the features of `tokens_of`."""
    vectors, tensors = 2 * n_scales, n_scales
    numbers = 11 * n_scales + 2 * (vectors + tensors) + 4 + 3 + N_KINDS
    return TokenSizes(numbers, vectors + 2, tensors + 1)


def tokens_of(crop: Crop, counts: tuple[int, int, int], near_m: float, scales_m: Sequence[float]) -> Tokens:
    """Tokens at the first `counts` points, in stored order, on the target, within `near_m` of it, beyond.

    At each scale a token has the moments of the points around it, weighted by 1 - (d / scale)^2: their
    number, mean colour, share of target, mean position and its covariance.
    """
    points = target_frame_points(crop)
    distance = torch.linalg.vector_norm(points, dim=2)
    others = crop.valid & ~crop.target_mask
    kinds = (crop.target_mask, others & (distance <= near_m), others & (distance > near_m))
    picked = [first_true(kind, count) for kind, count in zip(kinds, counts, strict=True)]
    rows, valid = (torch.cat(parts, dim=1) for parts in zip(*picked, strict=True))
    centres, rgb = gather_rows(points, rows), gather_rows(crop.rgb, rows)

    mask = crop.target_mask[..., None].to(points.dtype)
    lifted = torch.cat(
        [torch.ones_like(mask), points, points[..., _LEFT] * points[..., _RIGHT], crop.rgb, mask], dim=2
    )
    lifted = torch.where(crop.valid[..., None], lifted, 0.0)
    horizontal = torch.linalg.vector_norm(centres[..., :2], dim=2)
    outward = centres[..., :2] / (horizontal[..., None] + _AXIS_M)
    numbers = [
        3 * centres[..., 2],
        centres[..., 2] + crop.target_rise_m[:, None],
        2 * horizontal,
        2 * torch.linalg.vector_norm(centres, dim=2),
        *rgb.unbind(2),
    ]
    vectors: list[Tensor] = []
    tensors: list[Tensor] = []
    for scale, sums in zip(scales_m, _moment_sums(centres, points, lifted, scales_m), strict=True):
        mean, covariance, others_ = _moments(sums)
        mean = 3 * (mean - centres) / scale
        xx, yy, zz, xy, xz, yz = (5 * covariance / scale**2).unbind(2)
        level, tilt = mean[..., :2], torch.stack([xz, yz], dim=2)
        stretch = torch.stack([xx - yy, 2 * xy], dim=2)
        numbers += [torch.log1p(sums[..., 0]) / 3, mean[..., 2], zz, xx + yy, *others_.unbind(2)]
        numbers += [torch.linalg.vector_norm(v, dim=2) for v in (level, tilt, stretch)]
        vectors += [level, tilt]
        tensors += [stretch]
    outward_twice = doubled(outward)
    for v, axis in [*((v, outward) for v in vectors), *((t, outward_twice) for t in tensors)]:
        along, aside = turned(v, axis).unbind(2)
        numbers += [along, aside.abs()]  # in a mirror `aside` changes its sign, and numbers must not
    kind_of = torch.eye(N_KINDS, device=points.device).repeat_interleave(
        torch.tensor(counts, device=points.device), dim=0
    )
    stacked = torch.cat([torch.stack(numbers, dim=2), kind_of.expand(len(rows), -1, -1)], dim=2)
    vectors += [2 * centres[..., :2], outward]
    tensors += [outward_twice]
    keep = valid[..., None, None]

    sums = torch.einsum("rk,rkf->rf", mask[..., 0], lifted)
    mean, covariance, _ = _moments(sums)
    xx, yy, zz, xy, xz, yz = (covariance / _TARGET_SIZE_M**2).unbind(1)
    none = ~crop.target_mask
    radius = distance.masked_fill(none, 0.0).amax(1)
    top = points[..., 2].masked_fill(none, -0.3).amax(1)
    bottom = points[..., 2].masked_fill(none, 0.3).amin(1)
    return Tokens(
        centres_m=torch.where(valid[..., None], centres, 0.0),
        valid=valid,
        numbers=torch.where(valid[..., None], stacked, 0.0),
        vectors=torch.where(keep, torch.stack(vectors, dim=2), 0.0),
        tensors=torch.where(keep, torch.stack(tensors, dim=2), 0.0),
        target_numbers=torch.stack([zz, xx + yy, 10 * top, 10 * bottom, 10 * radius, 10 * mean[:, 2]], dim=1),
        target_vectors=torch.stack([mean[:, :2] / _TARGET_SIZE_M, torch.stack([xz, yz], dim=1)], dim=1),
        target_tensors=torch.stack([xx - yy, 2 * xy], dim=1)[:, None],
        target_radius_m=radius,
        target_rise_m=crop.target_rise_m,
    )


def target_frame_points(crop: Crop) -> Tensor:
    """The crop's points (R, K, 3) with the target's centre as origin; rows that are not valid are zero."""
    points = crop.points_m - torch.nn.functional.pad(crop.target_rise_m[:, None, None], (2, 0))
    return torch.where(crop.valid[..., None], points, 0.0)


def turned(v: Tensor, axis: Tensor) -> Tensor:
    """Pairs (..., 2) in the frame of unit axes (..., 2): (along, left), v times the axis' conjugate."""
    x, y = v.unbind(-1)
    c, s = axis.unbind(-1)
    return torch.stack([x * c + y * s, y * c - x * s], dim=-1)


def doubled(axis: Tensor) -> Tensor:
    """Axes (..., 2) of twice the angle: the axis' square, as a complex number."""
    c, s = axis.unbind(-1)
    return torch.stack([c * c - s * s, 2 * c * s], dim=-1)


def _moment_sums(centres: Tensor, points: Tensor, lifted: Tensor, scales_m: Sequence[float]) -> list[Tensor]:
    """Weighted sums (R, J, F) of `lifted` (R, K, F) around centres (R, J, 3), a tensor for each scale."""
    sums: list[list[Tensor]] = [[] for _ in scales_m]
    for c, p, values in zip(centres, points, lifted, strict=True):  # a robot's (J, K) fits a cache
        x, y, z = (c[:, None, k] - p[None, :, k] for k in range(3))
        gap2 = x * x + y * y + z * z
        for k, scale in enumerate(scales_m):
            sums[k].append((1 - gap2 / scale**2).clamp_(min=0) @ values)
    return [
        torch.stack(parts) if parts else lifted.new_zeros((0, centres.shape[1], lifted.shape[2]))
        for parts in sums
    ]


def _moments(sums: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean position (..., 3), covariance (..., 6), mean of colour and mask (..., 4) from sums (..., 14)."""
    means = sums[..., 1:] / sums[..., :1].clamp(min=1e-6)
    mean, products, rest = means.split([3, 6, 4], dim=-1)
    return mean, products - mean[..., _LEFT] * mean[..., _RIGHT], rest


A = TypeVar("A")
_TARGET_WIDTHS = (TARGET_NUMBERS, 2 * TARGET_VECTORS, 2 * TARGET_TENSORS, 1, 1)
TARGET_WIDTH = sum(_TARGET_WIDTHS)


def packed_width(sizes: TokenSizes) -> int:
    """Numbers that `pack` makes of one token."""
    return 3 + 1 + sizes.numbers + 2 * sizes.vectors + 2 * sizes.tensors


@dataclass(frozen=True, eq=False)
class EncodedClouds(Clouds[A]):
    """S clouds without points, and the tokens of R robots in the order of the batch's robots."""

    tokens: A  # (R, J, F) float16: centre, valid, numbers, vectors, tensors
    targets: A  # (R, TARGET_WIDTH) float32: numbers, vectors, tensors, radius, rise
    hand_poses: A  # (S, K, HAND_WIDTH) float16


@dataclass(frozen=True, eq=False)
class EncodedCandidates(CandidateInputs[A]):
    """N base positions with the estimated visibility of the target."""

    visible_share: A  # (N,) float32
    reach: A | None = field(default=None, kw_only=True)  # (N, K, N_CODES) uint8 of `hand_reach`


def pack(tokens: Tokens) -> tuple[Tensor, Tensor]:
    """`EncodedClouds.tokens` and `EncodedClouds.targets` of these tokens; hand poses are packed already."""
    of_tokens = [
        tokens.centres_m,
        tokens.valid[..., None].to(tokens.numbers.dtype),
        tokens.numbers,
        tokens.vectors.flatten(2),
        tokens.tensors.flatten(2),
    ]
    of_targets = [
        tokens.target_numbers,
        tokens.target_vectors.flatten(1),
        tokens.target_tensors.flatten(1),
        tokens.target_radius_m[:, None],
        tokens.target_rise_m[:, None],
    ]
    return torch.cat(of_tokens, dim=2).half(), torch.cat(of_targets, dim=1).float()


def unpack(clouds: EncodedClouds[Tensor], sizes: TokenSizes) -> Tokens:
    """The tokens that `pack` was given, in single precision."""
    widths = [3, 1, sizes.numbers, 2 * sizes.vectors, 2 * sizes.tensors]
    centres, valid, numbers, vectors, tensors = clouds.tokens.float().split(widths, dim=2)
    t_numbers, t_vectors, t_tensors, radius, rise = clouds.targets.split(list(_TARGET_WIDTHS), dim=1)
    return Tokens(
        centres_m=centres,
        valid=valid[..., 0] > 0,
        numbers=numbers,
        vectors=vectors.unflatten(2, (-1, 2)),
        tensors=tensors.unflatten(2, (-1, 2)),
        target_numbers=t_numbers,
        target_vectors=t_vectors.unflatten(1, (-1, 2)),
        target_tensors=t_tensors.unflatten(1, (-1, 2)),
        target_radius_m=radius[:, 0],
        target_rise_m=rise[:, 0],
        hand_poses=clouds.hand_poses.float(),
    )
