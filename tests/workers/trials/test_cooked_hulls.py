"""Hulls that SAPIEN keeps are those that it cooks."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("sapien", reason="SAPIEN cannot be imported here: run `datagen doctor`")

from sapien import physx

from datagen.workers.settling.sapien_bodies import convex_shape
from datagen.workers.trials import cooked_hulls
from datagen.workers.trials.cooked_hulls import cooked_shape

MATERIAL = physx.PhysxMaterial(0.5, 0.5, 0.0)


def points(seed: int) -> np.ndarray:
    return (0.05 * np.random.default_rng(seed).normal(size=(30, 3))).astype(np.float32)


def test_kept_hulls_equal_cooked_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cooked_hulls, "_MOST_HULLS", 4)  # dropped and cooked again on the way
    first = [cooked_shape(points(seed), MATERIAL).vertices.copy() for seed in range(6)]
    for seed, vertices in enumerate(first):
        np.testing.assert_array_equal(cooked_shape(points(seed), MATERIAL).vertices, vertices)
        direct = convex_shape(points(seed), MATERIAL).vertices
        np.testing.assert_array_equal(np.unique(direct, axis=0), np.unique(vertices, axis=0))


def test_a_flat_part_is_cooked_as_before() -> None:
    flat = np.zeros((4, 3), np.float32)
    flat[:, :2] = [(0, 0), (0.1, 0), (0.1, 0.1), (0, 0.1)]
    thick = np.concatenate([flat, flat + np.float32([0, 0, 1e-4])])
    assert cooked_shape(thick, MATERIAL).vertices.shape[1] == 3
