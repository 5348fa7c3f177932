"""A kill, a failing disk and a full one at the calls of what writes to a run.

Here a sample of the points; `python -m benchmarks.faults.crash_points` tries them all.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.faults.crash_points_campaign import run_campaign, start
from tests.faults.crash_points_operations import OPERATIONS
from tests.faults.crash_points_shim import Call, read_log

pytestmark = pytest.mark.slow

SAMPLE = 0  # each kind of end: only its first and last call
# Calls that leave files as they are. Any other one that touches a run must be known to the shim.
READING = {
    "access", "close", "faccessat", "faccessat2", "fadvise64", "fcntl", "flock", "fstat", "fstatfs", "getcwd",
    "getdents64", "ioctl", "lseek", "lstat", "newfstatat", "poll", "pread64", "preadv", "read",
    "readlink", "readlinkat", "readv", "stat", "statfs", "statx",
}  # fmt: skip
KINDS = {"linkat": "link", "mkdirat": "mkdir", "openat": "open", "renameat": "rename", "renameat2": "rename"}


def test_every_unit_is_absent_or_there_wherever_it_ends() -> None:
    findings = run_campaign([], SAMPLE)
    assert [found.operation for found in findings] == [operation.name for operation in OPERATIONS]
    for found in findings:
        assert found.violations == [], found.operation
        assert found.calls >= 5, found.operation
        assert found.absent + found.there + found.between == found.points
    # The sample has points of every kind: some before the unit is there, some after, some refused.
    assert all(
        sum(getattr(found, kind) for found in findings) > 20 for kind in ("absent", "there", "refused")
    )


def test_the_shim_hits_every_call_that_the_kernel_sees(tmp_path: Path) -> None:
    """strace knows calls by what the kernel is asked for, however a library asks."""
    strace = shutil.which("strace")
    if strace is None:
        pytest.skip("strace is not installed")
    tracing = [strace, "-f", "--seccomp-bpf", "-y", "-s", "300", "-e", "trace=%file,%desc", "-o"]
    probe = subprocess.run([*tracing, str(tmp_path / "probe"), "true"], capture_output=True, check=False)
    if probe.returncode != 0:
        pytest.skip("this machine does not let one process trace another")
    log, traced = tmp_path / "log", tmp_path / "traced"
    start([f"--trace={log}"], [*tracing, str(traced)])
    ours = by_operation(log.read_text())
    lines = [line for line in traced.read_text().splitlines() if f"<{log}>" not in line]  # the shim's own
    seen = kernel_calls(lines, list(ours))
    assert len(ours) == len(OPERATIONS)
    for folder, calls in ours.items():
        assert [call.kind for call in calls] == seen[folder], folder


def by_operation(text: str) -> dict[str, list[Call]]:
    """What the shim counted, by the folder of each operation."""
    found: dict[str, list[Call]] = {}
    for call in read_log(text):
        if call.kind == "begin":
            found[call.path] = []
        else:
            found[list(found)[-1]].append(call)
    return found


def kernel_calls(lines: list[str], folders: list[str]) -> dict[str, list[str]]:
    """Kinds of the calls below each folder that may change a file, in order, between its two markers."""
    calls: dict[str, list[str]] = {folder: [] for folder in folders}
    now = ""
    for line in lines:
        found = re.match(r"[0-9]+ +([a-z0-9_]+)\((.*)", line)
        if not found:
            continue  # the second half of a call that was interrupted, or the end of a process
        name, arguments = found[1], found[2]
        for folder in folders:
            if f'"{folder}.begin"' in arguments:
                now = folder
            if f'"{folder}.end"' in arguments:
                now = ""
        if not now or not re.search(re.escape(now) + r'["/>]', arguments):
            continue
        if name in READING or is_reading(name, arguments):
            continue
        if name == "unlinkat" and "AT_REMOVEDIR" in arguments:
            name = "rmdir"
        calls[now].append({**KINDS, "unlinkat": "unlink"}.get(name, name))
    return calls


def is_reading(name: str, arguments: str) -> bool:
    """Whether a call that can change a file was made so that it does not."""
    if name in ("open", "openat"):
        return re.search(r"O_(CREAT|TRUNC|WRONLY|RDWR)", arguments) is None
    return name == "mmap" and not ("PROT_WRITE" in arguments and "MAP_SHARED" in arguments)
