"""Threads that a process may take.

Memory is for the system to bound, of a container or a service: under a hard limit of its own
(``RLIMIT_DATA``) a process is not refused but hangs, since OpenBLAS asks again for ever.
"""

from __future__ import annotations

import os

from sightline.errors import InputError

_THREADS = "SIGHTLINE_THREADS"
# Of BLAS, of OpenMP and of OpenCV, each read when its library is loaded.
_OF_LIBRARIES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)
_MOST_THREADS = 1024


def limit_threads(count: int) -> None:
    """Have linear algebra, pictures, decoding and networks each take at most so many threads.

    Libraries that are loaded already keep theirs. Processes that this one starts inherit the limit.

    Raises:
        InputError: It is no number from 1 on.
    """
    if not 1 <= count <= _MOST_THREADS:
        raise InputError(f"{count} threads cannot be had; give 1 to {_MOST_THREADS}")
    for name in (_THREADS, *_OF_LIBRARIES):
        os.environ[name] = str(count)


def most_threads() -> int | None:
    """How many threads a decoder or a network may take; None: as many as there are cores.

    Raises:
        InputError: The environment's ``SIGHTLINE_THREADS`` is no number from 1 on.
    """
    return _number(_THREADS, 1, _MOST_THREADS)


def _number(variable: str, least: int, most: int) -> int | None:
    text = os.environ.get(variable, "")
    if not text:
        return None
    if not text.isdecimal() or not least <= int(text) <= most:
        raise InputError(f"{variable}={text[:20]}: expected a number from {least} to {most}")
    return int(text)
