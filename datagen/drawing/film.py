"""One trial as images: the recorded poses in a far and a near view, rendered on the CPU."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from PIL import ImageColor

from datagen.display.styles import TARGET
from datagen.drawing.film_camera import Shot, Subject, choose_shot, nothing, scaled_camera
from datagen.drawing.posed_robot import RobotBodies
from datagen.workers.geometry.mesh import F64, U8
from datagen.workers.rendering import Camera
from datagen.workers.rendering.embree import RayMesh, RayScene, cast_pixels
from datagen.workers.scenes.reconstruct import ReconstructedScene
from datagen.workers.trials import Recording

Rows = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]
Moments = tuple[tuple[int, str], ...]  # rows of a recording, with their names

_WIDE_M, _NEAR_M = 1.9, 0.8  # from the camera to the centre of the view
_LINK_M, _NEAR_HALF_M = 0.07, 0.08  # around link origins in the far view, around the target in the near one
_FOLLOWED_M = 1.0  # a target that fell farther is not kept in the picture
OUTLINE_RGB = ImageColor.getrgb(TARGET.colour)

# Moments of a trial: phase, share of it, name.
_MOMENTS = (
    ("reach", 0.0, "start"),
    ("reach", 0.5, "on the way"),
    ("reach", 1.0, "before the grasp"),
    ("approach", 1.0, "at the grasp"),
    ("close", 1.0, "fingers closed"),
    ("lift", 0.5, "lifting"),
    ("lift", 1.0, "lift ends"),
    ("hold", 1.0, "hold ends"),
)
_PHASE_WORDS = {
    "reach": "moving",
    "approach": "approaching",
    "close": "closing",
    "lift": "lifting",
    "hold": "holding",
}


@dataclass(frozen=True, eq=False)
class Film:
    """A trial to be rendered; its cameras are chosen once."""

    recalled: ReconstructedScene
    bodies: RobotBodies
    T_world_base: F64
    recording: Recording
    moments: Moments  # of a filmstrip
    wide_px: tuple[int, int]  # width and height of the far view
    near_px: tuple[int, int]

    def stage(self, moment: int) -> RayScene:
        """Objects, then the robot's bodies, at a moment; without the house."""
        recording, rays = self.recording, self.recalled.rays
        opening_m = float(recording.opening_m[moment])
        robot = self.bodies.poses(self.T_world_base, recording.q_rad[moment], opening_m)
        return RayScene(
            nothing(),
            [*rays.objects, *self.bodies.rays],
            np.concatenate([rays.radii_m, self.bodies.radii_m]),
            np.concatenate([recording.T_world_object[moment], robot]),
        )

    @cached_property
    def shots(self) -> tuple[Shot, Shot]:
        """The far view of the whole trial, and the near one of the grasp."""
        recording, bodies, models = self.recording, self.bodies, self.recalled.models
        named, last = {words: moment for moment, words in self.moments}, len(recording.phase) - 1
        shown = sorted({0, named.get("on the way", 0), named.get("at the grasp", (last + 1) // 2), last})
        stages = [self.stage(moment) for moment in shown]
        hand = tuple(len(models) + k for k in bodies.hand)
        arm = tuple(len(models) + k for k in range(len(bodies.rays)) if bodies.link[k] >= 0)
        origins_m = np.concatenate([stage.T_world_object[list(arm), :3, 3] for stage in stages])
        target_m = recording.T_world_object[shown, 0, :3, 3]
        target_m = target_m[np.linalg.norm(target_m - target_m[0], axis=1) < _FOLLOWED_M]
        around_m = np.concatenate([_around(origins_m, _LINK_M), _around(target_m, _LINK_M)])
        grasp_m = recording.T_world_object[0, :1, :3, 3] + [0.0, 0.0, 0.04]
        half_m = max(_NEAR_HALF_M, float(models[0].radius_m) + 0.03)
        house, forward = self.recalled.house.house, self.T_world_base[:3, 0]
        wide = Subject(stages, ((arm, 1.0), (hand, 1.5), ((0,), 1.5)), around_m, forward)
        near = Subject(stages[-2:], ((hand, 1.0), ((0,), 1.0)), _around(grasp_m, half_m), forward)
        return (
            choose_shot(house, wide, _WIDE_M, *self.wide_px),
            choose_shot(house, near, _NEAR_M, *self.near_px),
        )

    def rise_m(self, moment: int) -> float:
        """Rise of the target above its start (m)."""
        z = self.recording.T_world_object[:, 0, 2, 3]
        return float(z[moment] - z[0])

    def words(self, moment: int) -> str:
        """Name of the phase at a moment."""
        return _PHASE_WORDS.get(self.recording.phase[moment], self.recording.phase[moment])


def filmstrip_moments(recording: Recording) -> Moments:
    """The eight moments of a filmstrip as (row, name); an early end leaves no gaps."""
    phase = np.array(recording.phase)
    names: dict[int, str] = {}
    for name, share, words in _MOMENTS:
        rows = np.flatnonzero(phase == name)
        if len(rows):
            names.setdefault(int(rows[round(share * (len(rows) - 1))]), words)
    last = len(phase) - 1
    names.setdefault(last, _PHASE_WORDS.get(str(phase[last]), str(phase[last])))
    while len(names) < min(len(_MOMENTS), len(phase)):
        rows = sorted(names)
        gaps = np.diff(rows)
        middle = rows[int(np.argmax(gaps))] + int(gaps.max()) // 2
        names[middle] = _PHASE_WORDS.get(str(phase[middle]), str(phase[middle]))
    return tuple(sorted(names.items()))


class Lens:
    """One view at one resolution; the static house is rendered once."""

    def __init__(self, shot: Shot, sharpness: int, outlined: bool) -> None:
        self.sharpness, self.outlined = sharpness, outlined
        self.camera = scaled_camera(shot.camera, sharpness)
        empty = RayScene(shot.house, [], np.zeros(0), np.zeros((0, 4, 4)))
        self.house = cast_pixels(empty, self.camera, np.arange(self.camera.width_px * self.camera.height_px))
        self.nothing: RayMesh = nothing()

    def picture(self, stage: RayScene) -> U8:
        """The house with the stage's bodies in it, (height, width, 3)."""
        rgb, depth_m = self.house.rgb.copy(), self.house.depth_m.copy()
        depth_m[depth_m == 0] = np.inf
        target = np.zeros(len(rgb), np.bool_)
        for k, T in enumerate(stage.T_world_object):
            # Each body is rendered only within its bounds: most cover a small part of the image.
            rows = _window(self.camera, T[:3, 3], float(stage.radii_m[k]))
            alone = RayScene(self.nothing, [stage.objects[k]], stage.radii_m[k : k + 1], T[None])
            front = cast_pixels(alone, self.camera, rows)
            nearer = (front.depth_m > 0) & (front.depth_m < depth_m[rows])
            seen = rows[nearer]
            rgb[seen], depth_m[seen], target[seen] = front.rgb[nearer], front.depth_m[nearer], k == 0
        if self.outlined:
            rgb[self._border(target)] = OUTLINE_RGB
        h, w, s = self.camera.height_px, self.camera.width_px, self.sharpness
        fine = rgb.reshape(h // s, s, w // s, s, 3).astype(np.uint16)
        return (fine.sum((1, 3)) // (s * s)).astype(np.uint8)

    def _border(self, mask: Bools) -> Rows:
        """Flat pixels at the border of a flat mask, inside it."""
        s = self.sharpness
        padded = np.pad(mask.reshape(self.camera.height_px, self.camera.width_px), s)
        inner = padded.copy()
        for axis in (0, 1):
            for step in (-s, s):
                inner &= np.roll(padded, step, axis)
        return np.flatnonzero((padded & ~inner)[s:-s, s:-s])


def pictures(film: Film, moments: Sequence[int], sharpness: int) -> Iterator[tuple[U8, U8]]:
    """The far and the near view of each moment."""
    wide, near = (
        Lens(shot, sharpness, outlined) for shot, outlined in zip(film.shots, (True, False), strict=True)
    )
    for moment in moments:
        stage = film.stage(moment)
        yield wide.picture(stage), near.picture(stage)


def _around(centres_m: F64, half_m: float) -> F64:
    """The corners (8 N, 3) of cubes around points (N, 3)."""
    corners = ((np.arange(8)[:, None] >> np.arange(3)) & 1) * 2.0 - 1.0
    return (centres_m[:, None, :] + half_m * corners).reshape(-1, 3)


def _window(camera: Camera, centre_m: F64, radius_m: float) -> Rows:
    """Flat pixels of a rectangle around the image of a sphere."""
    T = camera.T_world_camera
    x, y, z = (float(v) for v in (centre_m - T[:3, 3]) @ T[:3, :3])
    w, h = camera.width_px, camera.height_px
    if z < radius_m + 0.05:  # next to or behind the camera: no bound
        return np.arange(w * h)
    # The near and far faces of the sphere's bounding cube bound its image.
    ends = [
        (v + side * radius_m) / (z + depth * radius_m)
        for v in (x, y)
        for side in (-1, 1)
        for depth in (-1, 1)
    ]
    u, v = np.array(ends[:4]) * camera.fx_px + camera.cx_px, np.array(ends[4:]) * camera.fy_px + camera.cy_px
    columns = np.arange(max(int(u.min()), 0), min(int(u.max()) + 1, w))
    lines = np.arange(max(int(v.min()), 0), min(int(v.max()) + 1, h))
    return (lines[:, None] * w + columns).ravel()
