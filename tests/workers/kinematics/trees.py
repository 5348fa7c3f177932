"""Random trees of joints."""

from __future__ import annotations

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import pose
from datagen.workers.kinematics.tree import KinematicTree


def random_tree(rng: np.random.Generator) -> KinematicTree:
    """Joints that branch, slide, share coordinates and have offsets; frames on any or on the base."""
    joints, frames = int(rng.integers(1, 12)), int(rng.integers(1, 5))
    coordinate = np.arange(joints) if rng.random() < 0.5 else rng.integers(0, joints, joints)
    _, coordinate = np.unique(coordinate, return_inverse=True)
    axis = np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(3, 3))])[rng.integers(0, 9, joints)]
    is_chain = rng.random() < 0.5
    parent = [j - 1 if is_chain else int(rng.integers(-1, j)) for j in range(joints)]
    lower = rng.uniform(-3.0, 0.5, coordinate.max() + 1)
    tcp = joints - 1 if is_chain or rng.random() < 0.9 else -1
    return KinematicTree(
        np.array(parent),
        np.stack([random_pose(rng) for _ in range(joints)]),
        axis / np.linalg.norm(axis, axis=1, keepdims=True),
        rng.random(joints) < 0.3,
        coordinate,
        rng.choice([1.0, 1.0, -1.0, 0.5], joints),
        rng.choice([0.0, 0.0, 0.3], joints),
        lower,
        lower + rng.uniform(0.5, 5.0, len(lower)),
        np.append(rng.integers(-1, joints, frames - 1), tcp),
        np.stack([random_pose(rng) for _ in range(frames)]),
    )


def random_pose(rng: np.random.Generator, size_m: float = 0.3) -> F64:
    return pose(rng.uniform(-size_m, size_m, 3), rng.normal(size=4))


def random_coordinates(tree: KinematicTree, rng: np.random.Generator) -> F64:
    """Within the limits (A,)."""
    return rng.uniform(tree.lower, tree.upper)
