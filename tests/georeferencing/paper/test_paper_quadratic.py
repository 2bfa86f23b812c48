from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.georeferencing.paper.quadratic import QuadraticKernelRegression, lift
from sightline.georeferencing.paper.vectorisation import vec


def monomials(X: np.ndarray) -> np.ndarray:
    """All monomials up to degree two, written out."""
    n = X.shape[1]
    products = [X[:, i] * X[:, j] for i in range(n) for j in range(i, n)]
    return np.column_stack([np.ones(len(X)), *X.T, *products])


def planted(
    rng: np.random.Generator, n: int, n_outputs: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    H = rng.normal(size=(n_outputs, n, n))
    return H + np.swapaxes(H, 1, 2), rng.normal(size=(n_outputs, n)), rng.normal(size=n_outputs)


def evaluate(H: np.ndarray, f: np.ndarray, r: np.ndarray, X: np.ndarray) -> np.ndarray:
    return np.einsum("ni,kij,nj->nk", X, H, X) + X @ f.T + r


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_lift_is_the_vec_of_the_outer_product(n: int) -> None:
    X = np.random.default_rng(n).normal(size=(7, n))
    extended = np.column_stack([X, np.ones(7)])
    outer = extended[:, :, None] * extended[:, None, :]
    np.testing.assert_allclose(lift(X).T, vec(outer), rtol=1e-15)


@given(st.integers(1, 5), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_recovers_a_planted_quadratic(n: int, n_outputs: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    H, f, r = planted(rng, n, n_outputs)
    X = rng.uniform(-1.0, 1.0, size=(300, n))
    model = QuadraticKernelRegression().fit(X, evaluate(H, f, r, X))
    np.testing.assert_allclose(model.H_, H, atol=1e-10)
    np.testing.assert_allclose(model.f_, f, atol=1e-10)
    np.testing.assert_allclose(model.r_, r, atol=1e-10)
    elsewhere = rng.uniform(-3.0, 3.0, size=(20, n))
    np.testing.assert_allclose(model.predict(elsewhere), evaluate(H, f, r, elsewhere), atol=1e-8)


def test_sums_are_those_of_algorithm_1() -> None:
    rng = np.random.default_rng(2)
    X, y = rng.random((9, 2)), rng.normal(size=9)
    A, b = np.zeros((6, 6)), np.zeros(6)
    for x_i, y_i in zip(X, y, strict=True):
        extended = np.append(x_i, 1.0)
        z = vec(np.outer(extended, extended))
        A += np.outer(z, z)
        b += y_i * z
    model = QuadraticKernelRegression().fit(X, y)
    np.testing.assert_allclose(model.A_, A, rtol=1e-14)
    np.testing.assert_allclose(model.b_[:, 0], b, rtol=1e-13)
    np.testing.assert_allclose(model.q_[:, 0], np.linalg.solve(A, b), rtol=1e-7)


@pytest.mark.parametrize("n", [1, 2, 4])
def test_equals_least_squares_on_the_monomials(n: int) -> None:
    rng = np.random.default_rng(3)
    X, Y = rng.random((200, n)), rng.normal(size=(200, 2))
    design = monomials(X)
    coefficients = np.linalg.lstsq(design, Y)[0]
    model = QuadraticKernelRegression().fit(X, Y)
    np.testing.assert_allclose(model.predict(X), design @ coefficients, atol=1e-10)
    residuals = Y - design @ coefficients
    np.testing.assert_allclose(
        model.residual_covariance_,
        residuals.T @ residuals / (200 - design.shape[1]),
        rtol=1e-9,
    )
    assert model.rank_ == design.shape[1]


@pytest.mark.slow
@given(st.lists(st.integers(1, 60), min_size=1, max_size=8), st.integers(0, 2**32 - 1))
def test_portions_add_up_to_one_pass(sizes: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    X, Y = rng.random((40 + sum(sizes), 2)), rng.normal(size=(40 + sum(sizes), 2))
    at_once = QuadraticKernelRegression().fit(X, Y)
    in_portions = QuadraticKernelRegression()
    for rows in np.split(np.arange(len(X)), 40 + np.cumsum([0, *sizes[:-1]])):
        in_portions.partial_fit(X[rows], Y[rows])
    np.testing.assert_allclose(in_portions.A_, at_once.A_, rtol=1e-12)
    np.testing.assert_allclose(in_portions.predict(X), at_once.predict(X), atol=1e-9)
    np.testing.assert_allclose(
        in_portions.residual_covariance_, at_once.residual_covariance_, rtol=1e-9
    )


def test_rows_of_many_blocks_count_once_each() -> None:
    rng = np.random.default_rng(4)
    X, Y = rng.random((50_001, 2)), rng.normal(size=(50_001, 2))
    model = QuadraticKernelRegression().fit(X, Y)
    z = lift(X)
    np.testing.assert_allclose(model.A_, z @ z.T, rtol=1e-12)
    np.testing.assert_allclose(model.b_, z @ Y, rtol=1e-9, atol=1e-9)
    assert model.n_rows_ == 50_001


def test_memory_does_not_grow_with_the_rows() -> None:
    def peak(n_rows: int) -> int:
        X, Y = np.ones((n_rows, 2)), np.ones((n_rows, 2))
        model = QuadraticKernelRegression()
        model._start(2, 2)
        tracemalloc.start()
        model._accumulate(X, Y)
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most

    assert peak(1_000_000) < 1.1 * peak(100_000)
    assert peak(1_000_000) < 4_000_000


def test_fit_forgets_what_came_before() -> None:
    rng = np.random.default_rng(5)
    X, Y = rng.random((30, 2)), rng.normal(size=(30, 2))
    model = QuadraticKernelRegression().fit(rng.random((50, 2)), rng.normal(size=(50, 2)))
    np.testing.assert_array_equal(model.fit(X, Y).q_, QuadraticKernelRegression().fit(X, Y).q_)


@pytest.mark.parametrize(
    ("X", "rank"),
    [
        (np.column_stack([np.linspace(0, 1, 40), 0.3 + 0.5 * np.linspace(0, 1, 40)]), 3),
        (np.tile([[0.2, 0.7]], (40, 1)), 1),
        (np.random.default_rng(6).random((4, 2)), 4),
    ],
    ids=["on a line", "in one place", "fewer rows than coefficients"],
)
def test_undetermined_data_gives_the_solution_of_smallest_norm(X: np.ndarray, rank: int) -> None:
    y = np.random.default_rng(7).normal(size=(len(X), 2))
    model = QuadraticKernelRegression().fit(X, y)
    assert model.rank_ == rank
    smallest = np.linalg.pinv(lift(X).T, rcond=1e-10) @ y
    np.testing.assert_allclose(model.q_, smallest, atol=1e-7 * np.abs(smallest).max())


@pytest.mark.slow
def test_stated_covariance_is_that_of_the_error_over_many_fits() -> None:
    rng = np.random.default_rng(8)
    H, f, r = planted(rng, 2, 2)
    noise = np.linalg.cholesky(np.array([[0.04, 0.015], [0.015, 0.01]]))
    X = rng.random((14, 2))
    beyond = np.array([[1.3, 0.4]])
    errors, stated = [], []
    for _ in range(2000):
        Y = evaluate(H, f, r, X) + rng.normal(size=(14, 2)) @ noise.T
        predicted, covariance = QuadraticKernelRegression().fit(X, Y).predict(beyond, True)
        truth = evaluate(H, f, r, beyond) + rng.normal(size=(1, 2)) @ noise.T
        errors.append((truth - predicted)[0])
        stated.append(covariance[0])
    actual = np.cov(np.array(errors).T)
    # Mostly the coefficients' share, or the test would be one of the noise alone.
    assert actual[0, 0] > 2.0 * 0.04
    np.testing.assert_allclose(np.mean(stated, axis=0), actual, rtol=0.1)


def test_ellipses_hold_their_share() -> None:
    rng = np.random.default_rng(9)
    H, f, r = planted(rng, 2, 2)
    noise = np.linalg.cholesky(np.array([[4.0, -1.5], [-1.5, 1.0]]))
    X = rng.random((10_400, 2))
    Y = evaluate(H, f, r, X) + rng.normal(size=(10_400, 2)) @ noise.T
    model = QuadraticKernelRegression().fit(X[:400], Y[:400])
    predicted, covariance = model.predict(X[400:], return_cov=True)
    error = Y[400:] - predicted
    distance = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    assert np.mean(distance < 5.991) == pytest.approx(0.95, abs=0.012)
    assert np.mean(distance < 1.386) == pytest.approx(0.50, abs=0.03)


def test_a_perfect_fit_has_no_negative_variance() -> None:
    rng = np.random.default_rng(10)
    X = rng.random((50, 2))
    model = QuadraticKernelRegression().fit(X, evaluate(*planted(rng, 2, 2), X))
    assert (np.linalg.eigvalsh(model.residual_covariance_) >= -1e-20).all()
    assert np.trace(model.residual_covariance_) < 1e-12


def test_too_few_rows_state_no_covariance() -> None:
    rng = np.random.default_rng(11)
    model = QuadraticKernelRegression().fit(rng.random((6, 2)), rng.random((6, 2)))
    _, covariance = model.predict([[0.5, 0.5]], return_cov=True)
    assert np.isnan(covariance).all()


def test_one_target_stays_a_vector() -> None:
    rng = np.random.default_rng(12)
    X, y = rng.random((20, 2)), rng.random(20)
    model = QuadraticKernelRegression().fit(X, y)
    predicted, covariance = model.predict(X, return_cov=True)
    assert predicted.shape == (20,)
    assert covariance.shape == (20, 1, 1)
    assert model.fit(X, y[:, None]).predict(X).shape == (20, 1)


def test_a_stored_estimator_predicts_the_same_and_learns_on() -> None:
    rng = np.random.default_rng(13)
    X, Y = rng.random((60, 2)), rng.normal(size=(60, 2))
    first = QuadraticKernelRegression().fit(X[:30], Y[:30])
    again = QuadraticKernelRegression.from_state(*first.state())
    for one, other in zip(first.predict(X, True), again.predict(X, True), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    again.partial_fit(X[30:], Y[30:])
    np.testing.assert_allclose(
        again.predict(X), QuadraticKernelRegression().fit(X, Y).predict(X), atol=1e-10
    )
    # What was stored is not what learned on.
    assert first.n_rows_ == 30
    np.testing.assert_allclose(first.A_[2, 2], 30.0)


def test_portions_of_another_shape_are_refused() -> None:
    model = QuadraticKernelRegression().partial_fit(np.ones((3, 2)), np.ones((3, 2)))
    with pytest.raises(ValueError, match="3 features"):
        model.partial_fit(np.ones((3, 3)), np.ones((3, 2)))
    with pytest.raises(ValueError, match="1 outputs"):
        model.partial_fit(np.ones((3, 2)), np.ones((3, 1)))
