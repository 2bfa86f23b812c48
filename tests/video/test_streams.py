"""Streams: the time of a frame is that of its arrival, and what breaks off says so."""

from __future__ import annotations

import io
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from videos import number_of, picture, write

from sightline.errors import BrokenOffError
from sightline.tally import Tally
from sightline.video import containers, frames

Parts = Sequence[tuple[float, bytes]]


class Server:
    """Sends parts to who connects, each after a pause, and then ends in a certain way.

    Attributes:
        sent_s: When each part was sent.
    """

    def __init__(self, parts: Parts, end: str, head: bytes) -> None:
        self.sent_s: list[float] = []
        self._parts, self._end, self._head = parts, end, head
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._socket.getsockname()[1]}/live"
        self.stop = threading.Event()
        self.thread = threading.Thread(target=self._serve, daemon=True)
        self.thread.start()

    def _serve(self) -> None:
        connection, _ = self._socket.accept()
        with connection, self._socket:
            connection.recv(4096)
            connection.sendall(b"HTTP/1.0 200 OK\r\n" + self._head + b"\r\n")
            for pause_s, data in self._parts:
                self.stop.wait(pause_s)
                self.sent_s.append(time.time())
                connection.sendall(data)
            if self._end == "silent":
                self.stop.wait(30.0)
            if self._end == "reset":
                # What has not been received yet is lost with a reset.
                self.stop.wait(0.3)
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


Serve = Callable[[Parts, str, bytes], Server]


@pytest.fixture
def serve() -> Iterator[Serve]:
    servers: list[Server] = []

    def start(parts: Parts, end: str, head: bytes = b"") -> Server:
        servers.append(Server(parts, end, head))
        return servers[-1]

    yield start
    for server in servers:
        server.stop.set()
        server.thread.join()


def jpegs(count: int, apart_s: float, *, length: bool = True) -> Parts:
    """The parts of a stream of pictures, as cameras send them."""
    parts = []
    for number in range(count):
        stored = io.BytesIO()
        Image.fromarray(picture(number, (640, 480))).save(stored, "JPEG")
        data = stored.getvalue()
        told = f"Content-Length: {len(data)}\r\n" if length else ""
        head = f"--frame\r\nContent-Type: image/jpeg\r\n{told}\r\n".encode()
        parts.append((apart_s, head + data + b"\r\n"))
    return parts


MULTIPART = b"Content-Type: multipart/x-mixed-replace; boundary=frame\r\n"


@pytest.mark.parametrize("length", [True, False])
def test_frames_are_of_the_time_of_their_arrival(serve: Serve, length: bool) -> None:
    server = serve(jpegs(12, 0.1, length=length), "close", MULTIPART)
    found = []
    with pytest.raises(BrokenOffError, match=r"breaks off after \d+ frames"):
        found.extend(frames(server.url))
    # Without a length the end of a picture shows with the next.
    assert [number_of(frame.image_bgr) for frame in found] == list(range(12 if length else 11))
    times = np.array([frame.time_utc_s for frame in found])
    sent = np.array(server.sent_s)[: len(times)] + (0.0 if length else 0.1)
    np.testing.assert_allclose(times, sent, rtol=0, atol=0.15)
    # Also of those that have come before it was known what they are.
    assert np.diff(times).min() > 0.0


@pytest.mark.parametrize(
    ("end", "reason"), [("reset", "reset"), ("silent", "said nothing for 1 s"), ("close", "")]
)
def test_a_stream_that_breaks_off(
    serve: Serve, end: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(containers, "SILENCE_TIMEOUT_S", 1.0)
    server = serve(jpegs(8, 0.02), end, MULTIPART)
    found = []
    with pytest.raises(BrokenOffError, match=rf"breaks off after 8 frames \(.*{reason}"):
        found.extend(frames(server.url))
    assert [number_of(frame.image_bgr) for frame in found] == list(range(8))


def test_damaged_packets_do_not_end_a_stream(serve: Serve, tmp_path: Path) -> None:
    path = write(tmp_path / "a.ts", list(range(0, 4000, 100)))
    data = bytearray(path.read_bytes())
    damaged = 12 * 188
    begun = len(data) // 2 // 188 * 188
    data[begun : begun + damaged] = b"\xff" * damaged
    pieces = [(0.01, bytes(data[place : place + 1880])) for place in range(0, len(data), 1880)]
    server = serve(pieces, "close", b"Content-Type: video/mp2t\r\n")
    tally = Tally(server.url)
    found = []
    with pytest.raises(BrokenOffError, match="has ended"):
        found.extend(frames(server.url, tally=tally))
    assert len(found) >= 25
    assert number_of(found[-1].image_bgr) == 39
    times = np.array([frame.time_utc_s for frame in found])
    assert np.diff(times).min() >= 0.0
    # Not by a clock in the stream, which says four seconds.
    assert times[-1] - times[0] < 3.0


def test_one_interrupt_ends_the_wait_for_a_silent_stream(serve: Serve) -> None:
    server = serve(jpegs(5, 0.02), "silent", MULTIPART)
    code = (
        "import signal, sys\nfrom sightline.video import frames\n"
        # Whoever is started in a shell's background inherits that it is ignored.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "try:\n    for frame in frames(sys.argv[1]):\n        print(frame.index, flush=True)\n"
        "except KeyboardInterrupt:\n    print('interrupted', flush=True)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, server.url], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        shown = [process.stdout.readline() for _ in range(5)]
        process.send_signal(signal.SIGINT)
        begun_s = time.monotonic()
        rest = process.communicate(timeout=20.0)[0]
        assert shown == [f"{number}\n" for number in range(5)]
        assert rest == "interrupted\n"
        assert process.returncode == 0
    # The stream would have been waited for longer than this.
    assert time.monotonic() - begun_s < containers.SILENCE_TIMEOUT_S
