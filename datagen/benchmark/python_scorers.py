"""Score by a function of the user: `module:function`, imported from the working folder or the environment."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from datagen.schemas.errors import InputError
from datagen.train.inputs import F64, Array, Batch, is_clear

REFERENCE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


@dataclass(frozen=True, eq=False)
class PythonScorer:
    """A user's function from a batch without labels to scores (N,); 0 where the base is not clear.

    The function's attribute `threshold`, if it has one, is the lowest score that counts as good. Without it
    scores are probabilities and the threshold is 0.5.
    """

    name: str
    function: Callable[[Batch[Array]], Any]
    threshold: float
    gives_probabilities: bool

    def score(self, batch: Batch[Array]) -> F64:
        """The function's scores. InputError where they are no probabilities and no threshold is stated."""
        clear = is_clear(batch)
        given = replace(batch, label=np.zeros_like(batch.label), extra={"base_is_clear": clear})
        score = np.asarray(self.function(given), np.float64)
        if (
            self.gives_probabilities
            and score.shape == clear.shape
            and not ((score >= 0) & (score <= 1)).all()
        ):
            fix = "Return numbers from 0 to 1, or set the function's attribute `threshold`"
            raise InputError(self.name, "score", "is no probability, and no threshold is stated", fix)
        return np.where(clear, score, 0.0) if score.shape == clear.shape else score


def import_scorer(reference: str) -> PythonScorer:
    """Import `module:function`, which runs the module's code. InputError where there is no such function."""
    module_name, _, name = reference.partition(":")
    folder = str(Path.cwd())
    sys.path.insert(0, folder)
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise
        fix = f"Name a module in {folder} or of this environment, as module:function"
        raise InputError("METHOD", reference, f"there is no module {error.name}", fix) from None
    finally:
        sys.path.remove(folder)
    function = getattr(module, name, None)
    if not callable(function):
        fix = "Define it: def score(batch): ... returns a number a candidate"
        raise InputError("METHOD", reference, f"{module_name} has no function {name}", fix)
    stated = getattr(function, "threshold", None)
    if stated is not None and not (isinstance(stated, (int, float)) and np.isfinite(stated)):
        raise InputError("METHOD", reference, f"threshold {stated!r:.40} is not a number", "Set a number")
    return PythonScorer(reference, function, 0.5 if stated is None else float(stated), stated is None)
