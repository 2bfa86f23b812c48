"""How many threads linear algebra takes."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

_P = ParamSpec("_P")
_R = TypeVar("_R")


def on_one_thread(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Have a function's linear algebra (BLAS and LAPACK) done on one thread.

    The matrices of a fit are small: threads wait for each other, ten times as long where the
    machine has something else to do, and the last digits depend on how many there are.

    Args:
        function: Returns when it is done: no generator.
    """

    @functools.wraps(function)
    def limited(*arguments: _P.args, **options: _P.kwargs) -> _R:
        # What is loaded later would not be limited.
        import scipy.linalg  # noqa: F401
        from threadpoolctl import threadpool_limits

        with threadpool_limits(limits=1, user_api="blas"):
            return function(*arguments, **options)

    return limited
