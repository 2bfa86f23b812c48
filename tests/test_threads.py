"""Linear algebra on one thread."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from threadpoolctl import threadpool_info, threadpool_limits

import sightline
from sightline.pipeline import evaluate, fit, fit_unlabelled, run
from sightline.scene import clocks
from sightline.threads import on_one_thread


def blas_threads() -> set[int]:
    scipy.linalg.cholesky(np.eye(3))
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


def test_a_function_runs_on_one_thread_and_the_rest_does_not() -> None:
    @on_one_thread
    def inside(first: int, *, second: int) -> tuple[int, set[int]]:
        """What it says."""
        return first + second, blas_threads()

    with threadpool_limits(limits=2, user_api="blas"):
        before = blas_threads()
        assert inside(1, second=2) == (3, {1})
        assert blas_threads() == before
    assert inside.__doc__ == "What it says."


def test_threads_come_back_after_an_error() -> None:
    @on_one_thread
    def fails() -> None:
        raise KeyError

    with threadpool_limits(limits=2, user_api="blas"):
        before = blas_threads()
        with pytest.raises(KeyError):
            fails()
        assert blas_threads() == before


@pytest.mark.parametrize(
    "function",
    [
        sightline.fit,
        sightline.run,
        sightline.compare,
        sightline.evaluate,
        fit.fit,
        fit_unlabelled.associate_scene,
        fit_unlabelled.update_scene,
        evaluate.leave_one_out,
        run.run,
        clocks.settle_clocks,
    ],
)
def test_whatever_fits_cameras_does_so_on_one_thread(function: object) -> None:
    assert getattr(function, "__wrapped__", None) is not None
