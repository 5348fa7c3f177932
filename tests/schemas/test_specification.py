"""Specifications, ids and random streams: strict, and hashed over all that changes a sample."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pydantic import ValidationError

from datagen.configuration.specify import layout_of
from datagen.schemas.fields import SCHEMAS, Field
from datagen.schemas.identity import Stream, digest_of, generator, sample_ids
from datagen.schemas.specification import CandidateParams, Source, Specification

SOURCES = {"houses": Source(kind="a", digest="1" * 64), "objects": Source(kind="b", digest="2" * 64)}
SPEC = Specification.model_validate(SOURCES)


def test_every_part_moves_the_hash() -> None:
    changes: tuple[dict[str, Any], ...] = (
        {"seed": 1}, {"split": "val"}, {"label_source": "plan"}, {"engines": {"sapien": "4"}},
        {"houses": Source(kind="a", digest="3" * 64)}, {"scene": {"n_clutter": 5}},
        {"settle": {"engine": "pybullet"}}, {"observation": {"noise": {"enabled": True}}},
        {"candidates": {"per_scene": "grid"}}, {"visibility": {"window_px": 32}}, {"heuristic": {"mu": 0.5}},
    )  # fmt: skip
    again = Specification.model_validate_json(SPEC.model_dump_json())
    assert again == SPEC and again.hash() == SPEC.hash()
    hashes = {Specification.model_validate(SOURCES | change).hash() for change in changes}
    assert len(hashes | {SPEC.hash()}) == len(changes) + 1


NONSENSE: tuple[dict[str, Any], ...] = (  # what test_bad_input.py does not give
    {"seed": 2**63}, {"houses": {"kind": "a", "digest": "xyz"}}, {"settle": {"timestep_s": 0}},
    # Trials that would take for ever, or lift nothing.
    {"arm": {"trial": {"timestep_s": 1e-9}}}, {"arm": {"trial": {"control_period_s": 1e-9}}},
    {"arm": {"trial": {"timestep_s": 0.02, "control_period_s": 0.01}}},
    {"arm": {"motion": {"check_step_rad": 1e-300}}}, {"arm": {"motion": {"lift_m": 0}}},
    {"arm": {"motion": {"lift_m": 100}}}, {"arm": {"motion": {"pregrasp_m": 100}}},
    {"candidates": {"yaw_rad": {"low": 0.2, "high": 0.1}}},
    {"candidates": {"yaw_rad": {"low": -4.0, "high": 0.0}}},
    {"candidates": {"footprint_m": [[1, 1], [1, -1], [2, 0]]}},
    {"candidates": {"footprint_m": [[1, 0], [-1, 0]]}},
    {"candidates": {"footprint_m": [[1, 0], [0, 0], [-1, 0]]}},
    {"arm": {"motion": {"margin_m": 100}}}, {"arm": {"disturbance": {"mass_scale": {"low": 0, "high": 1}}}},
)  # fmt: skip


@pytest.mark.parametrize("bad", NONSENSE)
def test_nonsense_is_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        Specification.model_validate(SOURCES | bad)


@given(st.floats(0.05, 2.0), st.floats(0.05, 0.6))
def test_bases_are_scaled_below_the_reach_of_the_panda(reach_m: float, radius_m: float) -> None:
    alike, scaled = (CandidateParams(base_radius_m=radius_m, scaled_base=s) for s in (None, True))
    assert alike.radius_of_base_m(reach_m) == radius_m
    assert scaled.radius_of_base_m(reach_m) == pytest.approx(radius_m * min(1.0, reach_m / 0.855))
    np.testing.assert_array_equal(scaled.radius_of_base_m(np.array([0.855, 1.0])), [radius_m, radius_m])


@given(st.integers(1, 10**7))
@example(180_000)
def test_a_layout_holds_n_and_wastes_less_than_a_shard(n: int) -> None:
    layout = layout_of(SPEC, n)
    shards = layout.shards_for(n)
    assert (shards - 1) * layout.samples_per_shard < n <= shards * layout.samples_per_shard
    assert 1 <= layout.scenes_per_shard <= 500  # a minute of work
    assert n != 180_000 or (layout.scenes_per_shard, shards * layout.samples_per_shard) == (40, n)


@pytest.mark.parametrize("name", sorted(SCHEMAS))
def test_names_of_both_tables_and_of_dimensions_do_not_collide(name: str) -> None:
    schema = SCHEMAS[name]
    fields: list[Field] = [*schema.scene_fields, *schema.sample_fields]
    names = [f.name for f in fields]
    assert len(set(names)) == len(names)
    assert not set(names) & ({"scene", "sample"} | {d for f in fields for d in f.dims})
    assert all(d in schema.sizes for f in fields for d in f.dims)
    assert all(f.doc for f in fields)


def draws(seed: int, stream: Stream, scene: int, retry: int) -> list[int]:
    return generator(seed, stream, scene, retry).integers(2**32, size=3).tolist()


def test_recorded_draws_have_not_moved() -> None:
    assert draws(0, Stream.SCENE, 0, 0) == [1957847465, 2588842716, 3986200875]
    assert draws(0, Stream.CANDIDATES, 7, 2) == [3536547021, 37485500, 377380517]
    assert generator(7, Stream.SCENE, 0, 0).random(2).tolist() == [0.6357160003790892, 0.5442333481490879]


def test_recorded_ids_and_digests_have_not_moved() -> None:
    ids = sample_ids("00" * 32, 3, np.array([0, 41]))
    assert ids.shape == (2, 16)
    assert bytes(ids[1]).hex() == "e80bc8de6edaea318d3aa8eb6852eb16"
    assert digest_of({"b": 1.5, "a": [1, "x"]}).startswith("5efd1c99acaa74c2f0c237017fb8919d")
