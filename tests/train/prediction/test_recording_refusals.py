"""Recordings that cannot be used: each is refused in one line that names what is wrong, in bounded memory."""

from __future__ import annotations

import os
import shutil
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from backports import zstd
from rosbags.rosbag2 import storage_mcap

from datagen.schemas.errors import InputError
from datagen.train.prediction.recordings import read_recording
from datagen.workers.geometry.transforms import translation
from tests.datagen.predict.test_predict_refusals import write_png
from tests.train.prediction.recorded_scenes import (
    COLOR,
    COLOR_INFO,
    DEPTH,
    DEPTH_INFO,
    Sent,
    packed,
    plain,
    record,
    transforms,
    write,
)
from tests.train.prediction.seen_scenes import Seen

Change = Callable[[Any], None]


def put(part: str = "", **values: Any) -> Change:
    """Set fields of a part of a message, as a path of names and indices."""

    def change(message: Any) -> None:
        for name in part.split():
            message = message[int(name)] if name.isdigit() else getattr(message, name)
        vars(message).update(values)

    return change


FIRST, SECOND = "transforms 0 ", "transforms 1 "
# What a message is changed to, by its topic, with words of the error.
MESSAGES: dict[str, tuple[str, Change, str]] = {
    "huge image": (DEPTH, put(width=100_000, height=100_000), "100000x100000 pixels"),
    "no pixels": (DEPTH, put(width=0), "0x240 pixels"),
    "short rows": (DEPTH, put(step=100), "153,600 bytes for 320x240"),
    "few bytes": (COLOR, put(data=np.zeros(1000, np.uint8)), "1,000 bytes for 320x240"),
    "encoding": (COLOR, put(encoding="bayer_rggb8"), "color: no topic fits"),
    "no depth": (DEPTH, put(data=np.zeros(153_600, np.uint8)), "no pixel has depth"),
    "other size": (DEPTH_INFO, put(width=640), "640x240 pixels, but"),
    "no intrinsics": (COLOR_INFO, put(k=np.zeros(9)), "no intrinsics in pixels"),
    "nan intrinsics": (DEPTH_INFO, put(p=np.full(12, np.nan)), "no intrinsics in pixels"),
    "tilted map": ("/map", put("info origin orientation", x=0.1), "tilted"),
    "no turn": ("/map", put("info origin orientation", w=0.0), "tilted or no pose"),
    "nan map": ("/map", put("info origin position", x=np.nan), "tilted or no pose"),
    "large map": ("/map", put("info", width=2**31), "57,600 cells for 2147483648x240"),
    "no resolution": ("/map", put("info", resolution=np.nan), "of nan m"),
    "no rotation": ("/tf", put(FIRST + "transform rotation", w=9.0), "map -> odom is no rotation"),
    "nan transform": ("/tf", put(SECOND + "transform translation", x=np.inf), "odom -> base_link is no"),
    "loop": ("/tf", put(FIRST + "header", frame_id="optical"), "form a tree"),
    "two parents": ("/tf", put(SECOND, child_frame_id="optical"), "camera_link, odom"),
    "another time": ("/tf", put(FIRST + "header stamp", sec=5), "map -> odom within 0.1 s of the frame"),
    "far away": ("/tf", put(FIRST + "transform translation", x=1e7), "farther than 1000 m"),
    "other frame": (DEPTH, put("header", frame_id="lens"), "no transform of the camera's frame 'lens'"),
    "colour elsewhere": (COLOR, put("header", frame_id="lens"), "no transform of the camera's frame 'lens'"),
}


def refused(path: Path, *words: str, **more: Any) -> str:
    with pytest.raises(InputError) as error:
        read_recording(path, **more)
    text = str(error.value)
    assert "\n" not in text and len(text) < 2500 and error.value.fix
    assert str(path) in text
    for word in words:
        assert word in text, text
    return text


@pytest.mark.parametrize("name", MESSAGES)
def test_messages_that_are_wrong(seen: Seen, tmp_path: Path, name: str) -> None:
    topic, change, words = MESSAGES[name]
    sent = record(seen)
    for each in sent:
        if each.topic == topic:
            change(each.message)
    refused(write(tmp_path, sent), words)


MISSING = {
    DEPTH: "depth: no topic fits",
    COLOR: "color: no topic fits",
    "/tf_static": "Record /tf and /tf_static; it has map -> odom, odom -> base_link",
}


@pytest.mark.parametrize("topic", MISSING)
def test_topics_that_are_missing(seen: Seen, tmp_path: Path, topic: str) -> None:
    text = refused(write(tmp_path, [each for each in record(seen) if each.topic != topic]), MISSING[topic])
    if topic != "/tf_static":
        assert "/camera/color/camera_info (sensor_msgs/msg/CameraInfo)" in text


@pytest.mark.parametrize("camera", ["/camera/", "/direct/"])
def test_a_depth_image_of_an_unknown_lens(seen: Seen, tmp_path: Path, camera: str) -> None:
    sent = record(seen)
    for each in sent:
        each.topic = each.topic.replace("image_rect_raw", "image_raw").replace("/camera/", camera)
        if each.topic == DEPTH_INFO.replace("/camera/", camera):
            each.message.d, each.message.distortion_model = np.full(5, 0.01), "fov"
    refused(write(tmp_path, sent), "fov is unknown", "plumb_bob")


