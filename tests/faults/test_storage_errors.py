"""A real program whose disk fails one call: one line, and the same command again gives what it should.

Here one call of one operation; `python -m benchmarks.faults.storage_errors` tries more, of all operations.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.faults.storage_errors_campaign import OPERATIONS, can_trace, try_errors


@pytest.mark.skipif(not can_trace(), reason="strace is not here, or may not trace")
def test_a_call_that_fails_costs_one_line(tmp_path: Path) -> None:
    found = try_errors(OPERATIONS[0], tmp_path, 1, np.random.default_rng(1))
    assert found.wrong == [] and found.tried == 1
