"""What the ROS 2 node converts, on serialised messages of both distributions, against a running service."""

from __future__ import annotations

import ast
import importlib.util
import json
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from io import BytesIO
from types import SimpleNamespace
from typing import Any
from urllib.error import URLError
from urllib.request import Request, urlopen

import numpy as np
import pytest
import yaml
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import datagen
from datagen.workers.geometry.transforms import pose, translation, yaw_pose
from datagen.workers.occupancy_map import grid_map
from tests.conftest import REPOSITORY
from tests.train.prediction.recorded_scenes import camera_info, grid, image, quaternion, vector
from tests.train.prediction.seen_scenes import Seen, camera_arrays, draw_seen

PACKAGE = REPOSITORY / "ros2" / "datagen_ros"
_spec = importlib.util.spec_from_file_location("conversions", PACKAGE / "datagen_ros" / "conversions.py")
assert _spec is not None and _spec.loader is not None
conversions = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(conversions)

STORES = {name: get_typestore(Stores[f"ROS2_{name.upper()}"]) for name in ("humble", "jazzy")}
TRANSFORM = "geometry_msgs/msg/Transform"
SIZES: dict[str, Any] = {"base_height": 0.7, "reach": 0.9}


@pytest.fixture(scope="module")
def seen() -> Seen:
    return draw_seen(0)


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    """A running `datagen serve`."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    words = ["serve", "--base-height", "0.7", "--reach", "0.9", "--port", str(port)]
    with subprocess.Popen([sys.executable, "-m", "datagen.cli", *words]) as service:
        for _ in range(600):
            try:
                urlopen(f"http://127.0.0.1:{port}/health", timeout=5).close()
                break
            except URLError:
                assert service.poll() is None
                time.sleep(0.2)
        yield f"http://127.0.0.1:{port}"
        service.terminate()


def sent(store: Any, kind: str, message: Any) -> Any:
    """The message as a subscriber gets it."""
    return store.deserialize_cdr(store.serialize_cdr(message, kind), kind)


def as_transform(T: np.ndarray) -> Any:
    return SimpleNamespace(translation=vector(T[:3, 3]), rotation=quaternion(T[:3, :3]))


def messages(
    seen: Seen, store: Any, encoding: str = "16UC1", colour: str = "rgb8", pad: int = 0
) -> list[Any]:
    """Colour, depth, CameraInfo, the camera's pose and the map."""
    rgb, steps, _, T, _ = camera_arrays(seen)
    depth = (
        steps.astype("<u2") if encoding == "16UC1" else np.where(steps, steps / 1000, np.nan).astype(">f4")
    )
    rgb = rgb if colour == "rgb8" else np.insert(rgb[..., ::-1], 3, 255, axis=2)
    free = grid(0.0, np.zeros((240, 240)), translation(*(T[:2, 3] - 6.0), 0.0))
    plain = (image("", 0.0, rgb, colour, pad=pad), image("", 0.0, depth, encoding, pad=pad))
    made = [*plain, camera_info("", 0.0, seen)]
    found = [sent(store, each.kind, each.message) for each in made]
    return [*found, sent(store, TRANSFORM, as_transform(T)), sent(store, free.kind, free.message)]


def middle(mask: np.ndarray) -> tuple[int, int]:
    v, u = np.nonzero(mask)
    k = int(np.argmin((v - v.mean()) ** 2 + (u - u.mean()) ** 2))
    return int(u[k]), int(v[k])


def test_depth_of_another_frame_than_colour_is_refused() -> None:
    seen = draw_seen(0)
    color, depth, info, T, _ = messages(seen, get_typestore(Stores.ROS2_HUMBLE))
    depth.header.frame_id = "camera_depth_optical_frame"
    with pytest.raises(ValueError, match="not aligned to colour: their frames are camera_depth"):
        conversions.request_body(color, depth, info, T)


@pytest.mark.parametrize(
    ("name", "encoding", "colour", "pad"), [("humble", "16UC1", "rgb8", 0), ("jazzy", "32FC1", "bgra8", 5)]
)
def test_messages_get_the_answer_of_find_base(
    url: str, seen: Seen, name: str, encoding: str, colour: str, pad: int
) -> None:
    store, (rgb, depth, K, T, mask) = STORES[name], camera_arrays(seen)
    u, v = middle(mask)
    asked = SimpleNamespace(u=u, v=v, session="", arrival="nav2", allow_unseen=False)
    body = conversions.request_body(*messages(seen, store, encoding, colour, pad))
    with urlopen(Request(f"{url}/base?{conversions.request_query(asked)}", body), timeout=120) as found:
        answer = json.load(found)
    free = grid_map("map", np.zeros((240, 240)), 0.05, (*(T[:2, 3] - 6.0), 0.0))
    own = datagen.find_base(rgb, depth, K, T, click=(u, v), map=free, arrival="nav2", **SIZES)
    assert own.best is not None and answer["level"] == own.level
    poses = conversions.ranked_poses(answer)
    assert len(poses) > 1 and poses[0]["score"] == pytest.approx(own.score[own.best], abs=1e-4)
    # A PoseStamped on the wire holds the pose of the base.
    types = store.types
    empty = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](0, 0, 0), types["geometry_msgs/msg/Quaternion"](0, 0, 0, 1)
    )
    header = image("", 0.0, rgb, "rgb8", frame="map").message.header
    goal = SimpleNamespace(header=header, pose=conversions.fill_pose(empty, poses[0]["pose"]))
    back = sent(store, "geometry_msgs/msg/PoseStamped", goal)
    x, y = own.base_xy_m[own.best]
    expected = yaw_pose(float(x), float(y), 0.0, float(own.yaw_rad[own.best]))
    like = SimpleNamespace(translation=back.pose.position, rotation=back.pose.orientation)
    np.testing.assert_allclose(conversions.matrix(like), expected, atol=1e-4)


