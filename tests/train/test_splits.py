"""Splits: no house on both sides, by name or by content, and one run divided by its houses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datagen.schemas.errors import InputError
from datagen.schemas.specification import Source, Specification
from datagen.train.dataset import SampleStream
from datagen.train.run_parts import refuse_mixed_labels
from datagen.train.splits import HouseShare, HouseSide, refuse_one_class, refuse_shared_houses, split_by_house
from datagen.workers.houses import split_of
from tests.train.stream_runs import make_stream_run


def test_a_shared_house_is_named_by_id_or_by_content(tmp_path: Path):
    make_stream_run(tmp_path / "a", 18, house_id="one", house_digest="1" * 64)
    make_stream_run(tmp_path / "b", 18, seed=1, house_id="two", house_digest="2" * 64)
    make_stream_run(tmp_path / "id", 18, seed=2, house_id="one", house_digest="3" * 64)
    make_stream_run(tmp_path / "content", 18, seed=3, house_id="other", house_digest="1" * 64)
    train = SampleStream([tmp_path / "a"])
    refuse_shared_houses(train, SampleStream([tmp_path / "b"]))
    with pytest.raises(InputError, match="/id: house_id: house 'one' is also in the training data, one of 1"):
        refuse_shared_houses(train, SampleStream([tmp_path / "id"]))
    with pytest.raises(
        InputError, match=r"/content: .*house 'one' .*\(there as 'other', with equal content\)"
    ):
        refuse_shared_houses(train, SampleStream([tmp_path / "b", tmp_path / "content"]))


def test_a_tenth_of_the_houses_is_held_out_in_any_split():
    ids = [f"house-{i}" for i in range(4000)]
    held, kept = HouseSide(held_out=True), HouseSide(held_out=False)
    assert all(held(i) != kept(i) for i in ids)
    for split in ("train", "val", "test"):
        share = np.mean([held(i) for i in ids if split_of(i) == split])
        assert 0.07 < share < 0.13


def test_a_larger_share_has_the_houses_of_a_smaller_one_whatever_the_side():
    ids = [f"house-{i}" for i in range(4000)]
    kept = HouseSide(held_out=False)
    smaller: set[str] = set()
    for share in (0.1, 0.25, 0.5, 1.0):
        chosen = {i for i in ids if HouseShare(share)(i)}
        assert smaller <= chosen
        assert abs(len(chosen) / len(ids) - share) < 0.03
        assert {i for i in ids if HouseShare(share, kept)(i)} == {i for i in chosen if kept(i)}
        smaller = chosen
    assert smaller == set(ids)


def test_one_run_is_divided_by_house(tmp_path: Path):
    held = HouseSide(held_out=True)
    twin, plain = (next(h for h in map(str, range(99)) if held(h) == side) for side in (True, False))
    for name, house in (("out", twin), ("in", plain)):
        make_stream_run(tmp_path / name, 18, seed=7 + held(house), house_id=house, house_digest=name)
        with pytest.raises(
            InputError, match=rf"/{name}: house_id: has too few houses .* Name a run of other houses"
        ):
            split_by_house([tmp_path / name])
    make_stream_run(tmp_path / "run", 6 * 18)
    places = [tmp_path / name for name in ("run", "in", "out")]
    train, validation = split_by_house(places, scenes_per_batch=4, seed=3)
    assert not train.house_ids() & validation.house_ids()
    assert train.n_scenes + validation.n_scenes == 24
    assert (train.shuffle, validation.shuffle, train.seed, validation.seed) == (True, False, 3, 3)
    # Twins by content under two names, one on each side.
    make_stream_run(tmp_path / "twin", 18, seed=6, house_digest="in", house_id=twin)
    with pytest.raises(InputError, match="with equal content"):
        split_by_house([tmp_path / "in", tmp_path / "twin"])


@pytest.mark.parametrize("label", [0, 1])
def test_one_class_is_refused_with_the_run_and_the_class(tmp_path: Path, label: int):
    make_stream_run(tmp_path / "bad", 18, label=label)
    alike = SampleStream([tmp_path / "bad"])
    with pytest.raises(InputError, match=f"/bad: label: all 18 labels are {label}"):
        refuse_one_class(alike)
    make_stream_run(tmp_path / "good", 18, seed=1)
    refuse_one_class(SampleStream([tmp_path / "bad", tmp_path / "good"]))


def test_versions_of_one_source_are_not_mixed() -> None:
    assets = Source(kind="builtin", digest="1" * 64)
    old, new, other = (
        Specification(label_source=source, houses=assets, objects=assets, engines={"labels": version})
        for source, version in (("sim", "1"), ("sim", "2"), ("plan", "1"))
    )
    refuse_mixed_labels([("a", new), ("b", new), ("c", other)])
    with pytest.raises(InputError, match="sim labels are of version 2, those of a of version 1"):
        refuse_mixed_labels([("a", old), ("b", new)])
