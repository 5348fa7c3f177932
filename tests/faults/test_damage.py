"""A run with one file damaged: checks find every damage, and repair brings back what has a second source."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.faults.damage_campaign import (
    Campaign,
    Damage,
    cuts,
    fewer_arrays,
    findings_at,
    flips,
    keys_of,
    kind_of,
    make_merged,
    make_place,
    try_all,
)


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """Runs of few files."""
    with fewer_arrays():
        yield


@pytest.fixture(scope="module", params=["run", "merged"])
def clean(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sealed run of two shards and a failed attempt, or merged runs. Tests only copy it."""
    folder = tmp_path_factory.mktemp("damage") / "clean"
    if request.param == "merged":
        make_merged(folder)
    else:
        make_place(folder, n=9, scenes_per_shard=1)
    assert findings_at(folder) == []
    return folder


def one_of_each(clean: Path) -> list[Damage]:
    """The first damage of each kind."""
    found: dict[str, Damage] = {}
    for damage in cuts(clean):
        found.setdefault(damage.kind, damage)
    return list(found.values())


def test_every_bit_flip_is_found_and_repaired(clean: Path, tmp_path: Path):
    campaign = Campaign()
    try_all(clean, tmp_path / "run", flips(clean, 60, np.random.default_rng(3)), campaign, repair_every=9)
    assert (campaign.missed, campaign.not_restored, campaign.not_clean) == ([], [], [])
    assert campaign.tried.total() == 60 and len(campaign.tried) == len({kind_of(k) for k in keys_of(clean)})


def test_every_cut_is_found_and_repaired(clean: Path, tmp_path: Path):
    campaign, damages = Campaign(), one_of_each(clean)
    try_all(clean, tmp_path / "run", damages, campaign, repair_every=8)
    assert (campaign.missed, campaign.not_restored, campaign.not_clean) == ([], [], [])
    assert campaign.tried.total() == len(damages) == 5 * len({kind_of(k) for k in keys_of(clean)})


def test_the_campaign_sees_what_is_missed(clean: Path, tmp_path: Path):
    """A damage that changes nothing must be told as missed, or the campaign proves nothing."""
    campaign = Campaign()
    nothing = Damage("flip object", keys_of(clean)[0], lambda data: data)
    try_all(clean, tmp_path / "run", [nothing], campaign)
    assert len(campaign.missed) == 1
