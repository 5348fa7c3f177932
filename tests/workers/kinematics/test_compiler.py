"""Machine code kept on disk: of these very sources, whole, or made again."""

from __future__ import annotations

import gc
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

import datagen
from datagen.workers.geometry.mesh import F64
from datagen.workers.kinematics.compiler import compiled, in_memory, struct


class Inner(NamedTuple):
    values: F64  # (N,)


class Outer(NamedTuple):
    inner: Inner
    values: F64  # (N,)


new_inner = struct(Inner)
struct(Outer)


@compiled
def total(outer: Outer) -> float:
    return outer.values.sum() + outer.inner.values.sum()


@compiled
def made_inside(n: int) -> float:
    made = new_inner(np.full(n, 2.0))
    values = made.values
    values[0] += 1.0
    return made.values.sum()


def test_structures_keep_their_arrays_though_reading_them_counts_no_reference() -> None:
    n, outers = 100_000, []
    gc.freeze()  # of all that test processes import, each collection would take a second
    for k in range(20):
        outers.append(in_memory(Outer(Inner(np.full(n, float(k))), np.full(n, 1.0))))
        gc.collect()
    gc.unfreeze()
    for k, outer in enumerate(outers):
        assert total(outer) == total(outer) == n * (k + 1)
    assert made_inside(n) == 2 * n + 1


ASK = """
import numpy as np
from datagen.workers.kinematics import on_compiling
from datagen.workers.kinematics.compiler import is_kept
from datagen.workers.motion.path_search import dense
told, kept = [], is_kept(dense)
with on_compiling(lambda: told.append(1)):
    points = dense(np.ones(2), np.array([[0.0, 0.0], [0.0, 1.0]]), 2.0)
hits = sum(dense.stats.cache_hits.values())
assert (len(told), kept, is_kept(dense)) == ASKED[hits], (told, kept, is_kept(dense))
print(len(points), hits)
"""


def test_code_is_loaded_and_made_again_where_sources_changed_or_it_is_damaged(tmp_path: Path) -> None:
    package, cache = tmp_path / "datagen", tmp_path / "cache"
    shutil.copytree(Path(datagen.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "DATAGEN_CACHE": str(cache)}

    def asked(compiling: str = "(1, False, True)") -> list[int]:
        told = subprocess.run(
            [sys.executable, "-c", f"ASKED = {{0: {compiling}, 1: (0, True, True)}}\n{ASK}"],
            check=False,
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
        )
        assert told.returncode == 0, told.stderr
        return [int(word) for word in told.stdout.split()]

    assert asked() == [2, 0]
    assert asked() == [2, 1]
    for path in (cache / "machine-code").rglob("*.code"):
        path.write_bytes(path.read_bytes()[:-9])
    assert asked("(1, True, True)") == [2, 0]
    # `dense` calls a function of another file.
    callee = package / "workers" / "motion" / "arm_motion.py"
    callee.write_text(callee.read_text().replace("return max(1, math", "return max(2, math"))
    assert asked() == [3, 0]
    shutil.rmtree(cache)
    cache.write_text("a file where the folder should be")
    assert asked("(1, False, False)") == [3, 0]
