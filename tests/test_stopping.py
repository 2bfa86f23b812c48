"""Work that waits can be asked to stop, and gives what it had until then."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator

import pytest

from sightline.errors import InputError, StoppedError
from sightline.stopping import call, check, iterate


def test_without_an_event_an_iterator_is_itself() -> None:
    threads = {threading.current_thread()}

    def items() -> Iterator[int]:
        threads.add(threading.current_thread())
        yield from range(3)

    assert list(iterate(items, None)) == [0, 1, 2]
    assert len(threads) == 1


def test_all_items_come_in_their_order() -> None:
    assert list(iterate(lambda: iter(range(1000)), threading.Event())) == list(range(1000))


def test_what_an_iterator_raises_comes_after_its_items() -> None:
    def items() -> Iterator[int]:
        yield from range(3)
        raise InputError("broken")

    got: list[int] = []
    with pytest.raises(InputError, match="broken"):
        got.extend(iterate(items, threading.Event()))
    assert got == [0, 1, 2]


def test_what_opening_raises_is_raised() -> None:
    def refuse() -> Iterator[int]:
        raise InputError("there is no such stream")

    with pytest.raises(InputError, match="no such stream"):
        list(iterate(refuse, threading.Event()))


def test_an_iterator_that_waits_for_ever_is_stopped() -> None:
    stop, for_ever = threading.Event(), threading.Event()

    def items() -> Iterator[int]:
        yield from range(3)
        stop.set()
        for_ever.wait()

    assert list(iterate(items, stop)) in ([0], [0, 1], [0, 1, 2], [])
    for_ever.set()


def test_opening_that_waits_for_ever_is_stopped() -> None:
    stop, for_ever = threading.Event(), threading.Event()

    def wait() -> Iterator[int]:
        stop.set()
        for_ever.wait()
        return iter([1])

    assert list(iterate(wait, stop)) == []
    for_ever.set()


def test_nobody_reads_ahead_for_one_who_has_left() -> None:
    """An endless source is let go of, with its file."""
    closed = threading.Event()

    def items() -> Iterator[int]:
        try:
            yield from itertools.count()
        finally:
            closed.set()

    taken = iterate(items, threading.Event())
    assert [next(taken), next(taken)] == [0, 1]
    taken.close()  # type: ignore[attr-defined]
    assert closed.wait(timeout=30.0)


def test_a_call_that_is_not_stopped_has_its_result() -> None:
    assert call(lambda: 3, None) == call(lambda: 3, threading.Event()) == 3


def test_a_call_is_stopped() -> None:
    stop = threading.Event()
    stop.set()
    with pytest.raises(StoppedError):
        call(lambda: 3, stop)
    with pytest.raises(StoppedError):
        check(stop)
    check(None)
