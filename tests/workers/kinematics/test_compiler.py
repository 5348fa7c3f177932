"""Machine code kept on disk follows the sources that it was made of."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HEAD = "from datagen.workers.kinematics.compiler import compiled, constant\n"
INNER = f"{HEAD}TWO = constant(2)\n@compiled\ndef inner(x):\n    return x + 1\n"
OUTER = f"{HEAD}from inner_code import TWO, inner\n@compiled\ndef outer(x):\n    return TWO * inner(x)\n"
ASK = "from outer_code import outer; print(outer(1), len(outer.stats.cache_hits))"


def test_a_function_is_compiled_again_when_what_it_uses_changes(tmp_path: Path) -> None:
    def asked() -> list[int]:
        code = f"import sys; sys.path.append({str(tmp_path)!r}); {ASK}"
        told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        return [int(x) for x in told.stdout.split()]

    (tmp_path / "outer_code.py").write_text(OUTER)
    (tmp_path / "inner_code.py").write_text(INNER)
    assert asked() == [4, 0]
    assert asked() == [4, 1]
    (tmp_path / "inner_code.py").write_text(INNER.replace("x + 1", "x + 9").replace("(2)", "(3)"))
    assert asked() == [30, 0]
