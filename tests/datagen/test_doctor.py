"""The doctor: real checks of this machine, and each way in which a check can go wrong."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from rich.console import Console

from datagen import cli, doctor
from datagen.doctor import engines, host
from datagen.doctor.check import Check, probe
from datagen.doctor.host import ENOUGH_DISK_BYTES
from datagen.workers.extras import EXTRAS, how_to_get
from datagen.workers.robots import ROBOTS


def test_a_probe_survives_a_crash() -> None:
    crashed = probe("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    assert not crashed.succeeded
    assert crashed.text == "crashed with SIGSEGV"


def test_a_probe_survives_a_hang() -> None:
    hung = probe("import time; time.sleep(60)", timeout_s=0.5)
    assert not hung.succeeded
    assert "no result" in hung.text


def test_a_probe_tells_the_last_line() -> None:
    assert probe("print('first'); print('last')").text == "last"
    failed = probe("raise RuntimeError('no such device')")
    assert not failed.succeeded
    assert failed.text == "RuntimeError: no such device"


def test_broken_engines_are_named_with_a_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "find_spec", lambda name: name)
    for code in ("_SAPIEN_PHYSICS", "_PYBULLET", "_EMBREE", "_RAY"):
        monkeypatch.setattr(engines, code, "import a_module_that_is_not_there")
    found = {check.name: check for check in engines.engine_checks()}
    assert {name: check.status for name, check in found.items()} == {
        "sapien physics": "fail",
        "pybullet": "fail",
        "embree": "fail",
        "ray": "warn",
    }
    for check in found.values():
        assert "a_module_that_is_not_there" in check.detail
        assert check.fix
    assert "--workers 0" in found["ray"].fix  # one worker is a worker of Ray's


def test_one_settler_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "find_spec", lambda name: name)
    monkeypatch.setattr(engines, "_SAPIEN_PHYSICS", "raise OSError('libX11.so.6: cannot open')")
    monkeypatch.setattr(engines, "_PYBULLET", "print('a cube falls')")
    found = {check.name: check for check in engines.engine_checks()}
    assert found["sapien physics"].status == "warn"
    assert "libX11" in found["sapien physics"].detail
    assert "sapien render device" not in found


def test_what_is_not_installed_is_not_probed_and_its_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("coal", "embreex", "pybullet"):
        monkeypatch.setitem(sys.modules, name, None)
    found = {check.name: check for check in doctor.extra_checks()}
    assert list(found) == [f"extra {name}" for name in EXTRAS]
    assert found["extra sim"].status == found["extra pybullet"].status == "ok"  # a choice, not a fault
    assert found["extra labels"].status == "fail"
    assert found["extra sim"].detail == "not installed (coal); would give plan and sim labels"
    assert found["extra sim"].fix == how_to_get("sim") != ""
    assert not engines.arm_checks()
    assert not {"embree", "pybullet"} & {check.name for check in engines.engine_checks()}


def test_arm_libraries_that_do_not_work_are_one_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "_LIBRARIES", "raise ImportError('libcoal.so: wrong')")
    (check,) = engines.arm_checks()
    assert check.status == "warn" and "libcoal" in check.detail and "--force-reinstall" in check.fix


def test_what_is_broken_of_the_arm_stack_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "_LIBRARIES", "print('there')")
    monkeypatch.setattr(engines, "_ROBOT", "raise OSError('no such URDF')")
    monkeypatch.setattr(engines, "_TRIAL", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    found = {check.name: check for check in engines.arm_checks()}
    assert found["robot panda"].status == "warn" and "no such URDF" in found["robot panda"].detail
    assert found["grasp trial"].status == "warn" and found["grasp trial"].detail == "crashed with SIGSEGV"
    assert all(check.fix for check in found.values() if check.status != "ok")


@pytest.mark.parametrize(
    ("text", "cores"),
    [("150000 100000", 1.5), ("max 100000", None), ("", None), ("1 0", None), ("a b", None), ("1 2 3", None)],
)
def test_container_cores(tmp_path: Path, text: str, cores: float | None) -> None:
    (tmp_path / "cpu.max").write_text(text)
    assert host.cgroup_cores(tmp_path) == cores
    assert host.cgroup_cores(tmp_path / "absent") is None


def test_container_limits_are_named(tmp_path: Path) -> None:
    (tmp_path / "cpu.max").write_text("50000 100000")
    (tmp_path / "memory.max").write_text(str(300 * 2**20))
    (tmp_path / "memory.current").write_text(str(100 * 2**20))
    cores, memory = host.check_cores(tmp_path), host.check_memory(tmp_path)
    assert cores.status == "warn"
    assert "--workers 1" in cores.fix
    assert memory.status == "fail"
    assert "container limit" in memory.detail


def test_disk(tmp_path: Path) -> None:
    assert host.check_disk("disk", tmp_path, enough=0).status in {"ok", "fail"}
    assert host.check_disk("temporary files", tmp_path, enough=2**62).status == "warn"
    absent = host.check_disk("temporary files", tmp_path / "absent", ENOUGH_DISK_BYTES)
    assert absent.status == "warn"
    assert absent.fix


def test_cache_follows_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DATAGEN_CACHE", str(tmp_path / "own"))
    assert host.check_cache() == Check("cache", "ok", str(tmp_path / "own"))
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("DATAGEN_CACHE", str(tmp_path / "file" / "below"))
    refused = host.check_cache()
    assert refused.status == "warn"
    assert "DATAGEN_CACHE" in refused.fix
    monkeypatch.delenv("DATAGEN_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert host.cache_folder() == tmp_path / "datagen"


def test_a_missing_library_comes_with_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host, "LIBRARIES", {"libnothere.so.9": ("nothing", "libnothere9")})
    (check,) = host.check_libraries()
    assert check.status == "warn"
    assert "apt-get install -y libnothere9" in check.fix


def test_gpu_program_that_fails_is_no_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "nvidia-smi"
    program.write_text("#!/bin/sh\nexit 9\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert host.check_gpu().status == "warn"
    program.write_text("#!/bin/sh\necho 'NVIDIA X, 24564 MiB, 570.1'\n")
    assert host.check_gpu() == Check("gpu", "ok", "NVIDIA X, 24564 MiB, 570.1")


def test_engines_work_where_the_tests_run_and_json_names_every_check(
    capsys: pytest.CaptureFixture[str],
) -> None:
    code = cli.run(["doctor", "--json"])
    report = json.loads(capsys.readouterr().out)
    assert list(report) == ["ok", "checks"]
    assert report["ok"] == (code == 0)
    names = [check["name"] for check in report["checks"]]
    assert len(names) == len(set(names))
    status = {check["name"]: check["status"] for check in report["checks"]}
    assert status["embree"] == status["ray"] == "ok"
    assert "ok" in {status.get("sapien physics"), status.get("pybullet")}
    assert {"python", "memory", "disk", "embree", "ray", "arm libraries", "houses", "objects"} <= set(names)
    arms = [check for check in report["checks"] if check["name"].startswith(("arm", "robot", "grasp"))]
    assert len(arms) == 2 + len(ROBOTS) and {check["status"] for check in arms} == {"ok"}, arms
    for check in report["checks"]:
        assert list(check) == ["name", "status", "detail", "fix"]
        assert check["detail" if check["status"] == "ok" else "fix"]


def test_a_missing_folder_of_houses_fails(tmp_path: Path) -> None:
    houses, objects = doctor.asset_checks(f"procthor:{tmp_path / 'absent'}", "teapots:x")
    assert houses.status == objects.status == "fail"
    assert str(tmp_path / "absent") in houses.detail
    assert houses.fix
    assert "ycb" in objects.fix


def test_real_assets_are_counted(assets: Path, real_objects: str) -> None:
    houses, objects = doctor.asset_checks(f"procthor:{assets / 'procthor'}", real_objects)
    assert houses.detail.startswith("2018 ")
    assert objects.status == "ok"


def test_brackets_in_a_message_are_no_markup() -> None:
    console = Console(width=100)
    with console.capture() as captured:
        console.print(doctor.as_table([Check("x", "fail", "[red]no[/blue] [/]", "use [fast]")]))
    assert "[red]no[/blue] [/]" in captured.get()
    assert "use [fast]" in captured.get()
