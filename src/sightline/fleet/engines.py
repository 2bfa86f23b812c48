"""Engines that perform many tasks: processes of this machine, or a cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Generic, NamedTuple, Protocol, TypeVar

from sightline.errors import InputError, SightlineError

Item = TypeVar("Item")
Result = TypeVar("Result")

_WAITS_S = 0.2
_CLOSE_S = 2.0
_BACK_OFF_S = 0.5


@dataclass(frozen=True)
class Outcome(Generic[Item, Result]):
    """What became of an item.

    Attributes:
        item: The item.
        result: What was made of it; None where that failed.
        line: Why it failed; None where it did not.
        attempts: How often it was tried.
        bug: Whether it failed by an error that is not the user's.
    """

    item: Item
    result: Result | None
    line: str | None = None
    attempts: int = 1
    bug: bool = False


class Engine(Protocol):
    """Performs a function on items, each once."""

    def map(
        self,
        function: Callable[[Item], Result],
        items: Iterable[Item],
        retries: int = 2,
        stop: threading.Event | None = None,
    ) -> Iterator[Outcome[Item, Result]]:
        """Outcomes as they come.

        What an item cannot help is tried again: a process that dies or runs out of memory, an
        error of the operating system. What is wrong with the item itself is not.

        Args:
            function: Can be pickled, and so can items and results.
            items: Are taken as they are needed.
            retries: How often more an item is tried.
            stop: Ends it when it is set; what is at work then has no outcome.
        """
        ...

    def close(self) -> None:
        """End what is at work, and let go of all."""
        ...


class _Closes(Protocol):
    def close(self) -> None: ...


class Answer(NamedTuple, Generic[Result]):
    """What a process says of an item.

    Attributes:
        result: What was made of it; None where that failed.
        line: Why it failed.
        retry: Whether it may succeed the next time.
        bug: Whether it failed by an error that is not the user's.
    """

    result: Result | None
    line: str | None = None
    retry: bool = False
    bug: bool = False


def attempt(function: Callable[[Item], Result], item: Item) -> Answer[Result]:
    """Perform a function on an item, whatever it raises."""
    try:
        return Answer(function(item))
    except SightlineError as error:
        return Answer(None, str(error))
    except MemoryError:
        return Answer(None, "there was not enough memory", retry=True)
    except OSError as error:
        return Answer(None, f"{type(error).__name__}: {error}", retry=True)
    except Exception as error:
        text = " ".join(str(error).split())
        return Answer(None, f"{type(error).__name__}: {text}", bug=True)


class LocalEngine:
    """Processes of this machine, each of which performs one item after the other.

    A pool of the standard library is lost as a whole with the first process that dies, and does
    not say which item killed it; so each process has a pipe of its own here.
    """

    def __init__(self, workers: int | None = None) -> None:
        """Start nothing yet.

        Args:
            workers: How many processes; None: one for each processor that this one may use.

        Raises:
            InputError: There are fewer than one.
        """
        if workers is not None and workers < 1:
            raise InputError(f"workers is {workers}; give 1 or more")
        self.workers = workers or _processors()
        self._pools: list[_Closes] = []

    def map(
        self,
        function: Callable[[Item], Result],
        items: Iterable[Item],
        retries: int = 2,
        stop: threading.Event | None = None,
    ) -> Iterator[Outcome[Item, Result]]:
        """See `Engine`."""
        pool = _Pool(function, self.workers)
        self._pools.append(pool)
        try:
            yield from pool.outcomes(iter(items), retries, stop)
        finally:
            pool.close()
            self._pools.remove(pool)

    def close(self) -> None:
        """See `Engine`."""
        for pool in self._pools:
            pool.close()


class _Pool(Generic[Item, Result]):
    """The processes that perform one function."""

    def __init__(self, function: Callable[[Item], Result], workers: int) -> None:
        self._function = function
        self._workers = workers
        self._running: list[_Worker[Item, Result]] = []

    def outcomes(
        self, waiting: Iterator[Item], retries: int, stop: threading.Event | None
    ) -> Iterator[Outcome[Item, Result]]:
        again: deque[_Try[Item]] = deque()
        while stop is None or not stop.is_set():
            self._hand_out(waiting, again)
            if not any(worker.tried for worker in self._running):
                if not again:
                    return
                time.sleep(_WAITS_S)
            for tried, answer in self._answers():
                if answer.retry and tried.attempts <= retries:
                    tried.not_before_s = time.monotonic() + _BACK_OFF_S * 2.0**tried.attempts
                    again.append(tried)
                else:
                    yield Outcome(
                        tried.item, answer.result, answer.line, tried.attempts, answer.bug
                    )

    def close(self) -> None:
        for worker in self._running:
            worker.end()
        self._running = []

    def _hand_out(self, waiting: Iterator[Item], again: deque[_Try[Item]]) -> None:
        """Give each process that has nothing to do an item, as long as there are any."""
        self._running = [worker for worker in self._running if worker.alive or worker.tried]
        while sum(worker.tried is not None for worker in self._running) < self._workers:
            tried = _next(waiting, again)
            if tried is None:
                return
            idle = [worker for worker in self._running if worker.tried is None]
            if not idle:
                idle = [_Worker(self._function)]
                self._running += idle
            idle[0].give(tried)

    def _answers(self) -> Iterator[tuple[_Try[Item], Answer[Result]]]:
        """What those say that have finished, or died."""
        busy = [(worker, worker.tried) for worker in self._running if worker.tried is not None]
        ready = wait([worker.pipe for worker, _ in busy], _WAITS_S)
        for worker, tried in busy:
            if worker.pipe in ready:
                yield tried, worker.answer()


def _processors() -> int:
    """How many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@dataclass
