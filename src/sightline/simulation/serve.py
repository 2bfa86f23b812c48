"""A synthetic harbour as a camera that can be watched: pictures over HTTP, AIS over TCP."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import BaseRequestHandler, ThreadingTCPServer
from typing import ClassVar

import cv2

from sightline.addresses import Address
from sightline.errors import InputError
from sightline.simulation.harbour import Harbour
from sightline.simulation.render import Look
from sightline.simulation.simulate import ais_sentences, painter

_BOUNDARY = "picture"
_QUALITY = 90
_WAIT_S = 0.5


class HarbourServer:
    """Serves what happens in a harbour as if it happened now, until its time is over.

    Everybody who opens the address gets the newest picture as soon as it is drawn (MJPEG, a
    ``multipart/x-mixed-replace`` stream), and everybody who connects to the other the AIS
    sentences from then on.

    Attributes:
        shift_s: What is added to the harbour's times to make them those of today.
    """

    def __init__(
        self,
        harbour: Harbour,
        pictures: tuple[str, int],
        *,
        ais: tuple[str, int] | None = None,
        rate_hz: float = 10.0,
        look: Look | None = None,
    ) -> None:
        """Take the addresses; `start` begins to serve.

        Args:
            harbour: The world.
            pictures: Host and port; port 0 takes a free one.
            ais: Likewise; None: no AIS.
            rate_hz: Pictures a second.
            look: How it is drawn; None: as its seed says.

        Raises:
            InputError: An address cannot be had, or the rate is not positive.
        """
        if not rate_hz > 0.0:
            raise InputError(f"a rate of {rate_hz:g} pictures a second is not positive")
        self._harbour, self._rate_hz = harbour, rate_hz
        self._paint = painter(harbour, look)
        self._drawn = threading.Condition()
        self._picture, self._number = b"", 0
        self._ended = threading.Event()
        self._begun_s = 0.0
        self.shift_s = 0.0
        self._servers: list[ThreadingHTTPServer | ThreadingTCPServer] = []
        self._threads: list[threading.Thread] = []
        try:
            self._servers.append(_bound(ThreadingHTTPServer, pictures, _Pictures, self))
            if ais is not None:
                self._servers.append(_bound(_AisServer, ais, _Ais, self))
        except InputError:
            self.close()
            raise

    @property
    def addresses(self) -> list[tuple[str, int]]:
        """Host and port of the pictures, and of AIS where it is served."""
        return [(str(one.server_address[0]), int(one.server_address[1])) for one in self._servers]

    def start(self) -> None:
        """Begin to serve, in threads of its own."""
        self._begun_s = time.time()
        self.shift_s = self._begun_s - self._harbour.start_utc_s
        jobs = [self._draw, *(one.serve_forever for one in self._servers)]
        self._threads = [threading.Thread(target=job, daemon=True) for job in jobs]
        for thread in self._threads:
            thread.start()

    def wait(self, stop: threading.Event | None = None) -> None:
        """Return when the harbour's time is over, or an event is set."""
        while not self._ended.wait(_WAIT_S):
            if stop is not None and stop.is_set():
                return

    def close(self) -> None:
        """End all streams, and let go of the addresses."""
        self._ended.set()
        with self._drawn:
            self._drawn.notify_all()
        for server in self._servers:
            if self._threads:
                server.shutdown()
            server.server_close()
        for thread in self._threads:
            thread.join(2.0)
        self._servers, self._threads = [], []

    def pictures(self, after: int) -> tuple[int, bytes]:
        """The newest picture as JPEG and its number, as soon as there is one after a number.

        Returns:
            An empty picture where there will be none.
        """
        with self._drawn:
            self._drawn.wait_for(lambda: self._ended.is_set() or self._number > after)
            return (self._number, b"") if self._ended.is_set() else (self._number, self._picture)

    def sentences(self) -> list[tuple[float, str]]:
        """AIS sentences and the times at which they are sent, POSIX seconds."""
        return ais_sentences(self._harbour, self.shift_s, names=True)

    def pause_until(self, time_utc_s: float) -> bool:
        """Wait for a time; False where the harbour's time is over before."""
        return not self._ended.wait(max(time_utc_s - time.time(), 0.0))

    def _draw(self) -> None:
        end_s = self._begun_s + self._harbour.end_utc_s - self._harbour.start_utc_s
        number = 0
        while not self._ended.is_set():
            due_s = self._begun_s + number / self._rate_hz
            if not self.pause_until(due_s):
                break
            now_s = time.time()
            if now_s >= end_s:
                break
            image = self._paint(now_s - self.shift_s)
            packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
            with self._drawn:
                self._picture, self._number = packed.tobytes(), self._number + 1
                self._drawn.notify_all()
            # A machine that is too slow leaves pictures out; the harbour does not wait for it.
            number = max(number + 1, int((time.time() - self._begun_s) * self._rate_hz))
        self._ended.set()
        with self._drawn:
            self._drawn.notify_all()


class _Pictures(BaseHTTPRequestHandler):
    """Answers whoever opens the address with pictures."""

    harbour: ClassVar[HarbourServer]

    def do_GET(self) -> None:
        """Send pictures until there are no more."""
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        number = 0
        with contextlib.suppress(OSError):
            while True:
                number, picture = self.harbour.pictures(number)
                if not picture:
                    break
                head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\n"
                head += f"Content-Length: {len(picture)}\r\n\r\n"
                self.wfile.write(head.encode() + picture + b"\r\n")
            self.wfile.write(f"--{_BOUNDARY}--\r\n".encode())
        self.close_connection = True

    def log_message(self, format: str, *arguments: object) -> None:  # noqa: A002
        """Say nothing: a library does not."""


class _Ais(BaseRequestHandler):
    """Sends whoever connects the sentences from now on."""

    harbour: ClassVar[HarbourServer]

    def handle(self) -> None:
        """Send each when its time has come."""
        now_s = time.time()
        with contextlib.suppress(OSError):
            for time_s, line in self.harbour.sentences():
                if time_s < now_s:
                    continue
                if not self.harbour.pause_until(time_s):
                    break
                self.request.sendall(f"{line}\r\n".encode())


class _AisServer(ThreadingTCPServer):
    daemon_threads = True
    allow_reuse_address = True


def _bound(
    kind: type[ThreadingHTTPServer] | type[ThreadingTCPServer],
    address: tuple[str, int],
    handler: type[_Pictures] | type[_Ais],
    harbour: HarbourServer,
) -> ThreadingHTTPServer | ThreadingTCPServer:
    try:
        return kind(address, type(handler.__name__, (handler,), {"harbour": harbour}))
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"cannot serve at {address[0]}:{address[1]} ({reason}); expected a free port of this "
            "machine"
        ) from error


def local_address(text: str, scheme: str) -> tuple[str, int]:
    """Host and port of an address such as ``http://127.0.0.1:8090/``.

    Args:
        text: The address.
        scheme: How it must begin.

    Raises:
        InputError: It begins otherwise, or has no host and port.
    """
    try:
        address = Address.parse(text, {scheme: None}, feed="serve", with_path=True)
    except InputError as error:
        reason = f"{text!r} is no address to serve at; give {scheme}://HOST:PORT"
        raise InputError(reason) from error
    host, port = address.host, address.port
    with contextlib.suppress(OSError):
        socket.getaddrinfo(host, port)
        return host, port
    raise InputError(f"{text!r}: the host {host!r} is not known; give one of this machine")
