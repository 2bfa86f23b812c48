"""The paper's Gaussian process regression (section 4.2)."""

from __future__ import annotations

import warnings
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.utils.validation import check_is_fitted

from sightline.georeferencing.paper.estimator import (
    Arrays,
    Scaler,
    Settings,
    check_features,
    check_pairs,
    like_targets,
)
from sightline.types import FloatArray

_BLOCK_ROWS = 2048
"""Rows predicted at once; each needs a row of the kernel matrix against all points kept."""

_KERNEL_POINTS = 500
"""Points that the kernel's three parameters are found from; more of them tell little more."""


class GaussianProcessRegression(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """An exact Gaussian process with an RBF kernel and white noise, on standardised data.

    All outputs share the kernel, whose amplitude, length and noise maximise the marginal
    likelihood. Their covariance is the process's variance times the matrix ``Yᵀ K⁻¹ Y / N`` of
    the standardised targets Y, the maximum-likelihood estimate of how the outputs vary together
    (the intrinsic model of coregionalisation, under which the mean stays that of each output
    alone). So errors that run along a line of sight have ellipses that do.

    Time grows with the third power of the points. Of more rows than `max_points` the process
    keeps those that lie furthest apart, beginning with the one nearest the middle and always
    adding the one furthest from all kept so far: the same rows give the same points, and sparse
    regions keep theirs. The kernel's parameters are found from at most 500 of the points kept,
    chosen in the same way.

    Args:
        max_points: Rows to keep at most.

    Attributes:
        kernel_: The kernel with its parameters, as scikit-learn has it.
        residual_covariance_: (K, K) float64, of the white noise.
        n_features_in_: Features seen in the fit.
        flat_targets_: Whether the targets came as (N,).
    """

    def __init__(self, *, max_points: int = 2000) -> None:
        self.max_points = max_points

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Keep the training points and fit the kernel's hyperparameters.

        Args:
            X: (N, n) features.
            y: (N,) or (N, K) targets.
        """
        features, targets = check_pairs(self, X, y)
        self._feature_scaler = Scaler.of(features)
        inputs = self._feature_scaler.forward(features)
        kept = spread_out(inputs, self.max_points)
        self._target_scaler = Scaler.of(targets[kept])
        inputs, outputs = inputs[kept], self._target_scaler.forward(targets[kept])
        few = spread_out(inputs, _KERNEL_POINTS)
        kernel = ConstantKernel(1.0, (1e-3, 1e3)) * RBF(1.0, (1e-2, 1e2)) + WhiteKernel(
            1e-2, (1e-6, 1e1)
        )
        with warnings.catch_warnings():
            # A parameter at its bound is an answer: no structure, or no noise.
            warnings.simplefilter("ignore", ConvergenceWarning)
            found = GaussianProcessRegressor(kernel).fit(inputs[few], outputs[few]).kernel_
        self._set_process(GaussianProcessRegressor(found, optimizer=None).fit(inputs, outputs))
        return self

    def predict(
        self, X: ArrayLike, return_cov: bool = False
    ) -> FloatArray | tuple[FloatArray, FloatArray]:
        """Predictive mean of the process.

        Args:
            X: (N, n) features.
            return_cov: Whether to return covariances, too.

        Returns:
            (N,) or (N, K) predictions, as the targets were; with ``return_cov`` also their
            (N, K, K) covariances, white noise included.
        """
        check_is_fitted(self)
        inputs = self._feature_scaler.forward(check_features(self, X))
        n_rows, n_outputs = len(inputs), len(self._target_scaler.mean)
        mean = np.empty((n_rows, n_outputs))
        variance = np.empty(n_rows)
        for start in range(0, n_rows, _BLOCK_ROWS):
            rows = slice(start, start + _BLOCK_ROWS)
            block = inputs[rows]
            if return_cov:
                predicted, deviation = self._process.predict(block, return_std=True)
                variance[rows] = deviation.reshape(len(block), -1)[:, 0] ** 2
            else:
                predicted = self._process.predict(block)
            mean[rows] = predicted.reshape(len(block), -1)
        predictions = like_targets(self, self._target_scaler.back(mean))
        if not return_cov:
            return predictions
        return predictions, variance[:, None, None] * self._output_covariance

    def state(self) -> tuple[Arrays, Settings]:
        """Training points, scales and hyperparameters."""
        check_is_fitted(self)
        arrays: Arrays = {
            "feature_mean": self._feature_scaler.mean,
            "feature_scale": self._feature_scaler.scale,
            "target_mean": self._target_scaler.mean,
            "target_scale": self._target_scaler.scale,
            "inputs": self._process.X_train_,
            "outputs": self._process.y_train_,
        }
        settings: Settings = {
            "max_points": self.max_points,
            "amplitude": float(self.kernel_.k1.k1.constant_value),
            "length_scale": float(self.kernel_.k1.k2.length_scale),
            "noise_level": float(self.kernel_.k2.noise_level),
            "flat_targets": self.flat_targets_,
        }
        return arrays, settings

    @classmethod
    def from_state(cls, arrays: Arrays, settings: Settings) -> Self:
        """Restore the estimator from its `state`."""
        for name in ("amplitude", "length_scale", "noise_level"):
            if not 0.0 < settings[name] < np.inf:
                raise ValueError(f"{name} is no positive number")
        estimator = cls(max_points=settings["max_points"])
        estimator._feature_scaler = Scaler(arrays["feature_mean"], arrays["feature_scale"])
        estimator._target_scaler = Scaler(arrays["target_mean"], arrays["target_scale"])
        estimator.n_features_in_ = len(arrays["feature_mean"])
        estimator.flat_targets_ = settings["flat_targets"]
        kernel = ConstantKernel(settings["amplitude"]) * RBF(
            settings["length_scale"]
        ) + WhiteKernel(settings["noise_level"])
        process = GaussianProcessRegressor(kernel, optimizer=None)
        estimator._set_process(process.fit(arrays["inputs"], arrays["outputs"]))
        return estimator

    def _set_process(self, process: GaussianProcessRegressor) -> None:
        self._process = process
        self.kernel_ = process.kernel_
        outputs = process.y_train_
        together = outputs.T @ process.alpha_.reshape(outputs.shape) / len(outputs)
        self._output_covariance = self._target_scaler.covariance_back((together + together.T) / 2.0)
        self.residual_covariance_ = self.kernel_.k2.noise_level * self._output_covariance

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags


def spread_out(points: FloatArray, n_kept: int) -> NDArray[np.intp]:
    """Farthest-point subset of a table's rows (the greedy k-centre of Gonzalez, 1985).

    Args:
        points: (N, n).
        n_kept: How many to keep; all, in their order, where there are no more than that.

    Returns:
        (min(N, n_kept),) increasing row numbers.
    """
    if len(points) <= n_kept:
        return np.arange(len(points))
    kept = np.empty(n_kept, dtype=np.intp)
    kept[0] = np.argmin(((points - points.mean(axis=0)) ** 2).sum(axis=1))
    nearest = ((points - points[kept[0]]) ** 2).sum(axis=1)
    # Rows that repeat a place are taken last, one each, rather than one of them again and again.
    nearest[kept[0]] = -1.0
    for i in range(1, n_kept):
        kept[i] = np.argmax(nearest)
        np.minimum(nearest, ((points - points[kept[i]]) ** 2).sum(axis=1), out=nearest)
        nearest[kept[i]] = -1.0
    return np.sort(kept)
