"""The code on docs/development/extending.md is real: its modules, its lines and its tests are executed."""

from __future__ import annotations

import importlib
import inspect
import json
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from datagen import cli
from tests.small_runs import arrays_of, json_of, make_small_run

PAGE = Path(__file__).parents[1] / "docs" / "development" / "extending.md"
_BLOCK = re.compile(r"^```(?:python|toml) (file|line)=(\S+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_ROOM = {"room_m": [4.5, 4.0], "table_m": [1.2, 0.8], "height_m": 0.75}


def blocks() -> list[tuple[str, str, str]]:
    """(file or line, where it belongs, code) of each block, in the page's order."""
    return _BLOCK.findall(PAGE.read_text())


def lines_of(registry: str) -> list[str]:
    """The page's lines for one registry."""
    return [code for kind, place, code in blocks() if kind == "line" and place == registry]


def executed(monkeypatch: pytest.MonkeyPatch, name: str, code: str) -> ModuleType:
    """The code as a module that can be imported for the duration of the test."""
    module = ModuleType(name)
    monkeypatch.setitem(sys.modules, name, module)
    exec(compile(code, f"{PAGE.name}: {name}", "exec", dont_inherit=True), module.__dict__)
    return module


@pytest.fixture
def extended(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, ModuleType]:
    """Every module of the page, by its file, with its line in its registry; undone after the test."""
    modules: dict[str, ModuleType] = {}
    for kind, place, code in blocks():
        if kind == "file":
            if place.endswith(".toml"):
                (tmp_path / Path(place).name).write_text(code)
            elif not place.startswith("tests/"):
                modules[place] = executed(monkeypatch, place.removesuffix(".py").replace("/", "."), code)
            continue
        assert code.count("\n") == 1, f"more than one line for {place}"
        module, registry = place.split(":")
        known: dict[str, Any] = getattr(importlib.import_module(module), registry)
        for name, target in eval("{" + code + "}", {}).items():
            assert name not in known
            file = tmp_path / target  # where the package has no such file
            monkeypatch.setitem(known, name, str(file) if target.endswith(".toml") else target)
    return modules


def test_each_example_is_one_file_one_line_and_one_test() -> None:
    shape = [
        (kind, re.split(r"[/.]", place.removeprefix("datagen.").removeprefix("datagen/"))[0])
        for kind, place, _ in blocks()
    ]
    assert shape == [("file", "workers"), ("line", "workers"), ("file", "tests")] * 4
    assert len(re.findall("```(?:python|toml)", PAGE.read_text())) == len(shape)  # no block escapes this test
    for kind, place, _ in blocks():
        if kind == "file":  # it would be a new file, beside the others of its kind
            assert not (PAGE.parents[2] / place).exists()
            assert (PAGE.parents[2] / place).parent.is_dir()


def page_tests() -> list[tuple[str, str, str]]:
    """(file, its code, test's name) of every test on the page."""
    files = [(place, code) for kind, place, code in blocks() if kind == "file" and place.startswith("tests/")]
    return [
        (place, code, name) for place, code in files for name in re.findall(r"^def (test_\w+)", code, re.M)
    ]


@pytest.mark.usefixtures("extended")
@pytest.mark.parametrize(("place", "code", "name"), page_tests(), ids=[name for *_, name in page_tests()])
def test_the_tests_on_the_page_pass(
    place: str, code: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if place.startswith("tests/workers/robots/"):
        pytest.importorskip("pinocchio", reason="pinocchio cannot be imported here: run `datagen doctor`")
    module = executed(monkeypatch, place.removesuffix(".py").replace("/", "."), code)
    test = getattr(module, name)
    marks = [mark for mark in getattr(test, "pytestmark", []) if mark.name == "parametrize"]
    cases = [{mark.args[0]: value} for mark in marks for value in mark.args[1]] or [{}]
    wanted = inspect.signature(test).parameters
    assert set(wanted) <= {"tmp_path", *cases[0]}
    for k, case in enumerate(cases):
        folder = tmp_path / str(k)
        folder.mkdir()
        test(**({"tmp_path": folder} if "tmp_path" in wanted else {}), **case)


@pytest.mark.usefixtures("extended")
def test_the_robot_conforms_by_its_line_alone() -> None:
    pytest.importorskip("pinocchio", reason="pinocchio cannot be imported here: run `datagen doctor`")
    from tests.workers.robots import test_conformance, test_physics
    from tests.workers.robots.robots_under_test import cases_of, opened

    robots = [
        name for code in lines_of("datagen.workers.robots:ROBOTS") for name in eval("{" + code + "}", {})
    ]
    checks = [
        check
        for module in (test_conformance, test_physics)
        for name, check in vars(module).items()
        if name.startswith("test_") and set(inspect.signature(check).parameters) == {"robot"}
    ]
    assert len(robots) == 1 and len(checks) > 10
    for case in cases_of(robots[0]):
        for check in checks:
            check(robot=opened(case))


@pytest.mark.usefixtures("extended")
def test_a_run_with_all_three_sources_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rooms, boxes, run = tmp_path / "rooms", tmp_path / "boxes.csv", tmp_path / "run"
    rooms.mkdir()
    for k in range(3):
        (rooms / f"room{k}.json").write_text(json.dumps(_ROOM | {"height_m": 0.7 + 0.05 * k}))
    lines = [f"box{k},{0.05 + 0.004 * k},{0.07},{0.06 + 0.01 * k},{0.1 + 0.05 * k}" for k in range(8)]
    boxes.write_text("\n".join(lines) + "\n")
    sources = ("--houses", f"one-table:{rooms}", "--objects", f"boxes:{boxes}")
    make_small_run(run, 64, *sources)
    arrays = arrays_of(run)
    assert set(arrays["house_id"]) <= {"room0", "room1", "room2"} and len(set(arrays["house_id"])) > 1
    assert all(name.startswith("box") for name in arrays["object_name"].ravel())
    assert json_of(capsys, ["status", str(run)])["complete"]
    picture = tmp_path / "scene.png"
    assert cli.run(["show", str(run), "--scene", "1", "--out", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
