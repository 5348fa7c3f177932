"""Agreement of labels, on small arrays whose answers are counted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.reports.agreement import Labels, equal_share
from datagen.schemas.run import Run
from tests.made_runs import make_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return make_run(tmp_path_factory.mktemp("runs") / "run", n=10)


def labels(run: Run, scene: list[int], candidate: list[int], label: list[int], near: list[int]) -> Labels:
    return Labels(run, np.array(scene), np.array(candidate), np.array(label) == 1, np.array(near) == 1, None)


def test_only_candidates_within_reach_that_both_labelled_are_compared_in_any_order(run: Run) -> None:
    first = labels(run, [0, 0, 1, 1, 2], [0, 1, 0, 1, 0], [1, 0, 1, 0, 1], [1, 1, 1, 1, 0])
    second = labels(run, [2, 1, 3, 0, 0], [0, 0, 0, 1, 0], [1, 0, 1, 0, 1], [0, 1, 1, 1, 1])
    found = equal_share(first, second)
    assert found["counts"] == {"both": 1, "neither": 1, "only_first": 1, "only_reference": 0}
    assert (found["candidates"], found["scenes"], found["equal_share"]) == (3, 2, pytest.approx(2 / 3))
    nothing = equal_share(first, labels(run, [9], [0], [1], [1]))
    assert (nothing["candidates"], nothing["equal_share"], nothing["interval"]) == (0, None, None)


def test_candidates_of_one_scene_are_one_observation(run: Run) -> None:
    # 20 scenes, each right or wrong as a whole: the interval is that of 20 draws, not of 2,000.
    scene, candidate = np.repeat(np.arange(20), 100).tolist(), np.tile(np.arange(100), 20).tolist()
    label, near = np.tile(np.arange(100) % 2, 20), [1] * 2000
    wrong = np.repeat(np.arange(20) % 4 == 0, 100)
    first = labels(run, scene, candidate, (label ^ wrong).tolist(), near)
    found = equal_share(first, labels(run, scene, candidate, label.tolist(), near))
    low, high = found["interval"]
    assert found["equal_share"] == 0.75 and low < 0.75 < high
    assert high - low == pytest.approx(2 * 1.96 * np.sqrt(0.75 * 0.25 / 20), rel=0.15)
