"""A real program whose disk fails one call: one line, and the same command again gives what it should."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.faults.storage_errors_campaign import OPERATIONS, Operation, can_trace, try_errors


@pytest.mark.skipif(not can_trace(), reason="strace is not here, or may not trace")
@pytest.mark.parametrize("operation", OPERATIONS[:2], ids=lambda operation: operation.name)
def test_a_call_that_fails_costs_one_line(operation: Operation, tmp_path: Path) -> None:
    found = try_errors(operation, tmp_path, 1, np.random.default_rng(1))
    assert found.wrong == [] and found.tried == 1