def test_frames_without_a_pose_to_drive_to_have_none() -> None:
    assert conversions.ranked_poses({"goal": None}) == []


def test_after_a_failure_the_next_pose_follows_and_doubtful_ones_only_if_allowed() -> None:
    poses = [{"level": level} for level in ("good", "doubtful", "good")]
    orders: list[list[int]] = []
    for allowed in (False, True):
        tried: list[int] = []
        while (row := conversions.next_pose(poses, tried, allowed)) is not None:
            tried.append(row)
        orders.append(tried)
    assert orders == [[0, 2], [0, 1, 2]]


def test_transforms_are_poses() -> None:
    q = np.random.default_rng(0).normal(size=4)
    T = pose(np.array([1.0, -2.0, 0.5]), q / np.linalg.norm(q))
    back = sent(STORES["jazzy"], TRANSFORM, as_transform(T))
    np.testing.assert_allclose(conversions.matrix(back), T, atol=1e-9)


def test_a_turned_map_keeps_its_turn(seen: Seen) -> None:
    *frame, transform, _ = messages(seen, STORES["jazzy"])
    turned = grid(0.0, np.array([[-1, 0], [100, 50], [0, 0]]), yaw_pose(1.0, 2.0, 0.0, -2.5))
    sent_grid = sent(STORES["jazzy"], turned.kind, turned.message)
    with np.load(BytesIO(conversions.request_body(*frame, transform, sent_grid))) as arrays:
        x, y, yaw, resolution_m = arrays["map_pose"]
        found = [x, y, np.cos(yaw), np.sin(yaw), resolution_m]
        np.testing.assert_allclose(found, [1.0, 2.0, np.cos(-2.5), np.sin(-2.5), 0.05], atol=1e-6)
        np.testing.assert_array_equal(arrays["map"], [[-1, 0], [100, 50], [0, 0]])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: setattr(m[1], "encoding", "8UC1"), "cannot be read"),
        (lambda m: setattr(m[0], "encoding", "yuv422"), "cannot be read"),
        (lambda m: setattr(m[0], "width", m[0].width - 1), "differ in size"),
        (lambda m: setattr(m[1], "data", m[1].data[:-1]), "bytes for"),
        (lambda m: setattr(m[1], "step", 3), "bytes for"),
    ],
)
def test_messages_that_do_not_fit_are_refused(seen: Seen, change: Any, words: str) -> None:
    given = messages(seen, STORES["humble"])
    change(given)
    with pytest.raises(ValueError, match=words):
        conversions.request_body(*given)


def test_a_distorted_picture_is_refused_unless_it_is_rectified(seen: Seen) -> None:
    given = messages(seen, STORES["humble"])
    given[2].d = np.array([0.1, 0, 0, 0, 0])
    assert conversions.intrinsics(given[2], True) == pytest.approx(given[2].p[[0, 5, 2, 6]])
    with pytest.raises(ValueError, match="distorted"):
        conversions.request_body(*given, rectified=False)


def test_the_files_of_the_packages_agree() -> None:
    """The node, which needs a graph, is only read here."""
    tree = ast.parse((PACKAGE / "datagen_ros" / "base_pose_node.py").read_text())
    (parameters,) = (
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.AnnAssign) and ast.unparse(node.target) == "PARAMETERS" and node.value
    )
    config = yaml.safe_load((PACKAGE / "config" / "base_pose.yaml").read_text())
    assert config == {"/**": {"ros__parameters": parameters}}
    types: dict[str, dict[str, Any]] = {}
    for file, parts in (("srv/FindBasePose.srv", 2), ("action/GoToBasePose.action", 3)):
        texts = (REPOSITORY / "ros2" / "datagen_interfaces" / file).read_text().split("---\n")
        assert len(texts) == parts
        for k, text in enumerate(texts):
            for fields in get_types_from_msg(text, f"datagen_interfaces/msg/Part{k}").values():
                types[f"{file}{k}"] = dict(fields[1])
    used = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    answered = types["srv/FindBasePose.srv1"].keys() | types["action/GoToBasePose.action1"].keys()
    assert answered <= used
    asked = types["srv/FindBasePose.srv0"]
    assert asked.items() <= types["action/GoToBasePose.action0"].items()
    conversions.request_query(SimpleNamespace(**dict.fromkeys(asked, 0)))
