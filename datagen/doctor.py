"""`datagen doctor`: check this machine, and show how to fix each problem."""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import psutil
from rich.console import Console
from rich.table import Table
from rich.text import Text

from datagen.console.options import AsJson
from datagen.console.printing import print_json, size
from datagen.workers.content_cache import cache_folder
from datagen.workers.extras import EXTRAS, how_to_get

Status = Literal["ok", "warn", "fail"]
_COLOURS = {"ok": "green", "warn": "yellow", "fail": "bold red"}
_CGROUP = Path("/sys/fs/cgroup")
# A worker with houses, meshes and an engine needs about half of this; 180,000 labels take 0.4 GiB of a disk.
_ENOUGH_MEMORY_BYTES = _ENOUGH_DISK_BYTES = 2 * 2**30
# Ray keeps its objects here and is slow without; containers often start with 64 MiB.
_ENOUGH_SHM_BYTES = 2**28
_ENOUGH_OPEN_FILES = 4096
# Shared library -> its Debian and Ubuntu package. The first three are for SAPIEN, the last for arm libraries.
_LIBRARIES = {
    "libX11.so.6": "libx11-6",
    "libGL.so.1": "libgl1",
    "libgthread-2.0.so.0": "libglib2.0-0",
    "libgomp.so.1": "libgomp1",
}
_AGAIN = "Install it again: pip install --force-reinstall"


class Problem(Exception):
    """What a check found; `status` replaces that of the check."""

    def __init__(self, text: str, status: Status | None = None) -> None:
        super().__init__(text)
        self.status: Status | None = status


@dataclass(frozen=True)
class Check:
    """One check: `find` returns what it found, or raises Problem or OSError."""

    name: str
    find: Callable[[], str]
    fix: str = ""
    failed: Status = "warn"  # `fail`: labels cannot be made; `warn`: a feature is missing


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    name: str
    status: Status
    detail: str
    fix: str = ""


def checks() -> Iterator[Check]:
    """All checks of this machine, in the order of the report."""
    yield Check("python", lambda: f"{platform.python_version()} at {sys.executable}")
    yield Check("platform", _platform, "Only Linux is tested: use a Linux machine or container.")
    yield Check("cores", _cores, "Use as many --workers, or raise the container's limit.")
    yield Check("memory", _memory, "Use --workers 1, or free some memory.")
    yield Check("disk", partial(_free, Path.cwd(), _ENOUGH_DISK_BYTES), "Work on another disk.")
    shm_fix = "Start the container with --shm-size=1g; without it Ray is slower."
    yield Check("shared memory", partial(_free, Path("/dev/shm"), _ENOUGH_SHM_BYTES), shm_fix)
    yield Check("open files", _open_files, "Raise it before starting: ulimit -n 65536")
    yield Check(
        "cache", _cache, "Set DATAGEN_CACHE to a writable folder; without one files are parsed again."
    )
    for library, package in _LIBRARIES.items():
        yield Check(library, partial(_load, library), f"apt-get install -y {package}")
    for name in EXTRAS:
        yield Check(f"extra {name}", partial(_extra, name), how_to_get(name), "ok")
    if not EXTRAS["labels"].missing():
        fix = "Install the libraries named above, or use the engine that works: settle.engine in --config"
        yield Check("labels", partial(probe, LABELS.format(source="heuristic")), fix, "fail")
    if find_spec("ray"):
        yield Check("ray", partial(probe, RAY), f"{_AGAIN} ray; or use --workers 0.")
    if not EXTRAS["sim"].missing():
        fix = f"See the libraries above, or: {_AGAIN} numba coal mani-skill sapien"
        yield Check("sim labels", partial(probe, LABELS.format(source="sim")), fix)


def found(check: Check) -> Finding:
    """What a check finds here."""
    try:
        return Finding(check.name, "ok", check.find())
    except (Problem, OSError) as problem:
        status = problem.status if isinstance(problem, Problem) else None
        return Finding(check.name, status or check.failed, str(problem), check.fix)


def _platform() -> str:
    if sys.platform != "linux":
        raise Problem(platform.platform())
    return f"{platform.platform()}, {platform.machine()}"


def _limit(name: str) -> str:
    """First word of a control-group file of this container; "" or "max" where there is no limit."""
    path = _CGROUP / name
    return path.read_text().partition(" ")[0].strip() if path.is_file() else ""


def _cores() -> str:
    text = f"{len(os.sched_getaffinity(0))} of {os.cpu_count()} usable"
    if (quota_us := _limit("cpu.max")).isdigit():  # per 0.1 s
        cores = int(quota_us) / 1e5
        if cores < len(os.sched_getaffinity(0)):
            raise Problem(f"{text}, limited to {cores:.1f} by the container")
    return text


