"""Work that can be asked to stop while it waits for a file, a stream or a slow disk.

A library that waits in the operating system hears of no signal. So what may wait runs in a thread
of its own, and whoever asked for it looks at an event between any two things that it gets.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Generic, TypeVar

from sightline.errors import StoppedError

T = TypeVar("T")

_LOOKS_APART_S = 0.05
# Pictures are large, and more of them ahead make nothing faster.
_AHEAD = 2


class Stop(threading.Event):
    """An event that knows whether there is something to keep: whoever sets it may break off else.

    Attributes:
        begun: Whether something was seen of the source that the event ends.
    """

    def __init__(self) -> None:
        super().__init__()
        self.begun = False


def check(stop: threading.Event | None) -> None:
    """Raise where work was asked to stop.

    Raises:
        StoppedError: It was.
    """
    if stop is not None and stop.is_set():
        raise StoppedError("stopped before anything was seen")


def call(function: Callable[[], T], stop: threading.Event | None) -> T:
    """Result of a function that may wait for long.

    Args:
        function: Is called in a thread of its own, unless there is no event.
        stop: Is set by whoever no longer wants the result.

    Raises:
        StoppedError: The event was set before there was a result.
    """
    if stop is None:
        return function()
    for result in iterate(lambda: iter([function()]), stop):
        return result
    check(stop)
    raise AssertionError("without an event there is a result")


def iterate(start: Callable[[], Iterator[T]], stop: threading.Event | None) -> Iterator[T]:
    """Items of an iterator, which may wait for long; they end when an event is set.

    Args:
        start: Makes the iterator; both run in a thread of its own, unless there is no event.
        stop: Ends the items, as if there were no more.
    """
    if stop is None:
        yield from start()
        return
    source = _Source(start, stop)
    threading.Thread(target=source.run, daemon=True, name="sightline-source").start()
    yield from source.items()


class _Source(Generic[T]):
    """Hands the items of an iterator from one thread to another."""

    def __init__(self, start: Callable[[], Iterator[T]], stop: threading.Event) -> None:
        self._start = start
        self._stop = stop
        self._left = threading.Event()
        self._waiting: queue.Queue[tuple[T] | BaseException | None] = queue.Queue(_AHEAD)

    def run(self) -> None:
        """Fill the queue; the last thing in it is None, or the error that ended the items."""
        last: BaseException | None = None
        try:
            for item in self._start():
                if not self._put((item,)):
                    break
        except BaseException as error:
            last = error
        self._put(last)

    def items(self) -> Iterator[T]:
        """Empty the queue, until the event is set."""
        try:
            while not self._stop.is_set():
                with suppress(queue.Empty):
                    got = self._waiting.get(timeout=_LOOKS_APART_S)
                    if got is None:
                        return
                    if isinstance(got, BaseException):
                        raise got
                    yield got[0]
        finally:
            self._left.set()

    def _put(self, what: tuple[T] | BaseException | None) -> bool:
        """Whether somebody still takes what is put into the queue."""
        while not (self._left.is_set() or self._stop.is_set()):
            with suppress(queue.Full):
                self._waiting.put(what, timeout=_LOOKS_APART_S)
                return True
        return False
