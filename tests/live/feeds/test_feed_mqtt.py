"""Messages at a broker: a small one of ours that speaks MQTT 3.1.1, and mosquitto where it is."""

from __future__ import annotations

import contextlib
import json
import shutil
import socket
import struct
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from feed_receivers import HOSTILE, free_port, moment, port_of, target, until
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from sightline.live.feeds import open_feed

CONNECT, CONNACK, PUBLISH, PUBACK, PINGREQ, DISCONNECT = 1, 2, 3, 4, 12, 14


class Broker:
    """Takes what is published, as OASIS MQTT 3.1.1 has it, and hands nothing on."""

    def __init__(self, port: int = 0, *, refuse: int = 0) -> None:
        self.connects: list[bytes] = []
        self.published: list[tuple[str, bytes, bool]] = []
        self.goodbyes = 0
        self._refuse = refuse
        self._clients: list[socket.socket] = []
        self._server = socket.create_server(("127.0.0.1", port))
        self.port = port_of(self._server)
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        """Die without a word."""
        self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        for one in self._clients:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()

    def _accept(self) -> None:
        try:
            while True:
                made, _ = self._server.accept()
                self._clients.append(made)
                threading.Thread(target=self._serve, args=(made,), daemon=True).start()
        except OSError:
            return

    def _serve(self, made: socket.socket) -> None:
        try:
            with made.makefile("rb") as file:
                while first := file.read(1):
                    length, shift = 0, 0
                    while True:
                        (digit,) = file.read(1)
                        length |= (digit & 127) << shift
                        shift += 7
                        if digit < 128:
                            break
                    self._packet(made, first[0], file.read(length))
        except OSError:
            return

    def _packet(self, made: socket.socket, first: int, body: bytes) -> None:
        kind = first >> 4
        if kind == CONNECT:
            self.connects.append(body)
            made.sendall(bytes([CONNACK << 4, 2, 0, self._refuse]))
        elif kind == PUBLISH:
            (size,) = struct.unpack_from(">H", body)
            topic, rest = body[2 : 2 + size].decode(), body[2 + size :]
            if first & 0b110:
                made.sendall(bytes([PUBACK << 4, 2]) + rest[:2])
                rest = rest[2:]
            self.published.append((topic, rest, bool(first & 1)))
        elif kind == PINGREQ:
            made.sendall(b"\xd0\x00")
        elif kind == DISCONNECT:
            self.goodbyes += 1


def of(broker: Broker, topic: str) -> list[tuple[bytes, bool]]:
    return [(body, kept) for name, body, kept in broker.published if name == topic]


def test_a_moment_is_one_message_and_the_status_stays() -> None:
    broker = Broker()
    feed = open_feed(f"mqtt://127.0.0.1:{broker.port}/harbour/dock", kind="mqtt", camera="dock")
    until(lambda: feed.connected)
    # Each moment, not one a second.
    sent = [moment(0.04 * i, target(1), target(2, name=HOSTILE)) for i in range(5)]
    for one in sent:
        feed.publish(one)
    until(lambda: len(of(broker, "harbour/dock/moment")) == 5)
    feed.close()
    until(lambda: broker.goodbyes == 1)
    broker.close()
    assert [body for body, _ in of(broker, "harbour/dock/moment")] == [
        one.text.encode() for one in sent
    ]
    message = json.loads(of(broker, "harbour/dock/moment")[0][0])
    assert message["targets"][1]["name"] == HOSTILE
    assert of(broker, "harbour/dock/status") == [(b"online", True), (b"offline", True)]


def test_the_last_will_says_offline_and_stays() -> None:
    """Variable header and payload of CONNECT, 3.1 of the standard."""
    broker = Broker()
    feed = open_feed(f"mqtt://127.0.0.1:{broker.port}", kind="mqtt", camera="a/b+#")
    until(lambda: feed.connected)
    feed.close()
    broker.close()
    (body,) = broker.connects
    flags = body[7]
    assert flags & 0b100, "a will"
    assert flags & 0b100000, "that is retained"
    fields, rest = [], body[10:]
    while rest:
        (size,) = struct.unpack_from(">H", rest)
        fields.append(rest[2 : 2 + size])
        rest = rest[2 + size :]
    assert fields[1:] == [b"sightline/a-b--/status", b"offline"]


def test_a_broker_that_comes_and_goes_gets_the_newest() -> None:
    port = free_port()
    feed = open_feed(f"mqtt://127.0.0.1:{port}/t", kind="mqtt", camera="dock")
    for life in range(3):
        broker = Broker(port)
        feed._pause_s = 0.05
        times = iter(range(1, 1_000_000))

        def arrived(life=life, broker=broker, times=times) -> bool:
            feed.publish(moment(1000.0 * life + 0.01 * next(times)))
            return bool(of(broker, "t/moment"))

        until(arrived, within_s=30.0)
        broker.close()
    feed.close()
    assert feed.connections >= 3


def test_a_broker_that_refuses_is_told(caplog: pytest.LogCaptureFixture) -> None:
    broker = Broker(refuse=5)
    feed = open_feed(f"mqtt://127.0.0.1:{broker.port}", kind="mqtt", camera="dock")
    until(lambda: any("SIGHTLINE_MQTT_USER" in one.message for one in caplog.records))
    feed.close()
    broker.close()
    assert not feed.sent


@contextmanager
def mosquitto(folder: Path, port: int) -> Iterator[subprocess.Popen[bytes]]:
    program = shutil.which("mosquitto") or shutil.which("/usr/sbin/mosquitto")
    if program is None:
        pytest.skip("mosquitto is not installed")
    (folder / "m.conf").write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
    with subprocess.Popen([program, "-c", folder / "m.conf"], stderr=subprocess.DEVNULL) as done:
        try:
            yield done
        finally:
            done.terminate()


def test_mosquitto_hands_the_moment_on_and_the_status_to_who_comes_late(tmp_path: Path) -> None:
    port = free_port()
    with mosquitto(tmp_path, port):
        feed = open_feed(f"mqtt://127.0.0.1:{port}/t", kind="mqtt", camera="dock")
        until(lambda: feed.connected)
        heard: list[tuple[str, bytes]] = []
        client = Client(CallbackAPIVersion.VERSION2)
        client.on_message = lambda *said: heard.append((said[2].topic, said[2].payload))
        client.connect("127.0.0.1", port)
        client.subscribe("t/#")
        client.loop_start()
        until(lambda: ("t/status", b"online") in heard)
        one = moment()
        feed.publish(one)
        until(lambda: ("t/moment", one.text.encode()) in heard)
        feed.close()
        until(lambda: ("t/status", b"offline") in heard)
        client.disconnect()
        client.loop_stop()
