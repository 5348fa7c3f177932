"""The doctor: real checks of this machine, and each way in which a check can go wrong."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from rich.console import Console

from datagen import cli, doctor
from datagen.doctor import Check, Finding, Problem, found, probe
from datagen.workers.extras import EXTRAS, how_to_get


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "crashed with SIGSEGV"),
        ("import time; time.sleep(60)", "no result within 0 s"),
        ("raise RuntimeError('no such device')", "RuntimeError: no such device"),
    ],
)
def test_a_probe_survives_what_it_probes(code: str, said: str) -> None:
    with pytest.raises(Problem) as failed:
        probe(code, timeout_s=0.4 if "sleep" in code else 60)
    assert str(failed.value) == said
    assert probe("print('first'); print('last')") == "last"


def findings(*names: str) -> dict[str, Finding]:
    """The findings of some checks by name."""
    return {check.name: found(check) for check in doctor.checks() if check.name in names}


def test_broken_engines_are_named_with_a_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "find_spec", lambda name: name)
    for code in ("LABELS", "RAY"):
        monkeypatch.setattr(doctor, code, "import a_module_that_is_not_there")
    broken = findings("labels", "ray", "sim labels")
    wanted = {"labels": "fail", "ray": "warn"}
    assert {name: each.status for name, each in broken.items() if name in wanted} == wanted
    for each in broken.values():
        assert "a_module_that_is_not_there" in each.detail and each.fix
    assert "--workers 0" in broken["ray"].fix


def test_a_job_that_fails_is_named_by_its_cause(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = "import datagen.workers.run_shard as r\nr.generate_scene = None\n"
    monkeypatch.setattr(doctor, "LABELS", broken + doctor.LABELS)
    assert "NoneType" in findings("labels")["labels"].detail


def test_what_is_not_installed_is_not_probed_and_its_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("coal", "embreex", "pybullet"):
        monkeypatch.setitem(sys.modules, name, None)
    extras = findings(*(f"extra {name}" for name in EXTRAS))
    assert extras["extra sim"].status == extras["extra pybullet"].status == "ok"  # a choice, not a fault
    assert extras["extra labels"].status == "fail"
    assert extras["extra sim"].detail == "not installed (coal); would give plan and sim labels"
    assert extras["extra sim"].fix == how_to_get("sim") != ""
    assert not {"labels", "sim labels"} & {check.name for check in doctor.checks()}


def test_container_limits_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_CGROUP", tmp_path)
    assert {each.status for each in findings("cores").values()} == {"ok"}
    (tmp_path / "cpu.max").write_text("50000 100000\n")
    (tmp_path / "memory.max").write_text(f"{300 * 2**20}\n")
    (tmp_path / "memory.current").write_text(f"{100 * 2**20}\n")
    limited = findings("cores", "memory")
    assert "limited to 0.5" in limited["cores"].detail and "210 MB free" in limited["memory"].detail
    assert {each.status for each in limited.values()} == {"warn"}


def test_cache_follows_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DATAGEN_CACHE", str(tmp_path / "own"))
    assert findings("cache")["cache"] == Finding("cache", "ok", str(tmp_path / "own"))
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("DATAGEN_CACHE", str(tmp_path / "file" / "below"))
    refused = findings("cache")["cache"]
    assert refused.status == "warn" and "DATAGEN_CACHE" in refused.fix


def test_missing_files_are_findings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_LIBRARIES", {"libnothere.so.9": "libnothere9"})
    missing = findings("libnothere.so.9")["libnothere.so.9"]
    assert missing.status == "warn" and "apt-get install -y libnothere9" in missing.fix
    assert found(Check("disk", lambda: str((tmp_path / "absent").stat()), "Make it")).fix == "Make it"


def test_engines_work_where_the_tests_run_and_json_names_every_check(
    capsys: pytest.CaptureFixture[str],
) -> None:
    code = cli.run(["doctor", "--json"])
    report = json.loads(capsys.readouterr().out)
    assert list(report) == ["ok", "checks"]
    assert report["ok"] == (code == 0)
    status = {check["name"]: check["status"] for check in report["checks"]}
    assert len(status) == len(report["checks"])
    assert status["labels"] == status["ray"] == status["sim labels"] == "ok", report
    assert {"python", "memory", "disk"} <= status.keys()
    for check in report["checks"]:
        assert list(check) == ["name", "status", "detail", "fix"]
        assert check["detail" if check["status"] == "ok" else "fix"]


def test_brackets_in_a_message_are_no_markup_and_a_narrow_terminal_breaks_no_command() -> None:
    console, fix = Console(width=40), "pip install '/a/folder/whose name/is/long/datagen[fast]'"
    with console.capture() as captured:
        doctor.print_findings([Finding("x", "fail", "[red]no[/blue] [/]", fix)], console)
    assert "[red]no[/blue] [/]" in captured.get()
    assert f"-> {fix}\n" in captured.get()
