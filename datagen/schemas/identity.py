"""Sample ids and random streams, which depend only on specification and indices."""

from __future__ import annotations

import hashlib
import json
from enum import IntEnum
from typing import Any

import numpy as np
import numpy.typing as npt


class Stream(IntEnum):
    """Independent random streams of a run. Numbers are part of the data: never reuse one."""

    SCENE = 0
    SETTLE = 1
    OBSERVE = 2
    CANDIDATES = 3
    NOISE = 4
    PATH = 5
    DISTURBANCE = 6
    PLACE = 10
    LIGHT = 11  # for no sample: in exported frames
    ARRIVAL = 9  # for no sample: poses at which robots arrive in a closed loop


def generator(seed: int, stream: Stream, *index: int) -> np.random.Generator:
    """Return the random generator of one stage of one item; the same on every machine.

    `index` is (scene index, retry), or for a candidate (scene index, retry, candidate).
    """
    sequence = np.random.SeedSequence(seed, spawn_key=(int(stream), *index))
    return np.random.Generator(np.random.PCG64(sequence))


def canonical_json(value: Any) -> str:
    """JSON with sorted keys, no spaces and no NaN: equal values give equal text."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def digest_of(value: Any) -> str:
    """sha256 of the canonical JSON, as 64 hexadecimal digits."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()


def sample_ids(
    spec_hash: str, scene_index: int, candidate_indices: npt.NDArray[np.integer[Any]]
) -> npt.NDArray[np.uint8]:  # (N, 16)
    """128-bit ids of the samples of one scene: blake2b(spec hash, scene index, candidate index).

    They do not depend on shard size or worker, so two runs of one specification agree on them.
    """
    head = hashlib.blake2b(bytes.fromhex(spec_hash), digest_size=16)
    head.update(int(scene_index).to_bytes(8, "little"))
    out = np.empty((len(candidate_indices), 16), np.uint8)
    for row, candidate in enumerate(candidate_indices):
        h = head.copy()
        h.update(int(candidate).to_bytes(8, "little"))
        out[row] = np.frombuffer(h.digest(), np.uint8)
    return out
