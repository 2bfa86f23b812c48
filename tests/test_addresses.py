"""Addresses as they are given: one parser for all of them."""

from __future__ import annotations

import pytest

from sightline.addresses import Address, parse_address
from sightline.errors import InputError

PORTS = {"tcp": 10110, "udp": None}


def test_a_port_that_is_left_out_is_the_usual_one_where_there_is_one() -> None:
    assert Address.parse("tcp://host", PORTS, feed="nmea").port == 10110
    assert Address.parse("TCP://[::1]:7/", PORTS, feed="nmea").host == "::1"
    with pytest.raises(InputError, match="names no port"):
        Address.parse("udp://host", PORTS, feed="nmea")


@pytest.mark.parametrize(
    ("url", "why"),
    [
        ("http://host:1", "unknown scheme; expected a file, tcp://HOST:PORT or udp://HOST:PORT"),
        ("tcp://:1", "names no host"),
        ("tcp://host:99999", "expected a file"),
        ("tcp://host:1/x", "ends in more than a port"),
        ("tcp://user:secret@host:1", "give them in the environment"),
        ("tcp://ho st:1", "has a space"),
    ],
)
def test_what_is_wrong_is_said_without_a_password(url: str, why: str) -> None:
    with pytest.raises(InputError) as refused:
        Address.parse(url, PORTS, feed="nmea", or_else="a file")
    assert why in str(refused.value)
    assert "secret" not in str(refused.value)


def test_host_and_port() -> None:
    assert parse_address("127.0.0.1:8080") == ("127.0.0.1", 8080)
    assert parse_address("[::1]:0") == ("::1", 0)
    for text in ("8080", ":8080", "host:", "host:x", "host:65536", "host:٣"):
        with pytest.raises(InputError, match="expected HOST:PORT"):
            parse_address(text)
