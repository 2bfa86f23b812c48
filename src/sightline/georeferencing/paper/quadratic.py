"""Quadratic kernel regression, the first layer of the paper's model (eqs. 2, 3; Algorithm 1)."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_is_fitted

from sightline.georeferencing.paper.estimator import (
    Arrays,
    Settings,
    check_features,
    check_pairs,
    like_targets,
)
from sightline.georeferencing.paper.vectorisation import ivec, vec_weights
from sightline.types import FloatArray

_LARGEST = 1e150
_BLOCK_VALUES = 2**17
"""Feature values that are held at once: a megabyte, which stays in a core's cache."""


class QuadraticKernelRegression(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """Least squares on all monomials up to degree two (section 4.2, Algorithm 1).

    With ``Z = [x; 1] [x; 1]ᵀ`` and ``z = vec(Z)`` the model is ``y = z · q`` (eq. 2 with
    ``q = vec(Q)``). Fitting accumulates ``A = Σ z zᵀ`` and ``b = Σ y z``, one block of rows at a
    time, and solves ``A q = b`` through the singular values of A: ``q = V Σ⁺ Uᵀ b``. Where the
    data does not determine q, that is the solution of the smallest norm. Memory does not grow
    with the number of rows, all outputs share A, and `partial_fit` may bring the rows in any
    portions.

    A holds fourth powers of the features, so features should be of the order of one, as
    normalised image coordinates are: of raw pixels it keeps only two or three digits.

    Args:
        rcond: Singular values of A below this share of the largest count as zero. None: m
            times the rounding unit, below which A itself holds no information.

    Attributes:
        A_: (m, m) float64, ``Σ z zᵀ``, with m = (n + 1) (n + 2) / 2 for n features.
        b_: (m, K) float64, ``Σ z yᵀ`` for K outputs.
        q_: (m, K) float64, the solution.
        rank_: How many of the m combinations of coefficients the data determines.
        H_: (K, n, n) float64, ``f_q(x) = xᵀ H x + f · x + r`` (eq. 2).
        f_: (K, n) float64.
        r_: (K,) float64.
        n_rows_: Rows seen.
        residual_covariance_: (K, K) float64, from the residuals with n_rows_ - rank_ degrees of
            freedom; NaN where there are none.
        n_features_in_: Features seen in the first fit.
        flat_targets_: Whether the targets came as (N,).
    """

    def __init__(self, *, rcond: float | None = None) -> None:
        self.rcond = rcond

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Fit to all rows at once, forgetting what came before.

        Args:
            X: (N, n) features.
            y: (N,) or (N, K) targets.
        """
        features, targets = check_pairs(self, X, y)
        self._start(features.shape[1], targets.shape[1])
        self._accumulate(features, targets)
        self._solve()
        return self

    def partial_fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Update the fit with more rows.

        Args:
            X: (N, n) features.
            y: (N,) or (N, K) targets, shaped as before.

        Raises:
            ValueError: The number of features or outputs is not what it was.
        """
        first = not hasattr(self, "A_")
        features, targets = check_pairs(self, X, y, reset=first)
        if first:
            self._start(features.shape[1], targets.shape[1])
        elif targets.shape[1] != self.b_.shape[1]:
            raise ValueError(
                f"y has {targets.shape[1]} outputs, but the rows before had {self.b_.shape[1]}"
            )
        self._accumulate(features, targets)
        self._solve()
        return self

    def predict(
        self, X: ArrayLike, return_cov: bool = False
    ) -> FloatArray | tuple[FloatArray, FloatArray]:
        """``y = z · q``.

        The covariance is that of linear regression for a new observation,
        ``S (1 + zᵀ A⁺ z)`` with S the residual covariance. It holds where the world is
        quadratic and along directions that the data determines, no further.

        Args:
            X: (N, n) features.
            return_cov: Whether to return covariances, too.

        Returns:
            (N,) or (N, K) predictions, as the targets were; with ``return_cov`` also their
            (N, K, K) covariances.
        """
        check_is_fitted(self)
        z = lift(check_features(self, X))
        predicted = like_targets(self, z.T @ self.q_)
        if not return_cov:
            return predicted
        # Rounding can leave the form just below zero.
        leverage = np.maximum(np.einsum("mi,mi->i", z, self._A_pinv @ z), 0.0)
        return predicted, (1.0 + leverage)[:, None, None] * self.residual_covariance_

    def state(self) -> tuple[Arrays, Settings]:
        """The sums, from which the estimator can be rebuilt and fitted further."""
        check_is_fitted(self)
        arrays: Arrays = {"A": self.A_, "b": self.b_, "target_moments": self._target_moments}
        settings: Settings = {
            "n_features": self.n_features_in_,
            "n_rows": self.n_rows_,
            "flat_targets": self.flat_targets_,
            "rcond": self.rcond,
        }
        return arrays, settings

    @classmethod
    def from_state(cls, arrays: Arrays, settings: Settings) -> Self:
        """Restore the estimator from its `state`."""
        estimator = cls(rcond=settings["rcond"])
        estimator.n_features_in_ = settings["n_features"]
        estimator.flat_targets_ = settings["flat_targets"]
        estimator.n_rows_ = settings["n_rows"]
        estimator.A_ = np.array(arrays["A"])
        estimator.b_ = np.array(arrays["b"])
        estimator._target_moments = np.array(arrays["target_moments"])
        # Of what is no number, or is none once it is squared, LAPACK seeks the values for ever.
        if not (np.abs(estimator.A_) < _LARGEST).all():
            raise ValueError("its sums of monomials are not numbers")
        estimator._solve()
        return estimator

    def _start(self, n_features: int, n_outputs: int) -> None:
        m = (n_features + 1) * (n_features + 2) // 2
        self.A_ = np.zeros((m, m))
        self.b_ = np.zeros((m, n_outputs))
        self._target_moments = np.zeros((n_outputs, n_outputs))
        self.n_rows_ = 0

    def _accumulate(self, features: FloatArray, targets: FloatArray) -> None:
        n_rows, n_features = features.shape
        m, n_outputs = self.b_.shape
        block = max(_BLOCK_VALUES // (m + n_outputs), 1)
        # Monomials and targets side by side: one product of this table with itself is all sums.
        table = np.empty((m + n_outputs, min(block, n_rows)))
        sums = np.zeros((m + n_outputs, m + n_outputs))
        for start in range(0, n_rows, block):
            rows = slice(start, start + block)
            part = table[:, : len(features[rows])]
            _monomials(features[rows], out=part[:m])
            part[m:] = targets[rows].T
            sums += part @ part.T
        weights = vec_weights(n_features + 1)
        self.A_ += np.outer(weights, weights) * sums[:m, :m]
        self.b_ += weights[:, None] * sums[:m, m:]
        self._target_moments += sums[m:, m:]
        self.n_rows_ += n_rows

    def _solve(self) -> None:
        U, singular_values, Vt = np.linalg.svd(self.A_)
        rcond = self.rcond
        if rcond is None:
            rcond = len(self.A_) * float(np.finfo(float).eps)
        determined = singular_values > rcond * singular_values[0]
        self.rank_ = int(determined.sum())
        V_scaled = Vt[determined].T / singular_values[determined]
        self._A_pinv = V_scaled @ U[:, determined].T
        self.q_ = V_scaled @ (U[:, determined].T @ self.b_)
        Q = ivec(self.q_.T)
        self.H_ = Q[:, :-1, :-1]
        self.f_ = 2.0 * Q[:, :-1, -1]
        self.r_ = Q[:, -1, -1]
        self.residual_covariance_ = self._residual_covariance()

    def _residual_covariance(self) -> FloatArray:
        freedom = self.n_rows_ - self.rank_
        if freedom <= 0:
            return np.full_like(self._target_moments, np.nan)
        cross = self.q_.T @ self.b_
        left = self._target_moments - cross - cross.T + self.q_.T @ self.A_ @ self.q_
        # The sums cancel to rounding error where the fit is perfect: no variance below zero.
        values, vectors = np.linalg.eigh((left + left.T) / 2.0)
        covariance: FloatArray = (vectors * np.maximum(values, 0.0)) @ vectors.T / freedom
        return covariance

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags


def lift(X: FloatArray) -> FloatArray:
    """Quadratic feature vectors ``vec([x; 1] [x; 1]ᵀ)`` of every row.

    Args:
        X: (N, n).

    Returns:
        (m, N) float64, one column a row of X, with m = (n + 1) (n + 2) / 2.
    """
    n_rows, n_features = X.shape
    weights = vec_weights(n_features + 1)
    monomials = np.empty((len(weights), n_rows))
    _monomials(X, out=monomials)
    return weights[:, None] * monomials


def _monomials(X: FloatArray, *, out: FloatArray) -> None:
    """`lift` without its √2s. Stacked diagonal-wise, every diagonal is a product of two slices."""
    n_rows, n_features = X.shape
    extended = np.empty((n_features + 1, n_rows))
    extended[:-1] = X.T
    extended[-1] = 1.0
    start = 0
    for d in range(n_features + 1):
        stop = start + n_features + 1 - d
        np.multiply(extended[: n_features + 1 - d], extended[d:], out=out[start:stop])
        start = stop
