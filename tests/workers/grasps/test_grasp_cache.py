"""Grasps of known objects, equal everywhere, and a cache that only ever saves time."""

from __future__ import annotations

import ast
import hashlib
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.schemas.specification import GraspParams
from datagen.workers.grasps import grasp_cache
from datagen.workers.grasps.grasp_cache import (
    SCORED_FIRST,
    GraspSet,
    content_digest,
    grasps_of,
    scored_grasps,
)
from datagen.workers.grasps.search import BLOCK, TABLE_GAP_M, HandClearance, lowest_m
from datagen.workers.objects.model import ObjectModel
from tests.conftest import REPOSITORY
from tests.workers.grasps.shapes import bowl_model, box_gripper
from tests.workers.worlds import box_model, box_vertices, cylinder_model, model_of

GRIPPER = box_gripper()
FEW = GraspParams(per_object=24)
SIX = GraspParams(per_object=6)


def same(a: GraspSet, b: GraspSet) -> bool:
    names = ("T_object_tcp", "opening_m", "score")
    return all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for name in names)


@pytest.mark.parametrize(
    "model",
    [
        box_model("box", (0.05, 0.04, 0.1)),
        cylinder_model("can", 0.03, 0.1),
        cylinder_model("lying flat", 0.042, 0.033, mass_kg=0.17),
        bowl_model(),
    ],
    ids=lambda m: m.name,
)
def test_grasps_fit_the_hand_and_most_of_them_hold(model: ObjectModel) -> None:
    params = GraspParams(per_object=40, min_score=0.0)
    grasps = grasps_of(model, GRIPPER, params)
    assert 20 <= len(grasps) <= 40
    T = grasps.T_object_tcp
    np.testing.assert_allclose(np.linalg.det(T[:, :3, :3]), 1)
    assert (grasps.opening_m > 0).all() and (grasps.opening_m <= GRIPPER.max_opening_m).all()
    assert (np.diff(grasps.score) <= 0).all() and grasps.score.mean() > 0.5
    assert HandClearance(model.convex_parts_m, GRIPPER).free(T, grasps.opening_m).all()
    assert len(np.unique(np.round(T, 6), axis=0)) == len(T)


@given(st.lists(st.integers(1, 5 * BLOCK), min_size=2, max_size=3, unique=True))
def test_the_first_of_more_grasps_are_those_of_fewer(numbers: list[int]) -> None:
    """Whatever was asked for first: growing a set changes no grasp in it, nor its score."""
    grasp_cache._kept.clear()
    found = [scored_grasps(ORDER[0], GRIPPER, n) for n in numbers]
    for one, other in pairwise(found):
        n = min(len(one), len(other))
        for name in ("T_object_tcp", "opening_m", "score", "is_clear"):
            np.testing.assert_array_equal(getattr(one, name)[:n], getattr(other, name)[:n])
    assert [len(scored) for scored in found] == numbers


def test_any_first_few_grasps_are_spread_over_the_object() -> None:
    scored = scored_grasps(box_model("tall", (0.05, 0.05, 0.3)), GRIPPER, 64)
    for n in (8, 16, 32, 64):
        assert np.ptp(scored.T_object_tcp[:n, 2, 3]) > 0.25
        assert 0.7 <= scored.is_clear[:n].mean() <= 0.8


