"""Frames of a recording of ROS 2: colour and depth, the camera's pose in the map by tf, and the map.

Units and axes are those of REP 103, frames those of REP 105, depth images those of REP 118. Transforms are,
as tf2 has them, a tree of frames that move.
"""

from __future__ import annotations

import math
import re
import struct
from array import array
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image
from rosbags.rosbag2 import ReaderError
from scipy.spatial.transform import Rotation, Slerp

from datagen.schemas.errors import InputError
from datagen.train.inputs import F32, F64, U8
from datagen.train.prediction.bags import DAMAGED, FIX, OTHER_FRAME, Bag, stamp_ns, windows
from datagen.train.prediction.files import checked_pose, valid_depth
from datagen.train.prediction.frames import RgbdImage, SensorFrame, image_frame, moved
from datagen.train.prediction.intrinsics import Intrinsics, Pinhole
from datagen.workers.geometry.transforms import inverse, pose
from datagen.workers.image_file import MAX_PIXELS, MAX_SIDE_PX, decoded
from datagen.workers.occupancy_map import OccupancyMap, grid_map

_ROLES = ("color", "depth", "color_info", "depth_info", "map")
_IMAGE, _PACKED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_INFO, _GRID = "sensor_msgs/msg/CameraInfo", "nav_msgs/msg/OccupancyGrid"
# Type of an encoding's items, their number a pixel, and which are red, green and blue.
_COLOURS: dict[str, tuple[str, int, Any]] = {
    **{"rgb8": ("u1", 3, [0, 1, 2]), "bgr8": ("u1", 3, [2, 1, 0])},
    **{"rgba8": ("u1", 4, [0, 1, 2]), "bgra8": ("u1", 4, [2, 1, 0])},
    **{"mono8": ("u1", 1, [0, 0, 0]), "8UC1": ("u1", 1, [0, 0, 0])},
}
_DEPTHS = {"16UC1": ("u2", 1, 0), "mono16": ("u2", 1, 0), "32FC1": ("f4", 1, 0)}
_APART_NS = 50 * 10**6  # of colour and depth
_TRIES = 30  # images around the one that is asked for, of which the first with a pose is taken
_LEVEL = 0.9999  # cosine of a map's tilt


@dataclass(frozen=True, eq=False)
class Recorded:
    """Frames of a recording with poses in the frame `world`, and the map where there is one in it."""

    frames: tuple[SensorFrame, ...]
    world: str
    stamp_ns: int  # of the last frame
    map: OccupancyMap | None


def read_recording(path: Path, at_s: Iterable[float] = (), topics: Sequence[str] = ()) -> Recorded:
    """Frames at times (s) from the start of a recording, or its last; `topics` as ROLE=TOPIC.

    A frame is the depth camera's. Where colour is not aligned to it, a pixel has the colour of its point,
    black where the colour camera does not see it. InputError for anything that cannot be used.
    """
    try:
        with ExitStack() as stack:
            bag = Bag(path, stack)
            chosen = _chosen_topics(bag, dict(_role(each) for each in topics))
            taken = [_take(bag, chosen, at) for at in at_s] or [_take(bag, chosen, None)]
            _, world, stamp, recorded_ns = max(taken, key=lambda each: each[2])
            if any(each[1] != world for each in taken):
                raise bag.error("--at", f"not all frames have a pose in {world}", OTHER_FRAME)
            return Recorded(tuple(f for f, *_ in taken), world, stamp, _map(bag, chosen, world, recorded_ns))
    except InputError:
        raise
    except DAMAGED as error:
        problem = f"cannot be read: {error}" if isinstance(error, ReaderError) else "is damaged"
        raise InputError(path, "", f"{problem} ({type(error).__name__})"[:400], FIX) from None


def _role(text: str) -> tuple[str, str]:
    role, _, topic = text.partition("=")
    if role not in _ROLES:
        raise InputError("--topic", text[:80], "is not ROLE=TOPIC", f"Choose a role from {', '.join(_ROLES)}")
    return role, topic


