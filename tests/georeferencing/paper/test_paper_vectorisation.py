from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sightline.errors import InputError
from sightline.georeferencing.paper.vectorisation import ivec, vec

SQRT2 = np.sqrt(2.0)


@st.composite
def symmetric(draw: st.DrawFn, count: int = 1) -> list[np.ndarray]:
    n = draw(st.integers(1, 6))
    entries = st.floats(-1e6, 1e6, allow_subnormal=False)
    upper = [np.triu(draw(arrays(float, (n, n), elements=entries))) for _ in range(count)]
    return [u + np.triu(u, 1).T for u in upper]


def test_one_by_one_is_its_entry() -> None:
    np.testing.assert_array_equal(vec([[3.0]]), [3.0])
    np.testing.assert_array_equal(ivec([3.0]), [[3.0]])


def test_layout_of_two_by_two() -> None:
    np.testing.assert_array_equal(vec([[11.0, 12.0], [12.0, 22.0]]), [11.0, 22.0, SQRT2 * 12.0])


def test_layout_of_three_by_three_goes_diagonal_by_diagonal() -> None:
    matrix = [[11.0, 12.0, 13.0], [12.0, 22.0, 23.0], [13.0, 23.0, 33.0]]
    np.testing.assert_array_equal(
        vec(matrix), [11.0, 22.0, 33.0, SQRT2 * 12.0, SQRT2 * 23.0, SQRT2 * 13.0]
    )


def test_layout_of_four_by_four_ends_in_the_corner() -> None:
    rows, columns = np.meshgrid(np.arange(1, 5), np.arange(1, 5), indexing="ij")
    matrix = 10.0 * np.minimum(rows, columns) + np.maximum(rows, columns)
    stacked = [11.0, 22.0, 33.0, 44.0, 12.0, 23.0, 34.0, 13.0, 24.0, 14.0]
    np.testing.assert_array_equal(
        vec(matrix), np.array(stacked) * np.array([1.0] * 4 + [SQRT2] * 6)
    )


@given(symmetric())
def test_ivec_undoes_vec(matrices: list[np.ndarray]) -> None:
    np.testing.assert_allclose(ivec(vec(matrices[0])), matrices[0], rtol=4e-16, atol=0.0)


@given(
    st.integers(1, 6).flatmap(lambda n: arrays(float, n * (n + 1) // 2, elements=st.floats(-9, 9)))
)
def test_vec_undoes_ivec(vector: np.ndarray) -> None:
    matrix = ivec(vector)
    np.testing.assert_array_equal(matrix, matrix.T)
    np.testing.assert_allclose(vec(matrix), vector, rtol=4e-16, atol=1e-300)


@given(symmetric(count=2))
def test_inner_product_is_kept(matrices: list[np.ndarray]) -> None:
    X, Y = matrices
    scale = np.linalg.norm(X) * np.linalg.norm(Y)
    # Products below the smallest normal number have no twelve digits left.
    nothing = max(1e-13 * scale, np.finfo(float).tiny)
    assert vec(X) @ vec(Y) == pytest.approx(np.trace(X.T @ Y), rel=1e-12, abs=nothing)


def test_batches_go_through_row_by_row() -> None:
    rng = np.random.default_rng(1)
    upper = rng.normal(size=(2, 5, 3, 3))
    batch = upper + np.swapaxes(upper, -1, -2)
    vectors = vec(batch)
    assert vectors.shape == (2, 5, 6)
    np.testing.assert_array_equal(vectors[1, 3], vec(batch[1, 3]))
    np.testing.assert_allclose(ivec(vectors), batch, rtol=1e-15)
    assert vec(np.empty((0, 3, 3))).shape == (0, 6)


@pytest.mark.parametrize("shape", [(3,), (2, 3), (4, 3, 2), (0, 0)])
def test_vec_refuses_what_is_no_square_matrix(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match=r"shape \(\.\.\., n, n\)"):
        vec(np.zeros(shape))


@pytest.mark.parametrize("length", [0, 2, 4, 5, 7])
def test_ivec_refuses_lengths_of_no_triangle(length: int) -> None:
    with pytest.raises(InputError, match="1, 3, 6, 10"):
        ivec(np.zeros(length))
