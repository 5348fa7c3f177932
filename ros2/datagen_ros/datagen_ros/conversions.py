"""Between messages of ROS 2 and requests to `datagen serve`; messages are duck-typed, rclpy is not needed.

Axes follow REP 103 and REP 105: images are in an optical frame (x right, y down, z ahead), the map has z up
and its floor at z = 0. Depth follows REP 118: 32FC1 in metres with NaN and infinity where nothing was
measured, or 16UC1 in millimetres with 0 there.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterable
from typing import Any
from urllib.parse import urlencode

import numpy as np

# Type of an encoding's items, their number a pixel, and which are red, green and blue.
COLOURS: dict[str, tuple[int, list[int]]] = {
    "rgb8": (3, [0, 1, 2]),
    "bgr8": (3, [2, 1, 0]),
    "rgba8": (4, [0, 1, 2]),
    "bgra8": (4, [2, 1, 0]),
    "mono8": (1, [0, 0, 0]),
}
DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}


def pixels(image: Any, item: str, channels: int) -> np.ndarray:
    """An Image's items (H, W, channels); rows may be padded. ValueError for data of another size."""
    dtype = np.dtype(item).newbyteorder(">" if image.is_bigendian else "<")
    row = image.width * channels * dtype.itemsize
    data = np.frombuffer(image.data, np.uint8)
    if not 0 < row <= image.step or len(data) != image.step * image.height:
        raise ValueError(
            f"an image of {image.encoding} has {len(data)} bytes for {image.width}x{image.height}"
        )
    rows = np.ascontiguousarray(data.reshape(image.height, image.step)[:, :row]).view(dtype)
    return rows.reshape(image.height, image.width, channels).astype(dtype.newbyteorder("="))


def matrix(transform: Any) -> np.ndarray:
    """The pose (4, 4) of a Transform."""
    q, t = transform.rotation, transform.translation
    x, y, z, w = np.array([q.x, q.y, q.z, q.w]) / math.hypot(q.x, q.y, q.z, q.w)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), t.x],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), t.y],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), t.z],
            [0, 0, 0, 1],
        ]
    )


def intrinsics(info: Any, rectified: bool) -> list[float]:
    """fx, fy, cx, cy of a CameraInfo: of P for a rectified picture, else of K. ValueError for distortion."""
    if rectified and info.p[0] > 0:
        return [info.p[0], info.p[5], info.p[2], info.p[6]]
    if not rectified and np.any(info.d):
        raise ValueError("the picture is distorted: subscribe to a rectified topic, and set `rectified`")
    return [info.k[0], info.k[4], info.k[2], info.k[5]]


def request_body(
    color: Any, depth: Any, info: Any, map_to_camera: Any, grid: Any | None = None, rectified: bool = True
) -> bytes:
    """The .npz of a frame: Image, Image, CameraInfo, Transform of the camera in the map, OccupancyGrid.

    Colour must be aligned to depth. ValueError for messages that do not fit.
    """
    if depth.encoding not in DEPTHS or color.encoding not in COLOURS:
        raise ValueError(f"depth as {depth.encoding} with colour as {color.encoding} cannot be read")
    sizes = {(each.width, each.height) for each in (color, depth, info)}
    if len(sizes) != 1:
        raise ValueError(f"colour, depth and CameraInfo differ in size: {sorted(sizes)}")
    frames = [each.header.frame_id.strip("/") for each in (color, depth)]
    if frames[0] != frames[1]:
        raise ValueError(f"depth is not aligned to colour: their frames are {frames[1]} and {frames[0]}")
    channels, order = COLOURS[color.encoding]
    arrays: dict[str, np.ndarray] = {
        "rgb": pixels(color, "u1", channels)[..., order],
        "depth": pixels(depth, DEPTHS[depth.encoding], 1)[..., 0],
        "intrinsics": np.array(intrinsics(info, rectified), np.float64),
        "T_world_camera": matrix(map_to_camera),
    }
    if grid is not None:
        origin = grid.info.origin
        yaw = 2 * math.atan2(origin.orientation.z, origin.orientation.w)
        pose = [origin.position.x, origin.position.y, yaw, grid.info.resolution]
        arrays["map"] = np.asarray(grid.data, np.int8).reshape(grid.info.height, grid.info.width)
        arrays["map_pose"] = np.array(pose, np.float64)
    with io.BytesIO() as file:
        np.savez(file, **arrays)
        return file.getvalue()


def request_query(asked: Any) -> str:
    """The query of a FindBasePose request or a GoToBasePose goal."""
    query = {"click": f"{asked.u},{asked.v}", "allow_unseen": "true" if asked.allow_unseen else "false"}
    query |= {name: getattr(asked, name) for name in ("session", "arrival") if getattr(asked, name)}
    return urlencode(query)


def ranked_poses(answer: dict[str, Any]) -> list[dict[str, Any]]:
    """Poses of the base in an answer in turn, each with `pose`, `score`, `level` and `reasons`."""
    goal = answer["goal"]
    if goal is None:
        return []
    best = {name: goal[name] for name in ("score", "level", "reasons")} | {"pose": goal["goal"]["pose"]}
    return [best, *goal["alternatives"]]


def next_pose(poses: list[dict[str, Any]], tried: Iterable[int], allow_doubtful: bool) -> int | None:
    """Row of the first pose that was not tried; None where none is left."""
    left = set(range(len(poses))) - set(tried)
    rows = (row for row in sorted(left) if allow_doubtful or poses[row]["level"] == "good")
    return next(rows, None)


def fill_pose(message: Any, pose: dict[str, Any]) -> Any:
    """A geometry_msgs/Pose with the values of an answer's pose."""
    for part in ("position", "orientation"):
        for axis, value in pose[part].items():
            setattr(getattr(message, part), axis, float(value))
    return message