def _chosen_topics(bag: Bag, given: dict[str, str]) -> dict[str, str]:
    """The topic of each of `_ROLES`; a map may be missing."""

    def only(role: str, fits: Sequence[str]) -> str:
        fits = [given[role]] if role in given else fits
        if len(fits) != 1 or fits[0] not in bag.types:
            known = f"{len(fits)} topics fit" if fits else "no topic fits"
            raise bag.error(role, f"{given[role][:80]} is not in it" if role in given else known)
        return fits[0]

    images = [topic for topic, kind in bag.types.items() if kind in (_IMAGE, _PACKED)]
    ranks = {} if {"color", "depth"} <= given.keys() else {topic: _rank(bag, topic) for topic in images}
    infos = [topic for topic, kind in bag.types.items() if kind == _INFO]
    chosen: dict[str, str] = {}
    for role in ("color", "depth"):
        fits = {topic: rank for topic, (kind, *rank) in ranks.items() if kind == role}
        chosen[role] = only(role, [topic for topic, rank in fits.items() if rank == min(fits.values())])
        beside = [str(parent / "camera_info") for parent in PurePosixPath(chosen[role]).parents]
        chosen[f"{role}_info"] = only(f"{role}_info", [name for name in beside if name in infos][:1] or infos)
    grids = [topic for topic, kind in bag.types.items() if kind == _GRID and topic.endswith("/map")]
    return chosen | ({"map": only("map", grids)} if grids or "map" in given else {})


def _rank(bag: Bag, topic: str) -> tuple[str, bool, bool]:
    """The role of a topic by its first image, and whether that is compressed, and grey."""
    for _, _, data in bag.messages([topic]):
        message, packed = bag.read(topic, data), bag.types[topic] == _PACKED
        encoding = message.format if packed else message.encoding
        if encoding.startswith(tuple(_DEPTHS)) or "compressedDepth" in encoding:
            return "depth", packed, False
        return "color" if packed or encoding in _COLOURS else "", packed, encoding in ("mono8", "8UC1")
    return "", False, False


def _take(bag: Bag, topics: Mapping[str, str], at_s: float | None) -> tuple[SensorFrame, str, int, int]:
    """A frame, the name of its world, its stamp and the time of its recording (ns)."""
    length_s = (bag.end_ns - bag.start_ns) / 1e9
    if at_s is not None and not 0 <= at_s <= length_s:
        raise bag.error("--at", f"{at_s:g} s is outside its {length_s:.1f} s", "Give seconds from its start")
    time_ns = bag.end_ns if at_s is None else bag.start_ns + int(at_s * 1e9)
    problem: InputError | None = None
    for window in windows(time_ns):
        stamps: dict[str, list[tuple[int, int]]] = {topics[role]: [] for role in ("color", "depth")}
        for topic, recorded_ns, data in bag.messages(list(stamps), window):
            seconds, ns = struct.unpack_from("<iI" if data[1] else ">iI", data, 4)
            stamps[topic].append((seconds * 10**9 + ns, recorded_ns))
        colours, depths = stamps[topics["color"]], stamps[topics["depth"]]
        pairs = [
            (color, depth)
            for depth in sorted(depths, key=lambda each: abs(each[1] - time_ns))[:_TRIES]
            for color in sorted(colours, key=lambda each: abs(each[0] - depth[0]))[:1]
            if abs(color[0] - depth[0]) <= _APART_NS
        ]
        tree = TransformTree(bag, window) if pairs else None
        for color, depth in pairs:
            assert tree is not None
            try:
                return *_frame(bag, topics, tree, color, depth), *depth
            except NoTransformError as error:
                problem = error
        if not pairs:
            counts = f"{len(depths)} depth and {len(colours)} colour images"
            problem = bag.error("depth", f"no depth within {_APART_NS // 10**6} ms of colour ({counts})")
    assert problem is not None
    raise problem


def _message(bag: Bag, topic: str, stamp: int, recorded_ns: int) -> Any:
    for _, _, data in bag.messages([topic], (recorded_ns, recorded_ns + 1)):
        message = bag.read(topic, data)
        if stamp_ns(message.header) == stamp:
            return message
    raise bag.error(topic, "a message is missing", OTHER_FRAME)


