"""What all feeds have in common: nobody waits for a receiver, and what is lost is counted."""

from __future__ import annotations

import socket
import threading

import pytest
from feed_receivers import free_port, moment, port_of, until

from sightline.errors import InputError
from sightline.live.feeds import open_feed
from sightline.live.feeds.queued import QueuedFeed


class Receiver:
    """A transport that tests steer."""

    def __init__(self) -> None:
        self.received: list[bytes] = []
        self.refuse = False
        self.takes = threading.Event()
        self.takes.set()
        self.opened = 0

    def open(self, stopping: threading.Event) -> None:
        if self.refuse:
            raise ConnectionRefusedError("nobody there")
        self.opened += 1

    def send(self, messages) -> None:
        if not self.takes.wait(30.0):
            raise TimeoutError
        if self.refuse:
            raise ConnectionResetError("gone")
        self.received += messages

    def close(self) -> None:
        self.takes.set()


def number(one) -> list[bytes]:
    return [str(round(one.time_utc_s) % 1000).encode()]


def test_a_receiver_that_stands_still_delays_nobody_and_loses_the_oldest() -> None:
    receiver = Receiver()
    receiver.takes.clear()
    feed = QueuedFeed("slow", number, receiver)
    feed.publish(moment(0.0))
    # The first is being sent for ever; this loop would never end if it were waited for.
    until(lambda: not feed._waiting)
    for i in range(1, 1000):
        feed.publish(moment(float(i)))
    assert feed.lost == 999 - 8
    receiver.takes.set()
    until(lambda: feed.sent == 9)
    assert receiver.received == [b"0", *(str(i).encode() for i in range(992, 1000))]
    feed.close()
    assert not feed._thread.is_alive()


def test_a_receiver_that_went_is_reached_again(monkeypatch: pytest.MonkeyPatch) -> None:
    receiver = Receiver()
    feed = QueuedFeed("gone", number, receiver)
    feed._pause_s = 0.01
    feed.publish(moment(0.0))
    until(lambda: feed.sent == 1)
    receiver.refuse = True
    feed.publish(moment(1.0))
    until(lambda: not feed.connected)
    assert feed.lost == 1
    receiver.refuse = False
    feed.publish(moment(2.0))
    until(lambda: feed.sent == 2)
    assert receiver.received == [b"0", b"2"]
    assert feed.statistics() == {"sent": 2, "lost": 1, "connections": 2, "connected": 1}
    feed.close()


def test_an_outage_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    receiver = Receiver()
    receiver.refuse = True
    feed = QueuedFeed("absent", number, receiver)
    feed._pause_s = 0.001
    until(lambda: feed._pause_s > 0.1)
    feed.close()
    assert [one.message for one in caplog.records if one.levelname == "WARNING"] == [
        "feed absent: not reached (nobody there); trying again"
    ]


def test_what_is_left_is_sent_at_the_end_and_nothing_after() -> None:
    receiver = Receiver()
    feed = QueuedFeed("end", number, receiver)
    for i in range(5):
        feed.publish(moment(float(i)))
    until(lambda: feed.connected)
    feed.close()
    feed.publish(moment(9.0))
    feed.close()
    assert receiver.received == [b"0", b"1", b"2", b"3", b"4"]
    assert not feed._thread.is_alive()


def test_a_feed_for_plotters_sends_the_first_moment_of_each_second() -> None:
    receiver = Receiver()
    feed = QueuedFeed("rate", number, receiver, every_s=1.0)
    for i in range(100):
        feed.publish(moment(0.04 * i + 0.02))
        until(lambda: not feed._waiting)
    feed.close()
    assert feed.sent == 4
    assert feed.lost == 0


def test_a_moment_that_cannot_be_written_does_not_end_the_feed() -> None:
    receiver = Receiver()

    def encode(one):
        if one.time_utc_s % 1000 == 1.0:
            raise ZeroDivisionError
        return number(one)

    feed = QueuedFeed("bug", encode, receiver)
    feed._pause_s = 0.01
    for i in range(3):
        feed.publish(moment(float(i)))
    until(lambda: feed.sent == 2)
    feed.close()
    assert receiver.received == [b"0", b"2"]
    assert (feed.lost, feed.connections) == (1, 1)


@pytest.mark.parametrize(
    ("kind", "scheme"), [("signalk", "tcp"), ("signalk", "ws"), ("cot", "tcp"), ("mqtt", "mqtt")]
)
@pytest.mark.parametrize("there", [True, False])
def test_a_dead_receiver_holds_up_neither_publish_nor_close(
    kind: str, scheme: str, there: bool
) -> None:
    """It accepts and never answers, or nobody listens."""
    before = set(threading.enumerate())
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = port_of(server) if there else free_port()
        feed = open_feed(f"{scheme}://127.0.0.1:{port}", kind=kind, camera="dock")
        for i in range(200):
            feed.publish(moment(float(i)))
        feed.close()
        until(lambda: not set(threading.enumerate()) - before)


@pytest.mark.parametrize(
    ("kind", "url", "said"),
    [
        ("nmea", "localhost:10110", "expected tcp://HOST:PORT or udp://HOST:PORT"),
        ("nmea", "tcp://", "names no host"),
        ("nmea", "tcp://host:70000", "Port out of range"),
        ("nmea", "tcp://host:1/path", "ends in more than a port"),
        ("nmea", "http://host:1", "unknown scheme"),
        ("nmea", "udp://ho st:1", "space"),
        ("nmea", "tcp://127.0.0.1:1\r\n", "space or a control"),
        ("signalk", "ws://me:geheim@host:3000", "environment"),
        ("signalk", "ws://host/signalk/v1/stream?token=geheim", "SIGHTLINE_SIGNALK_TOKEN"),
        ("cot", "ssl://host:8089", "tls://HOST:PORT"),
        ("mqtt", "mqtt://me:geheim@host", "environment"),
        ("mqtt", "mqtt://host/a/#", "has a #"),
        ("mqtt", "mqtt://host/a/+", "other topics"),
        ("fax", "tcp://host:1", "known are nmea, signalk, cot, mqtt"),
    ],
)
def test_a_wrong_url_is_refused_in_one_line_without_its_password(
    kind: str, url: str, said: str
) -> None:
    with pytest.raises(InputError) as error:
        open_feed(url, kind=kind, camera="dock")
    assert said in str(error.value)
    assert "\n" not in str(error.value)
    assert "geheim" not in str(error.value)


def test_a_port_that_is_taken_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"tcp://127.0.0.1:{port_of(server)}"
        with pytest.raises(InputError, match="cannot listen at"):
            open_feed(url, kind="nmea", camera="dock")
