"""Learning curves: the error of a model as a function of the labels of each source.

One source alone follows a power law with an offset (Mahmood et al. 2022, arXiv 2207.01725):

    error(n) = e + a (n / n0)^-b

For several sources, labels are converted into labels of the first dear source and added, like the effective
data of a transfer (Hernandez et al. 2021, arXiv 2102.01293, eq. 1.2):

    m = q_1 + w q_2 + k n0 (q_cheap / h0)^g        error = e + a (m / n0)^-b

n0 and h0 are the largest numbers of labels measured. Parameters are fitted by least squares with weak priors:
a curve without a bend does not determine b, and one without a second dear source does not determine w. Each
resample of the bootstrap is fitted separately.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from datagen.train.inputs import F64

# The residual of a point that weighs as much as one standard deviation of a prior. Points differ by about as
# much between seeds.
_SPREAD = 0.005
# log b, log w, g: mean and standard deviation. Exponents of published curves are between 0.1 and 1.
_PRIOR_LOG_B, _PRIOR_LOG_W, _PRIOR_G = (np.log(0.35), 1.0), (0.0, 1.0), (0.5, 0.25)
_LEAST_POINTS = 3


@dataclass(frozen=True)
class CurveForm:
    """Terms and units of a curve: K - 1 dear sources after a cheap one, or K dear sources.

    Parameters theta (..., P): e, a, log b, log w of each further dear source, then k and g of a cheap one.
    """

    dear: int
    cheap: bool
    unit: float  # n0, labels
    cheap_unit: float = 1.0  # h0, labels

    def effective(self, theta: F64, labels: F64) -> F64:
        """Equivalent labels m (...) of the first dear source for labels (..., K), cheap source first if any.

        `theta` (..., P) broadcasts against the leading dimensions.
        """
        dear = labels[..., 1:] if self.cheap else labels
        found = dear[..., 0]
        for k in range(1, self.dear):
            found = found + np.exp(theta[..., 2 + k]) * dear[..., k]
        if self.cheap:
            share = labels[..., 0] / self.cheap_unit
            worth = theta[..., -2] * self.unit * np.where(share > 0, share, 1.0) ** theta[..., -1]
            found = found + np.where(share > 0, worth, 0.0)
        return found

    def error(self, theta: F64, labels: F64) -> F64:
        """Predicted error (...) with labels (..., K)."""
        m = np.maximum(self.effective(theta, labels), 1.0) / self.unit
        return theta[..., 0] + theta[..., 1] * m ** -np.exp(theta[..., 2])


@dataclass(frozen=True, eq=False)
class LearningCurve:
    """A fitted curve: parameters (P,), and those of each resample (B, P)."""

    form: CurveForm
    theta: F64
    resamples: F64
    residual: float  # root mean square over the points

    def accuracy(self, labels: F64) -> tuple[F64, F64]:
        """1 - error (...) with labels (..., K), and (B, ...) of the resamples."""
        drawn = self.resamples.reshape(len(self.resamples), *[1] * (labels.ndim - 1), -1)
        return 1 - self.form.error(self.theta, labels), 1 - self.form.error(drawn, labels)


def fit_curve(form: CurveForm, labels: F64, accuracy: F64, resampled: F64) -> LearningCurve | None:
    """Fit points with labels (M, K), accuracies (M,) and resampled ones (B, M). None for fewer than three."""
    if len(labels) < _LEAST_POINTS:
        return None
    starts = [_start(form, b) for b in (0.15, 0.5, 1.0)]
    fits = [_fit(form, labels, 1 - accuracy, start) for start in starts]
    theta = min(fits, key=lambda fit: fit[1])[0]
    resampled_theta = [_fit(form, labels, 1 - row, theta)[0] for row in resampled]
    residual = float(np.sqrt(np.mean((form.error(theta, labels) - (1 - accuracy)) ** 2)))
    return LearningCurve(form, theta, np.array(resampled_theta), residual)


def _start(form: CurveForm, b: float) -> F64:
    return np.array([0.05, 0.1, np.log(b), *[0.0] * (form.dear - 1), *[0.1, 0.5] * form.cheap])


def _bounds(form: CurveForm, labels: F64) -> tuple[F64, F64]:
    """Bounds (P,) of the parameters. Cheap labels may count negatively: training must undo a bad start."""
    least = labels[:, 1:].sum(axis=1)[labels[:, 0] > 0].min(initial=form.unit) if form.cheap else 0.0
    worst = -0.9 * least / form.unit
    low = [0.0, 0.0, np.log(0.02), *[np.log(0.01)] * (form.dear - 1), *[worst, 0.05] * form.cheap]
    high = [0.6, 1.0, np.log(3.0), *[np.log(100.0)] * (form.dear - 1), *[100.0, 1.0] * form.cheap]
    return np.array(low), np.array(high)


def _fit(form: CurveForm, labels: F64, error: F64, start: F64) -> tuple[F64, float]:
    def residuals(theta: F64) -> F64:
        priors = [_off(theta[2], _PRIOR_LOG_B), *(_off(t, _PRIOR_LOG_W) for t in theta[3 : 2 + form.dear])]
        priors += [_off(theta[-1], _PRIOR_G)] * form.cheap
        return np.concatenate([(form.error(theta, labels) - error) / _SPREAD, priors])

    low, high = _bounds(form, labels)
    inside = np.clip(start, low + 1e-9, high - 1e-9)
    fit = least_squares(residuals, inside, bounds=(low, high), x_scale=_scales(form), max_nfev=200)
    return fit.x, float(fit.cost)


def _off(value: float, prior: tuple[float, float]) -> float:
    return (value - prior[0]) / prior[1]


def _scales(form: CurveForm) -> Sequence[float]:
    return [0.05, 0.05, 0.5, *[0.5] * (form.dear - 1), *[0.1, 0.3] * form.cheap]