class _Try(Generic[Item]):
    item: Item
    attempts: int = 0
    not_before_s: float = 0.0


def _next(waiting: Iterator[Item], again: deque[_Try[Item]]) -> _Try[Item] | None:
    """The next to try: what failed goes first, once its time has come."""
    if again and again[0].not_before_s <= time.monotonic():
        return again.popleft()
    for item in waiting:
        return _Try(item)
    return None


class _Worker(Generic[Item, Result]):
    """A process, its pipe, and what it is at work on."""

    def __init__(self, function: Callable[[Item], Result]) -> None:
        # A fork would share the threads' locks of the libraries that are loaded.
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(
            target=_serve, args=(function, theirs), daemon=True
        )
        self.process.start()
        theirs.close()
        self.tried: _Try[Item] | None = None

    @property
    def alive(self) -> bool:
        return self.process.is_alive()

    def give(self, tried: _Try[Item]) -> None:
        tried.attempts += 1
        self.tried = tried
        # One that has died says so in `answer`.
        with suppress(OSError):
            self.pipe.send(tried.item)

    def answer(self) -> Answer[Result]:
        self.tried = None
        try:
            answer: Answer[Result] = self.pipe.recv()
        except (EOFError, OSError):
            self.process.join(_CLOSE_S)
            self.pipe.close()
            code = self.process.exitcode
            how = f"by signal {-code}" if code is not None and code < 0 else f"with status {code}"
            line = f"its process ended {how}; perhaps there was not enough memory"
            return Answer(None, line, retry=True)
        return answer

    def end(self) -> None:
        if self.process.is_alive() and self.tried is not None:
            self.process.terminate()
        self.pipe.close()
        self.process.join(_CLOSE_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join(_CLOSE_S)


def _serve(function: Callable[[Item], Result], pipe: Connection) -> None:
    """Perform what comes through the pipe, until it is closed."""
    # Whoever started it decides when it ends: Ctrl-C of a terminal goes to all its processes.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        try:
            item = pipe.recv()
        except (EOFError, OSError):
            return
        answer = attempt(function, item)
        try:
            pipe.send(answer)
        except OSError:
            return
