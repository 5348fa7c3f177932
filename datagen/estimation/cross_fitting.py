"""Predictions of dear labels from cheap labels and stored numbers, fitted on other scenes.

A binary cheap label predicts little; a regression on the numbers stored with it predicts more. Each scene's
predictions come from folds without it, so that they are as good for scenes with dear labels as for others
(Zrnic and Candes, "Cross-prediction-powered inference", arXiv 2309.16598).
"""

from __future__ import annotations

import numpy as np

from datagen.estimation.rates import Population
from datagen.train.inputs import F64, Bools

FOLDS = 5
# With fewer scenes the regression explains less than it costs; cheap labels are then used as they are.
SCENES_AT_LEAST = 40
_RIDGE = 3e-3


def cross_fitted(population: Population, features: F64, is_clear: Bools, seed: int = 0) -> F64 | None:
    """Return a prediction (N,) of each candidate's dear label from features (N, F); 0 where it is not clear.

    None where fewer than `SCENES_AT_LEAST` scenes have dear labels. The regression is linear in the features
    and their products, by least squares with a ridge.
    """
    dear_scenes = np.unique(population.scene[population.is_dear])
    fitted_on = population.is_dear & is_clear
    if len(dear_scenes) < SCENES_AT_LEAST or not fitted_on.any():
        return None
    rng = np.random.default_rng(seed)
    fold_of = np.full(population.n_scenes, -1)
    fold_of[dear_scenes] = rng.permutation(np.arange(len(dear_scenes)) % FOLDS)
    fold = fold_of[population.scene]
    mean, scale = features[is_clear].mean(axis=0), features[is_clear].std(axis=0)
    terms = _terms((features - mean) / np.where(scale > 0, scale, 1.0))
    prediction = np.zeros(len(fold))
    unlabelled = is_clear & (fold < 0)
    for number in range(FOLDS):
        rows = fitted_on & (fold != number)
        weight = 1 / population.probability[rows]
        inner = terms[rows].T * weight @ terms[rows]
        inner += _RIDGE * weight.sum() * np.diag(np.arange(len(inner)) > 0)
        solution = np.linalg.solve(inner, terms[rows].T * weight @ population.label[rows])
        held_out = is_clear & (fold == number)
        prediction[held_out] = terms[held_out] @ solution
        prediction[unlabelled] += terms[unlabelled] @ solution / FOLDS
    return prediction.clip(0.0, 1.0)


def _terms(x: F64) -> F64:
    """1, the columns of x (N, F), and the products of every two."""
    first, second = np.triu_indices(x.shape[1])
    return np.column_stack([np.ones(len(x)), x, x[:, first] * x[:, second]])
