"""Label source `sim`: positive where the planned grasp, executed in physics, lifts and holds the target."""

from __future__ import annotations

import numpy as np

from datagen.schemas.fields import RETRY_OUTCOMES
from datagen.schemas.run_records import StageClock
from datagen.schemas.specification import Specification
from datagen.workers.bases.candidates import SceneCandidates
from datagen.workers.labels import Columns, LabelSource, plan_source
from datagen.workers.scenes import SettledScene

# 2: the first grasp alone decides, lift and slip are measured at the grasp, thrown objects are `unstable`.
# 4: plans are those of `plan` labels of version 4.
VERSION = 4
_RETRY_CODES = {name: code for code, name in enumerate(RETRY_OUTCOMES)}


def label(
    scene: SettledScene, candidates: SceneCandidates, spec: Specification, clock: StageClock
) -> Columns:
    """The columns of `plan_source`, with outcomes and measurements of trials."""
    columns, trials = plan_source.label_with_trials(scene, candidates, spec, clock)

    def column(dtype: str, values: list[float]) -> np.ndarray:
        return np.array(values, dtype)

    columns |= {
        "attempts": column("int16", [len(t.results) for t in trials]),
        "retry_outcome": column("uint8", [_RETRY_CODES[t.retry_outcome or "none"] for t in trials]),
        "lift_m": column("float32", [t.results[-1].lift_m if t.results else 0.0 for t in trials]),
        "slip_m": column("float32", [t.results[-1].slip_m if t.results else 0.0 for t in trials]),
        "disturbed_m": column("float32", [t.results[-1].disturbed_m if t.results else 0.0 for t in trials]),
        "simulated_s": column("float32", [sum(r.simulated_s for r in t.results) for t in trials]),
    }
    return columns


SIM = LabelSource("sim", VERSION, "sim", label)
