"""Sentences, as another library reads them."""

from __future__ import annotations

import socket
from datetime import time

import pynmea2
import pytest
from feed_receivers import HOSTILE, moment, read_lines, target, udp_receiver, until

from sightline.live.feeds import open_feed
from sightline.live.feeds.nmea import TllEncoder, name_field


def read(sentence: bytes) -> pynmea2.TLL:
    return pynmea2.parse(sentence.decode("ascii"), check=True)


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg"),
    [(54.3233, 10.1394), (-33.8568, -70.0), (0.0, 179.9999999), (59.99999999, -0.00001)],
)
def test_another_library_reads_the_place_back(latitude_deg: float, longitude_deg: float) -> None:
    one = target(latitude_deg=latitude_deg, longitude_deg=longitude_deg, name="VESSEL")
    (sentence,) = TllEncoder()(moment(36.25, one))
    found = read(sentence)
    assert found.latitude == pytest.approx(latitude_deg, abs=1e-7)
    assert found.longitude == pytest.approx(longitude_deg, abs=1e-7)
    assert float(found.lat[2:]) < 60.0
    assert float(found.lon[3:]) < 60.0
    assert found.target_number == 17
    assert found.target_name == "VESSEL"
    assert found.timestamp.replace(tzinfo=None) == time(10, 0, 36, 250_000)
    assert found.target_status == "T"
    assert found.talker == "RA"
    assert sentence.endswith(b"\r\n")


@pytest.mark.parametrize(
    ("name", "field"),
    [
        ("EVER GIVEN", "EVER GIVEN"),
        ("Müritz", "Muritz"),
        ("a,b*c$d!e\\f^g~h", "a^2Cb^2Ac^24d^21e^5C"),
        ("x" * 30, "x" * 20),
        ("x" * 18 + ",,", "x" * 18),
        ("\u6f01\r\n", "???"),
    ],
)
def test_names_are_escaped_and_never_torn(name: str, field: str) -> None:
    assert name_field(name) == field


def test_a_vessel_without_a_name_is_called_by_its_mmsi() -> None:
    targets = target(17), target(18, mmsi=2110001)
    found = [read(one).target_name for one in TllEncoder()(moment(0.0, *targets))]
    assert found == ["target 17", "MMSI 002110001"]


def test_a_hostile_name_stays_one_field_of_one_sentence() -> None:
    (sentence,) = TllEncoder()(moment(0.0, target(name=HOSTILE)))
    assert sentence.count(b"\r\n") == 1
    assert sentence.count(b"$") == sentence.count(b"*") == 1
    found = read(sentence)
    assert len(found.data) == 9
    assert len(found.target_name) <= 20
    assert len(sentence) <= 128


def test_a_target_that_has_gone_is_lost_once() -> None:
    encoder = TllEncoder()
    encoder(moment(0.0, target(1), target(2)))
    second = [read(one) for one in encoder(moment(1.0, target(2)))]
    assert [(one.target_number, one.target_status) for one in second] == [(2, "T"), (1, "L")]
    assert len(encoder(moment(2.0, target(2)))) == 1


def test_a_place_that_is_not_known_is_not_sent() -> None:
    assert TllEncoder()(moment(0.0, target(latitude_deg=float("nan")))) == []


def test_udp_carries_all_sentences_in_datagrams_that_no_network_cuts() -> None:
    with udp_receiver() as receiver:
        feed = open_feed(f"udp://127.0.0.1:{receiver.getsockname()[1]}", kind="nmea", camera="dock")
        feed.publish(moment(0.0, *(target(i) for i in range(300))))
        numbers: list[int] = []
        while len(numbers) < 300:
            datagram = receiver.recv(9000)
            assert len(datagram) <= 1200
            numbers += [read(line).target_number for line in datagram.splitlines()]
        feed.close()
    assert numbers == list(range(300))


def test_all_that_connect_get_all_sentences_but_one_that_does_not_read() -> None:
    feed = open_feed("tcp://127.0.0.1:0", kind="nmea", camera="dock")
    address = ("127.0.0.1", feed.transport.port)
    with (
        socket.create_connection(address) as first,
        socket.create_connection(address) as second,
        socket.socket() as idle,
    ):
        idle.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        idle.connect(address)
        many = [target(i) for i in range(2000)]
        for i in range(60):
            feed.publish(moment(float(i), *many))
            for reader in (first, second):
                lines = read_lines(reader, 2000)
                assert read(lines[-1]).timestamp.second == i
        until(lambda: feed.sent == 60)
        # What it was too slow for is lost to it alone.
        assert feed.transport.lost > 0
        assert feed.lost == 0
    feed.close()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(address)


def test_one_that_hangs_up_is_forgotten() -> None:
    feed = open_feed("tcp://127.0.0.1:0", kind="nmea", camera="dock")
    socket.create_connection(("127.0.0.1", feed.transport.port)).close()
    with socket.create_connection(("127.0.0.1", feed.transport.port)) as reader:
        for i in range(3):
            feed.publish(moment(float(i)))
            read_lines(reader, 1)
        until(lambda: len(feed.transport._clients) == 1)
    feed.close()


def test_a_port_is_listened_at_again_after_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    feed = open_feed("tcp://127.0.0.1:0", kind="nmea", camera="dock")
    until(lambda: feed.connected)
    feed._pause_s = 0.01
    accept = feed.transport._accept

    def fail() -> None:
        monkeypatch.setattr(feed.transport, "_accept", accept)
        raise OSError("out of memory")

    monkeypatch.setattr(feed.transport, "_accept", fail)
    feed.publish(moment(0.0))
    until(lambda: feed.connections == 2)
    with socket.create_connection(("127.0.0.1", feed.transport.port)) as reader:
        feed.publish(moment(1.0))
        assert read(read_lines(reader, 1)[0]).timestamp.second == 1
    feed.close()
