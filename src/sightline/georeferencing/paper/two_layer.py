"""The paper's two-layer model: a base regression and one of its residual."""

from __future__ import annotations

from typing import Any, Self

from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, RegressorMixin, clone
from sklearn.utils.validation import check_is_fitted

from sightline.errors import unknown_name
from sightline.georeferencing.paper.estimator import (
    Arrays,
    CovarianceRegressor,
    Settings,
    check_features,
    check_pairs,
    like_targets,
    with_covariance,
)
from sightline.georeferencing.paper.gaussian_process import GaussianProcessRegression
from sightline.georeferencing.paper.neural import NeuralNetworkRegression
from sightline.georeferencing.paper.quadratic import QuadraticKernelRegression
from sightline.types import FloatArray

LAYERS: dict[str, type[CovarianceRegressor]] = {
    "qkr": QuadraticKernelRegression,
    "nn": NeuralNetworkRegression,
    "gpr": GaussianProcessRegression,
}
"""The estimators that a layer can be, by the name under which they are stored."""


class TwoLayerRegressor(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """``y = f_q(x) + f_r(x)`` (eq. 1), the residual layer fitted to ``y - f_q(x)`` (eq. 4).

    The covariance is that of the residual layer, whose targets contain all the noise, plus that
    part of the base's which comes from its uncertain parameters. The base's own residuals are no
    noise any more and do not count.

    Args:
        base: The layer that is fitted first, a `CovarianceRegressor`.
        residual: The layer that is fitted to what the base leaves, a `CovarianceRegressor`.

    Attributes:
        base_: The fitted base.
        residual_: The fitted residual layer.
        residual_covariance_: (K, K) float64, that of the residual layer.
        n_features_in_: Features seen in the fit.
        flat_targets_: Whether the targets came as (N,).
    """

    def __init__(self, base: CovarianceRegressor, residual: CovarianceRegressor) -> None:
        self.base = base
        self.residual = residual

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Fit the base, then the residual layer.

        Args:
            X: (N, n) features.
            y: (N,) or (N, K) targets.
        """
        features, targets = check_pairs(self, X, y)
        self.base_ = clone(self.base).fit(features, targets)
        left = targets - self.base_.predict(features)
        self.residual_ = clone(self.residual).fit(features, left)
        self.residual_covariance_ = self.residual_.residual_covariance_
        return self

    def predict(
        self, X: ArrayLike, return_cov: bool = False
    ) -> FloatArray | tuple[FloatArray, FloatArray]:
        """The sum of both layers.

        Args:
            X: (N, n) features.
            return_cov: Whether to return covariances, too.

        Returns:
            (N,) or (N, K) predictions, as the targets were; with ``return_cov`` also their
            (N, K, K) covariances.
        """
        check_is_fitted(self)
        features = check_features(self, X)
        if not return_cov:
            return like_targets(
                self, self.base_.predict(features) + self.residual_.predict(features)
            )
        coarse, coarse_covariance = with_covariance(self.base_, features)
        fine, fine_covariance = with_covariance(self.residual_, features)
        of_parameters = coarse_covariance - self.base_.residual_covariance_
        return like_targets(self, coarse + fine), fine_covariance + of_parameters

    def state(self) -> tuple[Arrays, Settings]:
        """The state of both layers; each must be one of `LAYERS`."""
        check_is_fitted(self)
        arrays: Arrays = {}
        settings: Settings = {"flat_targets": self.flat_targets_}
        for role, layer in (("base", self.base_), ("residual", self.residual_)):
            layer_arrays, layer_settings = layer.state()
            arrays |= {f"{role}.{name}": array for name, array in layer_arrays.items()}
            settings[role] = {"layer": _layer_name(layer), **layer_settings}
        return arrays, settings

    @classmethod
    def from_state(cls, arrays: Arrays, settings: Settings) -> Self:
        """Restore the estimator from its `state`.

        Raises:
            InputError: A layer is none of `LAYERS`.
        """
        layers = {}
        for role in ("base", "residual"):
            layer_settings = dict(settings[role])
            name = layer_settings.pop("layer")
            if name not in LAYERS:
                raise unknown_name("layer", name, list(LAYERS))
            prefix = f"{role}."
            own = {k.removeprefix(prefix): a for k, a in arrays.items() if k.startswith(prefix)}
            layers[role] = LAYERS[name].from_state(own, layer_settings)
        estimator = cls(clone(layers["base"]), clone(layers["residual"]))
        estimator.base_, estimator.residual_ = layers["base"], layers["residual"]
        estimator.residual_covariance_ = layers["residual"].residual_covariance_
        estimator.n_features_in_ = estimator.base_.n_features_in_
        estimator.flat_targets_ = settings["flat_targets"]
        return estimator

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags


def _layer_name(layer: CovarianceRegressor) -> str:
    for name, kind in LAYERS.items():
        if type(layer) is kind:
            return name
    raise unknown_name("layer", type(layer).__name__, list(LAYERS))
