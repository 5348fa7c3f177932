"""Joint paths in time: at rest at both ends, along straight lines, within speeds and accelerations."""

from __future__ import annotations

import numpy as np

from datagen.workers.geometry.mesh import F64

# Time from rest to full speed. A joint's speed may jump by its gain in a control period.
SPEED_UP_S = 0.25
_GRID_RAD = 0.02  # spacing of the points at which speeds are decided
_SAME_RAD = 1e-9


def time_parameterized(path_rad: F64, speed_radps: F64, period_s: float, at_least_s: float) -> F64:
    """Joints (N, A) every `period_s` along a path of straight lines (M, A), from rest to rest.

    The fastest motion in which no joint exceeds its speed (A,), gains more than it in `SPEED_UP_S`,
    or jumps in speed at a corner by more than it gains in a period; then slowed down to `at_least_s`
    and to whole periods. Speeds are decided forwards and backwards over a grid, as in numerical path
    parameterisation (Bobrow, Dubowsky, Gibson 1985).
    """
    steps = np.diff(path_rad, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    kept = lengths > _SAME_RAD
    steps, lengths = steps[kept], lengths[kept]
    if len(steps) == 0:
        ticks = max(1, int(np.ceil(at_least_s / period_s - 1e-9)))
        joints = np.repeat(path_rad[:1], ticks + 1, axis=0)
        joints[-1] = path_rad[-1]
        return joints
    corners = np.vstack([path_rad[:1], path_rad[1:][kept]])
    directions = steps / lengths[:, None]
    acceleration = speed_radps / SPEED_UP_S
    fastest = (speed_radps / np.maximum(np.abs(directions), 1e-12)).min(axis=1)  # (S,) along each line
    gain = (acceleration / np.maximum(np.abs(directions), 1e-12)).min(axis=1)
    turns = np.abs(np.diff(directions, axis=0))  # (S - 1, A)
    at_corner = (acceleration * period_s / np.maximum(turns, 1e-12)).min(axis=1)

    cells = np.maximum(1, np.ceil(lengths / _GRID_RAD).astype(int))
    if cells.sum() == 1:
        cells += 1  # at rest at both ends: there must be a point between them that moves
    line = np.repeat(np.arange(len(lengths)), cells)  # of each grid cell
    ds = np.repeat(lengths / cells, cells)
    s = np.concatenate([[0.0], np.cumsum(ds)])
    v2 = np.concatenate([[0.0], np.minimum(fastest[line[:-1]], fastest[line[1:]]) ** 2, [0.0]])
    ends = np.cumsum(cells)[:-1]
    v2[ends] = np.minimum(v2[ends], at_corner**2)
    gained = 2 * gain[line] * ds
    for k in range(len(ds)):
        v2[k + 1] = min(v2[k + 1], v2[k] + gained[k])
    for k in range(len(ds) - 1, -1, -1):
        v2[k] = min(v2[k], v2[k + 1] + gained[k])
    v = np.sqrt(v2)
    dt = 2 * ds / (v[:-1] + v[1:])
    t = np.concatenate([[0.0], np.cumsum(dt)])

    ticks = max(1, int(np.ceil(max(t[-1], at_least_s) / period_s - 1e-9)))
    moments = np.linspace(0.0, t[-1], ticks + 1)
    cell = np.clip(np.searchsorted(t, moments, side="right") - 1, 0, len(ds) - 1)
    tau = moments - t[cell]
    along = s[cell] + v[cell] * tau + (v[cell + 1] - v[cell]) / dt[cell] * tau**2 / 2
    starts = np.concatenate([[0.0], np.cumsum(lengths)])
    on = np.clip(np.searchsorted(starts, along, side="right") - 1, 0, len(lengths) - 1)
    share = np.clip((along - starts[on]) / lengths[on], 0.0, 1.0)[:, None]
    joints = corners[on] * (1 - share) + corners[on + 1] * share
    joints[0], joints[-1] = path_rad[0], path_rad[-1]
    return joints


def lag_compensated(joints_rad: F64, period_s: float, lag_s: float) -> F64:
    """Targets (N, A) for spring-damper drives, which follow a moving target late by damping / stiffness.

    Each target is ahead by this lag, so that the joints follow `joints_rad` (N, A).
    """
    speed = np.zeros_like(joints_rad)
    speed[1:-1] = (joints_rad[2:] - joints_rad[:-2]) / (2 * period_s)
    return joints_rad + lag_s * speed
