"""`datagen relabel`: label a run by other parameters, from its stored distances and visibilities."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from datagen.console.command_lines import resumable
from datagen.console.options import AsJson, RunPath
from datagen.console.printing import counted, print_lines
from datagen.jobs.job_report import print_job
from datagen.jobs.relabelling import relabel_run, relabelled_specification
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.specification import Distance
from datagen.schemas.storage import open_storage


def relabel(
    run: RunPath,
    /,
    *,
    out: str,
    mu: float | None = None,
    sigma_l: float | None = None,
    sigma_r: float | None = None,
    d_min: float | None = None,
    d_max: float | None = None,
    a: float | None = None,
    alpha: float | None = None,
    tau: float | None = None,
    distance: Distance | None = None,
    config: Path | None = None,
    json: AsJson = False,
) -> int:
    """Label a heuristic run by other parameters of the rule, without rendering.

    Distances are in metres, or shares of the reach with --distance planar-over-reach or mount-over-reach.
    Parameters that are not given stay as in the run; an option overrides the file. The new run equals that of
    `datagen submit heuristic --scenes-from RUN`, and has copies of all arrays except labels, scores and ids.
    The same command again resumes it, or extends it after the run has grown. The parts of a merged run are
    relabelled one by one.

    For example: datagen relabel runs/first --tau 0.6 --out runs/stricter

    Args:
        out: Folder or s3:// address of the new run.
        mu: Distance of the peak of the distance score.
        sigma_l: Width of the distance score below mu.
        sigma_r: Width of the distance score above mu.
        d_min: Smallest distance with a score.
        d_max: Largest distance with a score.
        a: Height of the peak of the distance score.
        alpha: Weight of the visibility score; the distance score has 1 - alpha.
        tau: Smallest score H of a positive label.
        distance: Distance that the score depends on.
        config: TOML file with the section [heuristic].
    """
    given = {
        "a": a, "mu": mu, "sigma_l": sigma_l, "sigma_r": sigma_r, "d_min": d_min, "d_max": d_max,
        "alpha": alpha, "tau": tau, "distance": distance,
    }  # fmt: skip
    options = {f"heuristic.{name}": value for name, value in given.items() if value is not None}
    source = Run.open(run)
    spec = relabelled_specification(source, options, config)
    if spec.heuristic == source.manifest.spec.heuristic:
        problem = "has these parameters already"
        raise InputError(run, "heuristic", problem, "Give another parameter, such as --tau, or --config")
    storage = open_storage(out)
    words = sys.argv[1:]
    with resumable(words):
        done = replace(relabel_run(storage, source, spec, json), path=out, resume=tuple(words))
    code = print_job(done, json=json)
    if done.remaining and not json and done.end == "complete":
        print_lines(f"{counted(done.remaining, 'shard')} that {run} lacks: make them, then relabel again")
    return code
