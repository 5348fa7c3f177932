"""Cache of grasps by content, in memory and in the user's cache folder."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from datagen.schemas.identity import digest_of
from datagen.schemas.specification import GraspParams
from datagen.workers.content_cache import Arrays, CacheFolder
from datagen.workers.grasps.grasp import GraspSet
from datagen.workers.grasps.search import VERSION, ScoredGrasps, search_grasps
from datagen.workers.objects.model import ObjectModel
from datagen.workers.robots.gripper import Gripper, Parts

_KEPT_IN_MEMORY = 512
_CACHE = CacheFolder(
    "grasps",
    {
        "T_object_tcp": (np.float64, ("n", 4, 4)),
        "opening_m": (np.float32, ("n",)),
        "score": (np.float32, ("n",)),
        "is_clear": (np.bool_, ("n",)),
        "counts": (np.int64, (3,)),
        "reason": (np.str_, ()),
    },
    most_files=2048,  # of some 30 KB each
    most_bytes=20_000_000,
)
# What moves a bit of the result beside our own code.
_ENGINES = ("sapien", "coal", "scipy", "numpy")

_kept: OrderedDict[str, ScoredGrasps] = OrderedDict()


def grasps_of(model: ObjectModel, gripper: Gripper, params: GraspParams, draw: int = 0) -> GraspSet:
    """The grasps worth offering to an arm: those with at least `min_score`, best first.

    A pure function of the object's collision parts and mass, the gripper and the parameters: equal
    content gives equal bits in every process and order. None where the object cannot be grasped.
    """
    scored = scored_grasps(model, gripper, params, draw)
    good = scored.score >= params.min_score
    return GraspSet(scored.T_object_tcp[good], scored.opening_m[good], scored.score[good])


def scored_grasps(
    model: ObjectModel, gripper: Gripper, params: GraspParams, draw: int = 0
) -> ScoredGrasps:
    """All scored grasps, from memory, from the cache folder, or computed and then cached.

    A cache that is broken or cannot be written costs seconds, never a result.
    """
    digest = content_digest(model, gripper, params, draw)
    if digest in _kept:
        _kept.move_to_end(digest)
        return _kept[digest]
    key = _file_digest(digest)
    stored = _CACHE.load(key)
    found = None if stored is None else _restored(stored)
    if found is None:
        rng = np.random.Generator(np.random.PCG64(int(digest, 16)))
        found = search_grasps(model, gripper, params.per_object, rng)
        _CACHE.store(key, _stored(found))
    _kept[digest] = found
    if len(_kept) > _KEPT_IN_MEMORY:
        _kept.popitem(last=False)
    return found


def content_digest(model: ObjectModel, gripper: Gripper, params: GraspParams, draw: int = 0) -> str:
    """sha256 over all that decides the grasps: it seeds their draws and names their file."""
    hand = (gripper.max_opening_m, gripper.pad_size_m, gripper.palm_depth_m)
    other = {"draw": draw} if draw else {}
    return digest_of(
        {
            "version": VERSION,
            "per_object": params.per_object,
            "object": [_parts_digest(model.convex_parts_m), model.mass_kg, model.size_m[2]],
            "gripper": [*hand, *map(_parts_digest, (gripper.palm_parts_m, *gripper.finger_parts_m))],
            **other,
        }
    )


def _parts_digest(parts_m: Parts) -> str:
    hasher = hashlib.sha256()
    for part in parts_m:
        hasher.update(np.int64(len(part)).tobytes())
        hasher.update(np.ascontiguousarray(part, np.float32).tobytes())
    return hasher.hexdigest()


def _file_digest(digest: str) -> str:
    """Names a file also by the engines, so that a newer one does not answer with what an older one found."""
    return digest_of([digest, *map(_version_of, _ENGINES)])


def _version_of(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:  # installed without metadata, as conda packages can be
        return ""


def _stored(found: ScoredGrasps) -> Arrays:
    return {
        "T_object_tcp": found.T_object_tcp,
        "opening_m": found.opening_m,
        "score": found.score,
        "is_clear": found.is_clear,
        "counts": np.array([found.n_tried, found.n_free, found.n_clear], np.int64),
        "reason": np.array(found.reason),
    }


def _restored(stored: Arrays) -> ScoredGrasps | None:
    n_tried, n_free, n_clear = (int(n) for n in stored["counts"])
    found = ScoredGrasps(
        stored["T_object_tcp"],
        stored["opening_m"],
        stored["score"],
        stored["is_clear"],
        n_tried,
        n_free,
        n_clear,
        str(stored["reason"]),
    )
    return found if _is_sound(found) else None


def _is_sound(found: ScoredGrasps) -> bool:
    R = found.T_object_tcp[:, :3, :3]
    turned_right = np.allclose(R @ R.transpose(0, 2, 1), np.eye(3), atol=1e-6)
    finite = np.isfinite(found.T_object_tcp).all() and np.isfinite(found.opening_m).all()
    return bool(turned_right and finite and ((found.score >= 0) & (found.score <= 1)).all())
