"""Runs made to do harm: every verb refuses them in a line, reads nothing outside and little inside."""

from __future__ import annotations

import os
import resource
import shutil
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

import pytest

from datagen import cli
from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMAS
from datagen.schemas.storage import open_storage
from tests.columns import columns_of
from tests.faults.crash_points_operations import small_schema
from tests.faults.damage_campaign import make_place
from tests.faults.hostile_stores import HOSTILE, OBJECT, odd_names
from tests.faults.opened_files import watched

SECRET = "the-canary-sings-at-noon"
# Above what a verb needs for a run of three shards, and far below what the hostile ones ask for.
MEMORY_BYTES = 1 << 30


@pytest.fixture(scope="module", autouse=True)
def fewer_arrays() -> Generator[None]:
    """Runs of fewer files; all that the verbs here read is among them."""
    scene = ("scene_index", "redraws", "house_id", "points_m", "rgb", "object_name")
    with pytest.MonkeyPatch.context() as patch:
        names = (*scene, *(f.name for f in SCHEMAS["heuristic"].sample_fields))
        patch.setitem(SCHEMAS, "heuristic", small_schema(names))
        yield


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hostile") / "clean"
    make_place(folder, n=9, scenes_per_shard=1)
    return folder


@pytest.fixture
def run(clean: Path, tmp_path: Path) -> Path:
    """A sealed run of two shards, to be made hostile, beside a folder with secrets."""
    shutil.copytree(clean, tmp_path / "run")
    (tmp_path / "outside").mkdir()
    for name in (
        "secret",
        "manifest.json",
        "000001.json",
        "a-1.zip",
        "a-1.start.json",
        "zarr.json",
        "data.json",
    ):
        (tmp_path / "outside" / name).write_text(f'{{"secret": "{SECRET}"}}')
    return tmp_path / "run"


@contextmanager
def little_memory() -> Generator[None]:
    """Let the process grow by MEMORY_BYTES of addresses and no more."""
    text = Path("/proc/self/statm").read_text()
    used = int(text.split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def read_all(place: str) -> int:
    """What every reader of columns does."""
    try:
        columns_of(place, ("points_m", "house_id", "label", "sample_id"))
    except InputError as error:
        assert len(str(error)) < 2000
        return 2
    return 0


VERBS: dict[str, Callable[[str], int]] = {
    "verify": lambda place: cli.run(["verify", place]),
    "repair": lambda place: cli.run(["verify", place, "--repair"]),
    "status": lambda place: cli.run(["status", place]),
    "audit": lambda place: cli.run(["audit", place]),
    "show": lambda place: cli.run(["show", place, "--scene", "1", "--out", f"{place}.png"]),
    "clean": lambda place: cli.run(["verify", place, "--clean"]),
    "read": read_all,
}


def verbs_for(name: str) -> list[str]:
    """Those that look at everything, and one of the others in turn; all where DATAGEN_ALL_VERBS is set."""
    others = [verb for verb in VERBS if verb not in ("verify", "repair", "read")]
    if os.environ.get("DATAGEN_ALL_VERBS"):
        return [*VERBS]
    return ["verify", others[list(HOSTILE).index(name) % len(others)], "repair", "read"]


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_run_harms_no_verb(name: str, run: Path, capfd: pytest.CaptureFixture[str]) -> None:
    HOSTILE[name](run)
    before = sorted(p.name for p in (run.parent / "outside").iterdir())
    codes: dict[str, int] = {}
    for verb in verbs_for(name):
        capfd.readouterr()
        with little_memory(), watched(run.parent / "outside") as opened:
            codes[verb] = VERBS[verb](str(run))
        assert opened == [], verb
        told = capfd.readouterr()
        assert codes[verb] in (0, 1, 2), verb
        assert SECRET not in told.out + told.err, verb
        assert "Traceback" not in told.out + told.err, verb
        lines = [line for line in told.err.splitlines() if not line.startswith("shards checked ")]
        assert len(lines) == (codes[verb] == 2 and verb != "read"), (verb, told.err)
        assert all(len(line) < 2500 and line.startswith("error: ") for line in lines), (verb, lines)
        assert all(c.isprintable() or c == "\n" for c in told.out + told.err), verb
    assert codes["verify"] in (1, 2), "nothing was found"
    for path in run.rglob("*"):
        if path.is_file() and not path.is_symlink() and path.stat().st_size < 10**6:
            assert SECRET.encode() not in path.read_bytes(), path
    assert sorted(p.name for p in (run.parent / "outside").iterdir()) == before


@pytest.mark.parametrize("name", ["object linked outside", "shards linked outside"])
def test_looking_outside_would_have_been_noticed(name: str, run: Path) -> None:
    """What the test above rests on: reading through a link and listing are seen; a stat is no reading."""
    HOSTILE[name](run)
    outside, rows = run.parent / "outside", run / OBJECT
    with watched(outside) as asked:
        assert rows.stat().st_size > 0
    with watched(outside) as read:
        rows.read_bytes()
    with watched(outside) as listed:
        assert any(outside.iterdir())
    assert (asked, read, listed) == ([], ["a-1.zip"], ["."])


def test_findings_name_what_is_hostile(run: Path) -> None:
    odd_names(run)
    keys = {f.key for f in check_runs(open_storage(run, probe=False), Checked())}
    assert any("owned" in key for key in keys)
