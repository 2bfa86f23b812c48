"""Moments for the tests of feeds, and receivers on this machine."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager

from moments import START, target, until
from sightline.moment import Moment, TargetState

__all__ = ["START", "target", "until"]

HOSTILE = '<img src=x onerror=alert(1)>,*00\r\n$&"\u202e'


def moment(time_s: float = 0.0, *targets: TargetState, camera: str = "dock") -> Moment:
    return Moment(START + time_s, "sender", camera, targets or (target(),))


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
