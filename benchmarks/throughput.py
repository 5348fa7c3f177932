"""The main path from a specification to committed, sealed labels: rates, scaling, memory and size.

    python -m benchmarks.throughput [--houses procthor:DIR] [--objects ycb:DIR] [--n 24000]
                                    [--scenes 2000] [--arm-scenes 24] [--quick]

Whole runs through the functions of `datagen submit`, with Ray and a real store in a temporary
folder; all figures come from the commit records. The steady rate of a job is the sum over its workers of
labels per second from each worker's first commit to its last: it leaves out the start of Ray and
the opening of sources, which are listed with it. Jobs of `plan` and `sim` label whole grids, which are
mostly furniture and distance, and candidates within reach, 15 a scene. The first run on a machine also
computes the grasps of the objects that it draws, later ones read them from the cache.
"""

from __future__ import annotations

import argparse
import os
import stat
import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from datagen.configuration.specify import layout_of, manifest_of, specify
from datagen.jobs.job import Job as LabelJob
from datagen.jobs.job import JobOptions, JobRun
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit
from datagen.schemas.sealing import seal
from datagen.schemas.storage import open_storage
from datagen.workers.houses import open_houses
from datagen.workers.objects import open_objects

WANTED = 180_000
CANDIDATES = 60
IN_REACH = 15  # candidates a scene of the jobs within reach


@dataclass(frozen=True)
class Job:
    """Cost of one run. Times are wall seconds unless named CPU."""

    labels: int
    scenes: int
    whole_s: float  # Ray start, all shards, seal
    ray_s: float  # start and end of the cluster
    seal_s: float
    opening_s: float  # extra time of a worker's first attempt over its others
    steady_per_s: float  # labels
    cpu_per_label_s: float
    core_share: float  # CPU seconds per wall second of a worker in an attempt
    write_share: float  # of a worker's steady time: encoding and writing a shard
    between_share: float  # of a worker's steady time: commit, report and dispatch of the next attempt
    peaks_bytes: tuple[int, ...]  # peak resident memory of each attempt of the busiest worker, in order
    stored_bytes: int
    disk_bytes: int  # with the blocks of files and folders
    workers: int
    stage_s: dict[str, float]  # wall seconds of all workers in each stage
    positives: int
    executed: int  # trials in physics


def run(
    options: argparse.Namespace,
    n: int,
    workers: int,
    per_scene: int | str,
    source: str = "heuristic",
    within: str | None = None,
) -> Job:
    """Make and seal n labels in a new folder and account for them."""
    houses, objects = open_houses(options.houses), open_objects(options.objects)
    fields: dict[str, Any] = {
        "seed": options.seed,
        "candidates.per_scene": per_scene,
        "candidates.within": within,
        "scene.places": {},  # open tops
    }
    if per_scene == "grid":
        fields["candidates.robots_per_scene"] = 1
    spec = specify(source, houses, objects, fields, None)
    with tempfile.TemporaryDirectory(dir=options.folder, prefix="datagen-throughput-") as folder:
        out = f"{folder}/run"
        manifest = manifest_of(
            spec, layout_of(spec, n), {"houses": options.houses, "objects": options.objects}
        )
        made = Run.create_or_open(open_storage(out), manifest, n)
        work = JobRun(made, absolute(options.houses), absolute(options.objects))
        job = LabelJob(made.storage, out, [work], JobOptions(workers=workers), time.monotonic())
        started_s = time.perf_counter()
        summary = job.make_missing(job.record(missing := job.missing()), missing)
        ended_s = time.perf_counter()
        if summary.end != "complete":
            raise InputError(out, "", f"the job ended {summary.end}: {summary.cause}", "Fix that first")
        seal(made.storage)
        sealed_s = time.perf_counter()
        commits = sorted(made.commits(), key=lambda c: c.created)
        return account(
            commits,
            Path(out),
            sealed_s - started_s,
            ended_s - started_s - summary.elapsed_s,
            sealed_s - ended_s,
            workers,
        )


