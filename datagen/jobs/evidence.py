"""The costs of made shards that a forecast rests on: those of a run itself, or of an earlier one like it."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.cluster.attempt_guard import this_host
from datagen.cluster.run_forecast import BETWEEN_JOBS, MadeShard, SeenCosts, worker_name
from datagen.schemas.errors import InputError
from datagen.schemas.keys import commit_key
from datagen.schemas.record_files import MAX_RECORD_BYTES
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit, Manifest

# With fewer commits than this of another run, a pilot gives more evidence.
_ENOUGH = 4
_MOST_READ, _MOST_RUNS = 256, 200


@dataclass(frozen=True)
class Evidence:
    """The costs of made shards, and their origin.

    `start_s`: from the command to its first shard. `known`: the job makes them again.
    """

    text: str
    costs: SeenCosts
    start_s: float
    known: bool = False


def made_here(run: Run) -> list[MadeShard]:
    """The run's shards that this machine made, in order of time; a sample of them for a large run."""
    shards, here = sorted(run.committed()), this_host()
    step = -(-len(shards) // _MOST_READ) or 1
    commits: list[Commit] = []
    read = run.storage.get_many(map(commit_key, shards[::step]), MAX_RECORD_BYTES)
    for shard, (_, data) in zip(shards[::step], read, strict=True):
        with suppress(InputError):  # `verify` reports a damaged one
            # A relabelled shard does not show the cost of making labels.
            if data and not (commit := run.decode_commit(shard, data)).cost.source_s:
                commits.append(commit)
    commits = [commit for commit in commits if commit.host.name == here.name]
    return [made_shard(commit) for commit in sorted(commits, key=lambda commit: commit.created)]


def costs_of(run: Run) -> SeenCosts:
    """The costs of the run's shards that this machine made."""
    costs = SeenCosts(BETWEEN_JOBS)
    for shard in made_here(run):
        costs.add(shard)
    return costs


def made_shard(commit: Commit) -> MadeShard:
    """The cost of a shard, from its commit.

    Writing takes about as long for one scene as for 32, and each array has one metadata file.
    """
    return MadeShard(
        commit.scenes,
        commit.cost,
        worker_name(commit.host),
        fixed_cpu_s=commit.cost.stage_cpu_s.get("write", 0.0),
        fixed_wall_s=commit.cost.stage_wall_s.get("write", 0.0),
        fixed_bytes=sum(file.size for file in commit.files if file.path.endswith("zarr.json")),
    )


def earlier_run(out: str, manifest: Manifest) -> tuple[Run, SeenCosts] | None:
    """The newest run of the same kind that this machine has made in the folder of `out`.

    Runs of the same kind have the same specification except for seed and source of the scenes.
    """
    if "://" in out:
        return None
    folder = Path(out).expanduser().absolute().parent
    found: list[Run] = []
    with suppress(OSError):
        for path in sorted(folder.iterdir())[:_MOST_RUNS]:
            if (path / "manifest.json").is_file():
                with suppress(InputError):
                    run = Run.open(path)
                    if _kind(run.manifest) == _kind(manifest):
                        found.append(run)
    for run in sorted(found, key=lambda run: run.manifest.created, reverse=True):
        with suppress(InputError):
            costs = costs_of(run)
            if costs.seen >= _ENOUGH:
                return run, costs
    return None


def own_costs(run: Run) -> SeenCosts | None:
    """The costs of the run's own shards, where there are enough of them."""
    costs = costs_of(run)
    return costs if costs.seen >= _ENOUGH else None


def _kind(manifest: Manifest) -> dict[str, Any]:
    fields = manifest.spec.model_dump(mode="json", exclude={"seed", "scenes_from"})
    size = manifest.layout.candidates_per_scene
    return fields | {"again": manifest.spec.scenes_from is not None, "per_scene": size}
