from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from sightline.camera.mixed_model import fewer_rows
from sightline.types import FloatArray


def problem(seed: int) -> FloatArray:
    """(61, 10) rows of a problem: three clocks among six other parameters, then residuals."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(0.0, 1.0, (61, 10))
    rows[:, 3:6] *= rng.integers(0, 3, 61)[:, None] == [0, 1, 2]
    return rows


@pytest.mark.parametrize("unseen", [False, True])
def test_fewer_rows_have_the_products_of_all(unseen: bool) -> None:
    rows = problem(0)
    rows[:, 4] *= not unseen
    fewer = fewer_rows(rows, slice(3, 6))
    assert fewer.shape == (10, 10)
    np.testing.assert_allclose(fewer.T @ fewer, rows.T @ rows, atol=1e-12)


def test_an_optimiser_takes_the_same_steps_from_fewer_rows() -> None:
    all_rows = problem(1)

    def steps(reduced: bool) -> FloatArray:
        def at(vector: FloatArray) -> FloatArray:
            residual = np.arctan(all_rows[:, :9] @ vector - all_rows[:, 9])
            slope = np.cos(residual)[:, None] ** 2
            rows = np.column_stack([all_rows[:, :9] * slope, residual])
            return fewer_rows(rows, slice(3, 6)) if reduced else rows

        found = least_squares(
            lambda vector: at(vector)[:, 9],
            np.zeros(9),
            jac=lambda vector: at(vector)[:, :9],
            max_nfev=6,
        )
        return np.append(found.x, found.cost)

    np.testing.assert_allclose(steps(True), steps(False), rtol=1e-9)
