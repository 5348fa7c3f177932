"""Make the golden files of a release, which every later version opens: a sealed run and a checkpoint.

    python -m tests.golden.make

Writes `tests/golden/<version>.zip` and adds what it holds to `tests/golden/golden.json`. Files that exist
are never changed.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from datagen import __version__, cli
from datagen.train.training.checkpoints import load_model
from tests.datagen.evaluation.conftest import checkpoint
from tests.small_runs import CONFIG, arrays_of, submit_arguments

GOLDEN = Path(__file__).parent
TOLD = GOLDEN / "golden.json"


def held(folder: Path) -> dict[str, Any]:
    """What unpacked golden files hold: digests of the arrays, and sums of the model's weights."""
    arrays = arrays_of(folder / "run")
    weights = load_model(folder / "model.ckpt")[0].state_dict()
    return {
        "arrays": {name: digest_of(values) for name, values in sorted(arrays.items())},
        "weights": {name: round(float(value.double().sum()), 6) for name, value in sorted(weights.items())},
    }


def digest_of(values: np.ndarray[Any, Any]) -> str:
    """A digest of type, shape and values."""
    is_text = values.dtype.kind in "OTU"
    data = "\0".join(values.astype(object).ravel().tolist()).encode() if is_text else values.tobytes()
    form = f"{'text' if is_text else values.dtype.str} {values.shape}"
    return hashlib.sha256(form.encode() + data).hexdigest()[:16]


def main() -> None:
    """Make the files of the present version."""
    archive = GOLDEN / f"{__version__}.zip"
    if archive.exists():
        raise SystemExit(f"{archive}: exists, and golden files are never changed")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "golden"
        folder.mkdir()
        few = CONFIG.replace("n_points = 256", "n_points = 64")
        if cli.run(submit_arguments(folder / "run", 8, per_scene=4, config=few)) != 0:
            raise SystemExit("the run was not made")
        (folder / "run.toml").unlink()
        shutil.rmtree(folder / "run" / "jobs")  # they name folders of this machine
        with torch.random.fork_rng():
            checkpoint(folder / "model.ckpt")
        shutil.make_archive(str(archive.with_suffix("")), "zip", folder)
        told = json.loads(TOLD.read_text()) if TOLD.exists() else {}
        TOLD.write_text(json.dumps({**told, __version__: held(folder)}, indent=1) + "\n")


if __name__ == "__main__":
    main()
