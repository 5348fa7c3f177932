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
from datagen.workers.robots import ROBOTS, robot_source

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
    settlers = {"sapien": SAPIEN_PHYSICS, "pybullet": PYBULLET}
    if installed := [name for name in settlers if find_spec(name)]:
        fix = f"Install the libraries named above, or: {_AGAIN} {' '.join(installed)}"
        yield Check("settlers", partial(_any_of, {name: settlers[name] for name in installed}), fix, "fail")
    if find_spec("embreex"):
        yield Check("embree", partial(_probe, EMBREE), f"{_AGAIN} embreex", "fail")
    if find_spec("ray"):
        yield Check("ray", partial(_probe, RAY), f"{_AGAIN} ray; or use --workers 0.")
    if not EXTRAS["sim"].missing():
        again = f"{_AGAIN} numba coal mani-skill"
        yield Check("arm libraries", partial(_probe, LIBRARIES), f"Plan and sim labels need them. {again}")
        for name in ROBOTS:
            from_sim = robot_source(name).keys.urdf.startswith("package:mani_skill/")
            if from_sim or not EXTRAS["robots"].missing():  # the line of the extra says that it is missing
                code = ROBOT.format(name=name)
                yield Check(f"robot {name}", partial(_probe, code), f"Use another --robot, or: {again}")
        fix = "See the settlers and robots above; plan labels need no physics."
        yield Check("grasp trial", partial(_probe, TRIAL), fix)


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


def _probe(code: str) -> str:
    answer = probe(code)
    if not answer.succeeded:
        raise Problem(answer.text)
    return answer.text


def _any_of(codes: dict[str, str]) -> str:
    """One working settler is enough: a broken one beside it is a warning."""
    answers = {name: probe(code) for name, code in codes.items()}
    text = "; ".join(a.text if a.succeeded else f"{name}: {a.text}" for name, a in answers.items())
    if not all(answer.succeeded for answer in answers.values()):
        raise Problem(text, "warn" if any(answer.succeeded for answer in answers.values()) else "fail")
    return text


def as_table(findings: list[Finding]) -> Table:
    """A table with one row per finding; the fix is below it."""
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for each in findings:
        # Text, because brackets in paths and messages are not markup.
        detail = Text(each.detail)
        if each.fix:
            detail.append(f"\n-> {each.fix}", style="cyan")
        table.add_row(Text(each.status, style=_COLOURS[each.status]), each.name, detail)
    return table


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
        console.print(as_table(findings))
        warnings = sum(each.status == "warn" for each in findings)
        verdict = "labels can be made here" if not failures else "labels cannot be made here yet"
        console.print(f"\n{verdict}: {failures} failed, {warnings} warned")
    return 1 if failures else 0


SAPIEN_PHYSICS = """
import importlib, importlib.metadata
sapien = importlib.import_module("sapien")
scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
builder = scene.create_actor_builder()
builder.add_box_collision(half_size=[0.05, 0.05, 0.05])
builder.initial_pose = sapien.Pose([0, 0, 1])
actor = builder.build(name="cube")
scene.step()
assert actor.pose.p[2] < 1.0, "the cube does not fall"
print("sapien " + importlib.metadata.version("sapien") + ", a cube falls")
"""

PYBULLET = """
import importlib, importlib.metadata
p = importlib.import_module("pybullet")
p.connect(p.DIRECT)
p.setGravity(0, 0, -9.81)
shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.05, 0.05, 0.05])
body = p.createMultiBody(1.0, shape, basePosition=[0, 0, 1])
p.stepSimulation()
assert p.getBasePositionAndOrientation(body)[0][2] < 1.0, "the cube does not fall"
print("pybullet " + importlib.metadata.version("pybullet") + ", a cube falls")
"""

EMBREE = """
import importlib.metadata
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
scene = EmbreeScene()
TriangleMesh(scene, np.array([[[-1, -1, 0], [1, -1, 0], [0, 1, 0]]], np.float32))
origin = np.array([[0, 0, 1]], np.float32)
hit = scene.run(origin, np.array([[0, 0, -1]], np.float32))
miss = scene.run(origin, np.array([[0, 0, 1]], np.float32))
assert hit[0] == 0 and miss[0] == -1, "a ray cast has a wrong result"
print("embreex " + importlib.metadata.version("embreex") + ", a ray hits")
"""

RAY = """
import importlib
ray = importlib.import_module("ray")
print("ray " + ray.__version__)
"""
LIBRARIES = """
import importlib, importlib.metadata, importlib.util
numba = importlib.import_module("numba")
coal = importlib.import_module("coal")
assert numba.njit(lambda a, b: a + b)(1.0, 2.0) == 3.0, "machine code adds wrongly"
near, far = coal.Transform3s(), coal.Transform3s()
far.setTranslation(importlib.import_module("numpy").array([3.0, 0.0, 0.0]))
ball = coal.Sphere(1.0)
hits = lambda other: coal.collide(ball, near, ball, other, coal.CollisionRequest(), coal.CollisionResult())
assert hits(near) and not hits(far), "the collision check of two balls is wrong"
print("numba " + numba.__version__ + ", coal " + importlib.metadata.version("coal"))
"""
ROBOT = """
from datagen.workers.robots import open_robot, robot_limits
limits = robot_limits({name!r})
robot = open_robot({name!r}, limits.reach_m[1], (limits.base_height_m or (0.5,))[0])
home = robot.homes_rad[0]
assert not robot.collides_itself(home), "the first tucked pose touches itself"
hand = robot.gripper
print(f"{{len(home)}} joints, reach {{robot.reach_m:.3f}} m, hand opens {{hand.max_opening_m:.3f}} m")
"""
TRIAL = """
from datagen.doctor.lift import main
raise SystemExit(main())
"""
# Several times the usual duration: files may be read for the first time, and the cores may be busy.
_DEADLINE_S = 120.0


@dataclass(frozen=True)
class Probe:
    """The result of a probe: its last line of output, or why there is none."""

    succeeded: bool
    text: str


def probe(code: str, timeout_s: float = _DEADLINE_S) -> Probe:
    """Run Python code in a new interpreter."""
    command = [sys.executable, "-W", "ignore", "-c", code]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=timeout_s, check=False
        )
    except subprocess.TimeoutExpired:
        return Probe(False, f"no result within {timeout_s:.0f} s")
    if done.returncode < 0:
        return Probe(False, f"crashed with {signal.Signals(-done.returncode).name}")
    said = (done.stderr if done.returncode else done.stdout).strip().splitlines()
    return Probe(done.returncode == 0, said[-1][:200] if said else f"exit code {done.returncode}")
