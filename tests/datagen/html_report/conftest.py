"""Runs and documents that reports are made of."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen import cli
from datagen.schemas.run import Run
from datagen.schemas.run_records import LedgerEntry, QuarantineRecord
from tests.datagen.forged import Columns, forge
from tests.small_runs import CONFIG, PER_SCENE, make_small_run

# What acts in a browser, a terminal or matplotlib if it is not escaped: each would call `alert` or fetch.
HOSTILE = (
    '"><script>alert(1)</script><img src="http://evil.test/x" onerror="alert(2)"></script><!-- </style>'
    "</pre></details> javascript:alert(3) $\\frac{1}$ {{7*7}} \x1b[31m\u202e&lt;b&gt; ' onfocus='alert(4)"
)
SCENES = 10
AT = "2026-01-01T00:00:00.000+00:00"


@pytest.fixture(scope="session")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of ten scenes, a shard each, with scene 0 alone in having been rejected often."""
    return make_small_run(tmp_path_factory.mktemp("reported") / "run", SCENES * PER_SCENE)


@pytest.fixture(scope="session")
def hostile(reported: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the run with hostile texts in its arrays, ledger and quarantine."""

    def change(arrays: Columns) -> None:
        for name in ("house_id", "room_type", "support_type", "object_name"):
            arrays[name] = np.full(arrays[name].shape, HOSTILE, object)
        # So that this scene is among the most unusual.
        arrays["settle_steps"][:] = 100_000

    run = forge(reported, tmp_path_factory.mktemp("hostile") / "run", 3, change)
    quarantine(run, 70, HOSTILE)
    return Path(run.storage.url)


def quarantine(run: Run, shard: int, text: str) -> None:
    """Add a failed attempt of a shard, and its quarantine, with this cause and stack."""
    attempt, stack = f"{shard:06d}-aaaaaaaa-000001", f"Traceback of {text}\n  line 2: {text}"
    run.ledger.end(
        LedgerEntry(
            attempt=attempt, shard=shard, outcome="failed", cause=text, stack=stack, started=AT, ended=AT
        )
    )
    record = QuarantineRecord(
        shard=shard, seed=0, first_scene=shard, scenes=1, attempts=(attempt,), causes=(text,),
        stacks=(stack,), created=AT,
    )  # fmt: skip
    assert run.quarantine(record)


@pytest.fixture(scope="session")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A document of `datagen evaluate --json`, of a rule on planned labels."""
    folder = tmp_path_factory.mktemp("evaluation")
    config, run = folder / "run.toml", str(folder / "run")
    config.write_text(CONFIG + "[arm.grasps]\nper_object = 40\nper_scene = 10\n")
    where = ["--out", run, "--config", str(config), "--workers", "0"]
    near = ["--candidates", "in-range", "--candidates-per-scene", "8"]
    assert cli.run(["submit", "plan", "--n", "48", *near, *where]) == 0

    import datagen

    report: dict[str, Any] = datagen.evaluate([run], baselines=["proximity", "analytic"], bootstrap=20)
    (folder / "evaluation.json").write_text(json.dumps(report))
    return folder / "evaluation.json"
