"""Robots beyond the sizes that a model was trained on are named in the answer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.schemas.errors import InputError
from datagen.train.dataset import ROBOT_SIZES, SampleStream
from datagen.train.models import build_model
from datagen.train.prediction import load_scorer
from datagen.train.prediction.base_cells import RobotSize
from datagen.train.prediction.predict import robot_notes, trained_robots
from datagen.train.scorers import ModelScorer
from datagen.train.training.checkpoints import read_checkpoint
from tests.train.prediction.checkpoints import document_of, stored_with, write_untrained
from tests.train.prediction.seen_scenes import MODEL

SIZES = {"arm_reach_m": [0.3, 1.0], "base_height_m": [0.5, 1.0], "camera_height_m": [0.8, 1.5]}


def origin(**more: Any) -> dict[str, Any]:
    fields: dict[str, Any] = {
        "spec_hashes": ["b"], "schema": "plan", "schema_version": 4, "n_samples": 3, "n_scenes": 1,
        "samples_sha256": "a", "cost": None,
    }  # fmt: skip
    return {**fields, **more}


@pytest.fixture(scope="module")
def untrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("untrained") / "model.ckpt"
    write_untrained(path, MODEL)
    return path


@given(st.sampled_from(ROBOT_SIZES), st.floats(0.02, 1.0), st.booleans())
def test_a_size_beyond_the_range_is_noted(name: str, beyond_m: float, is_below: bool) -> None:
    robots = {n: (a, b) for n, (a, b) in SIZES.items()}
    scorer = ModelScorer(build_model("shared", MODEL), "model", robots=robots)
    usual = RobotSize(1.2, 0.7, 0.855)
    assert not list(robot_notes(scorer, usual))
    low, high = SIZES[name]
    other = replace(usual, **{name: low - beyond_m if is_below else high + beyond_m})
    (note,) = robot_notes(scorer, other)
    words = name.removesuffix("_m").replace("_", " ")
    assert note.startswith(words) and f"{low:g} to {high:g} m" in note
    assert not list(robot_notes(ModelScorer(scorer.model, "of an older checkpoint"), other))


def test_a_checkpoint_has_the_sizes_of_all_its_runs(untrained: Path, heuristic_run: Path) -> None:
    head = read_checkpoint(untrained).head
    (run,) = SampleStream([heuristic_run]).origin()
    assert run.get("robots") == SIZES
    other, sizes = origin(robots={**SIZES, "arm_reach_m": [1.11, 1.11]}), {n: (*r,) for n, r in SIZES.items()}
    for data, expected in (
        ((run, other), sizes | {"arm_reach_m": (0.3, 1.11)}),
        ((run,), sizes),
        ((origin(),), {}),
        ((), {}),
    ):
        assert trained_robots(replace(head, data=data)) == expected
    # Of the released model, from Stretch's mount to the reach of its lift and arm, as its card says.
    assert load_scorer().robots == sizes | {"arm_reach_m": (0.3, 1.258), "base_height_m": (0.164, 1.0)}


@pytest.mark.parametrize("sizes", [{"arm_reach_m": [1.0]}, {"arm_reach_m": ["long", 1.0]}, [1.0, 2.0]])
def test_sizes_of_another_form_are_refused(untrained: Path, tmp_path: Path, sizes: Any) -> None:
    head = document_of(untrained)["head"] | {"data": [origin(robots=sizes)]}
    path = stored_with(tmp_path / "bad.ckpt", untrained, head=head)
    with pytest.raises(InputError, match=r"data\.0\.robots"):
        read_checkpoint(path)
