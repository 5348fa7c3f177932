"""A local cluster as datagen starts it: who can reach it, and what is said to who cannot."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from datagen.cluster import ray_cluster as ray_cluster_module
from datagen.cluster import ray_settings
from datagen.cluster.cluster_folders import is_alive, private_folder
from datagen.cluster.ray_cluster import RaySettings, known_token, ray_cluster, refuse_unusable, token_for
from datagen.cluster.ray_settings import head_environment, new_token
from datagen.schemas.errors import InputError
from tests.other_user import as_another_user, needs_root, traces_of


@pytest.fixture(autouse=True)
def without_token(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"):
        monkeypatch.delenv(name, raising=False)


def test_a_local_cluster_listens_on_loopback_alone_and_asks_for_its_token(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from ray._private import ray_constants

    monkeypatch.setattr(ray_constants, "ENABLE_RAY_CLUSTER", True)  # as where somebody imported Ray before
    monkeypatch.setenv("PYTHONBREAKPOINT", "ray.util.rpdb._driver_set_trace")  # Ray's own doing
    before = dict(os.environ)
    with ray_cluster(RaySettings(workers=1)) as ray:
        assert dict(os.environ) == before and not (tmp_path / ".ray").exists()
        token = str(ray.get(ray.remote(lambda: os.environ["RAY_AUTH_TOKEN"]).remote()))
        assert len(token) == 64
        its = [p for p in psutil.process_iter() if token_of(p) == token]
        assert {"gcs_server", "raylet"} <= {p.name() for p in its}
        listening = {
            socket.laddr.ip
            for p in [*its, psutil.Process()]
            for socket in p.net_connections("tcp")
            if socket.status == psutil.CONN_LISTEN
        }
        assert listening and listening <= {"127.0.0.1", "::1", "::ffff:127.0.0.1"}
        address = ray.get_runtime_context().gcs_address
        with pytest.raises(InputError, match=r"requires a token, but none is set\. Set RAY_AUTH_TOKEN"):
            refuse_unusable(address)
        monkeypatch.setenv("RAY_AUTH_TOKEN", new_token())
        with pytest.raises(InputError, match="refuses the token in RAY_AUTH_TOKEN"):
            refuse_unusable(address)
        monkeypatch.setenv("RAY_AUTH_TOKEN", token)
        assert token_for(address)["RAY_AUTH_TOKEN"] == token
    with ray_cluster(RaySettings(workers=1)) as ray:  # another one in the same process has another token
        assert ray.get(ray.remote(lambda: os.environ["RAY_AUTH_TOKEN"]).remote()) != token


def token_of(process: psutil.Process) -> str:
    try:
        return process.environ().get("RAY_AUTH_TOKEN", "")
    except psutil.Error:
        return ""


def test_auto_is_the_cluster_that_ray_names(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    with pytest.raises(InputError, match="RAY_ADDRESS names no cluster"):
        refuse_unusable("auto")
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    with pytest.raises(InputError, match=r"127\.0\.0\.1:1: cannot be reached"):
        refuse_unusable("auto")


def test_a_token_is_looked_for_where_ray_looks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert known_token() is None
    (tmp_path / ".ray").mkdir()
    for place, text in ((tmp_path / ".ray" / "auth_token", "default\n"), (tmp_path / "named", " named ")):
        place.write_text(text)
    assert known_token() == ("default", str(tmp_path / ".ray" / "auth_token"))
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(tmp_path / "named"))
    assert known_token() == ("named", str(tmp_path / "named"))
    monkeypatch.setenv("RAY_AUTH_TOKEN", "said")
    assert known_token() == ("said", "RAY_AUTH_TOKEN")


def test_a_cluster_of_this_machine_has_a_token_of_its_own() -> None:
    environment = head_environment("t" * 64)
    assert environment["RAY_AUTH_MODE"] == "token" and environment["RAY_AUTH_TOKEN"] == "t" * 64
    assert new_token() != new_token()


def test_sigterm_keeps_its_handler_while_a_cluster_runs_and_after_it() -> None:
    came: list[str] = []
    when = ""
    before = signal.signal(signal.SIGTERM, lambda number, frame: came.append(when))
    try:
        with ray_cluster(RaySettings(workers=1)):
            when = "in it"
            os.kill(os.getpid(), signal.SIGTERM)
            assert not any(signal.getitimer(signal.ITIMER_REAL))  # with which Ray aborts a process
        when = "after it"
        os.kill(os.getpid(), signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert came == ["in it", "after it"]


ANOTHER_USER = """
from pathlib import Path
import grpc, grpc._channel
address, folder, pids = sys.argv[1], Path(sys.argv[2]), sys.argv[3].split()
for place in ("session_latest/logs/raylet.out", "session_latest/sockets/planted", "planted"):
    try: (folder / "ray" / place).symlink_to("/etc/passwd")
    except PermissionError: print("refused")
