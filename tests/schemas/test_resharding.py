"""Cutting shards smaller: in one step or in several, names, numbers and costs are the same."""

from __future__ import annotations

from math import fsum

import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.schemas.merging.plan import Cut, base_name, common_layout, rank
from datagen.schemas.run_records import AttemptStart, Cost, Layout

seconds = st.floats(0, 1e6)
attempt_names = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}", fullmatch=True)
costs = st.builds(
    Cost,
    wall_s=seconds,
    cpu_s=seconds,
    stage_wall_s=st.dictionaries(st.sampled_from(["draw", "settle"]), seconds),
    stage_gpu_s=st.dictionaries(st.just("label"), seconds),
    source_s=st.dictionaries(st.sampled_from(["wall", "cpu"]), seconds),
    peak_rss_bytes=st.integers(0, 2**40),
    written_bytes=st.integers(0, 2**40),
)


@given(costs, st.integers(1, 60), st.integers(1, 12), st.integers(0, 10**6))
def test_pieces_add_up_to_the_whole(cost: Cost, pieces: int, into: int, shard: int):
    cut = Cut(pieces * into, into)
    shares = [cut.cost(cost, piece) for piece in cut.shards(shard)]
    assert len(shares) == pieces
    assert fsum(s.wall_s for s in shares) == pytest.approx(cost.wall_s, abs=1e-8)
    assert fsum(s.cpu_s for s in shares) == pytest.approx(cost.cpu_s, abs=1e-8)
    for stage, spent in cost.stage_wall_s.items():
        assert fsum(s.stage_wall_s[stage] for s in shares) == pytest.approx(spent, abs=1e-8)
    for clock, spent in cost.source_s.items():
        assert fsum(s.source_s[clock] for s in shares) == pytest.approx(spent, abs=1e-8)
    assert sum(s.written_bytes for s in shares) == cost.written_bytes
    assert {s.peak_rss_bytes for s in shares} == {cost.peak_rss_bytes}


@given(costs, attempt_names, st.integers(1, 5), st.integers(2, 5), st.integers(2, 5), st.integers(0, 100))
def test_two_cuts_are_one(cost: Cost, name: str, last: int, second: int, first: int, shard: int):
    whole, middle = last * second * first, last * second
    steps, more, once = Cut(whole, middle), Cut(middle, last), Cut(whole, last)
    name = base_name(name)  # that of an attempt which was never cut
    found = [
        (piece, more.name(steps.name(name, half), piece), more.cost(steps.cost(cost, half), piece))
        for half in steps.shards(shard)
        for piece in more.shards(half)
    ]
    assert found == [(piece, once.name(name, piece), once.cost(cost, piece)) for piece in once.shards(shard)]


@given(attempt_names, attempt_names, st.integers(1, 9), st.integers(2, 9), st.integers(0, 10**12))
def test_pieces_are_ranked_as_their_attempts_and_named_as_attempts_can_be(
    one: str, other: str, into: int, pieces: int, shard: int
):
    one, other = base_name(one), base_name(other)
    cut = Cut(into * pieces, into)
    piece = cut.first(shard)
    named = [cut.name(name, piece) for name in (one, other)]
    if one != other:
        assert (rank(named[0]) < rank(named[1])) == (rank(one) < rank(other))
    for name in named:
        AttemptStart(attempt=name, shard=0, started="")


def test_the_common_layout_divides_all():
    layouts = [Layout(scenes_per_shard=k, candidates_per_scene=7) for k in (12, 18, 30)]
    assert common_layout(layouts) == Layout(scenes_per_shard=6, candidates_per_scene=7)
    assert common_layout(layouts[:1]) == layouts[0]
