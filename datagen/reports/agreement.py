"""Labels of runs as arrays, and how far runs agree on the same candidates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.console.command_lines import command_line
from datagen.schemas.fields import OUTCOMES
from datagen.schemas.run import MOST_SAMPLES, Run
from datagen.schemas.shard_reading import read_committed
from datagen.schemas.specification import Specification
from datagen.train.bootstrap import Estimate
from datagen.workers.bases.candidate_sets import Bools, in_set, within_reach

# In ascending fidelity: the later of two is the reference for the earlier.
_FIDELITY = ("heuristic", "plan", "sim")
_RESAMPLES = 1000
_FEW, _CAUSES = 50, 3
_COLUMNS = (
    *("sample_scene_index", "candidate_index", "label", "base_is_clear", "mount_distance_m", "arm_reach_m"),
)


@dataclass(frozen=True, eq=False)
class Labels:
    """All committed candidates of a run, also beyond its n. Arrays are (N,)."""

    run: Run
    scene: npt.NDArray[np.int64]
    candidate: npt.NDArray[np.int64]
    label: Bools
    within_reach: Bools  # the base is clear and the target within the arm's reach
    outcome: npt.NDArray[np.uint8] | None  # code of OUTCOMES; None where the label has no cause

    def outcomes(self) -> dict[str, int]:
        """Candidates within reach by outcome, the most frequent first."""
        if self.outcome is None:
            return {}
        counts = np.bincount(self.outcome[self.within_reach], minlength=len(OUTCOMES)).tolist()
        found = {name: count for name, count in zip(OUTCOMES, counts, strict=True) if count}
        return dict(sorted(found.items(), key=lambda item: -item[1]))


def read_labels(run: Run) -> Labels:
    """Read the labels of a run. InputError for a damaged file."""
    has_outcome = any(field.name == "outcome" for field in run.schema.sample_fields)
    names = [*_COLUMNS, *(["outcome"] if has_outcome else [])]
    shards = [
        read_committed(run, commit, names, rows)
        for commit in run.commits()
        if (rows := run.rows_of(commit.shard, MOST_SAMPLES)).scenes
    ]

    def joined(name: str) -> Any:
        return np.concatenate([np.zeros(0, np.uint8), *(shard[name] for shard in shards)])

    sizes_m = joined("mount_distance_m"), joined("arm_reach_m")
    near = within_reach(run.manifest.spec.candidates, *sizes_m)
    return Labels(
        run=run,
        scene=joined("sample_scene_index").astype(np.int64),
        candidate=joined("candidate_index").astype(np.int64),
        label=joined("label") == 1,
        within_reach=in_set("in-range", joined("base_is_clear") == 1, near),
        outcome=joined("outcome") if has_outcome else None,
    )


def doubt(labels: Labels) -> str:
    """A question about the robot where none of at least 50 labels of a run of plans is positive; else ""."""
    n, manifest = len(labels.label), labels.run.manifest
    if labels.outcome is None or manifest.spec.arm is None or n < _FEW or labels.label.any():
        return ""
    counts = np.bincount(labels.outcome, minlength=len(OUTCOMES))
    most = [k for k in np.argsort(-counts, kind="stable")[:_CAUSES].tolist() if counts[k]]
    causes = ", ".join(f"{tuple(OUTCOMES)[k]} {counts[k]:,}" for k in most)
    robot = manifest.sources.get("robot") or manifest.spec.arm.robot
    see = command_line(["robot", robot])
    told = f"none of {n:,} labels is positive ({causes}): is robot {robot} right?"
    return f"{labels.run.storage.url}: {told} See: {see}"


def fidelity(spec: Specification) -> tuple[int, bool]:
    """Rank of a specification's labels: heuristic, plan, sim, disturbed sim."""
    known = spec.label_source in _FIDELITY
    return (_FIDELITY.index(spec.label_source) if known else 0, spec.is_disturbed)


def agreements(runs: Sequence[Labels]) -> list[dict[str, Any]]:
    """The share of equal labels of every two runs over the same candidates, within reach.

    `runs` are in ascending fidelity; the later of two is the reference.
    """
    found: list[dict[str, Any]] = []
    for first, second in combinations(runs, 2):
        specs = first.run.manifest.spec, second.run.manifest.spec
        if specs[0].scenes_hash == specs[1].scenes_hash and specs[0] != specs[1]:
            runs_of = {"run": first.run.storage.url, "reference_run": second.run.storage.url}
            names = {"labels": _name(specs[0]), "reference": _name(specs[1])}
            found.append(runs_of | names | equal_share(first, second))
    return found


def _name(spec: Specification) -> str:
    return f"{spec.label_source} disturbed" if spec.is_disturbed else spec.label_source


def equal_share(first: Labels, second: Labels) -> dict[str, Any]:
    """Count and share of equal labels of the candidates within reach that both have, with its interval.

    The interval is that of 1,000 resamples of scenes, since candidates of a scene are correlated.
    """
    # A scene has fewer than 2^32 candidates.
    keys = [side.scene * 2**32 + side.candidate for side in (first, second)]
    _, a, b = np.intersect1d(*keys, assume_unique=True, return_indices=True)
    near = second.within_reach[b]
    a, b = a[near], b[near]
    both = first.label[a] + 2 * second.label[b].astype(np.int64)
    neither, only_first, only_reference, good = np.bincount(both, minlength=4).tolist()
    counts = {"both": good, "neither": neither, "only_first": only_first, "only_reference": only_reference}
    if not len(a):
        return {"candidates": 0, "scenes": 0, "counts": counts, "equal_share": None, "interval": None}
    _, row = np.unique(second.scene[b], return_inverse=True)
    equal, of = np.bincount(row, first.label[a] == second.label[b]), np.bincount(row)
    rng, n = np.random.default_rng(0), len(of)
    drawn = (rng.integers(0, n, n) for _ in range(_RESAMPLES))
    resamples = np.array([equal[scenes].sum() / of[scenes].sum() for scenes in drawn])
    share = float(equal.sum() / len(a))
    interval = list(Estimate(share, resamples, n).interval()) if n > 1 else None
    return {"candidates": len(a), "scenes": n, "counts": counts, "equal_share": share, "interval": interval}