def test_later_grasps_are_scored_when_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    model, n = ORDER[0], SCORED_FIRST + 2 * BLOCK
    grasps = grasps_of(model, GRIPPER, GraspParams(per_object=n))
    known = len(grasps.score)
    assert known <= SCORED_FIRST and len(grasps) == known + 2 * BLOCK
    scored: list[int] = []
    real = grasp_cache.score_block

    def counted(*arguments: Any) -> Any:
        scored.append(arguments[3])
        return real(*arguments)

    monkeypatch.setattr(grasp_cache, "score_block", counted)
    asked = [grasps.score_of(row) for row in (known + BLOCK, known + BLOCK + 5)]
    assert scored == [SCORED_FIRST // BLOCK + 1]
    np.testing.assert_array_equal(asked, scored_grasps(model, GRIPPER, n).score[-BLOCK:][[0, 5]])
    assert [grasps.holds(row) for row in (0, known + BLOCK)] == [True, asked[0] >= 0.5]


def test_a_bowl_is_taken_by_its_rim() -> None:
    """One finger inside: the closing axis is level and the hand is over the wall, not over the middle."""
    bowl = bowl_model()
    T = grasps_of(bowl, GRIPPER, GraspParams(per_object=40)).T_object_tcp
    from_above = T[:, 2, 2] < -0.8
    radius = np.linalg.norm(T[:, :2, 3], axis=1)
    at_rim = from_above & (np.abs(radius - 0.068) < 0.01) & (np.abs(T[:, 2, 3] - 0.03) < 0.03)
    assert at_rim.sum() >= 5


@pytest.mark.parametrize("size_m", [(0.15, 0.03, 0.012), (0.09, 0.06, 0.02), (0.2, 0.012, 0.008)])
def test_flat_things_on_a_table_have_grasps_above_it(size_m: tuple[float, float, float]) -> None:
    model = box_model("flat", size_m, mass_kg=0.1)
    scored = scored_grasps(model, GRIPPER, FEW.per_object)
    assert scored.is_clear.sum() >= 10
    low = lowest_m(GRIPPER, scored.T_object_tcp, scored.opening_m)
    np.testing.assert_array_equal(scored.is_clear, low > TABLE_GAP_M - size_m[2] / 2)
    assert (low[scored.is_clear] > -size_m[2] / 2).all()
    assert scored.score[scored.is_clear].max() == 1.0


def test_objects_that_cannot_be_grasped_have_no_grasps() -> None:
    cube = box_model("cube", (0.12, 0.12, 0.12))
    # Two boards with a rod between them: narrow enough, but the hand cannot come in.
    boards = [box_vertices((0.3, 0.3, 0.1), (0, 0, z)) for z in (-0.07, 0.07)]
    spool = model_of("spool", cube.visual, [*boards, box_vertices((0.02, 0.02, 0.06))], 0.3)
    flat = replace(cube, name="sheet", convex_parts_m=(box_vertices((0.1, 0.1, 0.0)),))
    bare = replace(cube, name="bare", convex_parts_m=())
    nan = replace(cube, name="nan", convex_parts_m=(cube.convex_parts_m[0] * np.float32("nan"),))
    for model in (cube, spool, flat, bare, nan):
        assert len(grasps_of(model, GRIPPER, FEW)) == 0
    # A palm below may carry what no fingers hold, in one of the pulls.
    heavy = box_model("lead", (0.05, 0.05, 0.1), mass_kg=50.0)
    assert scored_grasps(heavy, GRIPPER, FEW.per_object).score.max() < 0.5


def test_parameters_choose_how_many_and_how_good_and_another_draw_gives_others() -> None:
    box = box_model("tall", (0.06, 0.05, 0.2), mass_kg=1.0)
    all_of_them = grasps_of(box, GRIPPER, GraspParams(per_object=30, min_score=0.0))
    good = grasps_of(box, GRIPPER, GraspParams(per_object=30, min_score=0.7))
    assert (good.score >= 0.7).all() and len(good) == (all_of_them.score >= 0.7).sum()
    assert len(grasps_of(box, GRIPPER, GraspParams(per_object=1, min_score=0.0))) == 1
    other = grasps_of(box, GRIPPER, GraspParams(per_object=30, min_score=0.0), draw=1)
    assert len(other) == len(all_of_them) and not same(other, all_of_them)


def test_content_alone_decides() -> None:
    box = box_model("box", (0.05, 0.04, 0.1))
    digest = content_digest(box, GRIPPER)
    assert content_digest(replace(box, name="other", digest="f" * 64), GRIPPER) == digest
    for changed in (
        content_digest(replace(box, mass_kg=0.31), GRIPPER),
        content_digest(box_model("box", (0.05, 0.04, 0.11)), GRIPPER),
        content_digest(box, box_gripper(0.07)),
        content_digest(box, GRIPPER, draw=1),
    ):
        assert changed != digest


ORDER = [cylinder_model("can", 0.03, 0.1), bowl_model()]


def digests(order: Sequence[ObjectModel]) -> dict[str, str]:
    found = ((model.name, grasps_of(model, GRIPPER, SIX)) for model in order)
    return {k: hashlib.sha256(g.T_object_tcp.tobytes() + g.score.tobytes()).hexdigest() for k, g in found}


def test_bit_equal_across_processes_and_order(tmp_path: Path) -> None:
    code = "from tests.workers.grasps.test_grasp_cache import *; print(digests(ORDER[::-1]))"
    for child in range(2):
        env = {**os.environ, "DATAGEN_CACHE": str(tmp_path / f"child-{child}"), "PYTHONPATH": str(REPOSITORY)}
        told = subprocess.run(
            [sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True
        )
        assert ast.literal_eval(told.stdout) == digests(ORDER)


def test_stored_grasps_are_not_computed_again(own_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    box = box_model("box", (0.05, 0.04, 0.1))
    first = grasps_of(box, GRIPPER, FEW)
    grasp_cache._kept.clear()
    for name in ("hand_poses_of", "score_block"):
        monkeypatch.setattr(grasp_cache, name, lambda *_: pytest.fail("worked out again"))
    assert same(first, grasps_of(box, GRIPPER, FEW))
    for folder in ("hand-poses", "grasps"):
        assert [file.suffix for file in (own_cache / folder).iterdir()] == [".npz"]
