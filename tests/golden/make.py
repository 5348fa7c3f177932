"""Makes the golden store of the present formats: `python -m tests.golden.make`. Never run by a test.

    run-format-<F>-schema-<S>.zip    run/: begun with one plan and extended by a second, sealed
                                     merged/: it and a run of another seed, sealed
    run-format-<F>-schema-<S>.json   what is read in them

A file that is there is not written again: an older format is read for ever as it was made.
"""

from __future__ import annotations

import json
import platform
import shutil
import sys
from pathlib import Path
from typing import Any

from datagen import cli
from datagen.schemas.fields import SCHEMA_VERSION
from datagen.schemas.run import Run
from datagen.schemas.run_records import FORMAT_VERSION
from tests.golden.archive import digests_of, pack

HERE = Path(__file__).parent
PLACE = Path("/tmp/golden")  # recorded in the store, so always the same
PER_SCENE, N = 6, 10
CONFIG = """
[scene]
n_clutter = 2
[observation]
n_points = 64
width_px = 160
height_px = 120
fx_px = 154.0
fy_px = 154.0
min_target_points = 16
n_farthest = 16
[visibility]
window_px = 24
"""


def main() -> None:
    """Make both runs, merge them, and write archive and expectations."""
    name = f"run-format-{FORMAT_VERSION}-schema-{SCHEMA_VERSION}"
    archive, expected = HERE / f"{name}.zip", HERE / f"{name}.json"
    if archive.exists() or expected.exists():
        sys.exit(f"{archive} is there: golden stores are never made again")
    platform.node = lambda: "golden"  # no machine's name in the records, nor its kernel's
    system = f"{platform.system()}-{platform.machine()}-with-{''.join(platform.libc_ver())}"
    platform.platform = lambda *_: system
    sys.argv = ["datagen"]
    PLACE.mkdir()
    try:
        make()
        expected.write_text(json.dumps(expectations(), indent=1) + "\n")
        for scratch in ("other", "config.toml"):
            path = PLACE / scratch
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        pack(PLACE, archive)
    finally:
        shutil.rmtree(PLACE)
    print(f"{archive}: {archive.stat().st_size} bytes")


def make() -> None:
    """run/ and merged/ in PLACE."""
    (PLACE / "config.toml").write_text(CONFIG)
    given = [
        "--config",
        str(PLACE / "config.toml"),
        "--candidates-per-scene",
        str(PER_SCENE),
        "--workers",
        "0",
    ]
    run, other, merged = (str(PLACE / name) for name in ("run", "other", "merged"))
    for command in (
        ["submit", "heuristic", "--n", str(PER_SCENE), "--out", run, *given],
        ["resume", run, "--n", str(N), "--workers", "0"],
        ["submit", "heuristic", "--n", str(PER_SCENE), "--seed", "1", "--out", other, *given],
        ["merge", run, other, "--out", merged],
    ):
        code = cli.run(command)
        if code:
            sys.exit(f"datagen {' '.join(command)} ended with {code}")


def expectations() -> dict[str, Any]:
    """What every later program must read in them."""
    run = Run.open(PLACE / "run")
    return {
        "format_version": FORMAT_VERSION,
        "schema_version": SCHEMA_VERSION,
        "spec_hash": run.manifest.spec_hash,
        "n": N,
        "plans": 2,
        "commits": {f"{c.shard}": [c.attempt, c.samples, c.positives] for c in run.commits()},
        "attempts": len(list(run.ledger.ends())),
        "merged_labels": N + PER_SCENE,
        "run": digests_of(PLACE / "run/data.zarr"),
        "merged": digests_of(PLACE / "merged/data.zarr"),
    }


if __name__ == "__main__":
    main()
