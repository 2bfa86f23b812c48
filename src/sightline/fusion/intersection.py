"""Estimates fused whose errors are correlated in an unknown way: (split) covariance intersection.

An average that takes correlated errors for independent ones states ellipses that are too small.
Covariance intersection (Julier and Uhlmann, "A non-divergent estimation algorithm in the presence
of unknown correlations", ACC 1997) holds for any correlation. Split covariance intersection (Julier
and Uhlmann, "General decentralized data fusion with covariance intersection", in *Handbook of
Multisensor Data Fusion*, 2001) holds where a part of each covariance is known to be of errors that
are independent of all others, and is tighter for it.
"""

from __future__ import annotations

import numpy as np

from sightline.errors import InputError
from sightline.types import BoolArray, FloatArray

_ITERATIONS = 60
_DAMPING = 0.7
_SETTLED = 1e-4


def intersect(
    values: FloatArray, covariances: FloatArray, correlated_share: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    r"""Fuse estimates of the same vectors by split covariance intersection.

    With the share s of each covariance :math:`P_i` correlated with the others' in an unknown way,
    and weights :math:`w_i` that sum to one,

    .. math:: P^{-1} = \sum_i g_i P_i^{-1}, \quad g_i = \frac{w_i}{s + (1 - s) w_i}, \quad
        x = P \sum_i g_i P_i^{-1} x_i .

    P is at least the covariance of x for any weights; they are those with the least determinant,
    which is a concave problem (multiplicative ascent). With s = 1 this is covariance intersection,
    with s = 0 the fusion of independent estimates.

    Args:
        values: (N, K, D) estimates, K of each of N vectors; NaN where there is none.
        covariances: (N, K, D, D) their covariances.
        correlated_share: The share s, 0 to 1.

    Returns:
        (N, D) fused values and (N, D, D) covariances; NaN where there was no estimate.

    Raises:
        InputError: The share is not between 0 and 1.
    """
    if not 0.0 <= correlated_share <= 1.0:
        raise InputError(f"a correlated share of {correlated_share:g} is not between 0 and 1")
    n, _, size = values.shape
    known: BoolArray = np.asarray(np.isfinite(values).all(axis=2))
    known = known & np.isfinite(covariances).all(axis=(2, 3))
    safe = np.where(known[..., None, None], covariances, np.eye(size))
    information = np.where(known[..., None, None], np.linalg.inv(safe), 0.0)
    gain = _gains(information, known, correlated_share)
    total = np.einsum("nk,nkij->nij", gain, information)
    at = np.where(known[..., None], values, 0.0)
    weighted = np.einsum("nk,nkij,nkj->ni", gain, information, at)
    some = known.any(axis=1)
    fused = np.full((n, size), np.nan)
    covariance = np.full((n, size, size), np.nan)
    covariance[some] = np.linalg.inv(total[some])
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    fused[some] = np.einsum("nij,nj->ni", covariance[some], weighted[some])
    return fused, covariance


def _gains(information: FloatArray, known: BoolArray, share: float) -> FloatArray:
    """(N, K) the gains that give the least determinant."""
    weight = known / np.maximum(known.sum(axis=1, keepdims=True), 1)
    several = np.flatnonzero(known.sum(axis=1) > 1)
    if share > 0.0 and several.size:
        weight[several] = _weights(information[several], weight[several], share)
    return np.asarray(np.where(known, weight / (share + (1.0 - share) * weight + 1e-300), 0.0))


def _weights(information: FloatArray, weight: FloatArray, share: float) -> FloatArray:
    """(N, K) weights on the simplex that maximise the determinant of the fused information."""
    for _ in range(_ITERATIONS):
        below = share + (1.0 - share) * weight
        total = np.einsum("nk,nkij->nij", weight / below, information)
        trace = np.einsum("nij,nkji->nk", np.linalg.inv(total), information)
        # The gradient of the logarithm of the determinant, times the weight.
        moved = weight * (trace * share / below**2) ** _DAMPING
        moved = moved / moved.sum(axis=1, keepdims=True)
        settled = float(np.abs(moved - weight).max()) < _SETTLED
        weight = moved
        if settled:
            break
    return weight
