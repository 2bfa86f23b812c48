"""Ways to receivers over UDP, TCP and TLS."""

from __future__ import annotations

import contextlib
import ipaddress
import os
import select
import socket
import ssl
import threading
import time
from collections import deque
from collections.abc import Sequence

from sightline.errors import InputError

_CONNECT_S = 10.0
_SEND_S = 5.0
_POLL_S = 0.1
_MOST_CLIENTS = 32
_BATCHES = 4
_IDLE_S = 30.0
_READ = 65536
_DATAGRAM = 1200


class UdpTransport:
    """Sends each message as a datagram, also to a multicast group or a broadcast address.

    Args:
        host: Name or number.
        port: Its port.
        packed: Whether as many messages as fit go into one: the buffers of receivers hold a number
            of datagrams, however small they are.
    """

    def __init__(self, host: str, port: int, *, packed: bool = False) -> None:
        self._host, self._port, self._packed = host, port, packed
        self._socket: socket.socket | None = None
        self._target: tuple[str, int] | tuple[str, int, int, int] | tuple[int, bytes] | None = None

    def open(self, stopping: threading.Event) -> None:  # noqa: ARG002
        """Look the address up."""
        found = socket.getaddrinfo(self._host, self._port, type=socket.SOCK_DGRAM)
        family, _, _, _, self._target = found[0]
        made = socket.socket(family, socket.SOCK_DGRAM)
        made.settimeout(_SEND_S)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        with contextlib.suppress(ValueError):
            if family == socket.AF_INET and ipaddress.ip_address(self._target[0]).is_multicast:
                # It stays in this network.
                made.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
        self._socket = made

    def send(self, messages: Sequence[bytes]) -> None:
        """Send messages."""
        if self._socket is None or self._target is None:
            raise ConnectionError("closed")
        for datagram in _packed(messages) if self._packed else messages:
            self._socket.sendto(datagram, self._target)

    def close(self) -> None:
        """Let go of the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def _packed(messages: Sequence[bytes]) -> list[bytes]:
    """Messages joined to datagrams that no network cuts in pieces."""
    datagrams: list[bytes] = []
    for message in messages:
        if datagrams and len(datagrams[-1]) + len(message) <= _DATAGRAM:
            datagrams[-1] += message
        else:
            datagrams.append(message)
    return datagrams


class TcpTransport:
    """A connection to a receiver that listens, over TLS where there is a context for it."""

    def __init__(self, host: str, port: int, context: ssl.SSLContext | None = None) -> None:
        self._host, self._port, self._context = host, port, context
        self._socket: socket.socket | None = None

    def open(self, stopping: threading.Event) -> None:
        """Connect."""
        made = connect(self._host, self._port, stopping)
        self._socket = made
        if self._context is not None:
            self._socket = self._context.wrap_socket(made, server_hostname=self._host)

    def send(self, messages: Sequence[bytes]) -> None:
        """Send messages."""
        if self._socket is None:
            raise ConnectionError("closed")
        # One that has gone is noticed before what is sent to it is lost.
        self._socket.settimeout(0.0)
        with contextlib.suppress(BlockingIOError, ssl.SSLWantReadError):
            while True:
                if not self._socket.recv(_READ):
                    raise ConnectionResetError("the receiver closed the connection")
        self._socket.settimeout(_SEND_S)
        self._socket.sendall(b"".join(messages))

    def close(self) -> None:
        """Close the connection, also while something is being sent."""
        made, self._socket = self._socket, None
        if made is not None:
            with contextlib.suppress(OSError):
                made.shutdown(socket.SHUT_RDWR)
            made.close()


class TcpServerTransport:
    """Listens, and sends the same to all that have connected."""

    def __init__(self, host: str, port: int, *, feed: str) -> None:
        """Begin to listen.

        Args:
            host: The address to listen at.
            port: The port; 0 takes a free one.
            feed: Begins what is said where the address cannot be had.

        Raises:
            InputError: The address cannot be had.
        """
        try:
            family, *_ = socket.getaddrinfo(
                host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )[0]
            self._listener = socket.create_server((host, port), family=family)
            self._family = family
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(
                f"{feed}: cannot listen at {host}:{port} ({reason}); "
                "expected a free port of this machine"
            ) from error
        self._listener.setblocking(False)
        self.port: int = self._listener.getsockname()[1]
        self._place = (host, self.port)
        self._clients: list[_Client] = []

    @property
    def lost(self) -> int:
        """Batches that clients who are connected now were too slow for."""
        return sum(client.lost for client in self._clients)

    def open(self, stopping: threading.Event) -> None:  # noqa: ARG002
        """Listen again where it was closed; at first it listens already."""
        if self._listener.fileno() < 0:
            self._listener = socket.create_server(self._place, family=self._family)
            self._listener.setblocking(False)

    def send(self, messages: Sequence[bytes]) -> None:
        """Send messages to all that are connected, and take in those that have come."""
        self._accept()
        batch = b"".join(messages)
        for client in tuple(self._clients):
            try:
                client.send(batch)
            except OSError:
                client.close()
                self._clients.remove(client)

    def close(self) -> None:
        """Close all connections, and listen no more."""
        for client in tuple(self._clients):
            client.close()
        self._clients = []
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                made, _ = self._listener.accept()
                if len(self._clients) < _MOST_CLIENTS:
                    self._clients.append(_Client(made))
                else:
                    made.close()


class _Client:
    """One that is connected to a server: what it has not taken yet, and how much it lost."""

    def __init__(self, made: socket.socket) -> None:
        made.setblocking(False)
        self.lost = 0
        self._socket = made
        self._begun = b""
        self._waiting: deque[bytes] = deque()
        self._moved_s = time.monotonic()

    def send(self, batch: bytes) -> None:
        """Send a batch, or as much as it takes; raises `OSError` where it has gone."""
        with contextlib.suppress(BlockingIOError):
            while True:
                if not self._socket.recv(_READ):
                    raise ConnectionResetError("closed")
        if len(self._waiting) == _BATCHES:
            self._waiting.popleft()
            self.lost += 1
        self._waiting.append(batch)
        with contextlib.suppress(BlockingIOError):
            # A sentence that was begun is finished, so that it is not torn.
            while self._begun or self._waiting:
                self._begun = self._begun or self._waiting.popleft()
                self._begun = self._begun[self._socket.send(self._begun) :]
                self._moved_s = time.monotonic()
        if time.monotonic() - self._moved_s > _IDLE_S:
            raise TimeoutError("takes nothing")

    def close(self) -> None:
        """Let go of it."""
        self._socket.close()


def connect(host: str, port: int, stopping: threading.Event) -> socket.socket:
    """A TCP connection; gives up soon after it is asked to.

    Raises:
        OSError: Nobody answers, or it was asked to stop.
    """
    error: OSError = OSError("no address")
    for family, kind, protocol, _, place in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
        made = socket.socket(family, kind, protocol)
        try:
            made.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                made.connect(place)
            _await_connection(made, stopping)
            made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            made.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            made.settimeout(_SEND_S)
        except OSError as failed:
            made.close()
            error = failed
        else:
            return made
    raise error


def _await_connection(made: socket.socket, stopping: threading.Event) -> None:
    deadline = time.monotonic() + _CONNECT_S
    while not select.select([], [made], [], _POLL_S)[1]:
        if stopping.is_set():
            raise ConnectionAbortedError("stopped")
        if time.monotonic() > deadline:
            raise TimeoutError("no answer")
    number = made.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
    if number:
        raise OSError(number, os.strerror(number))
