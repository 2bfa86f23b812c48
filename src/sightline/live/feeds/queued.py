"""A feed with a thread and a bounded queue, so that no receiver can hold up the camera."""

from __future__ import annotations

import logging
import random
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Protocol

from sightline.moment import Moment
from sightline.text import terminal_text

_logger = logging.getLogger(__name__)

_WAITING = 8
_FIRST_PAUSE_S = 0.5
_LONGEST_PAUSE_S = 30.0
_CLOSE_S = 1.0
_ABORT_S = 0.2


class Transport(Protocol):
    """A way to a receiver."""

    def open(self, stopping: threading.Event) -> None:
        """Reach the receiver; returns or raises `OSError` soon after ``stopping`` is set."""

    def send(self, messages: Sequence[bytes]) -> None:
        """Send messages; raises `OSError` where the receiver has gone."""

    def close(self) -> None:
        """Let go of it, whatever is being done; may be called twice and from any thread."""


class QueuedFeed:
    """Publishes moments from a thread of its own; see `sightline.moment.Feed`.

    A receiver that is slow loses the oldest moments, and one that has gone is tried again, after
    pauses that grow.

    Attributes:
        name: What it is called in messages.
        sent: Moments that were handed to the receiver.
        lost: Moments that it should have had and did not get.
        connections: How often the receiver was reached.
        connected: Whether it is there now.
    """

    def __init__(
        self,
        name: str,
        encode: Callable[[Moment], Sequence[bytes]],
        transport: Transport,
        *,
        every_s: float = 0.0,
    ) -> None:
        """Begin to reach the receiver.

        Args:
            name: What it is called in messages.
            encode: Makes the messages of a moment.
            transport: The way to the receiver.
            every_s: At most one moment in this many seconds is sent; the others are not lost.
        """
        self.name = name
        self.sent = 0
        self.lost = 0
        self.connections = 0
        self.connected = False
        self.transport = transport
        self._encode = encode
        self._every_s = every_s
        self._slot: int | None = None
        self._waiting: deque[Moment] = deque()
        self._changed = threading.Condition()
        self._closing = False
        self._stopping = threading.Event()
        self._pause_s = _FIRST_PAUSE_S
        self._told = False
        self._thread = threading.Thread(target=self._run, name=f"feed {name}", daemon=True)
        self._thread.start()

    def publish(self, moment: Moment) -> None:
        """Hand a moment over; one that cannot keep up loses the oldest and counts them."""
        with self._changed:
            if self._closing:
                return
            if self._every_s > 0.0:
                slot = int(moment.time_utc_s // self._every_s)
                if slot == self._slot:
                    return
                self._slot = slot
            if len(self._waiting) == _WAITING:
                self._waiting.popleft()
                self.lost += 1
            self._waiting.append(moment)
            self._changed.notify()

    def close(self) -> None:
        """Send what is left, for at most a second, and let go of sockets and threads."""
        with self._changed:
            self._closing = True
            # Without a receiver there is nobody to wait for.
            if not self.connected:
                self._stopping.set()
            self._changed.notify()
        self._thread.join(_CLOSE_S - _ABORT_S)
        if self._thread.is_alive():
            self._stopping.set()
            self.transport.close()
            self._thread.join(_ABORT_S)

    def statistics(self) -> dict[str, int]:
        """What health tells of it: sent, lost, connections, and 1 where it is connected."""
        return {
            "sent": self.sent,
            "lost": self.lost,
            "connections": self.connections,
            "connected": int(self.connected),
        }

    def _run(self) -> None:
        try:
            while not self._stopping.is_set() and not self._closing:
                try:
                    self.transport.open(self._stopping)
                except Exception as error:
                    self._failed(error)
                    continue
                self._set_connected(True)
                try:
                    self._drain()
                except Exception as error:
                    self._set_connected(False)
                    self._failed(error)
        finally:
            self._set_connected(False)
            self.lost += len(self._waiting)
            self.transport.close()

    def _drain(self) -> None:
        """Send until asked to stop; raises what the transport raises."""
        while not self._stopping.is_set():
            with self._changed:
                while not self._waiting and not self._closing:
                    self._changed.wait()
                if not self._waiting:
                    return
                moment = self._waiting.popleft()
            try:
                messages = self._encode(moment)
            except Exception:
                # Not the network's fault but ours: the others are sent all the same.
                self.lost += 1
                _logger.exception("feed %s: a moment cannot be written", self.name)
                continue
            try:
                self.transport.send(messages)
            except BaseException:
                self.lost += 1
                raise
            self.sent += 1
            self._pause_s = _FIRST_PAUSE_S
            self._told = False

    def _set_connected(self, connected: bool) -> None:
        with self._changed:
            if connected:
                self.connections += 1
                _logger.info("feed %s: connected", self.name)
            self.connected = connected

    def _failed(self, error: Exception) -> None:
        """Say it once an outage, and wait, a little longer each time."""
        if not isinstance(error, OSError):
            # A bug, and no reason for the camera to stop.
            _logger.error("feed %s: %r", self.name, error, exc_info=error)
        elif not self._told and not self._closing:
            _logger.warning(
                "feed %s: not reached (%s); trying again", self.name, terminal_text(str(error))
            )
        self._told = True
        self.transport.close()
        # Feeds of many cameras are not to come back all at once.
        jitter = 0.75 + 0.5 * random.random()  # noqa: S311
        deadline = time.monotonic() + self._pause_s * jitter
        while not self._closing and time.monotonic() < deadline:
            if self._stopping.wait(min(0.1, max(0.0, deadline - time.monotonic()))):
                break
        self._pause_s = min(2.0 * self._pause_s, _LONGEST_PAUSE_S)