def _frame(
    bag: Bag, topics: Mapping[str, str], tree: TransformTree, color: tuple[int, int], depth: tuple[int, int]
) -> tuple[SensorFrame, str]:
    """The frame of two images, by their stamps and times of recording, and the name of its world."""
    names = [topics["color"], topics["depth"]]
    messages = [_message(bag, name, *when) for name, when in zip(names, (color, depth), strict=True)]
    painted, seen = (each.header.frame_id.strip("/") for each in messages)
    poses = tree.poses(seen, depth[0])
    world = next((name for name in ("map", "odom") if name in poses), [*poses][-1])
    rgb, depth_m = _rgb(bag, names[0], messages[0]), _depth(bag, names[1], messages[1])
    by, camera = (
        _camera(bag, topics, *each) for each in (("color", rgb, color[1]), ("depth", depth_m, depth[1]))
    )
    is_aligned = seen == painted and rgb.shape[:2] == depth_m.shape and by.pinhole == camera.pinhole
    grey = rgb if is_aligned else np.zeros((*depth_m.shape, 3), np.uint8)
    image = RgbdImage(grey, depth_m, camera.pinhole, None).undistorted(camera)
    if not is_aligned:
        others = {seen: np.eye(4)} if seen == painted else tree.poses(painted, depth[0])
        if (common := next((name for name in poses if name in others), None)) is None:
            raise tree.lacks(f"from {painted} to {seen}")
        picture = RgbdImage(rgb, np.zeros(rgb.shape[:2], np.float32), by.pinhole, None).undistorted(by)
        image = replace(image, rgb=_painted(image, picture, inverse(others[common]) @ poses[common]))
    if world != "map":
        note = f"the recording has no transform to map: poses are in {world}, and maps in other frames unused"
        image = replace(image, notes=(*image.notes, note))
    place = f"{bag.path}: {names[1]}"
    T = checked_pose(poses[world], place)
    return image_frame(image, T, {"depth": place}), world


def _painted(image: RgbdImage, by: RgbdImage, T_color_depth: F64) -> U8:
    """Colours (H, W, 3) of the points of a depth image in the picture of another camera."""
    pixels, (height, width) = np.flatnonzero(image.depth_m), by.rgb.shape[:2]
    points = moved(image.points(pixels), T_color_depth)
    points[points[:, 2] < 0.01] = np.nan
    column, row = np.rint(by.pinhole.pixels(points)).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    found = np.zeros((image.depth_m.size, 3), np.uint8)
    found[pixels[inside]] = by.rgb[row[inside].astype(np.int64), column[inside].astype(np.int64)]
    return found.reshape(*image.depth_m.shape, 3)


