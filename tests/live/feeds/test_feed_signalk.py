"""Deltas, as the schema of Signal K has them, over real sockets."""

from __future__ import annotations

import json
import math
import re
import threading

import pytest
from feed_receivers import HOSTILE, free_port, moment, port_of, target, udp_receiver, until
from websockets.sync.server import serve

from sightline.live.feeds import open_feed
from sightline.live.feeds.signalk import DeltaEncoder

# From the schema of Signal K 1.7, definitions.json.
UUID = (
    r"urn:mrn:signalk:uuid:[0-9A-Fa-f]{8}-[0-9A-Fa-f]{4}-4[0-9A-Fa-f]{3}"
    r"-[89ABab][0-9A-Fa-f]{3}-[0-9A-Fa-f]{12}"
)


def values(delta: dict) -> dict:
    (update,) = delta["updates"]
    return {one["path"]: one["value"] for one in update["values"]}


def test_a_delta_has_degrees_radians_and_the_time_of_capture() -> None:
    (line,) = DeltaEncoder("dock")(moment(0.04, target(mmsi=2110001, name="BOAT")))
    delta = json.loads(line)
    assert re.fullmatch(rf"vessels\.{UUID}", delta["context"])
    assert delta["updates"][0]["timestamp"] == "2024-06-01T10:00:00.040Z"
    found = values(delta)
    assert found["navigation.position"] == {"latitude": 54.3233, "longitude": 10.1394}
    assert found["navigation.speedOverGround"] == 3.1
    assert found["navigation.courseOverGroundTrue"] == pytest.approx(math.radians(210.5), abs=1e-5)
    assert found[""] == {"name": "BOAT", "mmsi": "002110001"}


def test_what_is_not_known_is_not_said() -> None:
    (line,) = DeltaEncoder("dock")(moment(0.0, target(speed_mps=None, course_deg=None)))
    found = values(json.loads(line))
    assert set(found) == {"", "navigation.position"}
    assert found[""] == {"name": "target 17"}


def test_contexts_tell_targets_and_cameras_apart_and_survive_a_restart() -> None:
    contexts = {DeltaEncoder(camera).context(i) for camera in ("a", "b") for i in range(50)}
    assert len(contexts) == 100
    assert DeltaEncoder("a").context(7) == DeltaEncoder("a").context(7)


def test_a_hostile_name_stays_a_text_of_json() -> None:
    (line,) = DeltaEncoder(HOSTILE)(moment(0.0, target(name=HOSTILE + "\ud800")))
    assert values(json.loads(line))[""]["name"] == HOSTILE + "\ufffd"
    assert line.count(b"\n") == 1


def test_udp_carries_a_delta_a_datagram() -> None:
    with udp_receiver() as receiver:
        feed = open_feed(f"udp://127.0.0.1:{port_of(receiver)}", kind="signalk", camera="dock")
        feed.publish(moment(0.0, target(1), target(2)))
        contexts = [json.loads(receiver.recv(2000))["context"] for _ in range(2)]
        feed.close()
    assert contexts == [DeltaEncoder("dock").context(i) for i in (1, 2)]


class Server:
    """A server that takes deltas from who has the token."""

    def __init__(self, port: int, token: str | None = None) -> None:
        self.received: list[str] = []
        self.paths: list[str] = []
        self.token = token
        self._server = serve(self._handle, "127.0.0.1", port, process_request=self._process)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def _process(self, connection, request):
        self.paths.append(request.path)
        if self.token and request.headers.get("Authorization") != f"Bearer {self.token}":
            return connection.respond(401, "who are you?\n")
        return None

    def _handle(self, connection) -> None:
        connection.send('{"name": "signalk-server", "version": "2.23.0"}')
        for message in connection:
            self.received.append(message)

    def close(self) -> None:
        self._server.shutdown()


def test_a_websocket_is_opened_with_the_token_and_opened_again_when_the_server_returns(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("SIGHTLINE_SIGNALK_TOKEN", "geheim")
    # The receiver is reached, and no proxy.
    for name in ("http_proxy", "https_proxy", "all_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    monkeypatch.delenv("no_proxy", raising=False)
    monkeypatch.delenv("NO_PROXY", raising=False)
    port = free_port()
    server = Server(port, "geheim")
    feed = open_feed(f"ws://127.0.0.1:{port}", kind="signalk", camera="dock")
    feed.publish(moment(0.0, target(1), target(2)))
    until(lambda: len(server.received) == 2)
    assert server.paths == ["/signalk/v1/stream?subscribe=none"]
    server.close()
    again = Server(port, "geheim")
    feed._pause_s = 0.05
    seconds = iter(range(1, 100_000))

    def arrived() -> bool:
        feed.publish(moment(float(next(seconds))))
        return bool(again.received)

    until(arrived)
    feed.close()
    again.close()
    assert feed.connections >= 2
    assert json.loads(again.received[0])["context"] == DeltaEncoder("dock").context(17)


def test_a_wrong_token_is_told_and_not_printed(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("SIGHTLINE_SIGNALK_TOKEN", "falsch")
    server = Server(0, "geheim")
    port = server._server.socket.getsockname()[1]
    feed = open_feed(f"ws://127.0.0.1:{port}", kind="signalk", camera="dock")
    until(lambda: any("SIGHTLINE_SIGNALK_TOKEN" in one.message for one in caplog.records))
    feed.close()
    server.close()
    assert server.received == []
    assert not any("falsch" in one.message for one in caplog.records)
