from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from sklearn.exceptions import NotFittedError

from sightline.errors import InputError
from sightline.georeferencing.paper.gaussian_process import GaussianProcessRegression, spread_out
from sightline.georeferencing.paper.neural import NeuralNetworkRegression
from sightline.georeferencing.paper.quadratic import QuadraticKernelRegression
from sightline.georeferencing.paper.two_layer import TwoLayerRegressor

NOISE = np.array([[0.020, 0.012], [0.012, 0.010]])

MAKERS: dict[str, Callable[[], object]] = {
    "nn": lambda: NeuralNetworkRegression(),
    "gpr": lambda: GaussianProcessRegression(),
    "qkr+nn": lambda: TwoLayerRegressor(QuadraticKernelRegression(), NeuralNetworkRegression()),
    "qkr+gpr": lambda: TwoLayerRegressor(QuadraticKernelRegression(), GaussianProcessRegression()),
}


def smooth(X: np.ndarray) -> np.ndarray:
    """A map that is no quadratic."""
    return np.column_stack([np.sin(4.0 * X[:, 0]) + X[:, 1], np.exp(X[:, 1]) * X[:, 0] ** 3])


def sample(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    X = rng.random((n, 2))
    return X, smooth(X) + rng.normal(size=(n, 2)) @ np.linalg.cholesky(NOISE).T


@pytest.mark.parametrize("name", list(MAKERS))
def test_learns_a_map_that_is_no_quadratic_and_says_how_well(name: str) -> None:
    model = MAKERS[name]().fit(*sample(300, seed=1))
    X, Y = sample(5000, seed=2)
    predicted, covariance = model.predict(X, return_cov=True)
    # The noise is all that is left, up to a tenth of its deviation.
    error = Y - predicted
    np.testing.assert_allclose(np.sqrt((error**2).mean(axis=0)), np.sqrt(np.diag(NOISE)), rtol=0.1)
    distance = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    assert 0.92 <= np.mean(distance < 5.991) <= 0.98
    np.testing.assert_allclose(covariance.mean(axis=0), error.T @ error / 5000, rtol=0.25)
    np.testing.assert_allclose(model.predict(X), predicted, atol=1e-12)


@pytest.mark.parametrize("name", list(MAKERS))
def test_one_target_stays_a_vector(name: str) -> None:
    X, Y = sample(40, seed=3)
    model = MAKERS[name]().fit(X, Y[:, 0])
    predicted, covariance = model.predict(X, return_cov=True)
    assert predicted.shape == (40,)
    assert covariance.shape == (40, 1, 1)
    assert (covariance > 0.0).all()


@pytest.mark.parametrize("name", list(MAKERS))
def test_the_same_data_gives_the_same_model(name: str) -> None:
    X, Y = sample(60, seed=4)
    np.testing.assert_array_equal(
        MAKERS[name]().fit(X, Y).predict(X), MAKERS[name]().fit(X, Y).predict(X)
    )


@pytest.mark.parametrize("name", list(MAKERS))
def test_a_constant_target_is_predicted_as_it_is(name: str) -> None:
    X, Y = sample(40, seed=5)
    Y[:, 1] = 0.1
    predicted, covariance = MAKERS[name]().fit(X, Y).predict(X, return_cov=True)
    np.testing.assert_allclose(predicted[:, 1], 0.1, atol=1e-12)
    np.testing.assert_allclose(covariance[:, 1], 0.0, atol=1e-12)
    assert (covariance[:, 0, 0] > 0.0).all()


@pytest.mark.parametrize("name", list(MAKERS))
def test_unfitted_says_so(name: str) -> None:
    with pytest.raises(NotFittedError):
        MAKERS[name]().predict([[0.5, 0.5]])
    with pytest.raises(NotFittedError):
        MAKERS[name]().state()


def test_seeds_make_different_networks() -> None:
    X, Y = sample(60, seed=6)
    one = NeuralNetworkRegression(random_state=1).fit(X, Y).predict(X)
    other = NeuralNetworkRegression(random_state=2).fit(X, Y).predict(X)
    assert np.abs(one - other).max() > 1e-6


def test_gaussian_process_is_the_closed_form_over_both_outputs() -> None:
    X, Y = sample(40, seed=7)
    at = np.array([[0.4, 0.6], [1.5, -0.2]])
    model = GaussianProcessRegression().fit(X, Y)
    predicted, covariance = model.predict(at, return_cov=True)

    _, kernel = model.state()
    scaled, scaled_at = ((v - X.mean(axis=0)) / X.std(axis=0) for v in (X, at))
    outputs = (Y - Y.mean(axis=0)) / Y.std(axis=0)

    def signal(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        squared = ((a[:, None] - b[None]) ** 2).sum(axis=2)
        return kernel["amplitude"] * np.exp(-squared / 2.0 / kernel["length_scale"] ** 2)

    K = signal(scaled, scaled) + kernel["noise_level"] * np.eye(40)
    B = outputs.T @ np.linalg.solve(K, outputs) / 40
    # One Gaussian over all outputs of all points: output by output, covariance B (x) K.
    joint = np.kron(B, K)
    for i in range(2):
        cross = np.kron(B, signal(scaled_at[[i]], scaled))
        mean = cross @ np.linalg.solve(joint, outputs.T.ravel())
        prior = B * (kernel["amplitude"] + kernel["noise_level"])
        posterior = prior - cross @ np.linalg.solve(joint, cross.T)
        np.testing.assert_allclose(predicted[i], mean * Y.std(axis=0) + Y.mean(axis=0), rtol=1e-6)
        np.testing.assert_allclose(
            covariance[i], posterior * np.outer(Y.std(axis=0), Y.std(axis=0)), rtol=1e-5
        )


def test_gaussian_process_finds_the_noise() -> None:
    model = GaussianProcessRegression().fit(*sample(800, seed=11))
    np.testing.assert_allclose(model.residual_covariance_, NOISE, rtol=0.2)


def test_gaussian_process_is_less_sure_far_away() -> None:
    model = GaussianProcessRegression().fit(*sample(80, seed=8))
    _, covariance = model.predict([[0.5, 0.5], [3.0, 3.0]], return_cov=True)
    assert np.trace(covariance[1]) > 5.0 * np.trace(covariance[0])


def test_gaussian_process_keeps_few_of_many_points() -> None:
    X, Y = sample(3000, seed=9)
    model = GaussianProcessRegression(max_points=150).fit(X, Y)
    assert model.state()[0]["inputs"].shape == (150, 2)
    assert np.sqrt(((model.predict(X) - smooth(X)) ** 2).mean()) < 0.05


def test_spread_out_keeps_all_where_there_is_room() -> None:
    np.testing.assert_array_equal(spread_out(np.random.default_rng(0).random((5, 2)), 5), range(5))


def test_spread_out_covers_what_a_random_choice_does_not() -> None:
    rng = np.random.default_rng(10)
    crowd, sparse = rng.normal(0.0, 0.01, (1000, 2)), rng.uniform(1.0, 10.0, (20, 2))
    points = np.concatenate([crowd, sparse])
    kept = spread_out(points, 25)
    assert set(range(1000, 1020)) <= set(kept)

    def radius(chosen: np.ndarray) -> float:
        return float(np.linalg.norm(points[:, None] - points[chosen], axis=2).min(axis=1).max())

    # The greedy choice is within twice the best radius (Gonzalez), so within twice any other's.
    others = [radius(rng.choice(1020, 25, replace=False)) for _ in range(200)]
    assert radius(kept) <= 2.0 * min(others)
    # What remains is covered at least as closely as the kept points are apart.
    apart = np.linalg.norm(points[kept][:, None] - points[kept], axis=2)
    assert radius(kept) <= apart[apart > 0.0].min()


def test_spread_out_takes_no_row_twice() -> None:
    kept = spread_out(np.repeat([[0.0, 0.0], [1.0, 0.0]], 10, axis=0), 15)
    assert len(set(kept)) == 15


@pytest.mark.parametrize("residual", [NeuralNetworkRegression(), GaussianProcessRegression()])
@pytest.mark.parametrize("seed", range(5))
def test_second_layer_never_makes_the_fit_worse(residual: object, seed: int) -> None:
    X, Y = sample(50, seed=20 + seed)
    if seed == 4:  # where nothing is left but noise
        Y = np.random.default_rng(4).normal(size=(50, 2))
    base = QuadraticKernelRegression().fit(X, Y)
    both = TwoLayerRegressor(QuadraticKernelRegression(), residual).fit(X, Y)
    assert ((Y - both.predict(X)) ** 2).sum() <= ((Y - base.predict(X)) ** 2).sum()


def test_second_layer_is_fitted_to_what_the_first_leaves() -> None:
    X, Y = sample(50, seed=30)
    at = np.random.default_rng(31).uniform(-1.0, 2.0, (30, 2))
    both = TwoLayerRegressor(QuadraticKernelRegression(), GaussianProcessRegression()).fit(X, Y)
    first = QuadraticKernelRegression().fit(X, Y)
    second = GaussianProcessRegression().fit(X, Y - first.predict(X))
    coarse, coarse_covariance = first.predict(at, return_cov=True)
    fine, fine_covariance = second.predict(at, return_cov=True)
    predicted, covariance = both.predict(at, return_cov=True)
    np.testing.assert_allclose(predicted, coarse + fine, atol=1e-9)
    grown = covariance - fine_covariance
    np.testing.assert_allclose(grown, coarse_covariance - first.residual_covariance_, atol=1e-12)
    # Where the quadratic extrapolates its own uncertainty counts.
    inside = ((at > 0.0) & (at < 1.0)).all(axis=1)
    far = (np.abs(at - 0.5) > 1.0).any(axis=1)
    assert np.trace(grown[far].mean(axis=0)) > 10.0 * np.trace(grown[inside].mean(axis=0))


def test_only_known_layers_are_stored() -> None:
    X, Y = sample(20, seed=32)
    nested = TwoLayerRegressor(
        QuadraticKernelRegression(),
        TwoLayerRegressor(QuadraticKernelRegression(), GaussianProcessRegression()),
    ).fit(X, Y)
    with pytest.raises(InputError, match="known are qkr, nn, gpr"):
        nested.state()
