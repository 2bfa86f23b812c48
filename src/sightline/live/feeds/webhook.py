"""Webhooks: each alert is posted as JSON, and again until it is taken."""

from __future__ import annotations

import contextlib
import http.client
import json
import logging
import os
import random
import ssl
import threading
import time
from collections import deque
from collections.abc import Mapping

from sightline.addresses import Address
from sightline.errors import InputError
from sightline.moment import Alert, Moment
from sightline.text import terminal_text

_logger = logging.getLogger(__name__)

TOKEN = "SIGHTLINE_WEBHOOK_TOKEN"  # noqa: S105
"""Environment variable with a token, which is sent as ``Authorization: Bearer``."""

_PORTS = {"http": 80, "https": 443}
_WAITING = 1000
_TIMEOUT_S = 5.0
_FIRST_PAUSE_S = 0.5
_LONGEST_PAUSE_S = 60.0
_GIVEN_UP_S = 6.0 * 3600.0
_CLOSE_S = 1.0
_MOST_ANSWER = 65_536
# Of those that say no, these may say yes later: time-out, conflict, too early, too many.
_LATER = frozenset({408, 409, 425, 429})


def open_webhook(url: str, camera: str) -> WebhookFeed:
    """A feed that posts alerts.

    Raises:
        InputError: The URL is of another form, or the token cannot be sent.
    """
    address = Address.parse(url, _PORTS, feed="webhook", with_path=True)
    token = os.environ.get(TOKEN)
    if token is not None and not (token.isascii() and token.isprintable()):
        raise InputError(f"{TOKEN}: has a character that cannot be sent")
    return WebhookFeed(address, camera, token)


class WebhookFeed:
    """Posts alerts from a thread of its own, in their order; see `sightline.moment.Feed`.

    One that is not taken is posted again, after pauses that grow to a minute, for six hours; those
    that come meanwhile wait. An answer of 4xx says that it never will be.

    Attributes:
        sent: Alerts that were taken.
        lost: Alerts that were refused, or given up.
        retries: How often one was posted again.
        connected: Whether the last was taken.
    """

    def __init__(self, address: Address, camera: str, token: str | None = None) -> None:
        """Begin to wait for alerts.

        Args:
            address: Where they are posted.
            camera: Its name, which is sent with them.
            token: Is sent with them, too.
        """
        self.sent = self.lost = self.retries = 0
        self.connected = False
        self._address, self._camera = address, camera
        # A password in the path of a URL is not for the log.
        self._shown = f"webhook {address.scheme}://{address.host}:{address.port}"
        self._headers = {"Content-Type": "application/json", "User-Agent": "sightline"}
        if token:
            self._headers["Authorization"] = f"Bearer {token}"
        self._waiting: deque[tuple[float, Alert]] = deque()
        self._changed = threading.Condition()
        self._closing = False
        self._told = False
        self._thread = threading.Thread(target=self._run, name="feed webhook", daemon=True)
        self._thread.start()

    def publish(self, moment: Moment) -> None:
        """Hand over the alerts of a moment; returns at once."""
        if not moment.alerts:
            return
        with self._changed:
            for alert in moment.alerts:
                if len(self._waiting) == _WAITING:
                    self._waiting.popleft()
                    self.lost += 1
                self._waiting.append((time.monotonic(), alert))
            self._changed.notify()

    def close(self) -> None:
        """Post what is left, for at most a second."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(_CLOSE_S)

    def statistics(self) -> dict[str, int]:
        """What health tells of it."""
        return {
            "sent": self.sent,
            "lost": self.lost,
            "retries": self.retries,
            "waiting": len(self._waiting),
            "connected": int(self.connected),
        }

    def _run(self) -> None:
        pause_s = _FIRST_PAUSE_S
        while True:
            with self._changed:
                while not self._waiting and not self._closing:
                    self._changed.wait()
                if not self._waiting:
                    return
                since_s, alert = self._waiting[0]
            why = self._posted(alert)
            done = why is None or not self._again(why)
            given_up = not done and time.monotonic() - since_s > _GIVEN_UP_S
            with self._changed:
                self.connected = why is None
                if done or given_up:
                    if self._waiting and self._waiting[0] == (since_s, alert):
                        self._waiting.popleft()
                    self.sent += why is None
                    self.lost += why is not None
            if why is not None and not self._told:
                self._told = True
                _logger.warning("feed %s: %s", self._shown, terminal_text(str(why)))
            if done:
                self._told = self._told and why is not None
                pause_s = _FIRST_PAUSE_S
                continue
            self.retries += 1
            if self._pause(pause_s):
                return
            pause_s = min(2.0 * pause_s, _LONGEST_PAUSE_S)

    def _pause(self, pause_s: float) -> bool:
        """Wait, unless it ends; whether it does."""
        # Those of many cameras are not to come back all at once.
        jitter = 0.75 + 0.5 * random.random()  # noqa: S311
        with self._changed:
            self._changed.wait_for(lambda: self._closing, pause_s * jitter)
            if self._closing:
                self.lost += len(self._waiting)
            return self._closing

    @staticmethod
    def _again(why: Exception) -> bool:
        status = why.status if isinstance(why, _RefusedError) else 500
        return status >= 500 or status in _LATER

    def _posted(self, alert: Alert) -> Exception | None:
        """Why an alert was not taken; None where it was."""
        body = json.dumps(self._message(alert), allow_nan=False).encode()
        try:
            connection = self._connection()
        except (OSError, ValueError) as error:
            return error
        with contextlib.closing(connection):
            try:
                path = f"/{self._address.path}"
                path += f"?{self._address.query}" if self._address.query else ""
                connection.request("POST", path, body, self._headers)
                answer = connection.getresponse()
                answer.read(_MOST_ANSWER)
            except (OSError, http.client.HTTPException, ValueError) as error:
                return error
        # Where it would send on, is nobody whom the user has named.
        return None if 200 <= answer.status < 300 else _RefusedError(answer.status)

    def _message(self, alert: Alert) -> Mapping[str, object]:
        return {"camera": self._camera, **alert.to_message()}

    def _connection(self) -> http.client.HTTPConnection:
        host, port = self._address.host, self._address.port
        if self._address.scheme == "http":
            return http.client.HTTPConnection(host, port, timeout=_TIMEOUT_S)
        context = ssl.create_default_context()
        return http.client.HTTPSConnection(host, port, timeout=_TIMEOUT_S, context=context)


class _RefusedError(Exception):
    """An answer that is no yes."""

    def __init__(self, status: int) -> None:
        super().__init__(f"the answer was {status}")
        self.status = status
