"""Encode a robot's cloud once, and score all its candidates on that encoding.

The cloud becomes 80 tokens: points on the target, near it and further away, with the shape of their
surroundings (`tokens.py`). Each candidate has the tokens in its own frame: directions are rotated into it,
and offsets from its line of sight and from the arm's straight path are added (`frames.py`). The first layer
is linear in all of that: the token's part is computed once for all candidates, and the rotated part is a
product with (cos, sin, cos 2, sin 2) of the frame's angle:

    token_kj = relu(A f_j + turn_k(V f_j) + B g_kj + C s_k)

then a small layer, and the maximum and the mean over each kind of token, joined with the candidate's
scalars s_k and with pooled poses of a hand at the target (`hand_pooling.py`). The logits do not change when
cloud and candidates rotate together about the vertical, nor, if `mirrored`, when the scene is mirrored at a
candidate's line to the target: the mean over both sides is taken.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from datagen.train.hands.poses import poses_of_clouds
from datagen.train.hands.reach import N_CODES, hand_reach, hands_of
from datagen.train.inputs import CandidateInputs, Clouds, RobotInputs
from datagen.train.models.crop import crop_clouds, take_rows
from datagen.train.models.frames import (
    N_PAIR_FEATURES,
    N_SCALARS,
    Frames,
    frames_of,
    pair_features,
    target_features,
)
from datagen.train.models.hand_pooling import N_SEEN_FROM_MOUNT, HandPooling, highest, tiles
from datagen.train.models.model import Model, ModelConfig, layers, read_config
from datagen.train.models.tokens import (
    N_KINDS,
    TARGET_NUMBERS,
    TARGET_TENSORS,
    TARGET_VECTORS,
    EncodedCandidates,
    EncodedClouds,
    Tokens,
    target_frame_points,
    token_sizes,
    tokens_of,
    unpack,
)
from datagen.train.observed_visibility import visible_shares
from datagen.train.tensors import on_cpu

# Candidates in one product: on a CPU their tokens stay in a core's cache.
_TILE_CPU, _TILE_CUDA = 64, 4096
# Height of an unknown camera above the mount: the difference of the middles of both ranges in the paper.
_CAMERA_ABOVE_MOUNT_M = 0.4
_MIN_REACH_M = 0.05
_N_VISIBILITY = 3
_MOST_DROPPED = 0.5  # of tokens and hand poses, in training
# The estimate needs surfaces without gaps: all points of a usual cloud.
_VISIBILITY_POINTS = 4096

Width = Annotated[int, Field(ge=1, le=1024)]
Count = Annotated[int, Field(ge=1, le=1024)]
Scale = Annotated[float, Field(gt=0, le=10)]


class SharedConfig(ModelConfig):
    """Sizes and inputs of the shared model.

    `camera`: "given", or "unknown" as for `paper`, which has the height of the mount and not of the camera.
    `observed_visibility`: add rho, estimated on the CPU from the robot's crop. `hand_poses`: number of poses
    of a hand at the target (`hands/poses.py`); 0 for none. `mirrored`: treat left and right alike.
    `kinematics`: poses of the robot's own hand, and how easily its arm brings it there (`hands/reach.py`).
    """

    n_points: int = Field(default=1024, ge=1, le=65_536)
    tokens: tuple[Count, Count, Count] = (16, 32, 32)  # on the target, near it, further away
    near_m: float = Field(default=0.25, gt=0, le=10)
    scales_m: tuple[Scale, ...] = Field(default=(0.05, 0.15), min_length=1, max_length=8)
    width: Width = 64
    embedding: Width = 128
    head: tuple[Width, ...] = Field(default=(128, 64), max_length=8)
    dropout: float = Field(default=0.4, ge=0, lt=1)
    camera: Literal["given", "unknown"] = "given"
    observed_visibility: bool = True
    hand_poses: int = Field(default=64, ge=0, le=104)  # at the target; 0 for none
    mirrored: bool = True
    kinematics: bool = False

    @model_validator(mode="after")
    def _has_poses(self) -> SharedConfig:
        if self.kinematics and not self.hand_poses:
            raise ValueError("kinematics needs hand_poses")
        return self


def with_reach(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Weights of a model without `kinematics` for one with it, whose scores are the same at first.

    Its codes of reach are multiplied with 0. Weights that have codes already stay as they are.
    """
    name = "hands.seen.weight"
    missing = N_SEEN_FROM_MOUNT + N_CODES - weights[name].shape[1]
    return {**weights, name: torch.nn.functional.pad(weights[name], (0, missing))}


