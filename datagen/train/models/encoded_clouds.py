"""Clouds and candidates with the inputs of `shared` already computed, as arrays that can be cached."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from datagen.train.inputs import CandidateInputs, Clouds
from datagen.train.models.tokens import (
    TARGET_NUMBERS,
    TARGET_TENSORS,
    TARGET_VECTORS,
    Tokens,
    TokenSizes,
)

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
