"""Moments for the tests of feeds, and receivers on this machine."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from sightline.moment import Moment, TargetState

# 1 June 2024, 10:00:00 UTC by `date -u -d 2024-06-01T10:00:00Z +%s`.
START = 1_717_236_000.0
HOSTILE = '<img src=x onerror=alert(1)>,*00\r\n$&"\u202e'


def target(number: int = 17, **values) -> TargetState:
    return TargetState(
        **{
            "id": number,
            "latitude_deg": 54.3233,
            "longitude_deg": 10.1394,
            "covariance_m2": np.array([[4.0, 1.0], [1.0, 9.0]]),
            "speed_mps": 3.1,
            "course_deg": 210.5,
            "state": "measured",
            **values,
        }
    )


def moment(time_s: float = 0.0, *targets: TargetState, camera: str = "dock") -> Moment:
    return Moment(START + time_s, "sender", camera, targets or (target(),))


def until(true: Callable[[], bool], within_s: float = 10.0) -> None:
    """Wait for what another thread does; the bound only ends a test that has failed."""
    deadline = time.monotonic() + within_s
    while not true():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.01)


@contextmanager
def udp_receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind(("127.0.0.1", 0))
        made.settimeout(10.0)
        yield made


def port_of(made: socket.socket) -> int:
    return made.getsockname()[1]


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as made:
        return port_of(made)


def read_lines(made: socket.socket, count: int) -> list[bytes]:
    made.settimeout(10.0)
    data = b""
    while data.count(b"\n") < count:
        more = made.recv(65536)
        assert more, "closed"
        data += more
    return data.split(b"\n")[:count]
