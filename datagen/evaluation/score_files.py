"""Scores from a CSV file: an id and a score a line, made by any program.

The first line is `sample_id,score`. A line `# threshold: NUMBER` before it gives the lowest score that counts
as good. Without that line scores are probabilities, and the threshold is 0.5.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular
from datagen.train.inputs import F64, Array, Batch, is_clear

HEAD = ("sample_id", "score")
_MOST_BYTES = 2**30
_ID = re.compile(r"[0-9a-f]{32}")
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
    data = read_regular(path, _MOST_BYTES, "Name a CSV file of scores")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(path, "", "is not UTF-8 text", _FIX) from None
    lines = text.splitlines()
    threshold, first = None, 0
    while first < len(lines) and lines[first].startswith("#"):
        if stated := _THRESHOLD.fullmatch(lines[first]):
            threshold = _number(path, first + 1, "threshold", stated[1])
        first += 1
    scores = _scores(path, lines[first:], first)
    is_probability = threshold is None
    if is_probability:
        for key, score in scores.items():
            if not 0 <= score <= 1:
                problem = f"{score:g} of {key.hex()} is no probability, and no threshold is stated"
                raise InputError(path, "score", problem, "Begin the file with a line: # threshold: NUMBER")
    return ScoreFile(path.stem, str(path), 0.5 if threshold is None else threshold, is_probability, scores)


def _scores(path: Path, lines: Iterable[str], before: int) -> dict[bytes, float]:
    """Scores by id; `before` is the number of lines before the first of these."""
    rows = csv.reader(lines)
    scores: dict[bytes, float] = {}
    try:
        if tuple(name.strip() for name in next(rows, ())) != HEAD:
            raise InputError(path, f"line {before + 1}", f"is not {','.join(HEAD)}", _FIX)
        for row in rows:
            line = before + rows.line_num
            if len(row) != 2 or not _ID.fullmatch(row[0]):
                problem = "is not an id of 32 hexadecimal digits and a score"
                raise InputError(path, f"line {line}", problem, _FIX)
            key = bytes.fromhex(row[0])
            if key in scores:
                raise InputError(path, f"line {line}", f"scores {row[0]} again", "Give each id once")
            scores[key] = _number(path, line, "score", row[1])
    except csv.Error as error:
        raise InputError(path, f"line {before + rows.line_num}", str(error), _FIX) from None
    return scores


def _number(path: Path, line: int, what: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(path, f"line {line}", f"{what} {text[:40]!r} is not a finite number", _FIX)
    return value