for pid in pids:
    try: Path("/proc", pid, "environ").read_bytes()
    except PermissionError: print("refused")
ask = grpc.insecure_channel(address).unary_unary("/ray.rpc.NodeInfoGcsService/GetClusterId")
try: ask(b"", timeout=300)
except grpc.RpcError as error: print(error.code().name)
"""


@needs_root
def test_another_user_can_neither_enter_nor_read_nor_speak_to_a_local_cluster() -> None:
    shared = set(
        Path("/tmp/ray").glob(f"session_*_{os.getpid()}")
    )  # other tests' clusters have other process ids
    with ray_cluster(RaySettings(workers=1)) as ray:
        token = str(ray.get(ray.remote(lambda: os.environ["RAY_AUTH_TOKEN"]).remote()))
        folder = Path(ray._private.worker._global_node.temp_dir).parent
        its = [p for p in psutil.Process().children(recursive=True) if token_of(p) == token]
        assert folder.stat().st_mode & 0o777 == 0o700 and len(its) >= 3
        address = ray.get_runtime_context().gcs_address
        tried = as_another_user(ANOTHER_USER, address, folder, " ".join(str(p.pid) for p in its)).split()
        assert tried == ["refused"] * (3 + len(its)) + ["UNAUTHENTICATED"]
        assert traces_of(token, [folder]) == []
    assert not folder.exists() and not [p for p in its if is_alive(p)]
    assert set(Path("/tmp/ray").glob(f"session_*_{os.getpid()}")) == shared


def test_the_next_cluster_removes_what_a_killed_driver_left() -> None:
    program = """
import ray, sys
from datagen.cluster.ray_cluster import RaySettings, ray_cluster
with ray_cluster(RaySettings(workers=1)) as ray:
    print(ray._private.worker._global_node.temp_dir, flush=True)
    sys.stdin.read()
"""
    driver = subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        cwd=Path(__file__).resolve().parents[2],
    )  # fmt: skip
    assert driver.stdout is not None
    folder = Path(driver.stdout.readline().strip()).parent
    its = psutil.Process(driver.pid).children(recursive=True)
    assert {"gcs_server", "raylet"} <= {p.name() for p in its}
    assert not [p for p in its if "Agent" in p.name() or "dashboard" in " ".join(p.cmdline()[:2])]
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    assert folder.exists()
    with private_folder():  # as the next cluster begins
        assert not folder.exists() and not [p for p in its if is_alive(p)]


DIES = "raise SystemExit(1)"
SILENCES_THE_CONTROL_STORE = """
import os, time, psutil
for sibling in psutil.Process(os.getppid()).children():
    if sibling.name() == "gcs_server":
        sibling.suspend()
time.sleep(600)
"""


@pytest.mark.parametrize("raylet", [DIES, SILENCES_THE_CONTROL_STORE])
def test_a_cluster_that_does_not_start_is_one_line_and_leaves_nothing(
    raylet: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    from ray._private import services

    executable = tmp_path / "raylet"
    executable.write_text(f"#!{sys.executable}\n{raylet}")
    executable.chmod(0o755)
    monkeypatch.setattr(services, "RAYLET_EXECUTABLE", str(executable))
    # Ray's waits for a node, which is 30 s, and for its control store.
    monkeypatch.setenv("RAY_raylet_start_wait_time_s", "1")
    monkeypatch.setitem(ray_settings._LOCAL, "RAY_gcs_rpc_server_connect_timeout_s", "1")
    monkeypatch.setattr(ray_cluster_module, "_SILENT_START_S", 0.0)
    said = pytest.raises(InputError, match=r"^ray: does not start: .* --workers 0.* --address")
    with said, ray_cluster(RaySettings(workers=1)):
        pass
    assert capsys.readouterr().err.splitlines() == ["waiting for Ray to start: --address local"]
    assert "gcs_server" not in {p.name() for p in psutil.Process().children(recursive=True) if is_alive(p)}


@pytest.mark.slow
def test_a_cluster_may_take_longer_to_start_than_ray_itself_waits(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from ray._private import services

    slow = tmp_path / "raylet"
    slow.write_text(f'#!/bin/sh\nsleep 40\nexec {services.RAYLET_EXECUTABLE} "$@"\n')
    slow.chmod(0o755)
    monkeypatch.setattr(services, "RAYLET_EXECUTABLE", str(slow))
    began_s = time.monotonic()
    with ray_cluster(RaySettings(workers=1)) as ray:
        assert ray.get(ray.remote(lambda: 2).remote()) == 2
    assert time.monotonic() - began_s > 40
