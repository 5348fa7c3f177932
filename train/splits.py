"""House-disjoint sides of training data: what is judged on was never trained on."""

from __future__ import annotations

from schemas.errors import InputError
from train.dataset import SampleStream


def refuse_shared_houses(train: SampleStream, other: SampleStream) -> None:
    """InputError that names a house of which both have scenes."""
    shared = sorted(train.house_ids() & other.house_ids())
    if shared:
        problem = f"{shared[0]!r} is trained on and judged on ({len(shared)} such houses)"
        raise InputError("training data", "house_id", problem, "Use runs of different splits")