def _camera(
    bag: Bag, topics: Mapping[str, str], role: str, picture: U8 | F32, recorded_ns: int
) -> Intrinsics:
    """The camera of an image, by its CameraInfo; of rectified images that of P."""
    topic, name, (height, width) = topics[f"{role}_info"], topics[role], picture.shape[:2]
    info = bag.last(topic, recorded_ns)
    if (info.width, info.height) != (width, height):
        raise bag.error(topic, f"is for {info.width}x{info.height} pixels, but {name} has {width}x{height}")
    is_ideal = re.search("[/_]rect", name) is not None  # /direct/image_raw is none
    k = np.array(info.p).reshape(3, 4) if is_ideal and info.p[0] else np.array(info.k).reshape(3, 3)
    if not np.isfinite(k).all() or min(k[0, 0], k[1, 1]) < 1 or np.abs(k).max() > 1e5:
        raise bag.error(topic, "has no intrinsics in pixels (K)", "Calibrate the camera")
    pinhole = Pinhole(float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
    # A model without coefficients may still be that of a fisheye.
    model, lens = ("", []) if is_ideal else (info.distortion_model, np.array(info.d, np.float64).tolist())
    return Intrinsics(f"{bag.path}: {topic}", pinhole, (width, height), model, tuple(lens))


def _rgb(bag: Bag, topic: str, message: Any) -> U8:
    """Colour (H, W, 3)."""
    if bag.types[topic] == _PACKED:
        return np.asarray(_picture(bag, topic, bytes(message.data)).convert("RGB"), np.uint8)
    return _pixels(bag, topic, message, _COLOURS)


def _depth(bag: Bag, topic: str, message: Any) -> F32:
    """Depth (H, W) in metres; whole numbers are millimetres."""
    if bag.types[topic] == _PACKED:
        # The data of compressedDepth begins with 12 bytes that say how floats were packed.
        image = _picture(bag, topic, bytes(message.data)[12 if "compressedDepth" in message.format else 0 :])
        if not image.mode.startswith("I;16") or message.format.startswith("32FC1"):
            raise bag.error(topic, f"is {message.format[:80]!r}", "Record depth as 16UC1, or uncompressed")
        depth = np.asarray(image)
    else:
        depth = _pixels(bag, topic, message, _DEPTHS)
    return valid_depth(depth if depth.dtype.kind == "f" else depth.astype(np.float32) * np.float32(0.001))


def _pixels(bag: Bag, topic: str, message: Any, encodings: Mapping[str, tuple[str, int, Any]]) -> Any:
    """The pixels (H, W) or (H, W, 3) of an Image, whose rows may be longer than they need."""
    if message.encoding not in encodings:
        fix = f"Record it as {', '.join(encodings)}"
        raise bag.error(topic, f"has the encoding {message.encoding[:40]!r}", fix)
    item, channels, order = encodings[message.encoding]
    dtype = np.dtype((">" if message.is_bigendian else "<") + item)
    _refuse_size(bag, topic, message.width, message.height)
    needed, size = message.width * channels * dtype.itemsize, message.step * message.height
    if message.step < needed or len(message.data) < size:
        problem = f"a message has {len(message.data):,} bytes for {message.width}x{message.height} pixels"
        raise bag.error(topic, problem, OTHER_FRAME)
    rows = np.ascontiguousarray(message.data[:size].reshape(message.height, -1)[:, :needed])
    return rows.view(dtype).reshape(message.height, message.width, channels)[..., order]


def _picture(bag: Bag, topic: str, data: bytes) -> Image.Image:
    return decoded(data, f"{bag.path}: a message of {topic}", ("PNG", "JPEG"))


def _refuse_size(bag: Bag, topic: str, width: int, height: int) -> None:
    if min(width, height) < 2 or max(width, height) > MAX_SIDE_PX or width * height > MAX_PIXELS:
        fix = f"Give images of at most {MAX_PIXELS:,} pixels"
        raise bag.error(topic, f"a message has {width}x{height} pixels", fix)


def _map(bag: Bag, topics: Mapping[str, str], world: str, recorded_ns: int) -> OccupancyMap | None:
    """The map at a time; None where there is none in that frame."""
    if (topic := topics.get("map")) is None:
        return None
    grid = bag.last(topic, recorded_ns)
    if grid.header.frame_id.strip("/") != world:
        return None
    info, p, q = grid.info, grid.info.origin.position, grid.info.origin.orientation
    if not 0 < info.width * info.height == len(grid.data) <= MAX_PIXELS or not 0.001 <= info.resolution <= 1:
        problem = f"has {len(grid.data):,} cells for {info.width}x{info.height} of {info.resolution:g} m"
        raise bag.error(topic, problem, f"Give a map of at most {MAX_PIXELS:,} cells, or --map")
    values = np.array([p.x, p.y, q.w, q.x, q.y, q.z])
    R = (
        pose(np.zeros(3), values[2:])[:3, :3]
        if np.isfinite(values).all() and values[2:].any()
        else np.eye(3) * -1
    )
    if R[2, 2] < _LEVEL or np.abs(values[:2]).max() > 1e5:
        raise bag.error(topic, "has an origin that is tilted or no pose", "Give a level map, or --map")
    percent = np.asarray(grid.data, np.int8).reshape(info.height, info.width)
    origin = (float(values[0]), float(values[1]), math.atan2(R[1, 0], R[0, 0]))
    return grid_map(f"{bag.path}: {topic}", percent, float(info.resolution), origin)


_TYPE = "tf2_msgs/msg/TFMessage"
_STALE_S = 0.1  # how old the last transform may be
_MOST = 1_000_000


class NoTransformError(InputError):
    """Where a frame was is unknown, at that time or at all."""


class TransformTree:
    """The transforms of a recording in a window of time (ns), and all that are static."""

    def __init__(self, bag: Bag, window_ns: tuple[int, int] | None) -> None:
        # By child and parent: rows of time (s), x, y, z, and quaternion x, y, z, w.
        self._edges: dict[str, dict[str, array[float]]] = {}
        self._bag, self._fixed, count = bag, set[str](), 0
        names = [topic for topic, kind in bag.types.items() if kind == _TYPE]
        for fixed in (True, False):
            topics = [name for name in names if name.endswith("tf_static") == fixed]
            for topic, _, data in bag.messages(topics, None if fixed else window_ns):
                transforms = bag.read(topic, data).transforms
                count += len(transforms)
                if count > _MOST:
                    raise bag.error(topic, f"has more than {_MOST:,} transforms", "Record a shorter one")
                for each in transforms:
                    self._add(topic, each, fixed)

    def _add(self, topic: str, each: Any, fixed: bool) -> None:
        parent, child = each.header.frame_id.strip("/"), each.child_frame_id.strip("/")
        p, q = each.transform.translation, each.transform.rotation
        row = [stamp_ns(each.header) / 1e9, p.x, p.y, p.z, q.x, q.y, q.z, q.w]
        if not math.isfinite(sum(row)) or not 0.99 < math.hypot(*row[4:]) < 1.01:
            problem = f"the transform {parent} -> {child} is no rotation and translation"
            raise self._bag.error(topic, problem, "Correct its publisher")
        rows = self._edges.setdefault(child, {}).setdefault(parent, array("d"))
        if fixed:
            self._fixed.add(child)
            del rows[:]
        rows.extend(row)

    def lacks(self, which: str) -> NoTransformError:
        pairs = sorted(f"{parent} -> {child}" for child, rows in self._edges.items() for parent in rows)
        fix = f"Record /tf and /tf_static; it has {', '.join(pairs[:30])[:1000] or 'no transforms'}"
        return NoTransformError(self._bag.path, "tf", f"has no transform {which}", fix)

    def poses(self, frame: str, time_ns: int) -> dict[str, F64]:
        """`T_ancestor_frame` (4, 4) by ancestor, the nearest first. InputError where one is unknown."""
        found, T = {frame: np.eye(4)}, np.eye(4)
        if frame not in self._edges:
            raise self.lacks(f"of the camera's frame {frame!r}")
        while frame in self._edges:
            (parent, rows), *others = self._edges[frame].items()
            if others or parent in found:
                names = ", ".join(self._edges[frame])
                raise self._bag.error(
                    "tf", f"{frame} has the parents {names}", "Frames form a tree (REP 105)"
                )
            T = self._at(f"{parent} -> {frame}", frame in self._fixed, rows, time_ns / 1e9) @ T
            found[parent], frame = T, parent
        return found

    def _at(self, name: str, fixed: bool, row: array[float], time_s: float) -> F64:
        """`T_parent_child` (4, 4), interpolated between two stamps."""
        rows = np.frombuffer(row).reshape(-1, 8)
        rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
        k = int(np.searchsorted(rows[:, 0], time_s))
        low, high = rows[max(k - 1, 0)], rows[min(k, len(rows) - 1)]
        if not 0 < k < len(rows):
            if not fixed and abs(low[0] - time_s) > _STALE_S:
                raise self.lacks(f"{name} within {_STALE_S:g} s of the frame")
            return pose(low[1:4], low[[7, 4, 5, 6]])
        share = (time_s - low[0]) / (high[0] - low[0])
        q = Slerp([0.0, 1.0], Rotation.from_quat(np.stack([low[4:], high[4:]])))(share).as_quat()
        return pose((1 - share) * low[1:4] + share * high[1:4], q[[3, 0, 1, 2]])
