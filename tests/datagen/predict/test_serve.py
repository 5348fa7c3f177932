"""Base poses over HTTP: the answers of `predict`, bounded sessions, and what hostile requests get."""

from __future__ import annotations

import json
import socket
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from fastapi.testclient import TestClient

import datagen
from datagen import cli
from datagen.commands.serve import ServeOptions, app_of
from datagen.train.prediction import service
from tests.refusals import refused
from tests.train.prediction.seen_scenes import Seen, camera_arrays, draw_seen

SIZES: dict[str, Any] = {"base_height": 0.7, "reach": 0.9}


@pytest.fixture(scope="module")
def seen() -> Seen:
    return draw_seen(0)


@pytest.fixture(scope="module")
def client() -> TestClient:
    return TestClient(app_of(ServeOptions(**SIZES)))


def packed(seen: Seen, **changed: Any) -> bytes:
    """The body of a request: an .npz of the frame."""
    rgb, depth, K, T, mask = camera_arrays(seen)
    arrays = {"rgb": rgb, "depth": depth, "intrinsics": K, "mask": mask, "T_world_camera": T} | changed
    with BytesIO() as file:
        np.savez_compressed(file, **{name: a for name, a in arrays.items() if a is not None})
        return file.getvalue()


def test_the_answer_is_that_of_predict(client: TestClient, seen: Seen) -> None:
    said = client.post("/base", content=packed(seen), params={"allow_unseen": True, "candidates": True})
    assert said.status_code == 200
    rgb, depth, K, T, mask = camera_arrays(seen)
    answer = datagen.find_base(rgb, depth, K, T, mask=mask, allow_unseen=True, **SIZES)
    document = said.json()
    assert document["level"] == answer.level and document["best"]["index"] == answer.best
    np.testing.assert_allclose([c["score"] for c in document["candidates"]], answer.score, atol=1e-6)
    short = client.post("/base", content=packed(seen), params={"allow_unseen": True}).json()
    # A product of other rows may differ in its last bits.
    del document["candidates"]
    assert _rounded(short) == _rounded(document)


def _rounded(document: Any) -> Any:
    return json.loads(json.dumps(document), parse_float=lambda text: round(float(text), 6))


def test_frames_of_a_session_are_fused_and_bounded(client: TestClient, seen: Seen) -> None:
    first = client.post("/base", content=packed(seen), params={"session": "kitchen"}).json()
    assert len(first["T_world_camera"]) == 1
    for count in range(2, service.MOST_FRAMES + 3):
        said = client.post("/base", content=packed(seen), params={"session": "kitchen"}).json()
        assert len(said["T_world_camera"]) == min(count, service.MOST_FRAMES)
    for k in range(service.MOST_SESSIONS + 2):
        client.post("/base", content=packed(seen), params={"session": f"s{k}"})
    assert client.get("/health").json()["sessions"] == service.MOST_SESSIONS
    assert client.delete("/sessions/s5").json() == {"was_there": True}
    assert client.delete("/sessions/s5").json() == {"was_there": False}


def test_the_latest_frame_that_marks_a_target_decides(client: TestClient, seen: Seen) -> None:
    here, ahead = seen.camera.T_world_camera[:3, 3], np.array([0.0, 0.0, 0.3])
    there = seen.turned_to(here + ahead)
    other = there.frame.body == np.bincount(there.frame.body[there.frame.body > 1]).argmax()

    def asked(body: bytes, **params: Any) -> Any:
        said = client.post("/base", content=body, params={"session": "hall2", **params})
        assert said.status_code == 200, said.text
        return said.json()

    def centre(found: Any) -> Any:
        return np.array(found["target"]["center_m"])

    first, alone = asked(packed(seen)), client.post("/base", content=packed(there, mask=other)).json()
    second = asked(packed(there, mask=other))  # not both objects, as one
    assert (
        np.linalg.norm(centre(second) - centre(alone)) < 0.02 < np.linalg.norm(centre(second) - centre(first))
    )
    # Turned from where the robot is now.
    np.testing.assert_allclose(second["T_world_camera"][0], there.frame.camera.T_world_camera)
    client.delete("/sessions/hall2")
    v, u = (int(np.median(pixels)) for pixels in np.nonzero(seen.frame.body == 1))
    clicked = asked(packed(seen, mask=None), click=f"{u},{v}")
    moved_on = asked(packed(there, mask=None))  # a click stays with its frame
    assert len(moved_on["T_world_camera"]) == 2
    assert np.linalg.norm(centre(moved_on) - centre(clicked)) < 0.02


