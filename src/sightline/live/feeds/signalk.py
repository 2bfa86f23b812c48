"""Signal K: a delta a target, over a WebSocket, TCP or UDP."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import math
import os
import socket
import ssl
import threading
import uuid
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sightline import _optional
from sightline.addresses import Address
from sightline.errors import InputError
from sightline.live.feeds.names import display_name
from sightline.live.feeds.queued import QueuedFeed, Transport
from sightline.live.feeds.transports import TcpTransport, UdpTransport, connect
from sightline.moment import Moment, TargetState
from sightline.text import encodable_text, terminal_text
from sightline.types import to_datetime64

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

_logger = logging.getLogger(__name__)

TOKEN = "SIGHTLINE_SIGNALK_TOKEN"  # noqa: S105
"""Environment variable with the token of the server, which a WebSocket is opened with."""

_PORTS = {"ws": 3000, "wss": 443, "tcp": 8375, "udp": 8377}
_STREAM = "signalk/v1/stream"
_EVERY_S = 1.0
_OPEN_S = 5.0


def open_signalk(url: str, camera: str) -> QueuedFeed:
    """A feed of Signal K deltas.

    Raises:
        InputError: The URL is of another form, or the library for WebSockets is not there.
    """
    web = url.lower().startswith("ws")
    address = Address.parse(url, _PORTS, feed="signalk", with_path=web)
    transport: Transport
    if address.scheme in ("ws", "wss"):
        if "token=" in address.query.lower():
            raise InputError(f"signalk: the URL holds a token, which others can read; set {TOKEN}")
        _optional.module("websockets.sync.client", "live")
        transport = WebSocketTransport(address, os.environ.get(TOKEN))
    elif address.scheme == "tcp":
        transport = TcpTransport(address.host, address.port)
    else:
        transport = UdpTransport(address.host, address.port)
    encoder = DeltaEncoder(camera)
    return QueuedFeed(f"signalk {url}", encoder, transport, every_s=_EVERY_S)


class DeltaEncoder:
    """Makes the deltas of moments, a line of JSON a target.

    Args:
        camera: Its name, from which and from the number of a target its context is made.
    """

    def __init__(self, camera: str) -> None:
        self._camera = camera

    def __call__(self, moment: Moment) -> Sequence[bytes]:
        """The deltas of a moment."""
        time = f"{np.datetime_as_string(to_datetime64(moment.time_utc_s + 0.0005), 'ms')}Z"
        return [
            json.dumps(self._delta(target, time), allow_nan=False, separators=(",", ":")).encode()
            + b"\n"
            for target in moment.targets
            if math.isfinite(target.latitude_deg) and math.isfinite(target.longitude_deg)
        ]

    def context(self, number: int) -> str:
        """The context of a target, the same after a restart."""
        digest = hashlib.sha256(f"sightline {self._camera} {number}".encode("utf-8", "replace"))
        # Version 4 is the only one that the schema of Signal K takes.
        return f"vessels.urn:mrn:signalk:uuid:{uuid.UUID(bytes=digest.digest()[:16], version=4)}"

    def _delta(self, target: TargetState, time: str) -> dict[str, object]:
        about: dict[str, object] = {"name": encodable_text(display_name(target))}
        if target.mmsi is not None:
            about["mmsi"] = f"{target.mmsi:09d}"
        position = {
            "latitude": round(target.latitude_deg, 7),
            "longitude": round(target.longitude_deg, 7),
        }
        values: list[dict[str, object]] = [
            {"path": "", "value": about},
            {"path": "navigation.position", "value": position},
        ]
        if _known(target.speed_mps):
            values.append({"path": "navigation.speedOverGround", "value": target.speed_mps})
        if _known(target.course_deg):
            course = math.radians(target.course_deg or 0.0)
            values.append({"path": "navigation.courseOverGroundTrue", "value": round(course, 5)})
        source = {"label": "sightline", "type": "camera", "src": encodable_text(self._camera)}
        update = {"source": source, "timestamp": time, "values": values}
        return {"context": self.context(target.id), "updates": [update]}


class WebSocketTransport:
    """A WebSocket of a Signal K server.

    Args:
        address: Of the server; without a path its stream is taken, without a subscription.
        token: Sent along, where there is one.
    """

    def __init__(self, address: Address, token: str | None) -> None:
        path = address.path or _STREAM
        query = address.query or "subscribe=none"
        host = f"[{address.host}]" if ":" in address.host else address.host
        self._url = f"{address.scheme}://{host}:{address.port}/{path}?{query}"
        self._address = address
        self._headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._connection: ClientConnection | None = None
        self._opened = contextlib.ExitStack()
        self._socket: socket.socket | None = None
        self._told = False

    def open(self, stopping: threading.Event) -> None:
        """Connect, and introduce ourselves."""
        from websockets.exceptions import InvalidHandshake, WebSocketException
        from websockets.sync.client import connect as connect_websocket

        made = connect(self._address.host, self._address.port, stopping)
        secure = ssl.create_default_context() if self._address.scheme == "wss" else None
        self._socket = made
        try:
            self._connection = self._opened.enter_context(
                connect_websocket(
                    self._url,
                    sock=made,
                    ssl=secure,
                    additional_headers=self._headers,
                    open_timeout=_OPEN_S,
                    close_timeout=0.3,
                    # Nobody hears of it whom the URL does not name.
                    proxy=None,
                )
            )
        except InvalidHandshake as error:
            hint = f"; is {TOKEN} right?" if "401" in str(error) or "403" in str(error) else ""
            raise ConnectionRefusedError(f"{error}{hint}") from error
        except WebSocketException as error:
            raise ConnectionError(str(error)) from error

    def send(self, messages: Sequence[bytes]) -> None:
        """Send messages, and read what the server says to them."""
        from websockets.exceptions import WebSocketException

        if self._connection is None:
            raise ConnectionError("closed")
        try:
            for message in messages:
                self._connection.send(message.decode().rstrip("\n"))
            with contextlib.suppress(TimeoutError):
                while True:
                    self._read(self._connection.recv(timeout=0))
        except WebSocketException as error:
            raise ConnectionError(str(error)) from error

    def close(self) -> None:
        """Close the connection, also while something is being sent."""
        self._connection = None
        with contextlib.suppress(Exception):
            self._opened.close()
        made, self._socket = self._socket, None
        if made is not None:
            # Ends a handshake that nobody answers, too; the library closes what it was given, and
            # its thread would not notice if it were closed here.
            with contextlib.suppress(OSError):
                made.shutdown(socket.SHUT_RDWR)

    def _read(self, said: str | bytes) -> None:
        """Tell once what the server refuses; it drops what has no permission without an error."""
        text = said if isinstance(said, str) else said.decode("utf-8", "replace")
        if "errorMessage" in text and not self._told:
            self._told = True
            _logger.warning("feed signalk: the server says %s", terminal_text(text[:200]))


def _known(value: float | None) -> bool:
    return value is not None and math.isfinite(value)
