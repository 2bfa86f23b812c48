"""Quadratic kernel regression against numpy's least squares on the written-out design matrix.

Run as ``python benchmarks/quadratic.py``. Both start from the same features (N, 2) and targets
(N, 2) in memory and end with the same six coefficients an output. Times are the best of several
runs, memory is what each holds at most beside its input.
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sightline.georeferencing.paper.quadratic import QuadraticKernelRegression

FloatArray = NDArray[np.float64]


def design_matrix(X: FloatArray) -> FloatArray:
    x, y = X.T
    return np.column_stack([x * x, y * y, np.ones(len(X)), x * y, x, y])


def with_lstsq(X: FloatArray, Y: FloatArray) -> FloatArray:
    return np.linalg.lstsq(design_matrix(X), Y)[0].astype(np.float64, copy=False)


def with_quadratic(X: FloatArray, Y: FloatArray) -> FloatArray:
    model = QuadraticKernelRegression().fit(X, Y)
    H, f, r = model.H_, model.f_, model.r_
    return np.column_stack([H[:, 0, 0], H[:, 1, 1], r, 2.0 * H[:, 0, 1], f]).T


def best_s(repeats: int, work: Callable[..., object], *arguments: FloatArray) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work(*arguments)
        times.append(time.perf_counter() - start)
    return min(times)


def peak_mb(work: Callable[..., object], *arguments: FloatArray) -> float:
    tracemalloc.start()
    work(*arguments)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak / 1e6


def main() -> None:
    rng = np.random.default_rng(0)
    print("| rows | sightline QKR | numpy lstsq | of it the solver alone | times faster |", end="")
    print(" QKR memory | lstsq memory | largest difference of a coefficient |")
    print("|---:|---:|---:|---:|---:|---:|---:|---:|")
    for n_rows, repeats in ((10_000, 30), (100_000, 10), (1_000_000, 5)):
        X = rng.random((n_rows, 2))
        Y = rng.normal(size=(n_rows, 2))
        design = design_matrix(X)
        ours_s = best_s(repeats, with_quadratic, X, Y)
        theirs_s = best_s(repeats, with_lstsq, X, Y)
        solver_s = best_s(repeats, np.linalg.lstsq, design, Y)
        ours_mb = peak_mb(with_quadratic, X, Y)
        theirs_mb = peak_mb(with_lstsq, X, Y)
        difference = np.abs(with_quadratic(X, Y) - with_lstsq(X, Y)).max()
        print(
            f"| {n_rows:,} | {ours_s * 1e3:.1f} ms | {theirs_s * 1e3:.1f} ms "
            f"| {solver_s * 1e3:.1f} ms | {theirs_s / ours_s:.1f} "
            f"| {ours_mb:.1f} MB | {theirs_mb:.1f} MB | {difference:.1e} |"
        )


if __name__ == "__main__":
    main()
