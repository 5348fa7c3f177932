"""A label of a source costs what its runs' records say, waste included."""

from __future__ import annotations

from pathlib import Path

import pytest

from datagen import cli
from datagen.frontier.cost_per_label import label_costs
from datagen.reports.prices import read_prices
from datagen.schemas.errors import InputError
from datagen.schemas.merged_runs import open_runs
from tests.small_runs import make_small_run


def test_the_cost_of_two_runs_is_shared_by_their_labels(tmp_path: Path):
    prices = read_prices()
    places = [str(make_small_run(tmp_path / str(seed), 16, "--seed", str(seed))) for seed in (0, 1)]
    found = label_costs({"heuristic": places}, prices)["heuristic"]
    commits = [commit for place in places for run in open_runs(place) for commit in run.commits()]
    cpu_s = sum(commit.cost.cpu_s for commit in commits)
    stored = sum(commit.cost.written_bytes for commit in commits)
    assert found.cpu_s == pytest.approx(cpu_s / 32)
    assert found.money == pytest.approx(prices.cost_of(cpu_s, 0, stored) / 32)


def test_scenes_of_a_run_that_is_not_named_have_no_cost(tmp_path: Path):
    first, again = make_small_run(tmp_path / "first", 16), tmp_path / "again"
    file = tmp_path / "other.toml"
    file.write_text("[heuristic]\nalpha = 0.4\n")
    words = ["submit", "heuristic", "--n", "16", "--scenes-from", str(first), "--out", str(again)]
    assert cli.run([*words, "--config", str(file), "--workers", "0"]) == 0
    alone, both = {"heuristic": [str(again)]}, {"heuristic": [str(first), str(again)]}
    with pytest.raises(InputError, match=r"has scenes of a run that is not named.*Name that run too"):
        label_costs(alone, read_prices())
    assert label_costs(both, read_prices())["heuristic"].cpu_s > 0
