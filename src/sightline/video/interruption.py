"""Reading of streams that is broken off from another thread.

Who waits inside FFmpeg hears nothing. While it waits it asks PyAV whether to wait on, ten times a
second, and PyAV looks at a clock, in the thread that waits. That clock runs out for a thread that
is to leave.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import av.container.core

_leaving: dict[int, Callable[[], bool]] = {}
_hours = itertools.count(1e12, 3600.0)


def _monotonic() -> float:
    asked = _leaving.get(threading.get_ident())
    return next(_hours) if asked is not None and asked() else time.monotonic()


@contextmanager
def interruptible(leave: Callable[[], bool]) -> Iterator[None]:
    """Let this thread's waits for a stream end once it is to leave.

    What is read then fails as if the stream had been silent for too long; it can only be closed.

    Args:
        leave: Whether to; asked ten times a second.
    """
    av.container.core.time = SimpleNamespace(monotonic=_monotonic)  # type: ignore[attr-defined]
    own = threading.get_ident()
    _leaving[own] = leave
    try:
        yield
    finally:
        del _leaving[own]
