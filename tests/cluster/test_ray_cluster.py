"""A local cluster as datagen starts it: who can reach it, and what is said to who cannot."""

from __future__ import annotations

import os
from pathlib import Path

import psutil
import pytest

from cluster.ray_cluster import RaySettings, known_token, ray_cluster, refuse_unusable, token_for
from cluster.ray_settings import head_arguments, head_environment, new_token
from schemas.errors import InputError

LOOPBACK = {"127.0.0.1", "::1", "::ffff:127.0.0.1"}
SOURCES = ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")


@pytest.fixture(autouse=True)
def without_token(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in SOURCES:
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
        assert listening and listening <= LOOPBACK
        address = ray.get_runtime_context().gcs_address
        with pytest.raises(InputError, match=r"asks for a token, and none is set\. Set RAY_AUTH_TOKEN"):
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


def test_the_cluster_of_this_machine_is_asked_too(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_a_head_of_this_machine_has_loopback_a_token_and_a_port_of_its_own() -> None:
    first, second = head_arguments(2), head_arguments(2)
    assert "--node-ip-address=127.0.0.1" in first and "--dashboard-host=127.0.0.1" in first
    assert [a for a in first if "client" in a] != [a for a in second if "client" in a]
    environment = head_environment("t" * 64)
    assert environment["RAY_AUTH_MODE"] == "token" and environment["RAY_AUTH_TOKEN"] == "t" * 64
    assert new_token() != new_token()