class SharedModel(Model):
    """Tokens of a robot's cloud in each candidate's frame."""

    name = "shared"

    def __init__(self, config: Mapping[str, Any]) -> None:
        self.sizes = read_config(SharedConfig, self.name, config)
        super().__init__(self.sizes)
        if not self.sizes.kinematics:  # checkpoints of before this field stay equal to those of today
            del self.config["kinematics"]
        width, embedding = self.sizes.width, self.sizes.embedding
        token = token_sizes(len(self.sizes.scales_m))
        n_scalars = N_SCALARS + TARGET_NUMBERS + 2 * (TARGET_VECTORS + TARGET_TENSORS)
        n_scalars += _N_VISIBILITY * self.sizes.observed_visibility
        self.token = nn.Sequential(
            nn.Linear(token.numbers, width),
            nn.LayerNorm(width),
            nn.ReLU(),
            nn.Linear(width, width),
            nn.ReLU(),
            nn.Linear(width, width),
        )
        # Along the frame's axis, then to its left.
        self.vectors = nn.Linear(2 * token.vectors, width, bias=False)
        self.tensors = nn.Linear(2 * token.tensors, width, bias=False)
        self.gates = nn.Linear(width, token.vectors + token.tensors)
        self.pair = nn.Linear(N_PAIR_FEATURES, width, bias=False)
        self.condition = nn.Linear(n_scalars, width, bias=False)
        self.condition_left = nn.Linear(TARGET_VECTORS + TARGET_TENSORS, width, bias=False)
        self.seen = nn.Sequential(nn.Linear(width, width), nn.ReLU(inplace=True))
        self.pooled = nn.Sequential(
            nn.Linear(2 * N_KINDS * width, embedding), nn.LayerNorm(embedding), nn.ReLU()
        )
        self.scalars = nn.Sequential(nn.Linear(n_scalars, 64), nn.ReLU(), nn.Linear(64, embedding))
        joined = 2 * embedding
        if self.sizes.hand_poses:
            self.hands = HandPooling(n_scalars, width, N_CODES * self.sizes.kinematics)
            joined += 3 * width
        head = self.sizes.head
        self.head = nn.Sequential(
            nn.LayerNorm(joined),
            nn.ReLU(),
            nn.Dropout(self.sizes.dropout),
            nn.Sequential(*layers(joined, head), nn.Linear(head[-1] if head else joined, 2)),
        )

    @property
    def logit_layer(self) -> nn.Module:
        return list(self.head.modules())[-1]

    def forward(
        self, clouds: Clouds[Tensor], candidates: CandidateInputs[Tensor], robots: RobotInputs[Tensor]
    ) -> Tensor:
        """Logits (N, 2)."""
        return self.score_tokens(self.encode(clouds, robots), clouds, candidates, robots)

    def encode(self, clouds: Clouds[Tensor], robots: RobotInputs[Tensor]) -> Tokens:
        """The clouds' tokens, the same for all candidates; without parameters, so they can be cached.

        Tokens of `EncodedClouds` are unpacked instead.
        """
        if isinstance(clouds, EncodedClouds):
            return unpack(clouds, token_sizes(len(self.sizes.scales_m)))
        with torch.no_grad(), torch.autocast(clouds.points_m.device.type, enabled=False):
            crop = crop_clouds(clouds, robots, self.sizes.n_points)
            tokens = tokens_of(crop, self.sizes.tokens, self.sizes.near_m, self.sizes.scales_m)
        if not self.sizes.hand_poses:
            return tokens
        points, mask, count = (
            t.cpu().numpy() for t in (clouds.points_m, clouds.target_mask, clouds.n_points)
        )
        hands = hands_of(on_cpu(robots), len(clouds)) if self.sizes.kinematics else ()
        poses = torch.from_numpy(poses_of_clouds(points, mask, count, self.sizes.hand_poses, hands))
        return replace(tokens, hand_poses=poses.to(clouds.points_m.device))

    def score_tokens(
        self,
        tokens: Tokens,
        clouds: Clouds[Tensor],
        candidates: CandidateInputs[Tensor],
        robots: RobotInputs[Tensor],
    ) -> Tensor:
        """Logits (N, 2) from the tokens that `encode` returned for these clouds and robots."""
        if self.training:
            tokens, candidates = _thinned(tokens, candidates)
        with torch.no_grad(), torch.autocast(candidates.base_xy_m.device.type, enabled=False):
            frames = self._frames(tokens, clouds, candidates, robots)
            target, target_left = target_features(frames, tokens, candidates.robot_row)
            parts = [frames.scalars(), target]
            if self.sizes.observed_visibility:
                parts.append(stretched(self.visible_share(tokens, clouds, candidates, robots)))
            scalars = torch.cat(parts, dim=1)
        same, left = self.steered(tokens)
        condition, condition_left = self.condition(scalars), self.condition_left(target_left)
        size = _TILE_CUDA if scalars.is_cuda else _TILE_CPU
        cut = tiles(candidates.robot_row, size)
        # Looked up once for all tiles: each look-up has a gradient of the size of all tokens.
        robot, counts = torch.cat([robot for robot, _ in cut]), [len(robot) for robot, _ in cut]
        of_tiles = (each[robot].split(counts) for each in (same, left, tokens.centres_m, tokens.valid))
        pooled = [
            self.pool(of_same, of_left, take_rows(frames, rows), condition[rows], condition_left[rows], *of)
            for (_, rows), of_same, of_left, *of in zip(cut, *of_tiles, strict=True)
        ]
        rows = torch.cat([rows.flatten() for _, rows in cut])
        sides = torch.cat([p.flatten(0, 1) for p in pooled])[torch.argsort(rows)]  # (N, 1 or 2, F)
        joined = [self.pooled(sides).mean(1), self.scalars(scalars)]
        if tokens.hand_poses is not None and self.sizes.hand_poses:
            cloud_row = robots.cloud_row[candidates.robot_row]
            reach = self.hand_reach(tokens, clouds, candidates, robots)
            joined.append(self.hands(tokens.hand_poses, cloud_row, frames, scalars, reach, size))
        return self.head(torch.cat(joined, dim=1)).float()

    def visible_share(
        self,
        tokens: Tokens,
        clouds: Clouds[Tensor],
        candidates: CandidateInputs[Tensor],
        robots: RobotInputs[Tensor],
    ) -> Tensor:
        """Estimated rho (N,), on the CPU from the robots' crops; that of `EncodedCandidates` as it is."""
        if isinstance(candidates, EncodedCandidates):
            return candidates.visible_share
        crop = crop_clouds(clouds, robots, _VISIBILITY_POINTS)
        camera_rise_m = self._frames(tokens, clouds, candidates, robots).camera_rise_m
        eyes_m = torch.cat([candidates.base_xy_m, camera_rise_m[:, None]], dim=1)
        inputs = (target_frame_points(crop), crop.target_mask, crop.valid, tokens.target_radius_m)
        rho = visible_shares(*(t.cpu().numpy() for t in (*inputs, candidates.robot_row, eyes_m)))
        return torch.from_numpy(rho.astype(np.float32)).to(candidates.base_xy_m.device)

    def hand_reach(
        self,
        tokens: Tokens,
        clouds: Clouds[Tensor],
        candidates: CandidateInputs[Tensor],
        robots: RobotInputs[Tensor],
    ) -> Tensor | None:
        """Codes (N, K, N_CODES) of the hand poses, on the CPU; those of `EncodedCandidates` as they are.

        None without `kinematics`. Raises InputError where a robot's files are missing.
        """
        if not self.sizes.kinematics or tokens.hand_poses is None:
            return None
        if isinstance(candidates, EncodedCandidates):
            return candidates.reach
        poses, rise_m = (t.cpu().numpy() for t in (tokens.hand_poses, tokens.target_rise_m))
        codes = hand_reach(poses, on_cpu(clouds), on_cpu(robots), on_cpu(candidates), rise_m)
        return torch.from_numpy(codes).to(candidates.base_xy_m.device)

    def _frames(
        self,
        tokens: Tokens,
        clouds: Clouds[Tensor],
        candidates: CandidateInputs[Tensor],
        robots: RobotInputs[Tensor],
    ) -> Frames:
        rise_m = tokens.target_rise_m
        if self.sizes.camera == "given":
            camera_rise_m = robots.camera_height_m - clouds.target_height_m[robots.cloud_row]
        else:
            camera_rise_m = _CAMERA_ABOVE_MOUNT_M - rise_m
        row = candidates.robot_row
        reach_m = robots.arm_reach_m.clamp(min=_MIN_REACH_M)
        of_robots = (t[row] for t in (rise_m, camera_rise_m, reach_m, tokens.target_radius_m))
        return frames_of(candidates.base_xy_m, *of_robots)

    def steered(self, tokens: Tokens) -> tuple[Tensor, Tensor]:
        """The tokens' linear part, to be multiplied with 1 and `Frames.steering`.

        (R, 5, J, W) that a mirror leaves unchanged, (R, 4, J, W) whose sign it changes.
        """
        hidden = self.token[:-1](tokens.numbers)
        gates = 2 * torch.sigmoid(self.gates(hidden))[..., None]
        n_vectors = tokens.vectors.shape[2]
        same, left = [self.token[-1](hidden)], []
        for layer, pairs in (
            (self.vectors, tokens.vectors * gates[:, :, :n_vectors]),
            (self.tensors, tokens.tensors * gates[:, :, n_vectors:]),
        ):
            # In the frame a pair (x, y) is (x cos + y sin, y cos - x sin).
            weight, weight_left = layer.weight.chunk(2, dim=1)
            x, y = pairs.unbind(-1)
            same += [x @ weight.T, y @ weight.T]
            left += [y @ weight_left.T, -x @ weight_left.T]
        return torch.stack(same, dim=1), torch.stack(left, dim=1)

    def pool(
        self,
        same: Tensor,
        left: Tensor,
        frames: Frames,
        condition: Tensor,
        condition_left: Tensor,
        centres_m: Tensor,
        valid: Tensor,
    ) -> Tensor:
        """Pooled tokens (r, c, 1 or 2, F) of c candidates each of r robots; second: mirrored scene."""
        steering = frames.steering()
        pairs = pair_features(frames, centres_m[:, None])
        weight = self.pair.weight
        even = _product(torch.nn.functional.pad(steering, (1, 0), value=1.0), same) + condition[:, :, None]
        odd = _product(steering, left) + condition_left[:, :, None]
        # In place: on a CPU new memory for each step would cost as much as the steps.
        even += pairs[..., 1:].to(even.dtype) @ weight[:, 1:].T.to(even.dtype)
        odd += pairs[..., :1].to(odd.dtype) @ weight[:, :1].T.to(odd.dtype)
        sides = (even + odd, even.sub_(odd)) if self.sizes.mirrored else (even.add_(odd),)
        return torch.stack([self._pool_side(side.relu_(), valid) for side in sides], dim=2)

    def _pool_side(self, tokens: Tensor, valid: Tensor) -> Tensor:
        """Maximum and mean (r, c, F) over each kind of tokens (r, c, J, W)."""
        seen = self.seen(tokens) * valid[:, None, :, None]
        parts: list[Tensor] = []
        for of_kind, mask in zip(
            seen.split(self.sizes.tokens, dim=2), valid.split(self.sizes.tokens, dim=1), strict=True
        ):
            n = mask.sum(1).clamp(min=1)[:, None, None]
            parts += [highest(of_kind, 2), of_kind.sum(2) / n]
        return torch.cat(parts, dim=2)