def account(
    commits: Sequence[Commit], folder: Path, whole_s: float, ray_s: float, seal_s: float, workers: int
) -> Job:
    """The figures of a job from its commits, in order of time, and its folder."""
    by_worker: dict[int, list[Commit]] = defaultdict(list)
    for commit in commits:
        by_worker[commit.host.pid].append(commit)
    rate = write_s = steady_s = between_s = 0.0
    opening_s: list[float] = []
    for own in by_worker.values():
        if len(own) < 2:
            continue
        first, rest = own[0], own[1:]
        span_s = seconds_of(own[-1]) - seconds_of(first)
        rate += sum(c.samples for c in rest) / span_s
        steady_s += span_s
        write_s += sum(c.cost.stage_wall_s["write"] for c in rest)
        between_s += span_s - sum(c.cost.wall_s for c in rest)
        opening_s.append(first.cost.wall_s - statistics.median(c.cost.wall_s for c in rest))
    if not steady_s:
        raise InputError("--n", "", "no worker made two shards", "Ask for more labels")
    labels = sum(c.samples for c in commits)
    cpu_s, wall_s = sum(c.cost.cpu_s for c in commits), sum(c.cost.wall_s for c in commits)
    longest = max(by_worker.values(), key=len)
    stored, disk = sizes(folder)
    stage_s: dict[str, float] = defaultdict(float)
    for commit in commits:
        for stage, wall_s_of in commit.cost.stage_wall_s.items():
            stage_s[stage] += wall_s_of
    arrays = zarr.open_group(folder / "data.zarr", mode="r")
    return Job(
        labels=labels,
        scenes=sum(c.scenes for c in commits),
        whole_s=whole_s,
        ray_s=ray_s,
        seal_s=seal_s,
        opening_s=max(opening_s),
        steady_per_s=rate,
        cpu_per_label_s=cpu_s / labels,
        core_share=cpu_s / wall_s,
        write_share=write_s / steady_s,
        between_share=between_s / steady_s,
        peaks_bytes=tuple(c.cost.peak_rss_bytes for c in longest),
        stored_bytes=stored,
        disk_bytes=disk,
        workers=workers,
        stage_s=dict(stage_s),
        positives=sum(c.positives for c in commits),
        executed=int(np.asarray(arrays["attempts"]).sum()) if "attempts" in arrays else 0,
    )


def seconds_of(commit: Commit) -> float:
    """Time of the commit, seconds since the epoch."""
    return datetime.fromisoformat(commit.created).timestamp()


def sizes(folder: Path) -> tuple[int, int]:
    """Bytes in files, and bytes in blocks with those of folders; a hard link counts once."""
    entries = {s.st_ino: s for s in (p.lstat() for p in folder.rglob("*"))}.values()
    stored = sum(s.st_size for s in entries if stat.S_ISREG(s.st_mode))
    return stored, sum(s.st_blocks * 512 for s in entries)


def absolute(ref: str) -> str:
    """A source reference with its folder made absolute, as workers need it."""
    kind, colon, folder = ref.partition(":")
    return f"{kind}:{Path(folder).resolve()}" if colon else ref


