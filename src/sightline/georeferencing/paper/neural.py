"""The paper's neural network: a small multi-layer perceptron (section 4.2)."""

from __future__ import annotations

import warnings
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.model_selection import KFold
from sklearn.neural_network import MLPRegressor
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


class NeuralNetworkRegression(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """A multi-layer perceptron with tanh units on standardised features and targets.

    The covariance is the same everywhere: that of the errors on rows held out in turn
    (`n_folds` folds, each with a network of its own). It knows nothing of rows far from those of
    the fit, and rows that come in runs, as the frames of a video do, make it too small, since
    each held-out row has its neighbours in the fit.

    Args:
        hidden_layer_sizes: Units in each hidden layer.
        alpha: Weight of the squared network weights in the loss.
        max_iter: Steps of L-BFGS at most.
        n_folds: Folds for the covariance, at least 2.
        random_state: Seed of the first weights and of the folds; the same seed, the same network.

    Attributes:
        coefs_: Weights of each layer, (units before, units) float64.
        intercepts_: Biases of each layer, (units,) float64.
        residual_covariance_: (K, K) float64, of the held-out errors; NaN for a single row.
        n_iter_: Steps that the training took.
        n_features_in_: Features seen in the fit.
        flat_targets_: Whether the targets came as (N,).
    """

    def __init__(
        self,
        *,
        hidden_layer_sizes: tuple[int, ...] = (16,),
        alpha: float = 0.1,
        max_iter: int = 500,
        n_folds: int = 5,
        random_state: int = 0,
    ) -> None:
        self.hidden_layer_sizes = hidden_layer_sizes
        self.alpha = alpha
        self.max_iter = max_iter
        self.n_folds = n_folds
        self.random_state = random_state

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Train the network, and one more for each fold.

        Args:
            X: (N, n) features.
            y: (N,) or (N, K) targets.
        """
        features, targets = check_pairs(self, X, y)
        self._feature_scaler = Scaler.of(features)
        self._target_scaler = Scaler.of(targets)
        inputs = self._feature_scaler.forward(features)
        outputs = self._target_scaler.forward(targets)
        self.residual_covariance_ = self._target_scaler.covariance_back(
            self._held_out_covariance(inputs, outputs)
        )
        network = self._train(inputs, outputs)
        self.coefs_, self.intercepts_ = network.coefs_, network.intercepts_
        self.n_iter_ = int(network.n_iter_)
        return self

    def predict(
        self, X: ArrayLike, return_cov: bool = False
    ) -> FloatArray | tuple[FloatArray, FloatArray]:
        """Predictions of the network.

        Args:
            X: (N, n) features.
            return_cov: Whether to return covariances, too.

        Returns:
            (N,) or (N, K) predictions, as the targets were; with ``return_cov`` also their
            (N, K, K) covariances, which are all `residual_covariance_`.
        """
        check_is_fitted(self)
        inputs = self._feature_scaler.forward(check_features(self, X))
        outputs = _forward(self.coefs_, self.intercepts_, inputs)
        predicted = like_targets(self, self._target_scaler.back(outputs))
        if not return_cov:
            return predicted
        return predicted, np.tile(self.residual_covariance_, (len(inputs), 1, 1))

    def state(self) -> tuple[Arrays, Settings]:
        """The network's weights and scales."""
        check_is_fitted(self)
        arrays: Arrays = {
            "feature_mean": self._feature_scaler.mean,
            "feature_scale": self._feature_scaler.scale,
            "target_mean": self._target_scaler.mean,
            "target_scale": self._target_scaler.scale,
            "residual_covariance": self.residual_covariance_,
        }
        for i, (coefs, intercepts) in enumerate(zip(self.coefs_, self.intercepts_, strict=True)):
            arrays[f"coefs_{i}"] = coefs
            arrays[f"intercepts_{i}"] = intercepts
        settings: Settings = {
            **self.get_params(),
            "hidden_layer_sizes": list(self.hidden_layer_sizes),
            "n_iter": self.n_iter_,
            "flat_targets": self.flat_targets_,
        }
        return arrays, settings

    @classmethod
    def from_state(cls, arrays: Arrays, settings: Settings) -> Self:
        """Restore the estimator from its `state`."""
        params = dict(settings)
        flat_targets, n_iter = params.pop("flat_targets"), params.pop("n_iter")
        params["hidden_layer_sizes"] = tuple(params["hidden_layer_sizes"])
        estimator = cls(**params)
        layers = range(len(estimator.hidden_layer_sizes) + 1)
        estimator.coefs_ = [np.array(arrays[f"coefs_{i}"]) for i in layers]
        estimator.intercepts_ = [np.array(arrays[f"intercepts_{i}"]) for i in layers]
        estimator.residual_covariance_ = np.array(arrays["residual_covariance"])
        estimator._feature_scaler = Scaler(arrays["feature_mean"], arrays["feature_scale"])
        estimator._target_scaler = Scaler(arrays["target_mean"], arrays["target_scale"])
        estimator.n_features_in_ = len(arrays["feature_mean"])
        estimator.flat_targets_, estimator.n_iter_ = flat_targets, n_iter
        return estimator

    def _held_out_covariance(self, inputs: FloatArray, outputs: FloatArray) -> FloatArray:
        n_rows, n_outputs = outputs.shape
        if n_rows < 2:
            return np.full((n_outputs, n_outputs), np.nan)
        folds = KFold(min(self.n_folds, n_rows), shuffle=True, random_state=self.random_state)
        errors = np.empty_like(outputs)
        for fitted, held_out in folds.split(inputs):
            network = self._train(inputs[fitted], outputs[fitted])
            predicted = _forward(network.coefs_, network.intercepts_, inputs[held_out])
            errors[held_out] = outputs[held_out] - predicted
        covariance: FloatArray = errors.T @ errors / n_rows
        return covariance

    def _train(self, inputs: FloatArray, outputs: FloatArray) -> MLPRegressor:
        network = MLPRegressor(
            hidden_layer_sizes=self.hidden_layer_sizes,
            activation="tanh",
            solver="lbfgs",  # on the few hundred rows of a scene it beats stochastic gradients
            alpha=self.alpha,
            max_iter=self.max_iter,
            random_state=self.random_state,
        )
        with warnings.catch_warnings():
            # max_iter bounds the time; a network stopped by it is as good as any.
            warnings.simplefilter("ignore", ConvergenceWarning)
            return network.fit(inputs, outputs[:, 0] if outputs.shape[1] == 1 else outputs)

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags


def _forward(
    coefs: list[FloatArray], intercepts: list[FloatArray], inputs: FloatArray
) -> FloatArray:
    activations = inputs
    for weights, bias in zip(coefs[:-1], intercepts[:-1], strict=True):
        activations = np.tanh(activations @ weights + bias)
    outputs: FloatArray = activations @ coefs[-1] + intercepts[-1]
    return outputs