def _thinned(tokens: Tokens, candidates: CandidateInputs[Tensor]) -> tuple[Tokens, CandidateInputs[Tensor]]:
    """Up to half of each robot's tokens and of all hand poses left out, at random, as dropout of inputs."""
    valid, poses = tokens.valid, tokens.hand_poses
    share = torch.rand(len(valid), 1, device=valid.device) * _MOST_DROPPED
    tokens = replace(tokens, valid=valid & (torch.rand(valid.shape, device=valid.device) >= share))
    if poses is None:
        return tokens, candidates
    least = math.ceil((1 - _MOST_DROPPED) * poses.shape[1])
    count = int(torch.randint(least, poses.shape[1] + 1, ()))
    kept = torch.randperm(poses.shape[1], device=poses.device)[:count]
    if isinstance(candidates, EncodedCandidates) and candidates.reach is not None:
        candidates = replace(candidates, reach=candidates.reach[:, kept])
    return replace(tokens, hand_poses=poses[:, kept]), candidates


def _product(steering: Tensor, of_tokens: Tensor) -> Tensor:
    """(r, c, J, W) of steering (r, c, n) and (r, n, J, W)."""
    return torch.bmm(steering, of_tokens.flatten(2)).unflatten(2, of_tokens.shape[2:])


def stretched(share: Tensor) -> Tensor:
    """(N, 3): rho (N,), and rho stretched near 0 and near 1, where the paper's score is steep."""
    return torch.stack([share, (share / 0.04).clamp(max=1), (share - 0.8).clamp(min=0) / 0.2], dim=1)