def main() -> None:
    """Run the jobs and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--houses", default="builtin")
    parser.add_argument("--objects", default="builtin")
    parser.add_argument("--n", type=int, default=24_000, help="labels with 60 candidates; 0: none")
    parser.add_argument("--scenes", type=int, default=2000, help="scenes of the memory job; 0 leaves it out")
    parser.add_argument(
        "--arm-scenes", type=int, default=24, help="scenes of plan and sim; 0 leaves them out"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="where the runs are written [the temporary folder]")
    parser.add_argument(
        "--quick", action="store_true", help="96 scenes a job, 16 of plan and sim, no memory job"
    )
    options = parser.parse_args()
    if options.quick:
        options.n, options.scenes, options.arm_scenes = 96 * CANDIDATES, 0, min(options.arm_scenes, 16)
    scenes = -(-options.n // CANDIDATES)
    print(f"load of the machine before: {os.getloadavg()[0]:.1f} on {len(os.sched_getaffinity(0))} cores")
    if options.n:
        one = run(options, options.n, 1, CANDIDATES)
        two = run(options, options.n, 2, CANDIDATES)
        grid = run(options, scenes * 625, 2, "grid")
        print_jobs({"60, 1 worker": one, "60, 2 workers": two, "grid, 2 workers": grid})
        print_targets(one, two, grid)
    if options.arm_scenes:
        labels = options.arm_scenes * 625
        arms = {f"{source}, grid": run(options, labels, 2, "grid", source) for source in ("plan", "sim")}
        labels = options.arm_scenes * 2 * IN_REACH
        for source in ("plan", "sim"):
            arms[f"{source}, in range"] = run(options, labels, 2, IN_REACH, source, "in-range")
        print_jobs(arms)
        print_arms(*arms.values())
    if options.scenes:
        print_memory(run(options, options.scenes * CANDIDATES, 1, CANDIDATES))


def print_jobs(jobs: dict[str, Job]) -> None:
    """One row a job."""
    head = (
        "job",
        "labels",
        "labels/s",
        "steady",
        "CPU ms",
        "core",
        "Ray s",
        "open s",
        "seal s",
        "write",
        "between",
    )
    print("{:<16}{:>9}{:>10}{:>8}{:>8}{:>7}{:>7}{:>8}{:>8}{:>8}{:>9}".format(*head))
    for name, job in jobs.items():
        print(
            f"{name:<16}{job.labels:>9,}{job.labels / job.whole_s:>10,.0f}{job.steady_per_s:>8,.0f}"
            f"{1e3 * job.cpu_per_label_s:>8.3f}{100 * job.core_share:>6.0f}%{job.ray_s:>7.1f}"
            f"{job.opening_s:>8.1f}{job.seal_s:>8.2f}"
            f"{100 * job.write_share:>7.1f}%{100 * job.between_share:>8.1f}%"
        )
    print(
        "labels/s: with Ray's start, opening and sealing. steady: without. CPU ms: per label. core: share\n"
        "of a core that a busy worker got; well below 100% another program used the machine, and rates\n"
        "are too low. write, between: share of steady time; between covers commit, report and dispatch.\n"
    )


def print_targets(one: Job, two: Job, grid: Job) -> None:
    """Figures compared with their targets."""
    ratio = two.steady_per_s / one.steady_per_s
    writing = two.write_share + two.between_share
    per_label = two.stored_bytes / two.labels
    size = per_label * WANTED
    start_s = two.ray_s + two.opening_s
    rows = [
        ("labels/s, 60 candidates", f"{two.steady_per_s:,.0f}", ">= 500", two.steady_per_s >= 500),
        ("labels/s, whole grid", f"{grid.steady_per_s:,.0f}", ">= 1,500", grid.steady_per_s >= 1500),
        ("2 workers over 1", f"{ratio:.2f}", ">= 1.8", ratio >= 1.8),
        ("  CPU a label, 2 over 1", f"{two.cpu_per_label_s / one.cpu_per_label_s:.2f}", "", True),
        ("writing, committing", f"{100 * writing:.1f}%", "<= 5%", writing <= 0.05),
        ("stored bytes a label", f"{per_label:,.0f}", "", True),
        ("  with blocks of files", f"{two.disk_bytes / two.labels:,.0f}", "", True),
        (f"{WANTED:,} labels, size", f"{size / 1e6:,.0f} MB", "< 400 MB", size < 400e6),
        (f"{WANTED:,} labels, time", f"{(start_s + WANTED / two.steady_per_s) / 60:.1f} min", "", True),
    ]
    print(f"{'figure':<26}{'here':>10}{'target':>11}")
    for name, value, target, reached in rows:
        print(f"{name:<26}{value:>10}{target:>11}{'' if reached else '  MISSED'}")


def print_arms(plan: Job, sim: Job, plan_near: Job, sim_near: Job) -> None:
    """Cost of an arm's labels compared with targets, and the share of each stage."""
    execute_s = sim.stage_s["execute"] + sim_near.stage_s["execute"]
    trials_per_s = (sim.executed + sim_near.executed) / execute_s * sim.workers
    whole_s = sim.ray_s + sim.opening_s + 12_000 / sim.steady_per_s
    rows = [
        ("plan labels/s, grid", f"{plan.steady_per_s:,.0f}", ">= 400", plan.steady_per_s >= 400),
        ("sim labels/s, grid", f"{sim.steady_per_s:,.0f}", ">= 60", sim.steady_per_s >= 60),
        (
            "plan labels/s, in range",
            f"{plan_near.steady_per_s:,.0f}",
            ">= 150",
            plan_near.steady_per_s >= 150,
        ),
        ("sim labels/s, in range", f"{sim_near.steady_per_s:,.0f}", "", True),
        ("executed trials/s", f"{trials_per_s:,.1f}", ">= 45", trials_per_s >= 45),
        ("12,000 sim labels, time", f"{whole_s / 60:.1f} min", "<= 5 min", whole_s <= 300),
        ("trials executed", f"{sim.executed + sim_near.executed:,}", "", True),
        ("positive, plan", f"{100 * plan.positives / plan.labels:.1f}%", "", True),
        ("positive, sim", f"{100 * sim.positives / sim.labels:.1f}%", "", True),
        ("positive, plan in range", f"{100 * plan_near.positives / plan_near.labels:.1f}%", "", True),
        ("positive, sim in range", f"{100 * sim_near.positives / sim_near.labels:.1f}%", "", True),
    ]
    print(f"{'figure':<26}{'here':>10}{'target':>11}")
    for name, value, target, reached in rows:
        print(f"{name:<26}{value:>10}{target:>11}{'' if reached else '  MISSED'}")
    print("\nshare of the time of stages")
    jobs = {"plan": plan, "sim": sim, "plan in range": plan_near, "sim in range": sim_near}
    for name, job in jobs.items():
        total_s = sum(job.stage_s.values())
        shares = sorted(job.stage_s.items(), key=lambda item: -item[1])
        print(f"{name:<14}" + ", ".join(f"{stage} {100 * s / total_s:.0f}%" for stage, s in shares[:6]))
    print()


def print_memory(job: Job) -> None:
    """Peak resident memory of one worker's attempts, early against late."""
    later = job.peaks_bytes[1:]  # the first opens the sources
    quarter = max(1, len(later) // 4)
    first, last = statistics.median(later[:quarter]), statistics.median(later[-quarter:])
    print(f"\nworker memory over {job.scenes:,} scenes in {len(job.peaks_bytes)} shards, peak of a shard, MB")
    print(
        f"first quarter {first / 1e6:,.0f}, last quarter {last / 1e6:,.0f}: {100 * (last / first - 1):+.1f}%"
    )
    middle = statistics.median(later[2 * quarter : 3 * quarter] or later)
    print(
        f"third quarter {middle / 1e6:,.0f}, to the last {100 * (last / middle - 1):+.1f}%: what still grows"
    )
    points = [later[k * (len(later) - 1) // 9] / 1e6 for k in range(10)]
    print("along the way: " + " ".join(f"{p:,.0f}" for p in points))


if __name__ == "__main__":
    main()
