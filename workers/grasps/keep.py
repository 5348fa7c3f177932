"""Grasps by content: worked out once, kept in memory and in the user's cache folder."""

from __future__ import annotations

import contextlib
import hashlib
import os
import zipfile
from collections import OrderedDict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from schemas.identity import digest_of
from schemas.specification import GraspParams
from workers.content_cache import cache_folder
from workers.grasps.grasp import GraspSet
from workers.grasps.search import VERSION, ScoredGrasps, search_grasps
from workers.objects.model import ObjectModel
from workers.robots.robot import Gripper, Parts

_KEPT_IN_MEMORY = 512
_KEPT_ON_DISK = 2048  # files, of some 30 KB each
_MAX_FILE_BYTES = 20_000_000
# What moves a bit of the result beside our own code.
_ENGINES = ("sapien", "coal", "scipy", "numpy")

_kept: OrderedDict[str, ScoredGrasps] = OrderedDict()


def grasps_of(model: ObjectModel, gripper: Gripper, params: GraspParams) -> GraspSet:
    """The grasps worth offering to an arm: those with at least `min_score`, best first.

    A pure function of the object's collision parts and mass, the gripper and the parameters: equal
    content gives equal bits in every process and order. None where the object cannot be grasped.
    """
    scored = scored_grasps(model, gripper, params)
    good = scored.score >= params.min_score
    return GraspSet(scored.T_object_tcp[good], scored.opening_m[good], scored.score[good])


def scored_grasps(model: ObjectModel, gripper: Gripper, params: GraspParams) -> ScoredGrasps:
    """All grasps that were scored, from memory, from the cache folder, or worked out and then kept.

    A cache that is broken or cannot be written costs seconds, never a result.
    """
    digest = content_digest(model, gripper, params)
    if digest in _kept:
        _kept.move_to_end(digest)
        return _kept[digest]
    path = cache_folder() / "grasps" / f"{_file_digest(digest)}.npz"
    found = _from_disk(path, digest)
    if found is None:
        rng = np.random.Generator(np.random.PCG64(int(digest, 16)))
        found = search_grasps(model, gripper, params.per_object, rng)
        _to_disk(path, digest, found)
    _kept[digest] = found
    if len(_kept) > _KEPT_IN_MEMORY:
        _kept.popitem(last=False)
    return found


def forget() -> None:
    """Drop what this process keeps in memory; what lies on disk stays."""
    _kept.clear()


def content_digest(model: ObjectModel, gripper: Gripper, params: GraspParams) -> str:
    """sha256 over all that decides the grasps: it seeds their draws and names their file."""
    hand = (gripper.max_opening_m, gripper.pad_size_m, gripper.palm_depth_m)
    return digest_of(
        {
            "version": VERSION,
            "per_object": params.per_object,
            "object": [_parts_digest(model.convex_parts_m), model.mass_kg, model.size_m[2]],
            "gripper": [*hand, *map(_parts_digest, (gripper.palm_parts_m, *gripper.finger_parts_m))],
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


def _from_disk(path: Path, digest: str) -> ScoredGrasps | None:
    try:
        if path.stat().st_size > _MAX_FILE_BYTES:
            return None
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            if str(data["digest"]) != digest:
                return None
            n_tried, n_free, n_clear = (int(n) for n in data["counts"])
            found = ScoredGrasps(
                data["T_object_tcp"].astype(np.float64, casting="equiv"),
                data["opening_m"].astype(np.float32, casting="equiv"),
                data["score"].astype(np.float32, casting="equiv"),
                data["is_clear"].astype(bool, casting="equiv"),
                n_tried,
                n_free,
                n_clear,
                str(data["reason"]),
            )
    except (OSError, EOFError, ValueError, TypeError, KeyError, zipfile.BadZipFile):
        return None  # absent, damaged or of something else: worked out and written anew
    return found if _is_sound(found) else None


def _is_sound(found: ScoredGrasps) -> bool:
    n = len(found.T_object_tcp)
    if found.T_object_tcp.shape != (n, 4, 4):
        return False
    if any(column.shape != (n,) for column in (found.opening_m, found.score, found.is_clear)):
        return False
    R = found.T_object_tcp[:, :3, :3]
    turned_right = np.allclose(R @ R.transpose(0, 2, 1), np.eye(3), atol=1e-6)
    finite = np.isfinite(found.T_object_tcp).all() and np.isfinite(found.opening_m).all()
    return bool(turned_right and finite and ((found.score >= 0) & (found.score <= 1)).all())


def _to_disk(path: Path, digest: str, found: ScoredGrasps) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            np.savez(
                file,
                digest=np.array(digest),
                T_object_tcp=found.T_object_tcp,
                opening_m=found.opening_m,
                score=found.score,
                is_clear=found.is_clear,
                counts=np.array([found.n_tried, found.n_free, found.n_clear]),
                reason=np.array(found.reason),
            )
        # Atomic, so that workers that fill the cache together never see half a file.
        temporary.replace(path)
        _drop_oldest(path.parent)
    except OSError:
        # A read-only or full cache folder only means that the next worker works it out again.
        with contextlib.suppress(OSError):
            temporary.unlink()


def _drop_oldest(folder: Path) -> None:
    files = sorted(folder.glob("*.npz"))
    if len(files) <= _KEPT_ON_DISK:
        return
    files.sort(key=lambda file: file.stat().st_mtime)
    for file in files[: len(files) - _KEPT_ON_DISK]:
        file.unlink(missing_ok=True)
