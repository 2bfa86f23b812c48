"""Calibration of a detector's confidence: of boxes at 0.7, seven in ten are to be right.

The map from scores to probabilities is a logistic curve over the logit of the score (Platt 1999),
fitted to boxes of which it is known whether they are right. It rises, so that no box changes places
with another. The expected calibration error is that of Naeini et al. 2015: the difference between
mean confidence and share of right boxes in ten bins, weighted by how many boxes each has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sightline.types import BoolArray, FloatArray

BINS = 10

CalibrationMap = tuple[tuple[float, float], ...]
"""Scores and the probability that a box of that score is right; linear between them."""

_ENDS = np.array([0.001, 0.003, 0.01, 0.02, 0.03])
_KNOTS = np.concatenate([[0.0], _ENDS, np.linspace(0.05, 0.95, 19), 1.0 - _ENDS[::-1], [1.0]])
_LEAST_SCORE = 1e-4
_FEWEST = 5
"""Right boxes, and wrong ones, without which a curve is a guess."""


@dataclass(frozen=True, eq=False)
class Reliability:
    """How often boxes are right, by their confidence.

    Attributes:
        confidence: (K,) mean of each bin; NaN where it is empty.
        right: (K,) share that is right, likewise.
        count: (K,) boxes.
        error: Expected calibration error; NaN without boxes.
    """

    confidence: FloatArray
    right: FloatArray
    count: FloatArray
    error: float


def reliability(confidence: FloatArray, right: BoolArray) -> Reliability:
    """Compare confidence with how often boxes are right, in bins of a tenth.

    Args:
        confidence: (N,) 0 to 1.
        right: (N,).
    """
    own = np.minimum((np.asarray(confidence) * BINS).astype(np.int64), BINS - 1)
    count = np.bincount(own, minlength=BINS).astype(float)
    filled = np.where(count > 0.0, count, np.nan)
    said = np.bincount(own, weights=confidence, minlength=BINS) / filled
    true = np.bincount(own, weights=np.asarray(right, float), minlength=BINS) / filled
    total = count.sum()
    error = float(np.nansum(count * np.abs(said - true)) / total) if total else float("nan")
    return Reliability(said, true, count, error)


def fit_calibration(confidence: FloatArray, right: BoolArray) -> CalibrationMap | None:
    """Fit the map from scores to probabilities.

    Args:
        confidence: (N,) scores, 0 to 1.
        right: (N,).

    Returns:
        None where there are too few boxes of a kind, or surer ones are not right more often.
    """
    from sklearn.linear_model import LogisticRegression

    positive = int(right.sum())
    negative = len(right) - positive
    if min(positive, negative) < _FEWEST:
        return None
    # Platt's targets: that one more of either kind may come.
    target = np.where(right, (positive + 1.0) / (positive + 2.0), 1.0 / (negative + 2.0))
    rows = np.concatenate([_logit(confidence), _logit(confidence)])[:, None]
    kinds = np.repeat([1, 0], len(right))
    curve = LogisticRegression(C=1e6).fit(
        rows, kinds, sample_weight=np.concatenate([target, 1.0 - target])
    )
    if curve.coef_[0, 0] <= 0.0:
        return None
    probability = curve.predict_proba(_logit(_KNOTS)[:, None])[:, 1]
    # Most of a picture has hardly any score.
    probability[0] = 0.0
    return tuple(
        (round(float(score), 4), round(float(share), 6))
        for score, share in zip(_KNOTS, probability, strict=True)
    )


def calibrated(confidence: FloatArray, mapping: CalibrationMap) -> FloatArray:
    """(N,) probabilities of scores, by a map."""
    scores, probabilities = np.array(mapping).T
    return np.asarray(np.interp(confidence, scores, probabilities))


def _logit(score: FloatArray) -> FloatArray:
    inside = np.clip(score, _LEAST_SCORE, 1.0 - _LEAST_SCORE)
    return np.asarray(np.log(inside) - np.log1p(-inside))
