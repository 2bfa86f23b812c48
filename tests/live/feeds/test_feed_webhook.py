"""Alerts are posted to a real HTTP server, which comes and goes."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from sightline.errors import InputError
from sightline.live.feeds import open_feed
from sightline.live.feeds import webhook as module
from sightline.live.lines import Lines
from sightline.moment import Alert, Moment

START_S = 1_717_236_000.0


class Receiver:
    """Keeps what is posted, and answers as it is told."""

    def __init__(self) -> None:
        self.posts: list[tuple[str, dict, dict]] = []
        self.answers: list[int] = []
        self.hang = threading.Event()
        self.hang.set()
        self.port = 0

    @contextmanager
    def served(self) -> Iterator[None]:
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                receiver.hang.wait(20.0)
                status = receiver.answers.pop(0) if receiver.answers else 204
                receiver.posts.append((self.path, dict(self.headers), json.loads(body)))
                self.send_response(status)
                if status == 302:
                    self.send_header("Location", f"http://127.0.0.1:{receiver.port}/elsewhere")
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        server = ThreadingHTTPServer(("127.0.0.1", self.port), Handler)
        self.port = server.server_address[1]
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield
        finally:
            server.shutdown()
            server.server_close()
            thread.join(5.0)


def _moment(number: int, *, alert: bool = True) -> Moment:
    alerts = (Alert(START_S + number, "enter", "basin", number),) if alert else ()
    return Moment(START_S + number, "sender", "quay", (), alerts=alerts)


def until(condition: Callable[[], bool], most_s: float = 15.0) -> None:
    end_s = time.monotonic() + most_s
    while not condition():
        assert time.monotonic() < end_s, "it did not come to that"
        time.sleep(0.02)


def _ids(receiver: Receiver) -> list[int]:
    return [body["target_id"] for _, _, body in receiver.posts]


def test_an_alert_is_posted_with_its_token(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(module.TOKEN, "abc")
    receiver = Receiver()
    with receiver.served():
        url = f"http://127.0.0.1:{receiver.port}/hook?a=1"
        feed = open_feed(url, kind="webhook", camera="quay")
        feed.publish(_moment(1, alert=False))
        feed.publish(_moment(2))
        until(lambda: feed.statistics()["sent"] == 1)
        feed.close()
    ((path, headers, body),) = receiver.posts
    assert path == "/hook?a=1"
    assert headers["Authorization"] == "Bearer abc"
    assert headers["Content-Type"] == "application/json"
    assert body == {
        "camera": "quay",
        "time_utc": "2024-06-01T10:00:02.000Z",
        "kind": "enter",
        "boundary": "basin",
        "target_id": 2,
        "probability": 1.0,
        "direction": None,
        "speed_mps": None,
        "mmsi": None,
        "name": None,
    }


def test_what_is_not_taken_is_posted_again_in_order(caplog: pytest.LogCaptureFixture) -> None:
    receiver = Receiver()
    with receiver.served():
        pass
    url = f"http://127.0.0.1:{receiver.port}/secret-path"
    feed = open_feed(url, kind="webhook", camera="quay")
    with caplog.at_level(logging.WARNING):
        for number in range(3):
            feed.publish(_moment(number))
        until(lambda: feed.statistics()["retries"] >= 1)
        # It comes, and is not ready yet.
        receiver.answers = [503, 429]
        with receiver.served():
            until(lambda: feed.statistics()["sent"] == 3)
    assert _ids(receiver) == [0, 0, 0, 1, 2]
    assert feed.statistics()["lost"] == 0
    feed.close()
    # Once an outage, and what may be a password is not said.
    assert 1 <= len(caplog.records) <= 2
    assert "secret-path" not in caplog.text


def test_one_that_says_no_is_not_asked_again_and_none_is_followed() -> None:
    receiver = Receiver()
    receiver.answers = [404, 302, 204]
    with receiver.served():
        feed = open_feed(f"http://127.0.0.1:{receiver.port}", kind="webhook", camera="quay")
        for number in range(3):
            feed.publish(_moment(number))
        until(lambda: feed.statistics()["sent"] == 1)
        feed.close()
    assert [path for path, _, _ in receiver.posts] == ["/", "/", "/"]
    assert feed.statistics()["lost"] == 2


def test_one_that_hangs_holds_up_nobody_and_no_alert_is_lost_before_it() -> None:
    receiver = Receiver()
    receiver.hang.clear()
    with receiver.served():
        feed = open_feed(f"http://127.0.0.1:{receiver.port}/", kind="webhook", camera="quay")
        lines = Lines({"webhook": feed})
        begun_s = time.monotonic()
        for number in range(100):
            lines.publish(_moment(number, alert=number % 10 == 0))
        assert time.monotonic() - begun_s < 2.0
        receiver.hang.set()
        until(lambda: feed.statistics()["sent"] == 10)
        lines.close()
    assert _ids(receiver) == list(range(0, 100, 10))


def test_it_ends_at_once_where_nobody_answers() -> None:
    receiver = Receiver()
    with receiver.served():
        pass
    feed = open_feed(f"http://127.0.0.1:{receiver.port}/", kind="webhook", camera="quay")
    feed.publish(_moment(1))
    until(lambda: feed.statistics()["retries"] >= 1)
    feed.close()
    assert not [one for one in threading.enumerate() if one.name == "feed webhook"]
    assert feed.statistics()["lost"] == 1


@pytest.mark.parametrize(
    "url", ["ftp://host/x", "http://user:secret@host/", "http:///x", "http://a b/"]
)
def test_urls_that_cannot_be_posted_to_are_refused(url: str) -> None:
    with pytest.raises(InputError) as refused:
        open_feed(url, kind="webhook", camera="quay")
    assert "secret" not in str(refused.value)
