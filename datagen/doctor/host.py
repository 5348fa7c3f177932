"""Checks of the machine: interpreter, cores, memory, disks, limits, shared libraries, GPU."""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import psutil

from datagen.doctor.check import Check
from datagen.workers.content_cache import cache_folder

GIB = 2**30
CGROUP = Path("/sys/fs/cgroup")

# A worker with houses, meshes and an engine needs about half of this.
ENOUGH_MEMORY_BYTES = 2 * GIB
LEAST_MEMORY_BYTES = GIB // 2
# 180,000 labels fit in 400 MB; the sealed store shares their files by hard links.
ENOUGH_DISK_BYTES = 2 * GIB
LEAST_DISK_BYTES = 100 * 2**20
# Ray keeps its objects here and is slow without; containers often start with 64 MiB.
ENOUGH_SHM_BYTES = 256 * 2**20
ENOUGH_OPEN_FILES = 4096

# Library -> (what needs it, its Debian and Ubuntu package).
LIBRARIES = {
    "libX11.so.6": ("the SAPIEN settler and renderer", "libx11-6"),
    "libGL.so.1": ("the SAPIEN settler and renderer", "libgl1"),
    "libgthread-2.0.so.0": ("the SAPIEN settler and renderer", "libglib2.0-0"),
    "libgomp.so.1": ("the arm libraries, built with OpenMP", "libgomp1"),
}


def _gib(n_bytes: float) -> str:
    return f"{n_bytes / GIB:.1f} GiB"


def cgroup_limit(name: str, group: Path = CGROUP) -> str:
    """First word of a control-group file of this container; "" or "max" where there is no limit."""
    try:
        words = (group / name).read_text().split()
    except OSError:
        return ""
    return words[0] if words else ""


def cgroup_cores(group: Path = CGROUP) -> float | None:
    """Cores that the container may use on average (quota over period), None without a limit."""
    try:
        quota, period = (group / "cpu.max").read_text().split()
        return None if quota == "max" else int(quota) / int(period)
    except (OSError, ValueError, ZeroDivisionError):
        return None


def check_python() -> Check:
    """The interpreter; pip refuses one that is too old."""
    return Check("python", "ok", f"{platform.python_version()} at {sys.executable}")


def check_platform() -> Check:
    """System and processor; only Linux is tested."""
    detail = f"{platform.platform()}, {platform.machine()}"
    if sys.platform != "linux":
        return Check("platform", "warn", detail, "Only Linux is tested: use a Linux machine or container.")
    return Check("platform", "ok", detail)


def check_cores(group: Path = CGROUP) -> Check:
    """Cores of the machine, of this process's affinity mask and of its container."""
    total = os.cpu_count() or 1
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else total
    detail = f"{allowed} of {total} usable"
    quota = cgroup_cores(group)
    if quota is not None and quota < allowed:
        fix = f"Use --workers {max(1, int(quota))}, or raise the container's limit."
        return Check("cores", "warn", f"{detail}, limited to {quota:.1f} by the container", fix)
    return Check("cores", "ok", detail)


def check_memory(group: Path = CGROUP) -> Check:
    """Free memory, with the container's limit."""
    memory = psutil.virtual_memory()
    available = memory.available
    detail = f"{_gib(available)} of {_gib(memory.total)} free"
    limit = cgroup_limit("memory.max", group)
    if limit.isdigit():
        used = cgroup_limit("memory.current", group)
        available = min(available, int(limit) - (int(used) if used.isdigit() else 0))
        detail += f", container limit {_gib(int(limit))}"
    if available < LEAST_MEMORY_BYTES:
        return Check("memory", "fail", detail, "Close other programs, or raise the container's limit.")
    if available < ENOUGH_MEMORY_BYTES:
        return Check("memory", "warn", detail, "Use --workers 1, or free some memory.")
    return Check("memory", "ok", detail)


def check_disk(name: str, folder: Path, enough: int = ENOUGH_DISK_BYTES) -> Check:
    """Free space where `folder` lies."""
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        return Check(name, "warn", f"{folder}: {error.strerror}", "Create the folder, or mount it.")
    detail = f"{_gib(free)} free in {folder}"
    if free < LEAST_DISK_BYTES and name == "disk":
        return Check(name, "fail", detail, "Free some space, or work on another disk.")
    if free < enough:
        fix = "Free some space, or work on another disk."
        if name == "shared memory":
            fix = "Start the container with --shm-size=1g; without it Ray is slower."
        return Check(name, "warn", detail, fix)
    return Check(name, "ok", detail)


def check_open_files() -> Check:
    """The soft limit of open files; Ray opens hundreds for each worker."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    endless = resource.RLIM_INFINITY
    detail = "no limit" if soft == endless else f"{soft} (hard limit {'none' if hard == endless else hard})"
    if soft != endless and soft < ENOUGH_OPEN_FILES:
        return Check("open files", "warn", detail, "Raise it before starting: ulimit -n 65536")
    return Check("open files", "ok", detail)


def check_cache() -> Check:
    """Whether the cache folder, or the nearest folder above it that exists, can be written."""
    try:
        folder = cache_folder()
        existing = next(p for p in (folder, *folder.absolute().parents) if p.exists())
        with tempfile.TemporaryFile(dir=existing):
            return Check("cache", "ok", str(folder))
    except OSError as error:
        fix = "Set DATAGEN_CACHE to a writable folder; without one every worker parses all files again."
        return Check("cache", "warn", str(error), fix)


def check_libraries() -> list[Check]:
    """Shared libraries that wheels need from the system, each with its package."""
    checks: list[Check] = []
    for library, (lost, package) in LIBRARIES.items():
        try:
            ctypes.CDLL(library)
        except OSError:
            sudo = "" if os.geteuid() == 0 else "sudo "
            fix = f"{sudo}apt-get install -y {package}"
            checks.append(Check(library, "warn", f"missing; lost: {lost}", fix))
        else:
            checks.append(Check(library, "ok", "found"))
    return checks


def check_gpu() -> Check:
    """NVIDIA devices by name. None is needed: heuristic labels are made on the CPU."""
    program = shutil.which("nvidia-smi")
    if program is None:
        return Check("gpu", "ok", "none found; none is needed")
    query = [program, "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"]
    try:
        done = subprocess.run(query, capture_output=True, text=True, timeout=20, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return Check("gpu", "warn", f"nvidia-smi fails: {type(error).__name__}", "Check the driver.")
    names = "; ".join(line.strip() for line in done.stdout.splitlines() if line.strip())
    if done.returncode or not names:
        return Check("gpu", "warn", "nvidia-smi finds no device", "Check the driver, or ignore it.")
    return Check("gpu", "ok", names)


def host_checks() -> list[Check]:
    """All checks of this module."""
    checks = [check_python(), check_platform(), check_cores(), check_memory()]
    checks += [check_disk("disk", Path.cwd()), check_disk("temporary files", Path(tempfile.gettempdir()))]
    if sys.platform == "linux":
        checks.append(check_disk("shared memory", Path("/dev/shm"), ENOUGH_SHM_BYTES))
    return [*checks, check_open_files(), check_cache(), *check_libraries(), check_gpu()]