@pytest.mark.parametrize(
    ("body", "params", "status", "words"),
    [
        (b"", {}, 422, ".npz"),
        (b"PK\x05\x06" + bytes(18), {}, 422, "has none of"),
        (None, {"click": "1"}, 422, "click"),
        (None, {"click": "1,1"}, 422, "--click"),
        (None, {"box": "1,1,9"}, 422, "box"),
        (None, {"box": "1,1,9,9"}, 422, "--box"),
        (None, {"session": "../x"}, 422, "session"),
        (None, {"arrival": "/etc/passwd"}, 422, "arrival"),
        (None, {"arrival": "normal:x"}, 422, "--arrival"),
        (None, {"camera_height": "-1"}, 422, "camera_height"),
        (None, {"allow_unsen": "true"}, 422, "allow_unsen"),
    ],
)
def test_hostile_requests_get_a_reason(
    client: TestClient, seen: Seen, body: bytes | None, params: dict[str, str], status: int, words: str
) -> None:
    said = client.post("/base", content=packed(seen) if body is None else body, params=params)
    assert said.status_code == status and words in said.text and "/tmp" not in said.text


def test_a_frame_that_cannot_be_read_does_not_spoil_its_session(client: TestClient, seen: Seen) -> None:
    for body, params in ((b"PK", {}), (packed(seen, mask=None), {"click": "1,1"})):
        assert client.post("/base", content=body, params={"session": "hall"} | params).status_code == 422
    said = client.post("/base", content=packed(seen), params={"session": "hall"})
    assert said.status_code == 200 and len(said.json()["T_world_camera"]) == 1


def test_a_body_may_have_the_map_and_the_answer_has_goals(client: TestClient, seen: Seen) -> None:
    low = camera_arrays(seen)[3][:2, 3] - 6.0
    grid, at = np.zeros((240, 240), np.int8), np.array([*low, 0.0, 0.05])
    assert client.post("/base", content=packed(seen)).json()["goal"] is None  # no floor is seen
    goal = client.post("/base", content=packed(seen, map=grid, map_pose=at)).json()["goal"]
    assert goal["child_frame_id"] == "base_link" and 0.5 < goal["score"] <= 1
    for changed in (
        {"map": grid},
        {"map": grid * 1.0, "map_pose": at},
        {"map": grid, "map_pose": at * np.nan},
    ):
        said = client.post("/base", content=packed(seen, **changed))
        assert said.status_code == 422 and "the body: map: is no map" in said.text


def test_the_service_goes_on_after_a_worker_was_killed(seen: Seen) -> None:
    before = set(psutil.Process().children(recursive=True))
    with TestClient(app_of(ServeOptions(**SIZES)), raise_server_exceptions=False) as client:
        assert client.post("/base", content=packed(seen)).status_code == 200
        workers = [each for each in psutil.Process().children() if each not in before]
        for each in workers:
            if "spawn_main" in " ".join(each.cmdline()):
                each.kill()
        statuses = [client.post("/base", content=packed(seen)).status_code for _ in range(2)]
        assert statuses[-1] == 200
    left = set(psutil.Process().children(recursive=True)) - before
    assert not any("spawn_main" in " ".join(each.cmdline()) for each in left if each.is_running())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), "error: --base-height: is missing"),
        (("--robot", "fetchh"), "fetchh: is unknown"),
        (("--base-height", "-1", "--reach", "0.9"), "--base-height"),
        (("--robot", "fetch", "--footprint", "x"), "footprint"),
        (("--robot", "fetch", "--footprint", "-1,0;1,0"), "--footprint: is not 3 to 256 corners"),
        (("--robot", "fetch", "--port", "99999"), "--port: 99999: is not between 1 and 65535"),
        (("--robot", "fetch", "--port", "{taken}"), "cannot be listened on"),
    ],
)
def test_what_cannot_be_served_is_refused_at_the_start(
    options: tuple[str, ...], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = other.getsockname()[1]
        said = refused(["serve", *(each.format(taken=taken) for each in options)], capsys, words)
    assert "listening" not in said


def test_a_base_decides_what_is_clear(seen: Seen) -> None:
    low = camera_arrays(seen)[3][:2, 3] - 6.0
    room = {"map": np.zeros((240, 240), np.int8), "map_pose": np.array([*low, 0.0, 0.05])}
    asked = {"content": packed(seen, **room), "params": {"candidates": True}}
    clear = []
    for footprint in ("0.2", "0.45"):
        answer = TestClient(app_of(ServeOptions(**SIZES, footprint=footprint))).post("/base", **asked).json()
        clear.append(sum(each["state"] == "clear" for each in answer["candidates"]))
    assert clear[0] > clear[1] > 0


def test_a_large_body_is_refused(client: TestClient, seen: Seen, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service, "MOST_BYTES", 1 << 20)
    assert client.post("/base", content=bytes(2 << 20)).status_code == 413


def test_a_token_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "token").write_text("0123456789abcdef\n")
    client = TestClient(app_of(ServeOptions(**SIZES, host="0.0.0.0", token=tmp_path / "token")))
    assert client.get("/health").status_code == 401
    for word, status in (("0123456789abcdef", 200), ("0123456789abcdeF", 401), ("é", 401)):
        headers = {"Authorization": f"Bearer {word}".encode()}
        assert client.get("/health", headers=headers).status_code == status
    (tmp_path / "short").write_text("word")
    refused(["serve", "--host", "0.0.0.0"], capsys, "is no loopback address")
    refused(["serve", "--token", str(tmp_path / "short")], capsys, "16 or more characters")
    assert cli.VERBS["serve"]
