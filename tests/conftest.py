"""Fixtures shared by all tests."""

from __future__ import annotations

import fcntl
import gzip
import os
import secrets
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from numba.core.dispatcher import Dispatcher

from datagen.workers.kinematics.compiler import code_folder
from tests.s3_servers import environment, make_bucket, moto_server

REPOSITORY = Path(__file__).resolve().parent.parent

# How long an example takes says how busy the machine is, and no more.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")


def once(folder: Path, make: Callable[[], object]) -> Path:
    """The folder, made by the first who comes; the others wait for it."""
    with open(f"{folder}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = Path(f"{folder}.done")
        if not done.exists():
            make()
            done.touch()
    return folder


@pytest.fixture(scope="session")
def assets() -> Path:
    """The folder of real houses and objects, or a skip that says how to have one."""
    folder = Path(os.environ.get("DATAGEN_ASSETS") or REPOSITORY.parent / "shared" / "assets")
    if not (folder / "ycb" / "objects.json").is_file():
        pytest.skip(f"no real assets at {folder}: set DATAGEN_ASSETS to a folder with ycb/ and procthor/")
    return folder


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that all workers of this test session share."""
    base = tmp_path_factory.getbasetemp()
    shared = (base.parent if base.name.startswith("popen-") else base) / "shared"
    shared.mkdir(exist_ok=True)
    return shared


@pytest.fixture(autouse=True, scope="session")
def session_cache(shared_folder: Path) -> Iterator[Path]:
    """A cache that all workers and their programs share, instead of the user's: real objects are decomposed,
    and grasps scored, once a session."""
    cache = shared_folder / "cache"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DATAGEN_CACHE", str(cache))
        yield cache


@pytest.fixture(autouse=True, scope="session")
def compiled_once(shared_folder: Path, session_cache: Path) -> Iterator[None]:
    """One worker compiles a function of kinematics or of the planner; others wait and load its code."""
    assert code_folder.cache_info().currsize == 0, "a file of tests opens a robot where it is imported"
    whole, depth = Dispatcher.compile, 0

    def compile_alone(dispatcher: Dispatcher, signature: object) -> object:
        nonlocal depth
        if depth == 0:
            fcntl.flock(lock, fcntl.LOCK_EX)
        depth += 1  # a function compiles those that it calls
        try:
            return whole(dispatcher, signature)
        finally:
            depth -= 1
            if depth == 0:
                fcntl.flock(lock, fcntl.LOCK_UN)

    with open(shared_folder / "compiling.lock", "w") as lock, pytest.MonkeyPatch.context() as patch:
        patch.setattr(Dispatcher, "compile", compile_alone)
        yield


@pytest.fixture(scope="session")
def real_objects(assets: Path, shared_folder: Path, session_cache: Path) -> str:
    """The source of the real objects, which the first who asks has read into the cache of all."""
    from datagen.workers.objects import open_objects

    source = f"ycb:{assets / 'ycb'}"
    once(shared_folder / "ycb", lambda: open_objects(source))
    return source


@pytest.fixture(scope="session")
def some_real_houses(assets: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The source of each fortieth real house, for runs: `submit` examines all houses of a source."""
    folder = tmp_path_factory.mktemp("procthor")
    (folder / "asset_sizes.json").symlink_to(assets / "procthor" / "asset_sizes.json")
    lines = [
        line
        for file in sorted((assets / "procthor").glob("*.jsonl.gz"))
        for line in gzip.decompress(file.read_bytes()).splitlines(keepends=True)[::40]
    ]
    (folder / "houses.jsonl.gz").write_bytes(gzip.compress(b"".join(lines), 1))
    return f"procthor:{folder}"


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """One thread for small models, where torch is loaded at all: test processes share the cores, and
    threads of one would wait for those of another. For whole modules, since their fixtures train as well.
    """
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def s3_port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """Port of moto's S3 server on the loopback address."""
    with moto_server(tmp_path_factory.mktemp("moto") / "log") as port:
        yield port


@pytest.fixture
def bucket(s3_port: int, monkeypatch: pytest.MonkeyPatch) -> str:
    """A new bucket, as `s3://name`; the environment names its server."""
    name = f"test-{secrets.token_hex(6)}"
    make_bucket(s3_port, name)
    for variable, value in environment(s3_port).items():
        monkeypatch.setenv(variable, value)
    return f"s3://{name}"
