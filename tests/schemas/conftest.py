"""Runs of few arrays."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from datagen.schemas.fields import SCHEMAS
from tests.faults.crash_points_operations import small_schema
from tests.schemas.checked import FEW


@pytest.fixture(scope="module")
def few_arrays() -> Iterator[None]:
    """Heuristic runs of few arrays: stores of fifty take the same paths."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SCHEMAS, "heuristic", small_schema(FEW))
        yield
