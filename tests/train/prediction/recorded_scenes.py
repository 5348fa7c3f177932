"""Recordings of ROS 2 that a moving robot would make of a scene, as messages that tests change and write."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from datagen.train.inputs import F64
from datagen.workers.geometry.transforms import inverse, pose, quaternion_wxyz, translation, yaw_pose
from tests.train.prediction.seen_scenes import Seen

STORE = get_typestore(Stores.ROS2_HUMBLE)
START_S = 1_700_000_000
COLOR, DEPTH = "/camera/color/image_raw", "/camera/depth/image_rect_raw"
COLOR_INFO, DEPTH_INFO = "/camera/color/camera_info", "/camera/depth/camera_info"
FRAME_S = (0.5, 1.5)  # from the start, of the two frames
# The robot drives ahead and turns, in the frame of its odometry.
SPEED_MPS, TURN_RADPS = 0.3, 0.4
T_MAP_ODOM = yaw_pose(0.7, -0.4, 0.0, 0.5)
T_BASE_LINK = translation(0.12, 0.0, 0.9)
T_LINK_OPTICAL = pose(np.zeros(3), np.array([0.5, -0.5, 0.5, -0.5]))  # REP 103


@dataclass
class Sent:
    """A message of a topic, at a time from the start."""

    topic: str
    kind: str
    time_s: float
    message: Any


def plain(**fields: Any) -> Any:
    """A message, or a part of one."""
    return SimpleNamespace(**fields)


def header(time_s: float, frame: str) -> Any:
    ns = round(1e9 * time_s)
    return plain(stamp=plain(sec=START_S + ns // 10**9, nanosec=ns % 10**9), frame_id=frame)


def quaternion(R: F64) -> Any:
    w, x, y, z = (float(each) for each in quaternion_wxyz(R))
    return plain(x=x, y=y, z=z, w=w)


def vector(xyz: F64) -> Any:
    return plain(x=float(xyz[0]), y=float(xyz[1]), z=float(xyz[2]))


def transforms(topic: str, time_s: float, *edges: tuple[str, str, F64]) -> Sent:
    made = [
        plain(
            header=header(time_s, parent),
            child_frame_id=child,
            transform=plain(translation=vector(T[:3, 3]), rotation=quaternion(T[:3, :3])),
        )
        for parent, child, T in edges
    ]
    return Sent(topic, "tf2_msgs/msg/TFMessage", time_s, plain(transforms=made))


def image(
    topic: str, time_s: float, pixels: np.ndarray, encoding: str, frame: str = "optical", pad: int = 0
) -> Sent:
    """An Image whose rows end with some bytes that mean nothing."""
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels).reshape(height, -1)
    big = rows.dtype.byteorder == ">"
    data = np.pad(rows.view(np.uint8), ((0, 0), (0, pad)), constant_values=77)
    fields = {"height": height, "width": width, "encoding": encoding, "is_bigendian": int(big)}
    message = plain(header=header(time_s, frame), step=data.shape[1], data=data.ravel(), **fields)
    return Sent(topic, "sensor_msgs/msg/Image", time_s, message)


def packed(topic: str, time_s: float, data: bytes, form: str) -> Sent:
    message = plain(header=header(time_s, "optical"), format=form, data=np.frombuffer(data, np.uint8))
    return Sent(topic, "sensor_msgs/msg/CompressedImage", time_s, message)


def camera_info(topic: str, time_s: float, seen: Seen, scale: int = 1, frame: str = "optical") -> Sent:
    c = seen.frame.camera
    fx, fy, cx, cy = (scale * each for each in (c.fx_px, c.fy_px, c.cx_px - 0.5, c.cy_px - 0.5))
    k = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0])
    p = np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0])
    roi = plain(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    message = plain(
        header=header(time_s, frame), height=scale * c.height_px, width=scale * c.width_px,
        distortion_model="plumb_bob", d=np.zeros(5), k=k, r=np.eye(3).ravel(), p=p, binning_x=0, binning_y=0,
        roi=roi,
    )  # fmt: skip
    return Sent(topic, "sensor_msgs/msg/CameraInfo", time_s, message)


def grid(time_s: float, cells: np.ndarray, corner: F64, frame: str = "map") -> Sent:
    """An OccupancyGrid of cells of 5 cm, whose lower left corner has a pose (4, 4)."""
    origin = plain(position=vector(corner[:3, 3]), orientation=quaternion(corner[:3, :3]))
    size = {"resolution": 0.05, "width": cells.shape[1], "height": cells.shape[0], "origin": origin}
    info = plain(map_load_time=header(time_s, "").stamp, **size)
    message = plain(header=header(time_s, frame), info=info, data=cells.ravel().astype(np.int8))
    return Sent("/map", "nav_msgs/msg/OccupancyGrid", time_s, message)


def moving(seen: Seen, time_s: float) -> F64:
    """`T_odom_base` (4, 4): the camera is where the scene has it at the last frame."""
    T_map_base = seen.camera.T_world_camera @ inverse(T_BASE_LINK @ T_LINK_OPTICAL)
    since_s = time_s - FRAME_S[1]
    T = inverse(T_MAP_ODOM) @ T_map_base @ yaw_pose(0.0, 0.0, 0.0, TURN_RADPS * since_s)
    T[:2, 3] += SPEED_MPS * since_s
    return T


def camera_pose(seen: Seen, time_s: float) -> F64:
    """`T_map_camera` (4, 4) at a time."""
    return T_MAP_ODOM @ moving(seen, time_s) @ T_BASE_LINK @ T_LINK_OPTICAL


def record(seen: Seen) -> list[Sent]:
    """Two frames and all that describes them; tf has no stamp of a frame."""
    sent = [
        transforms("/tf_static", 0.0, ("base_link", "camera_link", T_BASE_LINK)),
        transforms("/tf_static", 0.0, ("camera_link", "optical", T_LINK_OPTICAL)),
        grid(0.0, np.zeros((240, 240)), translation(*(seen.camera.T_world_camera[:2, 3] - 6.0), 0.0)),
    ]
    depth = np.round(seen.frame.depth_m * 1000).astype("<u2")
    for time_s in FRAME_S:
        sent.append(image(COLOR, time_s + 0.02, seen.frame.rgb, "rgb8"))
        sent.append(image(DEPTH, time_s, depth, "16UC1"))
        sent.append(camera_info(COLOR_INFO, time_s, seen))
        sent.append(camera_info(DEPTH_INFO, time_s, seen))
    for time_s in np.arange(0.05, 1.7, 0.1):
        edges = ("map", "odom", T_MAP_ODOM), ("odom", "base_link", moving(seen, time_s))
        sent.append(transforms("/tf", time_s, *edges))
    return sent


def write(
    folder: Path, sent: list[Sent], *, as_file: bool = True, sqlite: bool = False, packing: str = "",
    damage: Callable[[Sent, bytes], bytes] = lambda each, data: data,
) -> Path:  # fmt: skip
    """The recording as one file, or as a folder of rosbag2, by its time."""
    plugin = StoragePlugin.SQLITE3 if sqlite else StoragePlugin.MCAP
    writer = Writer(folder / "made", version=9, storage_plugin=plugin)
    if packing:
        writer.set_compression(CompressionMode[packing], CompressionFormat.ZSTD)
    with writer:
        known: dict[str, Any] = {}
        for each in sorted(sent, key=lambda one: one.time_s):
            if each.topic not in known:
                known[each.topic] = writer.add_connection(each.topic, each.kind, typestore=STORE)
            data = damage(each, bytes(STORE.serialize_cdr(each.message, each.kind)))
            writer.write(known[each.topic], START_S * 10**9 + round(1e9 * each.time_s), data)
    return folder / "made" / ("made.db3" if sqlite else "made.mcap") if as_file else folder / "made"
