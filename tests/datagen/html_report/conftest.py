"""Runs that reports are made of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datagen.schemas.run import Run
from datagen.schemas.run_records import LedgerEntry
from tests.datagen.forged import Columns, forge
from tests.made_runs import give_up
from tests.small_runs import PER_SCENE, make_small_run

# Texts that act in a browser, a terminal or matplotlib if they are not escaped.
HOSTILE = (
    '"><script>alert(1)</script><img src="http://evil.test/x" onerror="alert(2)"></script><!-- </style>'
    "</pre></details> javascript:alert(3) $\\frac{1}$ {{7*7}} \x1b[31m\u202e&lt;b&gt; ' onfocus='alert(4)"
)
SCENES = 10
AT = "2026-01-01T00:00:00.000+00:00"


@pytest.fixture(scope="session")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of ten scenes, a shard each."""
    return make_small_run(tmp_path_factory.mktemp("reported") / "run", SCENES * PER_SCENE)


@pytest.fixture(scope="session")
def hostile(reported: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the run with hostile texts in its arrays, ledger and quarantine."""

    def change(arrays: Columns) -> None:
        for name in ("house_id", "room_type", "support_type", "object_name"):
            arrays[name] = np.full(arrays[name].shape, HOSTILE, object)

    run = forge(reported, tmp_path_factory.mktemp("hostile") / "run", 0, change)
    quarantine(run, 70, HOSTILE)
    return Path(run.storage.url)


def quarantine(run: Run, shard: int, text: str) -> None:
    """Add a failed attempt of a shard, and its quarantine, with this cause and stack."""
    attempt, stack = f"{shard:06d}-aaaaaaaa-000001", f"Traceback of {text}\n  line 2: {text}"
    entry = LedgerEntry(attempt=attempt, shard=shard, outcome="failed", cause=text, stack=stack)
    run.ledger.end(entry.model_copy(update={"started": AT, "ended": AT}))
    give_up(run, shard, text, attempts=(attempt,), stack=stack, at=AT)
