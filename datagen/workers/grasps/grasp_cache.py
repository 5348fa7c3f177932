"""Cache of grasps by content, in memory and in the user's cache folder."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.schemas.identity import digest_of
from datagen.schemas.specification import GraspParams
from datagen.workers.content_cache import CacheFolder, version_of
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.grasps.search import BLOCK, VERSION, HandPoses, hand_poses_of, score_block, score_poses
from datagen.workers.objects.model import ObjectModel
from datagen.workers.robots.gripper import Gripper, Parts


@dataclass(frozen=True, eq=False)
class GraspSet:
    """G grasps, best first. The TCP frame is the gripper's (`datagen.workers.robots.gripper.Gripper`).

    Scores are shares of floating-hand pulls that held, 0 to 1. The scores of the first S grasps are known and
    at least `min_score`. Each other score is computed on first use and may be lower. `pose_score` gives that
    of any pose (4, 4) in the object's frame and opening.
    """

    T_object_tcp: F64  # (G, 4, 4)
    opening_m: F32  # (G,), of the hand on its approach: the object's width there plus a gap
    score: F32  # (S,)
    min_score: float = 0.0
    later_score: Callable[[int], float] | None = None  # by row - S
    pose_score: Callable[[F64, float], float] | None = None

    def __len__(self) -> int:
        return len(self.opening_m)

    def score_of(self, row: int) -> float:
        if row < len(self.score):
            return float(self.score[row])
        assert self.later_score is not None
        return self.later_score(row - len(self.score))

    def holds(self, row: int) -> bool:
        """Whether the grasp has at least `min_score`."""
        return row < len(self.score) or self.score_of(row) >= self.min_score


Bools = npt.NDArray[np.bool_]

_NO_SCORE = np.zeros(0, np.float32)
_KEPT_IN_MEMORY = 128
_POSES = CacheFolder("hand-poses", most_files=1024)  # about 250 KB each
_SCORES = CacheFolder("grasps", most_files=65_536)
_TURNING = 2  # as VERSION, of hands whose fingers turn
# Grasps of an object that are scored in advance; the others only when an arm has a plan to them.
SCORED_FIRST = 128
# Most searches of one object; fewer where they find enough poses.
_MOST_SEARCHES = 16
# Packages whose version can change bits of the result.
_ENGINES = ("sapien", "coal", "scipy", "numpy")


@dataclass(frozen=True, eq=False)
class ScoredGrasps:
    """The first G poses of one object, in order, with their scores."""

    T_object_tcp: F64  # (G, 4, 4)
    opening_m: F32  # (G,)
    score: F32  # (G,), share of floating-hand pulls that held
    is_clear: Bools  # (G,), the hand stays above the plane that the upright object stands on
    n_clear: int  # poses of the first search in which it does

    def __len__(self) -> int:
        return len(self.score)


@dataclass(eq=False)
class _Known:
    """Grasps of one object by one hand that this process has loaded or computed."""

    digest: str
    model: ObjectModel
    gripper: Gripper
    searches: list[HandPoses] = field(default_factory=list)
    scores: dict[tuple[int, int], F32] = field(default_factory=dict)  # by search and block
    sets: dict[tuple[int, float], GraspSet] = field(default_factory=dict)  # by number and least score

    def poses(self, n: int) -> Iterator[tuple[int, HandPoses, int]]:
        """The searches that find the first n poses: number, all poses, and how many of them to take."""
        for search in range(_MOST_SEARCHES):
            if search == len(self.searches):
                key = file_digest([self.digest, search])
                stored = _POSES.load(key)
                if stored is None:
                    rng = _generator([self.digest, search])
                    stored = vars(hand_poses_of(self.model, self.gripper, rng))
                    _POSES.store(key, stored)
                self.searches.append(HandPoses(**stored))
            poses = self.searches[search]
            yield search, poses, min(n, len(poses))
            n -= min(n, len(poses))
            if n == 0 or len(poses) == 0:
                return

    def score(self, search: int, block: int) -> F32:
        if (search, block) not in self.scores:
            key, of = [self.digest, search, block], (self.model, self.gripper, self.searches[search], block)
            stored = _SCORES.computed(file_digest(key), lambda: {"score": score_block(*of, _generator(key))})
            self.scores[search, block] = stored["score"]
        return self.scores[search, block]


_kept: OrderedDict[str, _Known] = OrderedDict()


def grasps_of(model: ObjectModel, gripper: Gripper, params: GraspParams, draw: int = 0) -> GraspSet:
    """The grasps offered to an arm: those of the first `per_object` that score at least `min_score`.

    The first `SCORED_FIRST` are scored now, and the good ones come first, by score. The others follow in the
    object's order and are scored when an arm has a plan to one: most scenes need none of them.

    A pure function of the object's collision parts and mass, the gripper and the parameters: equal
    content gives equal bits in every process and order. Empty where the object cannot be grasped. `draw`
    seeds all random numbers.
    """
    known, key = _known(model, gripper, draw), (params.per_object, params.min_score)
    if key in known.sets:
        return known.sets[key]
    first = scored_grasps(model, gripper, min(params.per_object, SCORED_FIRST), draw)
    order = np.argsort(-first.score, kind="stable")
    rows = order[first.score[order] >= params.min_score]
    T, openings = [first.T_object_tcp[rows]], [first.opening_m[rows]]
    later: list[tuple[int, int]] = []  # search and row of each
    skip = len(first)
    for search, poses, some in known.poses(params.per_object) if len(rows) else ():
        begin = min(skip, some)
        T.append(poses.T_object_tcp[begin:some])
        openings.append(poses.opening_m[begin:some].astype(np.float32))
        later += [(search, row) for row in range(begin, some)]
        skip -= begin

    def later_score(k: int) -> float:
        search, row = later[k]
        return float(known.score(search, row // BLOCK)[row % BLOCK])

    def pose_score(T_object_tcp: F64, opening_m: float) -> float:
        rng = _generator([known.digest, T_object_tcp.tolist(), opening_m])
        return float(score_poses(model, gripper, T_object_tcp[None], np.array([opening_m]), rng)[0])

    found = GraspSet(
        np.concatenate(T),
        np.concatenate(openings),
        first.score[rows],
        params.min_score,
        later_score,
        pose_score,
    )
    known.sets[key] = found
    return found


def scored_grasps(model: ObjectModel, gripper: Gripper, n: int, draw: int = 0) -> ScoredGrasps:
    """The first `n` grasps of an object, or all that `_MOST_SEARCHES` searches find.

    A larger `n` extends the list of a smaller one. Poses and scores come from memory, from the cache folder,
    or are computed and then cached. A broken or read-only cache costs time and changes no result.
    """
    known = _known(model, gripper, draw)
    T, openings, clear, scores = [np.zeros((0, 4, 4))], [np.zeros(0)], [np.zeros(0, bool)], [_NO_SCORE]
    for search, poses, some in known.poses(n):
        for block in range(-(-some // BLOCK)):
            rows = min(BLOCK, some - block * BLOCK)
            scores.append(known.score(search, block)[:rows])
        T.append(poses.T_object_tcp[:some])
        openings.append(poses.opening_m[:some])
        clear.append(poses.is_clear[:some])
    return ScoredGrasps(
        np.concatenate(T),
        np.concatenate(openings).astype(np.float32),
        np.concatenate(scores),
        np.concatenate(clear),
        int(known.searches[0].is_clear.sum()),
    )


def content_digest(model: ObjectModel, gripper: Gripper, draw: int = 0) -> str:
    """sha256 over everything that decides the grasps: it seeds random numbers and names the files."""
    hand = (gripper.max_opening_m, gripper.pad_size_m, gripper.palm_depth_m)
    other: dict[str, Any] = {"draw": draw} if draw else {}
    if gripper.linkage is not None:
        other["linkage"] = [_TURNING, gripper.digest]
    if gripper.least_width_m:
        other["least"] = gripper.least_width_m
    return digest_of(
        {
            "version": VERSION,
            "object": [_parts_digest(model.convex_parts_m), model.mass_kg, model.size_m[2]],
            "gripper": [*hand, *map(_parts_digest, (gripper.palm_parts_m, *gripper.finger_parts_m))],
            **other,
        }
    )


def _known(model: ObjectModel, gripper: Gripper, draw: int) -> _Known:
    digest = content_digest(model, gripper, draw)
    known = _kept.setdefault(digest, _Known(digest, model, gripper))
    _kept.move_to_end(digest)
    if len(_kept) > _KEPT_IN_MEMORY:
        _kept.popitem(last=False)
    return known


def _generator(key: list[Any]) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(int(digest_of(key), 16)))


def _parts_digest(parts_m: Parts) -> str:
    hasher = hashlib.sha256()
    for part in parts_m:
        hasher.update(np.int64(len(part)).tobytes())
        hasher.update(np.ascontiguousarray(part, np.float32).tobytes())
    return hasher.hexdigest()


def file_digest(key: list[Any]) -> str:
    """File name that includes the engines' versions: results of other versions are not read."""
    return digest_of([*key, *map(version_of, _ENGINES)])
