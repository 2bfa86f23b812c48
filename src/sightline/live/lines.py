"""Feeds that cannot hold up the pipeline or each other, whatever they do."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping

from sightline.moment import Feed, Moment
from sightline.text import without_secrets

_WAITING = 2
_MOST_WITH_ALERTS = 200
_TOLD_APART_S = 60.0


class _Line:
    """A thread between the pipeline and one feed."""

    def __init__(self, name: str, feed: Feed, told: Callable[[str], None]) -> None:
        self.name, self.lost, self.failed = name, 0, 0
        self._feed, self._told = feed, told
        self._changed = threading.Condition()
        self._waiting: deque[Moment] = deque()
        self._closing = False
        self._told_at_s = -_TOLD_APART_S
        self._thread = threading.Thread(target=self._run, daemon=True, name=f"sightline-{name}")
        self._thread.start()

    def put(self, moment: Moment) -> None:
        with self._changed:
            self._waiting.append(moment)
            if len(self._waiting) > _WAITING:
                # What has happened is not told again by the next moment.
                plain = (i for i, one in enumerate(self._waiting) if not one.alerts)
                oldest = next(plain, None)
                if oldest is not None or len(self._waiting) > _MOST_WITH_ALERTS:
                    del self._waiting[oldest or 0]
                    self.lost += 1
            self._changed.notify()

    def counts(self) -> dict[str, int]:
        ask = getattr(self._feed, "statistics", None)
        own: dict[str, int] = ask() if callable(ask) else {}
        return {**own, "lost": self.lost + own.get("lost", 0), "failed": self.failed}

    def ask_to_close(self) -> None:
        with self._changed:
            self._closing = True
            self._changed.notify()

    def join(self, until_s: float) -> None:
        self._thread.join(max(0.0, until_s - time.monotonic()))

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._waiting and not self._closing:
                    self._changed.wait()
                moment = self._waiting.popleft() if self._waiting else None
            if moment is None:
                break
            self._try(lambda one=moment: self._feed.publish(one))  # type: ignore[misc]
        self._try(self._feed.close)

    def _try(self, action: Callable[[], None]) -> None:
        try:
            action()
        # A feed is others' code, at the end of others' networks.
        except Exception as error:
            self.failed += 1
            now_s = time.monotonic()
            if now_s - self._told_at_s >= _TOLD_APART_S:
                self._told_at_s = now_s
                why = str(error) or type(error).__name__
                self._told(without_secrets(f"{self.name}: {why}"))


class Lines:
    """All feeds of a camera."""

    def __init__(
        self, feeds: Mapping[str, Feed], told: Callable[[str], None] | None = None
    ) -> None:
        """Begin a thread for each feed.

        Args:
            feeds: By what they are called.
            told: Is told what is wrong with one, at most once a minute for each.
        """
        silent: Callable[[str], None] = lambda _: None  # noqa: E731
        self._told = told or silent
        self._lines = [_Line(name, feed, self._told) for name, feed in feeds.items()]

    def add(self, name: str, feed: Feed) -> None:
        """Begin a thread for one more."""
        # Whole, since the pipeline may be going through them.
        self._lines = [*self._lines, _Line(name, feed, self._told)]

    def remove(self, name: str) -> None:
        """Let one send what is left, and end its thread; returns at once."""
        gone = [line for line in self._lines if line.name == name]
        self._lines = [line for line in self._lines if line.name != name]
        for line in gone:
            line.ask_to_close()

    def publish(self, moment: Moment) -> None:
        """Hand a moment to all; returns at once."""
        for line in self._lines:
            line.put(moment)

    def counts(self) -> dict[str, dict[str, int]]:
        """How many moments each lost, how often it failed, and what it tells of itself."""
        return {line.name: line.counts() for line in self._lines}

    def close(self, timeout_s: float = 1.2) -> None:
        """Let all of them send what is left, for so long together."""
        until_s = time.monotonic() + timeout_s
        for line in self._lines:
            line.ask_to_close()
        for line in self._lines:
            line.join(until_s)
