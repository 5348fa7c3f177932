"""What is kept of batches, and what is cut from it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from datagen.evaluation.columns import gather
from datagen.evaluation.runs import EvaluatedRun
from datagen.schemas.errors import InputError
from datagen.schemas.specification import ArmParams
from datagen.train.inputs import Array, Batch, CandidateInputs, Clouds, RobotInputs
from tests.datagen.evaluation.made_columns import make_columns
from tests.made_runs import small_spec

CELLS = 4


@dataclass(frozen=True)
class ByX:
    """A scorer that likes positive x; where `broken`, its second score is not finite."""

    name: str = "x"
    threshold: float = 0.0
    broken: float = 0.0

    def score(self, batch: Batch[Array]) -> np.ndarray:
        scores = batch.candidates.base_xy_m[:, 0].astype(np.float64)
        scores[1] += self.broken
        return scores


def make_batch(first: int, robots: list[int], per_robot: int = CELLS) -> Batch[Array]:
    """Scenes numbered from `first` on, with that many robots each and `per_robot` candidates a robot."""
    s, r = len(robots), sum(robots)
    n = r * per_robot
    cloud_row = np.repeat(np.arange(s), robots)
    ids = np.zeros((n, 16), np.uint8)
    ids[:, 0], ids[:, 1] = first, np.arange(n)
    rng = np.random.default_rng(first)
    names = np.array([[f"object-{first + k}", "clutter"] for k in range(s)], object)
    extra: dict[str, Any] = {
        "base_is_clear": np.ones(n, np.uint8),
        "outcome": np.zeros(n, np.uint8),
        **{k: rng.random(n).astype(np.float32) for k in ("distance_m", "mount_distance_m", "visibility")},
        "house_id": np.array([f"house-{first + k}" for k in range(s)], object),
        "place": np.zeros(s, np.uint8),
        "object_digest": names,
    }
    heights = np.ones(r, np.float32)
    return Batch(
        Clouds(
            rng.random((s, 9, 3)).astype(np.float32),
            np.zeros((s, 9, 3), np.uint8),
            np.zeros((s, 9), np.bool_),
            np.full(s, 7),
            np.ones(s, np.float32),
            np.ones(s, np.float32),
        ),
        RobotInputs(cloud_row, heights, heights, heights),
        CandidateInputs(np.repeat(np.arange(r), per_robot), rng.uniform(-1, 1, (n, 2)).astype(np.float32)),
        np.ones(n, np.int64),
        ids,
        extra,
    )


def test_good_is_what_most_draws_call_good() -> None:
    batch = make_batch(0, [2])  # whose own labels are all 1
    batch = replace(batch, extra={**batch.extra, "successes": np.arange(8, dtype=np.int16) % 6})
    stream: Any = SimpleNamespace(epoch=lambda _: iter([batch]))
    specs = {draws: small_spec(label_source="plan", arm=ArmParams(draws=draws)) for draws in (None, 4, 5)}
    good = {
        draws: next(EvaluatedRun("run", (spec,), stream).batches()).label.tolist()
        for draws, spec in specs.items()
    }
    assert good == {None: [1] * 8, 4: [0, 0, 0, 1, 1, 1, 0, 0], 5: [0, 0, 0, 1, 1, 1, 0, 0]}
    with pytest.raises(InputError, match=r"run: arm.draws: differs between its parts"):
        next(EvaluatedRun("run", (specs[4], specs[5]), stream).batches())


def test_scenes_and_robots_are_numbered_through_all_places() -> None:
    first, second, third = make_batch(0, [1, 2]), make_batch(2, [1]), make_batch(3, [1, 1])
    told: list[int] = []
    places = [(CELLS, [first, second]), (0, [third])]
    columns, seconds = gather(places, {"x": ByX()}, told.append)
    assert seconds["x"] > 0
    assert told == [2, 1, 2]
    assert columns.scene.tolist() == np.repeat([0, 1, 1, 2, 3, 4], CELLS).tolist()
    assert columns.robot.tolist() == np.repeat(np.arange(6), CELLS).tolist()
    assert columns.house.tolist() == [f"house-{k}" for k in range(5)]
    assert columns.run.tolist() == [0, 0, 0, 1, 1]
    # Two robots share a grid's cells, and the second place has no grids.
    assert columns.is_grid.tolist() == [True, False, True, False, False]
    np.testing.assert_array_equal(columns.scores["x"], columns.base_xy_m[:, 0].astype(np.float64))


def test_scores_that_are_not_finite_and_repeated_runs_are_refused() -> None:
    for broken in (np.nan, np.inf, -np.inf):
        with pytest.raises(InputError, match="x: score: is not finite for sample 0301"):
            gather([(0, [make_batch(3, [1])])], {"x": ByX(broken=broken)})
    with pytest.raises(InputError, match="03000000000000000000000000000000 occurs twice"):
        gather([(0, [make_batch(3, [1])]), (0, [make_batch(3, [1])])], {"x": ByX()})


def test_candidate_sets_match_their_definitions() -> None:
    columns = make_columns(np.random.default_rng(0))
    clear, in_range = columns.is_in("clear"), columns.is_in("in-range")
    assert columns.is_in("grid").all()
    np.testing.assert_array_equal(clear, columns.is_clear)
    assert (clear | ~in_range).all() and 0 < in_range.sum() < clear.sum()
    assert (columns.mount_distance_m[in_range] <= columns.reach_m[in_range]).all()


def test_selecting_rows_keeps_scenes_and_selecting_scenes_renumbers_them() -> None:
    columns = make_columns(np.random.default_rng(1))
    cut = columns.at(columns.is_clear)
    assert len(cut) == columns.is_clear.sum() and cut.n_scenes == columns.n_scenes
    kept = np.arange(columns.n_scenes) % 3 == 1
    some = columns.of_scenes(kept)
    assert some.n_scenes == kept.sum() and len(some) == kept.sum() * 20
    np.testing.assert_array_equal(some.house[some.scene], columns.house[columns.scene][kept[columns.scene]])
    np.testing.assert_array_equal(some.scores["random"], columns.scores["random"][kept[columns.scene]])
