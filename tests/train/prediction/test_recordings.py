"""Frames read from recordings: the same as given one by one, from every kind of recording and image."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from PIL import Image

import datagen
from datagen.schemas.errors import InputError
from datagen.train.prediction.recordings import read_recording
from datagen.workers.geometry.transforms import inverse, yaw_pose
from datagen.workers.occupancy_map import FREE, OCCUPIED, UNKNOWN
from tests.train.prediction.recorded_scenes import (
    COLOR,
    COLOR_INFO,
    DEPTH,
    FRAME_S,
    START_S,
    Sent,
    camera_info,
    camera_pose,
    grid,
    header,
    image,
    packed,
    record,
    transforms,
    write,
)
from tests.train.prediction.seen_scenes import Seen, sensor_frame

HOW = [
    *({}, {"as_file": False}, {"sqlite": True}, {"sqlite": True, "as_file": False}),
    *({"packing": "STORAGE"}, {"packing": "MESSAGE", "sqlite": True}),
]


@pytest.mark.parametrize("how", HOW, ids=str)
def test_a_frame_is_that_of_the_camera_in_the_map(seen: Seen, tmp_path: Path, how: dict[str, bool]) -> None:
    recorded = read_recording(write(tmp_path, record(seen), **how))
    (frame,), expected = recorded.frames, sensor_frame(seen, mask=False)
    assert frame.image is not None and expected.image is not None and frame.T_world_camera is not None
    np.testing.assert_allclose(frame.T_world_camera, seen.camera.T_world_camera, atol=1e-6)
    np.testing.assert_allclose(frame.points_m, expected.points_m, atol=1e-6)
    np.testing.assert_array_equal(frame.image.rgb, expected.image.rgb)
    assert recorded.world == "map" and recorded.stamp_ns == START_S * 10**9 + round(1e9 * FRAME_S[1])
    assert recorded.map is not None and (recorded.map.cells == FREE).all()


def test_frames_at_times_have_the_poses_of_then(seen: Seen, tmp_path: Path) -> None:
    path = write(tmp_path, record(seen))
    recorded = read_recording(path, [0.4, 1.6])
    for frame, time_s in zip(recorded.frames, FRAME_S, strict=True):
        assert frame.T_world_camera is not None
        np.testing.assert_allclose(frame.T_world_camera, camera_pose(seen, time_s), atol=1e-5)
    first, last = (frame.T_world_camera for frame in recorded.frames)
    assert first is not None and last is not None and np.linalg.norm((first - last)[:3, 3]) > 0.2


def test_the_last_frame_is_one_whose_pose_is_known(seen: Seen, tmp_path: Path) -> None:
    sent = [each for each in record(seen) if not (each.topic == "/tf" and each.time_s > 1.2)]
    recorded = read_recording(write(tmp_path, sent))
    assert recorded.stamp_ns == START_S * 10**9 + round(1e9 * FRAME_S[0])


@pytest.mark.parametrize(("dropped", "world"), [("map", "odom"), ("odom", "base_link")])
def test_the_world_without_a_map(seen: Seen, tmp_path: Path, dropped: str, world: str) -> None:
    sent = record(seen)
    for each in sent:
        if each.topic == "/tf":
            kept = [t for t in each.message.transforms if t.header.frame_id not in (dropped, "map")]
            each.message.transforms = kept
    recorded = read_recording(path := write(tmp_path, sent))
    assert recorded.world == world and recorded.map is None
    assert [f"poses are in {world}" in note for f in recorded.frames if f.image for note in f.image.notes]
    asked = {"bag": path, "robot": "fetch", "click": (160, 120)}
    room = datagen.OccupancyMap("room", np.zeros((9, 9), np.int8), 0.05, (0.0, 0.0, 0.0))
    with pytest.raises(InputError, match=f"--map: is no map of the frame {world}"):
        datagen.predict(**asked, map=[room])
    with pytest.raises(InputError, match=f"--keep-out: is no map of the frame {world}"):
        datagen.predict(**asked, keep_out=[room])


def test_channels_of_other_encodings_are_passed_over(seen: Seen, tmp_path: Path) -> None:
    path, mixed = write(tmp_path, record(seen)), tmp_path / "mixed.mcap"
    with path.open("rb") as whole, mixed.open("wb") as file:
        writer, channels = Writer(file), dict[int, int]()
        writer.start("ros2")
        for schema, channel, message in make_reader(whole).iter_messages():
            assert schema is not None
            if channel.id not in channels:
                of = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, of)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        for name, encoding in (("foxglove.Log", "protobuf"), ("foxglove.Pose", "jsonschema")):
            at = writer.register_channel(f"/{name}", "json", writer.register_schema(name, encoding, b"{}"))
            writer.add_message(at, START_S * 10**9, b"{}", START_S * 10**9)
        writer.finish()
    (plain,), (found,) = read_recording(path).frames, read_recording(mixed).frames
    np.testing.assert_array_equal(found.points_m, plain.points_m)


def png(pixels: np.ndarray, kind: str = "PNG") -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind)
    return file.getvalue()


def replaced(sent: list[Sent], topic: str, by: Sent) -> list[Sent]:
    """The recording with one message more, in place of all of a topic."""
    return [each for each in sent if each.topic != topic] + [by]


@pytest.mark.parametrize("encoding", ["bgr8", "rgba8", "bgra8", "mono8", "png", "jpeg"])
def test_colour_of_every_encoding(seen: Seen, tmp_path: Path, encoding: str) -> None:
    rgb = seen.frame.rgb
    opaque = np.full((*rgb.shape[:2], 1), 9, np.uint8)
    made = {
        "bgr8": rgb[..., ::-1],
        "rgba8": np.concatenate([rgb, opaque], axis=2),
        "bgra8": np.concatenate([rgb[..., ::-1], opaque], axis=2),
        "mono8": rgb[..., 1],
    }
    if encoding in made:
        one = image(COLOR, 1.5, made[encoding], encoding, pad=13)
    else:
        one = packed(
            f"{COLOR}/compressed", 1.5, png(rgb, encoding.upper()), f"rgb8; {encoding} compressed bgr8"
        )
    (frame,) = read_recording(write(tmp_path, replaced(record(seen), COLOR, one))).frames
    assert frame.image is not None
    expected = np.repeat(rgb[..., 1:2], 3, axis=2) if encoding == "mono8" else rgb
    off = np.abs(frame.image.rgb.astype(int) - expected)
    assert off.mean() < 6 if encoding == "jpeg" else not off.any()


@pytest.mark.parametrize("encoding", ["32FC1", "16UC1", "compressedDepth", "png"])
def test_depth_of_every_encoding(seen: Seen, tmp_path: Path, encoding: str) -> None:
    depth = seen.frame.depth_m.astype("<f4")
    steps = np.round(depth * 1000).astype("<u2")
    if encoding == "32FC1":
        holes = np.where(depth > 0, depth, np.float32(np.nan))
        one = image(DEPTH, 1.5, holes, encoding, pad=8)
    elif encoding == "16UC1":
        one = image(DEPTH, 1.5, steps.astype(">u2"), encoding, pad=6)
    elif encoding == "png":
        one = packed(f"{DEPTH}/compressed", 1.5, png(steps), "16UC1; png compressed ")
    else:
        one = packed(f"{DEPTH}/compressedDepth", 1.5, bytes(12) + png(steps), "16UC1; compressedDepth png")
    (frame,) = read_recording(write(tmp_path, replaced(record(seen), DEPTH, one))).frames
    assert frame.image is not None
    expected = depth if encoding == "32FC1" else steps.astype(np.float32) / 1000
    np.testing.assert_allclose(frame.image.depth_m, expected, atol=1e-6)


def test_colour_of_another_camera_paints_the_points(seen: Seen, tmp_path: Path) -> None:
    c = seen.camera
    eye = c.T_world_camera[:3, 3] + 0.03 * c.T_world_camera[:3, 0]
    other = seen.turned_to(eye)
    T = inverse(c.T_world_camera) @ other.frame.camera.T_world_camera
    sent = replaced(record(seen), COLOR, image(COLOR, 1.5, other.frame.rgb, "rgb8", frame="color_optical"))
    sent = replaced(sent, COLOR_INFO, camera_info(COLOR_INFO, 1.5, other, frame="color_optical"))
    sent.append(transforms("/tf_static", 0.0, ("optical", "color_optical", T)))
    (frame,) = read_recording(write(tmp_path, sent)).frames
    assert frame.image is not None and frame.T_world_camera is not None
    np.testing.assert_allclose(frame.T_world_camera, c.T_world_camera, atol=1e-6)
    off = np.abs(frame.image.rgb.astype(int) - seen.frame.rgb).max(axis=2)[frame.image.depth_m > 0]
    unpainted = np.abs(other.frame.rgb.astype(int) - seen.frame.rgb).max(axis=2)
    assert (off < 12).mean() > 0.9 and (off >= 12).mean() < 0.7 * (unpainted >= 12).mean()


def test_a_larger_colour_image_is_sampled(seen: Seen, tmp_path: Path) -> None:
    twice = seen.frame.rgb.repeat(2, axis=0).repeat(2, axis=1)
    sent = replaced(record(seen), COLOR, image(COLOR, 1.5, twice, "rgb8"))
    sent = replaced(sent, COLOR_INFO, camera_info(COLOR_INFO, 1.5, seen, scale=2))
    (frame,) = read_recording(write(tmp_path, sent)).frames
    assert frame.image is not None
    measured = frame.image.depth_m > 0
    np.testing.assert_array_equal(frame.image.rgb[measured], seen.frame.rgb[measured])


def test_the_map_of_then_with_its_turn(seen: Seen, tmp_path: Path) -> None:
    cells = np.array([[0, 25, 26, 64, 65, 100, -1]])
    corner = yaw_pose(1.0, 2.0, 0.0, 0.5)
    sent = replaced(record(seen), "/map", grid(0.1, np.full((1, 7), 100), corner))
    sent += [grid(1.4, cells, corner), grid(1.6, np.zeros((1, 7)), corner)]
    found = read_recording(write(tmp_path, sent)).map
    assert found is not None and found.origin == pytest.approx((1.0, 2.0, 0.5))
    expected = [FREE, FREE, UNKNOWN, UNKNOWN, OCCUPIED, OCCUPIED, UNKNOWN]
    assert found.cells.tolist() == [expected] and found.resolution_m == pytest.approx(0.05)
    c, s = np.cos(0.5), np.sin(0.5)
    xy = [[1.0 + 0.225 * c - 0.025 * s, 2.0 + 0.225 * s + 0.025 * c]]
    assert found.states(np.array(xy)) == OCCUPIED


def test_one_of_several_topics_is_named(seen: Seen, tmp_path: Path) -> None:
    sent = record(seen)
    far = np.full(seen.frame.depth_m.shape, 3000, "<u2")
    sent.append(image("/other/depth/image", 1.5, far, "16UC1"))
    path = write(tmp_path, sent)
    with pytest.raises(InputError, match="depth: 2 topics fit") as refused:
        read_recording(path)
    assert all(
        f"{topic} (sensor_msgs/msg/Image)" in str(refused.value) for topic in ("/other/depth/image", COLOR)
    )
    named = ("depth=/other/depth/image", "depth_info=/camera/depth/camera_info")
    (frame,) = read_recording(path, topics=named).frames
    assert frame.image is not None and np.allclose(frame.image.depth_m, 3)


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_a_rectified_image_has_the_camera_of_p(seen: Seen, tmp_path: Path, model: str) -> None:
    sent = record(seen)
    for each in sent:
        if each.topic == "/camera/depth/camera_info":
            each.message.d, each.message.k = np.full(5, 0.1), each.message.k * 0.9
            each.message.distortion_model = model
    (frame,) = read_recording(write(tmp_path, sent)).frames
    assert frame.image is not None and not frame.image.notes
    assert frame.image.pinhole.fx_px == pytest.approx(seen.frame.camera.fx_px)


def test_stamps_before_the_image_are_not_taken_for_it(seen: Seen, tmp_path: Path) -> None:
    sent = record(seen)
    for each in sent:
        if each.topic == COLOR:
            each.message.header = header(each.time_s + 0.06, "optical")
    with pytest.raises(InputError, match="no depth within 50 ms"):
        read_recording(write(tmp_path, sent))
