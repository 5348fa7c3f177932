"""A trial as pictures: recorded poses from far and from near, as a sheet of moments or as an animation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import matplotlib
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageColor, ImageDraw, ImageFont
from scipy.ndimage import binary_erosion

from datagen.display.styles import PHASE_COLOURS, TARGET
from datagen.drawing.floor_plan import height_m
from datagen.drawing.posed_robot import RobotBodies
from datagen.workers.geometry.mesh import BOX_BITS, F64, Mesh, concatenate, transformed
from datagen.workers.geometry.transforms import inverse, look_at
from datagen.workers.houses.house import House, StaticBody
from datagen.workers.rendering import Camera, Pixels, pixel_directions
from datagen.workers.rendering.embree import RayMesh, RayScene, cast_pixels, occluded, ray_mesh
from datagen.workers.scenes.reconstruct import ReconstructedScene
from datagen.workers.trials import Recording

Moments = tuple[tuple[int, str], ...]  # rows of a recording, with their names
Groups = Sequence[tuple[Sequence[int], float]]  # rows of bodies that a view should show, with their weights

WIDE_PX, NEAR_PX = (460, 345), (460, 276)  # width and height of the far and the near view
_WIDE_M, _NEAR_M = 1.9, 0.8  # from the camera to the centre of the view
_LINK_M, _NEAR_HALF_M = 0.07, 0.08  # around link origins in the far view, around the target in the near one
_FOLLOWED_M = 1.0  # a target that fell farther is not kept in the picture
_AZIMUTHS, _ELEVATIONS_DEG = 20, (20.0, 42.0)
_PROBE_PX = 56  # width of the images that compare views
_MARGIN = 0.86  # share of half an image that the visible points may fill
_WALL_M = 0.5  # lower walls (and floors, which loaders return as walls) hide nothing
_SIDEWAYS = 0.25  # weight of a view across the arm, compared with one along it
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
_COLUMNS, _GAP_PX, _TEXT_PX = 4, 10, 27
_FRAMES_PER_S, _MOST_FRAMES, _HOLD_MS = 10.0, 60, 1500
_PAPER, _INK, _PALE = "#ffffff", "#141414", "#555555"


def filmstrip_moments(recording: Recording) -> Moments:
    """Up to eight moments as (row, name), with the first and the last."""
    phase, last = np.array(recording.phase), len(recording.phase) - 1
    names: dict[int, str] = {}
    for name, share, words in _MOMENTS:
        rows = np.flatnonzero(phase == name)
        if len(rows):
            names.setdefault(int(rows[round(share * (len(rows) - 1))]), words)
    names.setdefault(last, str(phase[last]))
    return tuple(sorted(names.items()))


class View:
    """A camera at `eye_m` that fits points (N, 3) into its image, and the house without walls before it."""

    def __init__(self, eye_m: F64, points_m: F64, size_px: tuple[int, int]) -> None:
        self.points_m, self.size_px, self.house = points_m, size_px, no_house()
        self.T = look_at(eye_m, (points_m.min(0) + points_m.max(0)) / 2)
        self._empty: Pixels | None = None  # the house alone

    def camera(self, scale: float) -> Camera:
        """The camera with `scale` times the pixels per side."""
        w, h = (round(scale * side) for side in self.size_px)
        local = (self.points_m - self.T[:3, 3]) @ self.T[:3, :3]
        spread = np.abs(local[:, :2] / np.maximum(local[:, 2:], 0.1)).max(0)
        focal_px = float((_MARGIN * np.array([w, h]) / 2 / np.maximum(spread, 1e-6)).min())
        return Camera(self.T, w, h, focal_px, focal_px, w / 2, h / 2)

    def picture(self, stage: RayScene, sharpness: int, is_outlined: bool = False) -> Image.Image:
        """The house with the bodies of a stage; `sharpness` is the number of rays per pixel and axis."""
        camera = self.camera(sharpness)
        h, w = camera.height_px, camera.width_px
        if self._empty is None or len(self._empty.rgb) != h * w:
            nothing = RayScene(self.house, [], np.zeros(0), np.zeros((0, 4, 4)))
            self._empty = cast_pixels(nothing, camera, np.arange(h * w))
        pixels = _around(stage, camera)
        front, empty_m = cast_pixels(stage, camera, pixels), self._empty.depth_m[pixels]
        nearer = (front.depth_m > 0) & ((empty_m == 0) | (front.depth_m < empty_m))
        rgb = self._empty.rgb.reshape(h, w, 3).copy()
        rgb.reshape(-1, 3)[pixels[nearer]] = front.rgb[nearer]
        if is_outlined:
            target = np.zeros((h, w), np.bool_)
            target.flat[pixels[nearer & (front.body == 1)]] = True
            inside = np.asarray(binary_erosion(target, iterations=sharpness), np.bool_)
            rgb[target & ~inside] = ImageColor.getrgb(TARGET.colour)
        return Image.fromarray(rgb).reduce(sharpness)


@dataclass(frozen=True, eq=False)
class Film:
    """A trial to be drawn: its scene, its robot, the pose (4, 4) of the mount, and the recorded poses."""

    scene: ReconstructedScene
    bodies: RobotBodies
    T_world_base: F64
    recording: Recording
    moments: Moments

    def stage(self, row: int) -> RayScene:
        """Objects, then the robot's bodies, at one moment; without the house."""
        recording, rays = self.recording, self.scene.rays
        robot = self.bodies.poses(self.T_world_base, recording.q_rad[row], float(recording.opening_m[row]))
        return RayScene(
            no_house(),
            [*rays.objects, *self.bodies.rays],
            np.concatenate([rays.radii_m, self.bodies.radii_m]),
            np.concatenate([recording.T_world_object[row], robot]),
        )

    @cached_property
    def views(self) -> tuple[View, View]:
        """The far view of the whole trial, and the near one of the grasp."""
        return self.view(WIDE_PX), self.view(NEAR_PX, is_near=True)

    def view(self, size_px: tuple[int, int], is_near: bool = False) -> View:
        """The far or the near view, for images of `size_px`, width and height."""
        recording, objects = self.recording, len(self.scene.models)
        named, last = {words: row for row, words in self.moments}, len(recording.phase) - 1
        shown = sorted({0, named.get("on the way", 0), named.get("at the grasp", (last + 1) // 2), last})
        stages = [self.stage(row) for row in shown]
        hand = [objects + k for k in self.bodies.hand]
        arm = [objects + k for k in np.flatnonzero(self.bodies.link >= 0).tolist()]
        links_m = np.concatenate([stage.T_world_object[arm, :3, 3] for stage in stages])
        target_m = recording.T_world_object[shown, 0, :3, 3]
        target_m = target_m[np.linalg.norm(target_m - target_m[0], axis=1) < _FOLLOWED_M]
        around_m = _cubes(np.concatenate([links_m, target_m]), _LINK_M)
        half_m = max(_NEAR_HALF_M, float(self.scene.models[0].radius_m) + 0.03)
        grasp_m = _cubes(target_m[:1] + [0.0, 0.0, 0.04], half_m)
        house, ahead = self.scene.house.house, self.T_world_base[:3, 0]
        wide: Groups = ((arm, 1.0), (hand, 1.5), ((0,), 1.5))
        near: Groups = ((hand, 1.0), ((0,), 1.0))
        if is_near:
            return _best_view(house, stages[-2:], near, grasp_m, ahead, _NEAR_M, size_px)
        return _best_view(house, stages, wide, around_m, ahead, _WIDE_M, size_px)

    def pictures(self, row: int, sharpness: int) -> tuple[Image.Image, Image.Image]:
        """The far and the near view of one moment."""
        (wide, near), stage = self.views, self.stage(row)
        return wide.picture(stage, sharpness, is_outlined=True), near.picture(stage, sharpness)

    @property
    def moves(self) -> bool:
        """Whether the recording is a motion; else it is one pose."""
        return bool(self.recording.time_s[-1] > self.recording.time_s[0])

    def state(self, row: int) -> tuple[str, str]:
        """Time, and what hand and target do; empty for poses without motion."""
        recording = self.recording
        if not self.moves:
            return "", ""
        rise_m = recording.T_world_object[row, 0, 2, 3] - recording.T_world_object[0, 0, 2, 3]
        lift_cm = round(100 * float(rise_m), 1) + 0.0  # no -0.0
        opening_cm = 100 * recording.opening_m[row]
        seconds = recording.time_s[row] - recording.time_s[0]
        return f"{seconds:.1f} s", f"opening {opening_cm:.1f} cm   lift {lift_cm:.1f} cm"


def write_sheet(film: Film, colour: str, lines: Sequence[str], out: Path) -> None:
    """Write the moments in rows of four, each from far and below it from near.

    `lines` are the title, which follows a patch of `colour`, and facts below it.
    """
    cells = [
        _cell(film, row, f"{k + 1}  {words}", 2, is_stacked=True)
        for k, (row, words) in enumerate(film.moments)
    ]
    (w, h), title = cells[0].size, _title(colour, lines)
    width = max(title.width, _GAP_PX + min(_COLUMNS, len(cells)) * (w + _GAP_PX))
    height = title.height + -(-len(cells) // _COLUMNS) * (h + 2 * _GAP_PX)
    sheet = Image.new("RGB", (width, height), _PAPER)
    sheet.paste(title, (0, 0))
    for k, cell in enumerate(cells):
        row, column = divmod(k, _COLUMNS)
        sheet.paste(cell, (_GAP_PX + column * (w + _GAP_PX), title.height + row * (h + 2 * _GAP_PX)))
    sheet.save(out, optimize=True)


def write_animation(film: Film, colour: str, lines: Sequence[str], out: Path) -> None:
    """Write the whole recording as a GIF in real time; the last frame stays longer."""
    time_s, title = film.recording.time_s, _title(colour, lines)
    duration_s = float(time_s[-1] - time_s[0])
    count = int(np.clip(round(duration_s * _FRAMES_PER_S) + 1, 2, min(_MOST_FRAMES, len(time_s))))
    frames: list[Image.Image] = []
    for row in np.unique(np.linspace(0, len(time_s) - 1, count).round().astype(int)).tolist():
        cell = _cell(film, row, film.recording.phase[row], 1, is_stacked=False)
        width = max(title.width, cell.width + 2 * _GAP_PX)
        frame = Image.new("RGB", (width, title.height + cell.height + _GAP_PX), _PAPER)
        frame.paste(title, (0, 0))
        frame.paste(cell, (_GAP_PX, title.height))
        frames.append(frame)
    # One palette for all frames, so that static parts stay equal and compress well.
    palette = Image.fromarray(np.concatenate([np.asarray(f) for f in frames[:: len(frames) // 3 or 1]]))
    palette = palette.quantize(256)
    shown = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    step_ms = round(1000 * duration_s / max(len(shown) - 1, 1))
    durations = [step_ms] * (len(shown) - 1) + [_HOLD_MS]
    shown[0].save(out, save_all=True, append_images=shown[1:], duration=durations, loop=0, optimize=False)


def _cell(film: Film, row: int, words: str, sharpness: int, is_stacked: bool) -> Image.Image:
    """One moment: a bar in the colour of its phase, its words, and both views."""
    wide, near = film.pictures(row, sharpness)
    top = 2 * round(1.3 * _TEXT_PX) + _GAP_PX
    place = (0, top + wide.height + 3) if is_stacked else (wide.width + 3, top)
    cell = Image.new("RGB", (near.width + place[0], max(top + wide.height, near.height + place[1])), _PAPER)
    draw, (time, state) = ImageDraw.Draw(cell), film.state(row)
    draw.rectangle((0, 0, cell.width - 1, 7), fill=PHASE_COLOURS.get(film.recording.phase[row], _PALE))
    draw.text((0, 9), words, _INK, font_of(_TEXT_PX, bold=True))
    draw.text((cell.width, 9), time, _PALE, font_of(_TEXT_PX - 2), anchor="ra")
    draw.text((0, 9 + round(1.25 * _TEXT_PX)), state, _PALE, font_of(_TEXT_PX - 2))
    cell.paste(wide, (0, top))
    cell.paste(near, place)
    return cell


def _title(colour: str, lines: Sequence[str]) -> Image.Image:
    """A patch of the colour with the first line, and the other lines below it."""
    chip_px, left = round(1.3 * _TEXT_PX), 2 * _GAP_PX
    head, plain = font_of(chip_px, bold=True), font_of(_TEXT_PX)
    widths = [left + chip_px + head.getlength(lines[0]), *map(plain.getlength, lines[1:])]
    height = round((0.5 + 1.4 * len(lines)) * _TEXT_PX) + 2 * _GAP_PX
    title = Image.new("RGB", (left + round(max(widths)), height), _PAPER)
    draw = ImageDraw.Draw(title)
    draw.rectangle((_GAP_PX, 14, _GAP_PX + chip_px, 14 + chip_px), fill=colour)
    draw.text((left + chip_px, 11), lines[0], _INK, head)
    for k, line in enumerate(lines[1:]):
        draw.text((_GAP_PX, (1.9 + 1.4 * k) * _TEXT_PX + _GAP_PX), line, _PALE, plain)
    return title


def font_of(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """The font of pictures in a size in pixels."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)


def _best_view(
    house: House, stages: Sequence[RayScene], groups: Groups, points_m: F64, ahead: F64,
    distance_m: float, size_px: tuple[int, int],
) -> View:  # fmt: skip
    """The best of the views all around: it shows most of the groups, and looks across `ahead` (3,).

    All points (N, 3) lie in the image, and the camera `distance_m` from their centre. A group counts with its
    weight times the share of it that other bodies leave visible, mean over the stages.
    """
    walls = [body for body in house.bodies if body.kind == "wall" and height_m(body) > _WALL_M]
    open_house, middle_m = _rays_without(house, walls), (points_m.min(0) + points_m.max(0)) / 2
    found: list[tuple[float, int, View]] = []
    for elevation in np.radians(_ELEVATIONS_DEG):
        for azimuth in 2 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS:
            flat = np.cos(elevation)
            away = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
            view = View(middle_m + distance_m * away, points_m, size_px)
            score = _visible(open_house, stages, groups, view.camera(_PROBE_PX / size_px[0]))
            across = float(np.linalg.norm(np.cross(away, ahead)))
            found.append((score + _SIDEWAYS * across, -len(found), view))
    view = max(found)[2]
    # Walls in front of the points, or of the middle of the view.
    probe, eye_m = view.camera(_PROBE_PX / 4 / size_px[0]), view.T[:3, 3]
    rays = pixel_directions(probe, np.arange(probe.width_px * probe.height_px)) @ view.T[:3, :3].T
    directions = np.concatenate([points_m - eye_m, 0.85 * distance_m * rays]).astype(np.float32)
    origins = np.tile(eye_m.astype(np.float32), (len(directions), 1))
    limits = np.ones(len(directions), np.float32)
    hiding = [w for w in walls if occluded(ray_mesh(w.visual), origins, directions, limits).any()]
    view.house = _rays_without(house, hiding)
    return view


def _visible(house: RayMesh, stages: Sequence[RayScene], groups: Groups, probe: Camera) -> float:
    pixels = np.arange(probe.width_px * probe.height_px)
    total = 0.0
    for stage in stages:
        full = RayScene(house, stage.objects, stage.radii_m, stage.T_world_object)
        body = cast_pixels(full, probe, pixels).body - 1
        for rows, weight in groups:
            k = list(rows)
            group = RayScene(
                stage.house, [stage.objects[r] for r in k], stage.radii_m[k], stage.T_world_object[k]
            )
            alone = cast_pixels(group, probe, pixels).body > 0
            if alone.any():
                total += weight * float(np.isin(body[alone], k).mean())
    return total / len(stages)


def _around(stage: RayScene, camera: Camera) -> npt.NDArray[np.int64]:
    """Pixels of the rectangles around the bodies' images; all where one is beside or behind the camera."""
    shown = np.zeros((camera.height_px, camera.width_px), np.bool_)
    for rays, T in zip(stage.objects, inverse(camera.T_world_camera) @ stage.T_world_object, strict=True):
        corners_m = transformed(rays.around_m, T)
        if corners_m[:, 2].min() < 1e-3:
            return np.arange(shown.size)
        at_px = camera.fx_px * corners_m[:, :2] / corners_m[:, 2:] + (camera.cx_px, camera.cy_px)
        (left, top), (right, bottom) = np.maximum([at_px.min(0) - 1, at_px.max(0) + 1], 0).astype(int)
        shown[top:bottom, left:right] = True
    return np.flatnonzero(shown)


def _cubes(centres_m: F64, half_m: float) -> F64:
    """The corners (8 N, 3) of cubes around points (N, 3)."""
    return (centres_m[:, None, :] + half_m * (BOX_BITS * 2.0 - 1.0)).reshape(-1, 3)


def _rays_without(house: House, left_out: Sequence[StaticBody]) -> RayMesh:
    names = {body.body_id for body in left_out}
    kept = [body.visual for body in house.bodies if body.body_id not in names]
    return ray_mesh(concatenate(kept)) if kept else no_house()


@lru_cache(maxsize=1)
def no_house() -> RayMesh:
    """A mesh that no ray hits: a speck far below the ground."""
    speck = np.array([[0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0]], np.float32) - np.float32(1e4)
    faces: npt.NDArray[np.int32] = np.array([[0, 1, 2]], np.int32)
    return ray_mesh(Mesh(speck, faces, np.zeros((1, 3), np.uint8)))
