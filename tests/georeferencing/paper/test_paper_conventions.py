from __future__ import annotations

from collections.abc import Callable

import pytest
from sklearn.base import BaseEstimator
from sklearn.utils.estimator_checks import parametrize_with_checks

from sightline.georeferencing.paper.gaussian_process import GaussianProcessRegression
from sightline.georeferencing.paper.neural import NeuralNetworkRegression
from sightline.georeferencing.paper.quadratic import QuadraticKernelRegression
from sightline.georeferencing.paper.two_layer import TwoLayerRegressor


@pytest.mark.slow
@parametrize_with_checks(
    [
        QuadraticKernelRegression(),
        # Few steps and folds: the checks fit it a hundred times.
        NeuralNetworkRegression(max_iter=100, n_folds=2),
        GaussianProcessRegression(),
        TwoLayerRegressor(QuadraticKernelRegression(), QuadraticKernelRegression()),
    ]
)
def test_keeps_the_conventions_of_scikit_learn(
    estimator: BaseEstimator, check: Callable[[BaseEstimator], None]
) -> None:
    check(estimator)
