"""Base positions around the target, and the robots that stand there (GBPP, Sec. IV-A)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from schemas.specification import CandidateParams, Range
from workers.geometry.mesh import F32, F64


@dataclass(frozen=True, eq=False)
class Candidates:
    """N base poses of one scene. Numbers are float32, as stored, so that labels can be recomputed."""

    base_xy_m: F32  # (N, 2), world
    robot_index: npt.NDArray[np.int16]  # (N,)
    camera_height_m: F32  # (N,)
    base_height_m: F32  # (N,)
    arm_reach_m: F32  # (N,)

    def __len__(self) -> int:
        return len(self.base_xy_m)


def grid_offsets(params: CandidateParams) -> F64:
    """Cell centres (cells^2, 2) of the square grid around the target, row by row from -x, -y.

    The outermost centres lie on the border, so that the grid spans +-grid_half_width_m.
    """
    axis = np.linspace(-params.grid_half_width_m, params.grid_half_width_m, params.grid_cells)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    return np.stack([x.ravel(), y.ravel()], axis=1)


def draw_candidates(target_center_m: F64, params: CandidateParams, rng: np.random.Generator) -> Candidates:
    """All cells of the grid, or a random subset without repetition and jittered within its cells.

    Robots: `robots_per_scene` of them with the candidates dealt out in turn, so that a model can
    encode a scene once a robot; or one a candidate, as the paper has it.
    """
    offsets = grid_offsets(params)
    n = params.count
    if params.per_scene != "grid":
        offsets = offsets[rng.choice(len(offsets), size=n, replace=n > len(offsets))]
        if params.jitter:
            cell = 2 * params.grid_half_width_m / (params.grid_cells - 1)
            offsets = offsets + rng.uniform(-cell / 2, cell / 2, size=offsets.shape)
    robots = n if params.robot_per_candidate else min(params.robots_per_scene, n)

    def draw(r: Range) -> F32:
        return rng.uniform(r.low, r.high, size=robots).astype(np.float32)

    camera, base, reach = draw(params.camera_height_m), draw(params.base_height_m), draw(params.arm_reach_m)
    robot_index = (np.arange(n) % robots).astype(np.int16)
    return Candidates(
        base_xy_m=(target_center_m[:2] + offsets).astype(np.float32),
        robot_index=robot_index,
        camera_height_m=camera[robot_index],
        base_height_m=base[robot_index],
        arm_reach_m=reach[robot_index],
    )


def distances(candidates: Candidates, target_center_m: F64) -> tuple[F32, F32]:
    """Horizontal distance base to target centre, and distance arm mount to target centre; each (N,)."""
    planar_m = np.linalg.norm(candidates.base_xy_m.astype(np.float64) - target_center_m[:2], axis=1)
    rise_m = target_center_m[2] - candidates.base_height_m.astype(np.float64)
    return planar_m.astype(np.float32), np.hypot(planar_m, rise_m).astype(np.float32)
