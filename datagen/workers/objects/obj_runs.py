"""Runs of plain OBJ lines (nearly all are plain), found and parsed without a loop over the lines."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import numpy.typing as npt

# Numbers too short to overflow, and indices that a face may have; the slow reader parses other lines.
_NUMBER = rb" -?\d{1,18}(?:\.\d{1,18})?(?:e[-+]?\d\d?)?"
_INDEX = rb" [1-9]\d{0,6}"
_PAIR = _INDEX + rb"/[1-9]\d{0,6}"
_KINDS = {
    "v": rb"v" + 3 * _NUMBER,
    "vt": rb"vt" + 2 * _NUMBER,
    "f": rb"f" + 3 * _INDEX,
    "f/": rb"f" + 3 * _PAIR,
}
# Not possessive (`++`), which Python 3.11 before 3.11.5 matches wrongly.
_RUN = re.compile(b"|".join(rb"((?:" + line + rb" ?\r?\n)+)" for line in _KINDS.values()))
_NAMES = tuple(_KINDS)


def plain_run(text: bytes, start: int) -> tuple[str, int]:
    """The kind and end of the plain lines that begin at `start`; kind "" and the line's end for others.

    Kinds are `v`, `vt`, `f` (triangles of vertices) and `f/` (of vertices and texture coordinates).
    """
    run = _RUN.match(text, start)
    if run is not None and run.lastindex is not None:
        return _NAMES[run.lastindex - 1], run.end()
    return "", text.find(b"\n", start) + 1 or len(text)


def numbers_of(run: bytes, kind: str) -> npt.NDArray[Any]:
    """All numbers of a run, in order: float64, or int64 from 1 for faces."""
    text = run.replace(kind[0].encode(), b"").replace(b"t", b"").replace(b"/", b" ")
    return np.fromstring(text, np.int64 if kind[0] == "f" else np.float64, sep=" ")
