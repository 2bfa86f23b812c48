"""Vectorisation of symmetric matrices that preserves the inner product (appendix 7.1)."""

from __future__ import annotations

from functools import lru_cache
from math import isqrt, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sightline.errors import InputError
from sightline.types import FloatArray


def vec(matrices: ArrayLike) -> FloatArray:
    """Stack symmetric matrices diagonal by diagonal (definition 7.1).

    The main diagonal comes first as it is, then the first superdiagonal times √2, then the second
    times √2, and so on to the upper right corner:
    ``x11, x22, ..., xnn, √2 x12, √2 x23, ..., √2 x13, ..., √2 x1n``. So that, for symmetric X
    and Y, ``trace(Xᵀ Y) = vec(X) · vec(Y)`` (lemma 7.2).

    Args:
        matrices: (..., n, n), symmetric. Only the upper triangle is read.

    Returns:
        (..., n (n + 1) / 2) float64.

    Raises:
        InputError: The last two axes are not of one length of at least 1.
    """
    x = np.asarray(matrices, dtype=np.float64)
    if x.ndim < 2 or x.shape[-1] != x.shape[-2] or x.shape[-1] == 0:
        raise InputError(f"vec takes matrices of the shape (..., n, n), not {x.shape}")
    rows, columns, weights = _layout(x.shape[-1])
    return x[..., rows, columns] * weights


def ivec(vectors: ArrayLike) -> FloatArray:
    """Inverse of `vec`: symmetric matrices from their vectors.

    Args:
        vectors: (..., n (n + 1) / 2).

    Returns:
        (..., n, n) float64, symmetric.

    Raises:
        InputError: The length of the last axis is not n (n + 1) / 2 for any n of at least 1.
    """
    x = np.asarray(vectors, dtype=np.float64)
    length = x.shape[-1] if x.ndim else 0
    n = (isqrt(8 * length + 1) - 1) // 2
    if length == 0 or n * (n + 1) // 2 != length:
        raise InputError(
            f"ivec takes vectors of the length n (n + 1) / 2 (1, 3, 6, 10, ...), not {x.shape}"
        )
    rows, columns, weights = _layout(n)
    matrices = np.empty((*x.shape[:-1], n, n))
    values = x / weights
    matrices[..., rows, columns] = values
    matrices[..., columns, rows] = values
    return matrices


def vec_weights(n: int) -> FloatArray:
    """Weights of `vec` for the entries of an n x n matrix: (n (n + 1) / 2,), 1s then √2s."""
    return _layout(n)[2]


@lru_cache(maxsize=64)
def _layout(n: int) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Row, column and weight of each entry of the vector."""
    rows = np.concatenate([np.arange(n - d) for d in range(n)])
    columns = np.concatenate([np.arange(d, n) for d in range(n)])
    weights = np.where(rows == columns, 1.0, sqrt(2.0))
    for array in (rows, columns, weights):
        array.flags.writeable = False
    return rows, columns, weights
