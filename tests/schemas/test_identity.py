"""Identities and streams: they are data, so their values are recorded here."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from datagen.schemas.identity import Stream, digest_of, generator, sample_ids

seeds = st.integers(0, 2**63 - 1)


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


@given(seeds, st.integers(0, 10**6), st.integers(0, 50))
def test_streams_scenes_and_retries_are_independent(seed: int, scene: int, retry: int) -> None:
    here = draws(seed, Stream.SCENE, scene, retry)
    others = [
        draws(seed, Stream.OBSERVE, scene, retry),
        draws(seed, Stream.SCENE, scene + 1, retry),
        draws(seed, Stream.SCENE, scene, retry + 1),
        draws(seed ^ 1, Stream.SCENE, scene, retry),
    ]
    assert here not in others
    assert draws(seed, Stream.SCENE, scene, retry) == here


@given(st.integers(0, 10**9), st.lists(st.integers(0, 10**5), min_size=1, max_size=20, unique=True))
def test_ids_depend_on_nothing_but_specification_scene_and_candidate(scene: int, rows: list[int]) -> None:
    ids = sample_ids("ab" * 32, scene, np.array(rows))
    again = [sample_ids("ab" * 32, scene, np.array([row]))[0] for row in rows]
    np.testing.assert_array_equal(ids, again)
    assert len(np.unique(ids, axis=0)) == len(rows)
    assert (ids != sample_ids("ac" * 32, scene, np.array(rows))).any()
