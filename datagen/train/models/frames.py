"""Features in a candidate's own frame: x from base to target, y left, z up; origin at the target's centre."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from datagen.train.models.tokens import Tokens, doubled, turned

# Below these lengths a direction or a ratio would be noise.
_TINY_M = 1e-6
_MIN_LENGTH_M = 0.05
_MIN_RADIUS_M = 0.01
N_PAIR_FEATURES = 9
N_SCALARS = 14


@dataclass(frozen=True, eq=False)
class Frames:
    """The robot at each candidate; every field has the same leading dimensions."""

    forward: Tensor  # (..., 2) of length 1 from base to target; 0 where the base is below the target
    planar_m: Tensor  # (...) from base to target, horizontally
    target_rise_m: Tensor  # (...) of the target's centre above the mount
    camera_rise_m: Tensor  # (...) of the camera above the target's centre
    arm_reach_m: Tensor  # (...)
    target_radius_m: Tensor  # (...)

    def steering(self) -> Tensor:
        """(..., 4): the frame's axis (cos, sin), and the axis of twice its angle."""
        return torch.cat([self.forward, doubled(self.forward)], dim=-1)

    def scalars(self) -> Tensor:
        """(..., N_SCALARS): distances and heights, also in units of the reach; all of the order of 1."""
        mount_m = torch.hypot(self.planar_m, self.target_rise_m)
        reached = mount_m / self.arm_reach_m
        return torch.stack(
            [
                self.planar_m,
                self.planar_m**2,
                mount_m,
                self.planar_m / self.arm_reach_m,
                reached,
                reached**2,
                self.target_rise_m,
                self.arm_reach_m,
                self.camera_rise_m,
                torch.hypot(self.planar_m, self.camera_rise_m),
                10 * self.target_radius_m,
                self.target_rise_m / self.arm_reach_m,
                self.camera_rise_m / (self.planar_m + 0.1),
                self.target_rise_m / (self.planar_m + 0.1),
            ],
            dim=-1,
        )


def frames_of(
    base_xy_m: Tensor, target_rise_m: Tensor, camera_rise_m: Tensor, reach_m: Tensor, radius_m: Tensor
) -> Frames:
    """Frames of candidates (N, 2) in the target frame; other arguments (N,) are of their robots."""
    planar_m = torch.linalg.vector_norm(base_xy_m, dim=-1)
    forward = -base_xy_m / planar_m.clamp(min=_TINY_M)[..., None]
    return Frames(forward, planar_m, target_rise_m, camera_rise_m, reach_m, radius_m)


def pair_features(frames: Frames, centres_m: Tensor) -> Tensor:
    """Features (..., J, N_PAIR_FEATURES) of positions (..., J, 3), target frame, for candidates (...).

    The offset from the line of sight as projected to the target, in target radii (its first component is
    positive on the left and changes its sign in a mirror, all others do not); the distance in front of the
    target; and the distances to the mount and to the straight line between mount and target.
    """
    ahead, left = turned(centres_m[..., :2], frames.forward[..., None, :]).unbind(-1)
    up = centres_m[..., 2]
    planar = frames.planar_m[..., None]
    camera_rise, rise = frames.camera_rise_m[..., None], frames.target_rise_m[..., None]
    radius = frames.target_radius_m[..., None].clamp(min=_MIN_RADIUS_M)

    eye = torch.hypot(planar, camera_rise).clamp(min=_MIN_LENGTH_M)
    cosine, sine = planar / eye, camera_rise / eye
    before = up * sine - ahead * cosine  # distance in front of the target, towards the camera
    scale = eye / ((eye - before).clamp(min=0.1 * eye) * radius)
    side, height = left * scale, (up * cosine + ahead * sine) * scale
    aside2 = side * side + height * height
    before = before / radius

    along, above = ahead + planar, up + rise  # from the mount
    line2 = (planar * planar + rise * rise).clamp(min=_MIN_LENGTH_M**2)
    share = ((along * planar + above * rise) / line2).clamp(0, 1)
    left2 = left * left
    from_mount = (along * along + left2 + above * above).sqrt()
    from_line = ((along - share * planar) ** 2 + left2 + (above - share * rise) ** 2).sqrt()
    return torch.stack(
        [
            side.clamp(-4, 4),
            height.clamp(-4, 4),
            before.clamp(-6, 6) / 2,
            torch.exp(-aside2.sqrt()),
            torch.exp(-aside2 / 2) * torch.tanh(before),
            from_mount / frames.arm_reach_m[..., None],
            3 * from_line,
            torch.exp(-10 * from_line),
            3 * left.abs(),
        ],
        dim=-1,
    )


def target_features(frames: Frames, tokens: Tokens, robot_row: Tensor) -> tuple[Tensor, Tensor]:
    """The target's size and shape in the candidates' frames.

    Features (N, F) that a mirror leaves unchanged, and (N, G) whose sign it changes.
    """
    vectors = turned(tokens.target_vectors[robot_row], frames.forward[:, None])
    tensors = turned(tokens.target_tensors[robot_row], doubled(frames.forward)[:, None])
    along, left = torch.cat([vectors, tensors], dim=1).unbind(2)
    return torch.cat([tokens.target_numbers[robot_row], along, left.abs()], dim=1), left