def _memory() -> str:
    free_bytes = psutil.virtual_memory().available
    if (limit := _limit("memory.max")).isdigit():
        free_bytes = min(free_bytes, int(limit) - int(_limit("memory.current") or 0))
    return _enough(free_bytes, _ENOUGH_MEMORY_BYTES, "free")


def _free(folder: Path, enough_bytes: int) -> str:
    return _enough(shutil.disk_usage(folder).free, enough_bytes, f"free in {folder}")


def _enough(n_bytes: int, enough_bytes: int, where: str) -> str:
    text = f"{size(n_bytes)} {where}"
    if n_bytes < enough_bytes:
        raise Problem(f"{text}, of {size(enough_bytes)} that are enough")
    return text


def _open_files() -> str:
    limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if limit != resource.RLIM_INFINITY and limit < _ENOUGH_OPEN_FILES:
        raise Problem(f"{limit}; Ray opens hundreds for each worker")
    return "no limit" if limit == resource.RLIM_INFINITY else str(limit)


def _cache() -> str:
    folder = cache_folder()
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    with tempfile.TemporaryFile(dir=existing):
        return str(folder)


def _load(library: str) -> str:
    ctypes.CDLL(library)
    return "found"


def _extra(name: str) -> str:
    if missing := EXTRAS[name].missing():
        text = f"not installed ({', '.join(missing)}); would give {EXTRAS[name].gives}"
        raise Problem(text, "fail" if name == "labels" else None)  # the others are a choice
    return EXTRAS[name].gives


def print_findings(findings: list[Finding], console: Console) -> None:
    """Print each finding, and its fix below it in one line, whose command can be copied."""
    widest = max(len(each.name) for each in findings)
    for each in findings:
        table = Table(box=None, pad_edge=False, show_header=False)
        table.add_column(no_wrap=True, width=4)
        table.add_column(no_wrap=True, width=widest)
        table.add_column(overflow="fold")
        # Text, because brackets in paths and messages are not markup.
        table.add_row(Text(each.status, style=_COLOURS[each.status]), each.name, Text(each.detail))
        console.print(table)
        if each.fix:
            console.print(Text(f"  -> {each.fix}", style="cyan"), soft_wrap=True)


def doctor(*, json: AsJson = False) -> int:
    """Check this machine, and show how to fix what is missing.

    Exit code 0 when labels can be made here, else 1.
    """
    findings = [found(check) for check in checks()]
    failures = sum(each.status == "fail" for each in findings)
    if json:
        print_json({"ok": not failures, "checks": [asdict(each) for each in findings]})
    else:
        console = Console(highlight=False)
        print_findings(findings, console)
        warnings = sum(each.status == "warn" for each in findings)
        verdict = "labels can be made here" if not failures else "labels cannot be made here yet"
        console.print(f"\n{verdict}: {failures} failed, {warnings} warned")
    return 1 if failures else 0


# A few labels of one scene, by the engines that a job would use.
LABELS = """
import sys, tempfile, datagen
from pathlib import Path
with tempfile.TemporaryDirectory() as folder:
    config = Path(folder, "tops.toml")
    config.write_text("[scene]\\nplaces = {{}}\\n")
    made = datagen.submit("{source}", n=4, candidates="in-range", candidates_per_scene=4, config=config,
                          out=Path(folder, "run"), workers=0, no_seal=True, quiet=True)
if not made.complete:
    sys.exit(made.cause)
print(f"{{made.labels}} {source} labels in {{made.elapsed_s:.1f}} s")
"""
RAY = """
import importlib
ray = importlib.import_module("ray")
print("ray " + ray.__version__)
"""
# Several times the usual duration: code may be compiled and grasps computed for the first time.
_DEADLINE_S = 600.0


def probe(code: str, timeout_s: float = _DEADLINE_S) -> str:
    """Run Python code in a new interpreter; return its last line of output. Problem says why it failed."""
    command = [sys.executable, "-W", "ignore", "-c", code]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=timeout_s, check=False
        )
    except subprocess.TimeoutExpired:
        raise Problem(f"no result within {timeout_s:.0f} s") from None
    if done.returncode < 0:
        raise Problem(f"crashed with {signal.Signals(-done.returncode).name}")
    said = (done.stderr if done.returncode else done.stdout).strip().splitlines()
    text = said[-1][:200] if said else f"exit code {done.returncode}"
    if done.returncode:
        raise Problem(text)
    return text
