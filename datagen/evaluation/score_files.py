"""Scores from a CSV file: an id and a score a line, made by any program.

The first line is `sample_id,score`. A line `# threshold: NUMBER` before it gives the lowest score that counts
as good. Without that line scores are probabilities, and the threshold is 0.5. Empty lines do not count.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular
from datagen.train.inputs import F64, Array, Batch, is_clear

HEAD = ("sample_id", "score")
_MOST_BYTES = 2**30
_ID = re.compile(r"[0-9a-fA-F]{32}")
_THRESHOLD = re.compile(r"#\s*threshold\s*:\s*(\S+)\s*")
_FIX = "Write sample_id,score and then a line a candidate: docs/results/benchmark.md shows how"


@dataclass(frozen=True, eq=False)
class ScoreFile:
    """A scorer that looks scores up by sample id. Candidates that are not clear need none."""

    name: str
    path: str
    threshold: float
    gives_probabilities: bool
    scores: dict[bytes, float]

    def score(self, batch: Batch[Array]) -> F64:
        """Scores (N,); 0 where the base is not clear. InputError names a clear candidate without one."""
        clear = is_clear(batch)
        found = np.zeros(len(batch))
        for row in np.flatnonzero(clear):
            key = batch.sample_id[row].tobytes()
            if (score := self.scores.get(key)) is None:
                fix = "Score every clear candidate (base_is_clear) of every run"
                raise InputError(self.path, "sample_id", f"has no score for {key.hex()}", fix)
            found[row] = score
        return found


def read_scores(path: Path) -> ScoreFile:
    """Read the file. InputError names the first wrong line."""
    text = read_regular(path, _MOST_BYTES, "Name a CSV file of scores").decode("utf-8-sig", errors="replace")
    threshold, has_head, number = None, False, 1
    scores: dict[bytes, float] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        if line.startswith("#") and not has_head:
            if stated := _THRESHOLD.fullmatch(line):
                if threshold is not None:
                    raise InputError(path, f"line {number}", "states the threshold again", "State it once")
                threshold = _number(path, number, "threshold", stated[1])
            elif "threshold" in line.lower():  # else it would be 0.5 without a word
                problem, fix = "states no threshold", "Write # threshold: NUMBER, or remove the line"
                raise InputError(path, f"line {number}", problem, fix)
            continue
        first, second = (part.strip() for part in line.partition(",")[::2])
        if not has_head:
            if (first, second) != HEAD:
                break
            has_head = True
            continue
        if not _ID.fullmatch(first):
            problem = "is not an id of 32 hexadecimal digits and a score"
            raise InputError(path, f"line {number}", problem, _FIX)
        if (key := bytes.fromhex(first)) in scores:
            raise InputError(path, f"line {number}", f"scores {first} again", "Give each id once")
        scores[key] = score = _number(path, number, "score", second)
        if threshold is None and not 0 <= score <= 1:
            problem = f"{score:g} is no probability, and no threshold is stated"
            fix = "Begin the file with a line: # threshold: NUMBER"
            raise InputError(path, f"line {number}", problem, fix)
    if not has_head:
        raise InputError(path, f"line {number}", f"is not {','.join(HEAD)}", _FIX)
    return ScoreFile(path.stem, str(path), 0.5 if threshold is None else threshold, threshold is None, scores)


def _number(path: Path, line: int, what: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(path, f"line {line}", f"{what} {text[:40]!r} is not a finite number", _FIX)
    return value
