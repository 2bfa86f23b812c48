"""Base class of the paper's estimators: checks of inputs, scaling and state."""

from __future__ import annotations

from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import validate_data

from sightline.types import FloatArray

Arrays = dict[str, NDArray[Any]]
"""The numbers of a fitted estimator, by name: what a safetensors file holds."""

Settings = dict[str, Any]
"""The rest of a fitted estimator, as JSON can hold it."""


class CovarianceRegressor(Protocol):
    """A scikit-learn regressor with predictive covariance and storable state.

    Attributes:
        residual_covariance_: (K, K) float64, the covariance of what the fitted estimator leaves
            of the targets. NaN where the data is too little to tell.
    """

    residual_covariance_: FloatArray

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Fit to features (N, n) and targets (N,) or (N, K)."""
        ...

    def predict(self, X: ArrayLike, return_cov: bool = False) -> Any:
        """Predictions, shaped as in `fit`; with ``return_cov`` also (N, K, K) covariances."""
        ...

    def state(self) -> tuple[Arrays, Settings]:
        """State that `from_state` restores."""
        ...

    @classmethod
    def from_state(cls, arrays: Arrays, settings: Settings) -> Self:
        """Restore the estimator from its `state`."""
        ...


def check_pairs(
    estimator: Any, X: ArrayLike, y: ArrayLike, *, reset: bool = True
) -> tuple[FloatArray, FloatArray]:
    """Validate features and targets as scikit-learn does.

    Returns:
        (N, n) float64 and (N, K) float64; targets that came as (N,) become (N, 1), and
        ``estimator.flat_targets_`` says which it was, so that predictions can follow.

    Raises:
        ValueError: As scikit-learn's estimators raise it: NaN, infinity, or shapes that do not
            fit one another or the data that came before.
    """
    features, checked = validate_data(
        estimator, X, y, reset=reset, multi_output=True, y_numeric=True, dtype=np.float64
    )
    targets = np.asarray(checked, dtype=np.float64)
    if reset:
        estimator.flat_targets_ = targets.ndim == 1
    return features, targets.reshape(len(targets), -1)


def check_features(estimator: Any, X: ArrayLike) -> FloatArray:
    """Validate features of a fitted estimator, (N, n) float64, as `check_pairs` does."""
    checked: FloatArray = validate_data(estimator, X, reset=False, dtype=np.float64)
    return checked


def with_covariance(estimator: CovarianceRegressor, X: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Predictions of a fitted estimator as (N, K), whatever the targets were, and covariances."""
    predicted, covariance = estimator.predict(X, return_cov=True)
    return predicted.reshape(len(predicted), -1), covariance


def like_targets(estimator: Any, predicted: FloatArray) -> FloatArray:
    """Predictions (N, K) in the shape of the targets that the estimator was fitted to."""
    return predicted[:, 0] if estimator.flat_targets_ else predicted


class Scaler:
    """Standardises columns to mean 0 and standard deviation 1.

    A constant column is brought to 0, and whatever is predicted for it goes back to the constant.

    Attributes:
        mean: (K,) float64.
        scale: (K,) float64, the standard deviations; 0 for a constant column.
    """

    def __init__(self, mean: FloatArray, scale: FloatArray) -> None:
        self.mean = mean
        self.scale = scale

    @classmethod
    def of(cls, values: FloatArray) -> Self:
        """The scaler of a table (N, K)."""
        scale = values.std(axis=0)
        # What rounding leaves of a constant column must not be blown up to 1.
        negligible = scale <= 10.0 * np.finfo(float).eps * np.abs(values).max(axis=0)
        return cls(values.mean(axis=0), np.where(negligible, 0.0, scale))

    def forward(self, values: FloatArray) -> FloatArray:
        """Standardised values."""
        return (values - self.mean) / np.where(self.scale > 0.0, self.scale, 1.0)

    def back(self, values: FloatArray) -> FloatArray:
        """Undo `forward`."""
        return values * self.scale + self.mean

    def covariance_back(self, covariance: FloatArray) -> FloatArray:
        """Covariances (..., K, K) of standardised values, in the units of the values."""
        return covariance * np.outer(self.scale, self.scale)
