"""What any history of runs must leave, as plain dictionaries: the model of test_state_machine.py.

The model knows for each place which scenes of which specification are committed, how many samples are
wanted, what is in quarantine and what is sealed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from datagen.schemas.fields import SCHEMAS, sized_schema
from datagen.schemas.identity import sample_ids
from datagen.schemas.run_records import Layout
from datagen.schemas.specification import HeuristicParams, Specification
from datagen.workers.labels import distance_visibility_score, load_label_source
from tests.made_runs import small_spec, tables_of

LAYOUT = Layout(scenes_per_shard=1, candidates_per_scene=2)
PER_SHARD = LAYOUT.samples_per_shard
RULES = {"": HeuristicParams(), "near": HeuristicParams(mu=0.3), "far": HeuristicParams(mu=0.9, tau=0.2)}

# Every column would cost four times the time and show nothing more of the protocol.
_KEPT = {
    "scene_index", "redraws", "house_id", "points_m",
    "sample_id", "sample_scene_index", "candidate_index", "arm_reach_m", "distance_m", "mount_distance_m",
    "visibility", "heuristic_score", "label", "label_version",
}  # fmt: skip
SMALL = replace(
    SCHEMAS["heuristic"],
    scene_fields=tuple(f for f in SCHEMAS["heuristic"].scene_fields if f.name in _KEPT),
    sample_fields=tuple(f for f in SCHEMAS["heuristic"].sample_fields if f.name in _KEPT),
)


@dataclass(frozen=True)
class Part:
    """What the model knows of one run: its specification is named by a seed and a rule."""

    n: int
    committed: frozenset[int] = frozenset()
    quarantined: frozenset[int] = frozenset()

    @property
    def planned(self) -> range:
        return range(-(-self.n // PER_SHARD))

    @property
    def missing(self) -> list[int]:
        return sorted(set(self.planned) - self.committed - self.quarantined)


@dataclass
class Place:
    """A folder, and what it must hold. `sealed` is what the store was laid over."""

    folder: Path
    parts: dict[tuple[int, str], Part]
    sealed: dict[tuple[int, str], Part] | None = None

    @property
    def rule(self) -> str:
        return next(iter(self.parts))[1]

    @property
    def has_lost(self) -> bool:
        """Whether the store has rows of a shard that is not committed now."""
        held = self.sealed or {}
        return any(
            part.committed & set(part.planned) - self.parts[key].committed for key, part in held.items()
        )


# Specifications by seed and rule; those of relabelled runs come from the program.
SPECS: dict[tuple[int, str], Specification] = {}


def specification(seed: int, rule_name: str) -> Specification:
    """The drawn run of a seed, or that run relabelled by another rule."""
    if not rule_name and (seed, "") not in SPECS:
        SPECS[seed, ""] = small_spec(seed, engines={"labels": str(load_label_source("heuristic").version)})
    return SPECS[seed, rule_name]


@cache
def hash_of(seed: int, rule_name: str) -> str:
    """The hash of that specification, which a seed and a rule decide."""
    return specification(seed, rule_name).hash()


def united(one: Part, other: Part) -> Part:
    """What a merge of two runs of one specification holds."""
    committed = one.committed | other.committed
    return Part(max(one.n, other.n), committed, (one.quarantined | other.quarantined) - committed)


def expected_rows(sealed: dict[tuple[int, str], Part]) -> tuple[Any, Any]:
    """(ids, labels) that a store over these parts must hold, from the drawn rows alone."""
    ids, labels = [], []
    order = sorted(sealed, key=lambda key: hash_of(*key))
    with_rows = [key for key in order if sealed[key].committed & set(sealed[key].planned)]
    for key in with_rows:
        part = sealed[key]
        for shard in sorted(part.committed & set(part.planned)):
            rows = drawn_rows(key[0], shard)
            label = rows["label"]
            if key[1]:
                d, mount, reach, rho = (
                    rows[k] for k in ("distance_m", "mount_distance_m", "arm_reach_m", "visibility")
                )
                _, label = distance_visibility_score.heuristic(d, mount, reach, rho, RULES[key[1]])
            # Only the end of the store is cut: that of the last run with rows.
            kept = min(part.n - shard * PER_SHARD, PER_SHARD) if key == with_rows[-1] else PER_SHARD
            ids.append(sample_ids(hash_of(*key), shard, np.arange(PER_SHARD))[:kept])
            labels.append(label[:kept])
    return np.concatenate(ids), np.concatenate(labels)


@cache
def drawn_rows(seed: int, shard: int) -> Any:
    spec = specification(seed, "")
    return tables_of(sized_schema("heuristic", spec), LAYOUT, seed, shard, hash_of(seed, ""))[1]
