"""Cameras that tests can kill, stall and change: over HTTP, and one that pushes RTSP."""

from __future__ import annotations

import base64
import multiprocessing
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import av
import cv2
import numpy as np
from numpy.typing import NDArray

_BOUNDARY = b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%s\r\n"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def noise(seed: int, size_px: tuple[int, int] = (320, 240)) -> NDArray[np.uint8]:
    """A picture that no other is like."""
    rng = np.random.default_rng(seed)
    small = rng.integers(60, 200, (size_px[1] // 8, size_px[0] // 8, 3), dtype=np.uint8)
    return np.ascontiguousarray(small.repeat(8, axis=0).repeat(8, axis=1))


class HttpCamera:
    """A camera that sends MJPEG over HTTP.

    Attributes:
        mode: ``"run"``, ``"stall"``, ``"frozen"`` or ``"black"``.
        size_px: Of its pictures.
        rate_hz: Frames a second.
    """

    def __init__(self, password: str = "") -> None:
        self.mode, self.size_px, self.rate_hz = "run", (320, 240), 25.0
        self.port = free_port()
        self.sent = 0
        self._password = password
        self._server: ThreadingHTTPServer | None = None
        self._connections: list[socket.socket] = []

    @property
    def address(self) -> str:
        user = f"operator:{self._password}@" if self._password else ""
        return f"http://{user}127.0.0.1:{self.port}/video"

    def start(self) -> None:
        camera = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                camera._serve(self)

            def log_message(self, *_: object) -> None:
                pass

        ThreadingHTTPServer.allow_reuse_address = True
        self._server = ThreadingHTTPServer(("127.0.0.1", self.port), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()

    def kill(self) -> None:
        """As if its power were cut."""
        server, self._server = self._server, None
        if server is not None:
            server.shutdown()
            server.server_close()
        for one in self._connections:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
        self._connections.clear()

    def _serve(self, request: BaseHTTPRequestHandler) -> None:
        known = base64.b64encode(f"operator:{self._password}".encode()).decode()
        if self._password and request.headers.get("Authorization") != f"Basic {known}":
            request.send_response(401)
            request.send_header("WWW-Authenticate", 'Basic realm="camera"')
            request.end_headers()
            return
        request.send_response(200)
        request.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        request.end_headers()
        self._connections.append(request.connection)
        served_by = self._server
        with suppress(OSError, ValueError):
            while self._server is served_by:
                time.sleep(1.0 / self.rate_hz)
                if self.mode == "stall":
                    continue
                seed = 0 if self.mode == "frozen" else self.sent
                image = noise(seed, self.size_px)
                if self.mode == "black":
                    image = np.full_like(image, 3 + self.sent % 2)
                jpeg = cv2.imencode(".jpg", image)[1].tobytes()
                request.wfile.write(_BOUNDARY % (len(jpeg), jpeg))
                self.sent += 1


@contextmanager
def http_camera(password: str = "") -> Iterator[HttpCamera]:
    camera = HttpCamera(password)
    camera.start()
    try:
        yield camera
    finally:
        camera.kill()


def push_rtsp(address: str, start_utc_s: float, frames: int, rate_hz: float) -> None:
    """Push frames whose brightness is their number (of fifty); sender reports tell the clock."""
    output = av.open(
        address,
        "w",
        format="rtsp",
        options={"rtsp_transport": "tcp", "start_time_realtime": str(int(start_utc_s * 1e6))},
    )
    stream = output.add_stream(
        "libx264",
        rate=int(rate_hz),
        options={"tune": "zerolatency", "preset": "ultrafast", "g": "12", "crf": "1"},
    )
    stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
    for number in range(frames):
        image = np.full((240, 320, 3), 40 + 4 * (number % 50), dtype=np.uint8)
        image[::16] = 0
        picture = av.VideoFrame.from_ndarray(image, format="bgr24")
        picture.pts = number
        time.sleep(max(0.0, start_utc_s + number / rate_hz - time.time()))
        for packet in stream.encode(picture):
            output.mux(packet)
    output.close()


@contextmanager
def rtsp_camera(address: str, *, frames: int, rate_hz: float = 25.0) -> Iterator[float]:
    """A camera that pushes to whoever listens; yields when its first frame is taken."""
    start_utc_s = time.time() + 1.5
    process = multiprocessing.get_context("spawn").Process(
        target=push_rtsp, args=(address, start_utc_s, frames, rate_hz), daemon=True
    )
    process.start()
    try:
        yield start_utc_s
    finally:
        process.kill()
        process.join()
