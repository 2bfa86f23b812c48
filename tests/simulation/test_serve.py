"""The synthetic harbour as a camera that can be watched."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator

import av
import numpy as np
import pyais
import pytest

from sightline.errors import InputError
from sightline.simulation.harbour import Harbour, HarbourSettings
from sightline.simulation.render import Renderer
from sightline.simulation.serve import HarbourServer, local_address

LOCAL = ("127.0.0.1", 0)


@pytest.fixture(scope="module")
def harbour() -> Harbour:
    return Harbour.random(4, HarbourSettings(duration_s=120.0, image_size_px=(320, 180), ferries=1))


@pytest.fixture
def server(harbour: Harbour) -> Iterator[HarbourServer]:
    made = HarbourServer(harbour, LOCAL, ais=LOCAL, rate_hz=20.0)
    made.start()
    yield made
    made.close()


def test_pictures_are_those_of_the_harbour_now(harbour: Harbour, server: HarbourServer) -> None:
    host, port = server.addresses[0]
    shown = []
    with av.open(f"http://{host}:{port}/", timeout=10.0) as stream:
        for frame in stream.decode(video=0):
            shown.append((time.time(), frame.to_ndarray(format="bgr24")))
            if len(shown) == 8:
                break
    assert all(image.shape == (180, 320, 3) for _, image in shown)
    renderer = Renderer(harbour)

    def apart(image: np.ndarray, time_utc_s: float) -> float:
        there = renderer.image(time_utc_s - server.shift_s).astype(float)
        return float(np.abs(image.astype(float) - there).mean())

    seen_s, image = shown[-1]
    # The sea tells the time: what was drawn within the last second is far nearer than anything
    # of ten seconds later.
    now = min(apart(image, seen_s - late) for late in np.arange(0.0, 1.0, 0.02))
    assert now < 0.6 * apart(image, seen_s + 10.0)
    # Pictures move on.
    assert np.abs(shown[0][1].astype(float) - image).mean() > 0.2


def test_ais_tells_where_boats_are_now(harbour: Harbour, server: HarbourServer) -> None:
    heard: list[tuple[float, pyais.ANY_MESSAGE]] = []
    with socket.create_connection(server.addresses[1], timeout=30.0) as connection:
        for line in connection.makefile("rb"):
            sentence = line.strip().rsplit(b"\\", 1)[1]
            heard.append((time.time(), pyais.decode(sentence)))
            if {18, 24} <= {message.msg_type for _, message in heard}:
                break
    received_s, report = next(one for one in heard if one[1].msg_type == 18)
    assert report.second == pytest.approx(received_s % 60.0, abs=2.0)
    boat = next(one for one in harbour.boats if one.identity == report.mmsi - 211_000_000)
    truth = harbour.truth([received_s - server.shift_s], [boat])
    east, north = harbour.plane.to_plane([report.lat], [report.lon])
    assert np.hypot(east[0] - truth.east_m[0], north[0] - truth.north_m[0]) < 15.0
    name = next(one[1].shipname for one in heard if one[1].msg_type == 24)
    assert name.startswith(("LAUNCH", "FERRY"))


def test_it_ends_with_the_harbour_and_leaves_nothing() -> None:
    brief = Harbour.random(1, HarbourSettings(duration_s=1.0, image_size_px=(320, 180)))
    before = threading.active_count()
    server = HarbourServer(brief, LOCAL, rate_hz=5.0)
    server.start()
    server.wait()
    assert server.pictures(0)[1] == b""
    server.close()
    assert threading.active_count() == before


def test_a_wait_ends_when_somebody_asks(server: HarbourServer) -> None:
    stop = threading.Event()
    stop.set()
    server.wait(stop)


def test_what_cannot_be_served_is_a_line(harbour: Harbour, server: HarbourServer) -> None:
    with pytest.raises(InputError, match=r"cannot serve at 127\.0\.0\.1:[0-9]+ .*expected a free"):
        HarbourServer(harbour, server.addresses[0])
    with pytest.raises(InputError, match="a rate of 0 pictures"):
        HarbourServer(harbour, LOCAL, rate_hz=0.0)


@pytest.mark.parametrize(
    "text", ["rtsp://127.0.0.1:8554/", "http://127.0.0.1", "8090", "http://[::1:80/", "http://h:x/"]
)
def test_addresses_that_are_none_are_a_line(text: str) -> None:
    with pytest.raises(InputError, match=r"give http://HOST:PORT"):
        local_address(text, "http")


def test_an_address_has_a_host_and_a_port() -> None:
    assert local_address("http://127.0.0.1:8090/", "http") == ("127.0.0.1", 8090)