def test_cut_and_packed_messages(seen: Seen, tmp_path: Path) -> None:
    def cut(each: Sent, data: bytes) -> bytes:
        return data[: len(data) // 2] if each.topic == "/tf" else data

    refused(write(tmp_path, record(seen), damage=cut), "/tf: a message is damaged")

    def tiny(each: Sent, data: bytes) -> bytes:
        return data[:3] if each.topic == DEPTH else data

    shutil.rmtree(tmp_path / "made")
    refused(write(tmp_path, record(seen), damage=tiny), DEPTH, "damaged")
    bomb = zstd.compress(bytes(2**29))

    def packing(each: Sent, data: bytes) -> bytes:
        return bomb if each.topic == DEPTH else data

    shutil.rmtree(tmp_path / "made")
    refused(write(tmp_path, record(seen), damage=packing), "unpacks to more than 268,435,456 bytes")


def test_a_chunk_that_unpacks_to_more_than_it_says(
    seen: Seen, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = storage_mcap.McapWriter.__init__

    def bombing(self: Any, *arguments: Any) -> None:
        made(self, *arguments)
        self.compression, self.compressor = "zstd", lambda data: zstd.compress(bytes(2**28))

    monkeypatch.setattr(storage_mcap.McapWriter, "__init__", bombing)
    path = write(tmp_path, record(seen))
    tracemalloc.start()
    refused(path, "unpacks to more than")
    assert tracemalloc.get_traced_memory()[1] < 2**26
    tracemalloc.stop()


def test_a_picture_of_many_pixels(seen: Seen, tmp_path: Path) -> None:
    write_png(tmp_path / "huge.png", 100_000, 100_000)
    write_png(tmp_path / "cut.png", 320, 240)
    for name, words in (("huge.png", "too many pixels"), ("cut.png", "not a readable PNG")):
        data = bytes(12) + (tmp_path / name).read_bytes()
        sent = [each for each in record(seen) if each.topic != DEPTH]
        sent.append(packed(f"{DEPTH}/compressedDepth", 1.5, data, "16UC1; compressedDepth png"))
        refused(write(tmp_path, sent), words)
        shutil.rmtree(tmp_path / "made")


def test_files_that_are_no_recordings(seen: Seen, tmp_path: Path) -> None:
    whole = write(tmp_path, record(seen)).read_bytes()
    rng = np.random.default_rng(0)
    contents = {
        "text.mcap": b"hello",
        "empty.mcap": b"",
        "cut.mcap": whole[: len(whole) // 2],
        "end.mcap": whole[:-20],
        "junk.mcap": whole[:8] + rng.bytes(len(whole) // 50) + whole[-8:],
        "junk.db3": b"SQLite format 3\0" + rng.bytes(5000),
        "empty.db3": b"",
        "other.bag": b"#ROSBAG V2.0\n",
    }
    for name, data in contents.items():
        (tmp_path / name).write_bytes(data)
        refused(tmp_path / name)
    for _ in range(40):  # flipped bytes either do no harm or are refused
        at = int(rng.integers(len(whole) - 6000, len(whole)))
        (tmp_path / "flip.mcap").write_bytes(whole[:at] + rng.bytes(4) + whole[at + 4 :])
        try:
            read_recording(tmp_path / "flip.mcap")
        except InputError as error:
            assert "\n" not in str(error)
    os.mkfifo(tmp_path / "fifo.mcap")
    refused(tmp_path / "fifo.mcap", "is not a file")
    refused(tmp_path / "missing.mcap", "No such file")
    (tmp_path / "folder").mkdir()
    refused(tmp_path / "folder", "not a recording")
    (tmp_path / "folder" / "a.db3.zst").touch()
    refused(tmp_path / "folder", "zstd -d")


def test_options_that_fit_nothing(seen: Seen, tmp_path: Path) -> None:
    path = write(tmp_path, record(seen))
    refused(path, "9 s is outside its 1.7 s", at_s=[9.0])
    refused(path, "nan s is outside", at_s=[float("nan")])
    refused(path, "/nothing is not in it", "/map (nav_msgs/msg/OccupancyGrid)", topics=["depth=/nothing"])
    refused(
        path, "has the encoding '16UC1'", topics=[f"color={DEPTH}", "color_info=/camera/color/camera_info"]
    )
    with pytest.raises(InputError, match="Choose a role from color, depth"):
        read_recording(path, topics=["lidar=/scan"])


def test_a_recording_without_messages(tmp_path: Path) -> None:
    refused(write(tmp_path, []), "no topics")
    shutil.rmtree(tmp_path / "made")
    empty = transforms("/tf", 0.0, ("a", "b", translation(0.0, 0.0, 0.0)))
    empty.message = plain(transforms=[])
    refused(write(tmp_path, [empty]), "/tf (tf2_msgs/msg/TFMessage)")
