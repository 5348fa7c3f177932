"""The uncertainty of models about the label of each candidate of a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from datagen.estimation.mixed_labels import read_whole_scenes
from datagen.estimation.picks import score_candidates
from datagen.estimation.two_stage_sampling import Design, first_of, in_proportion
from datagen.evaluation_report.methods import EvaluatedMethod
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.train.inputs import F64

By = Literal["margin", "uncertain", "disagree"]


def unsureness(by: By, chance: F64, threshold: float, label: F64) -> F64:
    """Return the priority (N,) of dear labels, from a model's chance of success and a cheap label, both (N,).

    `margin`: minus the distance to the threshold. `uncertain`: the entropy in bits. `disagree`: 1 where model
    and cheap label decide otherwise, else 0.
    """
    match by:
        case "margin":
            return -np.abs(chance - threshold)
        case "uncertain":
            p = np.clip(chance, 1e-12, 1 - 1e-12)
            return -p * np.log2(p) - (1 - p) * np.log2(1 - p)
        case "disagree":
            return ((chance >= threshold) != (label == 1)).astype(np.float64)


def design_by(by: By, unsure: F64, n_scenes: int, per_scene: int, rng: np.random.Generator) -> Design:
    """The design of a selection from the unsureness (M, K) of all candidates; `rng` breaks ties."""
    if by == "uncertain":
        return in_proportion(unsure, n_scenes, per_scene)
    return first_of(unsure, n_scenes, per_scene, rng)


def read_unsure(
    run: Run, n_scenes: int, by: By, methods: Sequence[EvaluatedMethod], json: bool = False
) -> F64:
    """Return the unsureness (M, K) of every candidate of the first M scenes of a run, by the methods' mean.

    InputError where one of these scenes is not committed.
    """
    size = run.layout.candidates_per_scene
    columns = read_whole_scenes(run, ("sample_scene_index", "candidate_index", "sample_id", "label"))
    n = n_scenes * size
    if len(columns["label"]) < n:
        problem = f"has fewer than {n_scenes} whole scenes"
        raise InputError(run.storage.url, "commits", problem, "Resume it first")
    ids = np.ascontiguousarray(columns["sample_id"][:n]).view("V16").ravel()
    scores = score_candidates([run.storage.url], ids, methods, json)
    chance = np.mean(list(scores.values()), axis=0)
    threshold = float(np.mean([method.scorer.threshold for method in methods]))
    return unsureness(by, chance, threshold, columns["label"][:n]).reshape(n_scenes, size)
