"""What the server answers, and to whom."""

from __future__ import annotations

import asyncio
import json
import re
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from web_moments import HOSTILE, START, moment, target

from sightline.errors import InputError
from sightline.web.access import HEADERS, Guard, TokenBucket
from sightline.web.app import build_app
from sightline.web.hub import Hub, Listener
from sightline.web.server import LiveServer

TOKEN = "a token of some length"


def client(hub: Hub | None = None, *, token: str | None = None, host: str = "127.0.0.1:8080"):
    app = Guard(build_app(hub or Hub()), token, 8080)
    return TestClient(app, base_url=f"http://{host}", follow_redirects=False)


def test_the_newest_moment_is_told_as_the_contract_has_it() -> None:
    hub = Hub()
    asked = client(hub)
    assert asked.get("/api/moment").status_code == 503
    hub.publish(moment(0.0))
    hub.publish(moment(1.0, target(1), target(2, name=HOSTILE)))
    answer = asked.get("/api/moment")
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "application/json"
    assert answer.headers["cache-control"] == "no-store"
    assert answer.json()["time_utc"] == "2024-06-01T10:00:01.000Z"
    assert [one["name"] for one in answer.json()["targets"]] == [None, HOSTILE]


def test_a_number_that_is_none_ends_nothing() -> None:
    hub = Hub()
    hub.publish(moment(0.0, target(covariance_m2=np.full((2, 2), np.nan))))
    assert client(hub).get("/api/moment").status_code == 503
    assert client(hub).get("/tracks.geojson").status_code == 200


@pytest.mark.parametrize(
    ("health", "status"),
    [
        ({"state": "ok", "frames_seen": 17}, 200),
        ({"state": "silent", "reason": "no frame for 12 s"}, 503),
        ({}, 503),
    ],
)
def test_health_is_a_status_and_a_reason(health: dict[str, object], status: int) -> None:
    answer = client(Hub(health=lambda: health)).get("/healthz")
    assert answer.status_code == status
    assert health.items() <= answer.json().items()


def test_health_that_cannot_be_told_is_no_health() -> None:
    def fail() -> dict[str, object]:
        raise ZeroDivisionError

    answer = client(Hub(health=fail)).get("/healthz")
    assert answer.status_code == 503
    assert "ZeroDivisionError" in answer.json()["reason"]


def test_without_a_health_of_the_camera_moments_tell() -> None:
    hub = Hub()
    assert client(hub).get("/healthz").status_code == 503
    hub.publish(moment())
    assert client(hub).get("/healthz").status_code == 200


def test_metrics_are_the_text_that_prometheus_reads() -> None:
    told = {
        "state": "ok",
        "frames_seen": 17,
        "age_s": float("nan"),
        "feeds": {"nmea tcp://a": {"lost": np.int64(3)}},
    }
    hub = Hub(health=lambda: told)
    hub.publish(moment(0.0, camera='a"b\\c\nd'))
    answer = client(hub).get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    # The exposition format, version 0.0.4: a name, labels with escapes, a float.
    line = re.compile(r'([a-z][a-zA-Z0-9_]*)\{camera="((?:[^"\\\n]|\\["\\n])*)"\} (\S+)')
    values = {}
    for row in answer.text.splitlines():
        if row.startswith("# TYPE "):
            assert re.fullmatch(r"# TYPE [a-z][a-zA-Z0-9_]* gauge", row)
            continue
        found = line.fullmatch(row)
        assert found is not None, row
        assert found[2] == 'a\\"b\\\\c\\nd'
        values[found[1]] = float(found[3])
    assert values["sightline_up"] == 1.0
    assert values["sightline_frames_seen"] == 17.0
    assert values["sightline_feeds_nmea_tcp_a_lost"] == 3.0
    assert values["sightline_web_moments"] == 1.0
    assert values["sightline_targets"] == 1.0
    assert "sightline_age_s" not in values


@pytest.mark.parametrize(
    ("minutes", "status"),
    [
        *(("30", 200), ("0.5", 200), ("1440", 200), ("", 422), ("0", 422), ("-1", 422)),
        *(("1441", 422), ("nan", 422), ("inf", 422), ("1e400", 422), ("x", 422)),
    ],
)
def test_minutes_have_limits(minutes: str, status: int) -> None:
    assert client().get("/tracks.geojson", params={"minutes": minutes}).status_code == status


def test_tracks_are_geojson() -> None:
    hub = Hub()
    hub.publish(moment())
    answer = client(hub).get("/tracks.geojson")
    assert answer.headers["content-type"] == "application/geo+json"
    assert len(answer.json()["features"]) == 1


def test_the_picture_is_the_newest_and_says_how_large_its_frame_is() -> None:
    pictures = [b"first", b"second"]
    hub = Hub(picture=lambda: pictures.pop(0) if pictures else None)
    hub.publish(moment())
    asked = client(hub)
    assert asked.get("/picture.jpg").content == b"first"
    answer = asked.get("/picture.jpg")
    assert answer.content == b"second"
    assert answer.headers["content-type"] == "image/jpeg"
    assert answer.headers["x-frame-size"] == "1280x720"
    assert asked.get("/picture.jpg").status_code == 404


def test_every_answer_forbids_what_is_not_ours() -> None:
    asked = client(Hub(picture=lambda: None))
    for path in ("/", "/static/index.html", "/api/moment", "/healthz", "/nothing", "/picture.jpg"):
        answer = asked.get(path)
        assert HEADERS.items() <= answer.headers.items(), path
    policy = dict(rule.split(" ", 1) for rule in HEADERS["content-security-policy"].split("; "))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == "'self'"
    assert "unsafe" not in HEADERS["content-security-policy"]


@pytest.mark.parametrize("path", ["/docs", "/redoc", "/openapi.json"])
def test_there_are_no_pages_that_fetch_from_elsewhere(path: str) -> None:
    assert client().get(path).status_code == 404


@pytest.mark.parametrize(
    "path",
    ["/static/../server.py", "/static/..%2Fserver.py", "/static/%2Fetc%2Fpasswd", "/static/"],
)
def test_only_the_files_of_the_page_are_served(path: str) -> None:
    assert client().get(path).status_code == 404


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1:8080", 200),
        ("localhost:1", 200),
        ("[::1]:8080", 200),
        ("evil.example", 421),
        ("localhost.evil.example:8080", 421),
        ("127.0.0.1.evil.example", 421),
        ("[", 421),
        ("", 421),
    ],
)
def test_a_name_from_elsewhere_that_leads_here_is_refused(host: str, status: int) -> None:
    """A page of another site could point its own name at 127.0.0.1 and read what is there."""
    hub = Hub()
    hub.publish(moment())
    assert client(hub).get("/api/moment", headers={"host": host}).status_code == status


def test_without_the_token_nothing_is_told() -> None:
    hub = Hub(picture=lambda: b"picture")
    hub.publish(moment())
    asked = client(hub, token=TOKEN, host="camera.example")
    for path in ("/", "/static/index.html", "/api/moment", "/healthz", "/metrics", "/picture.jpg"):
        assert asked.get(path).status_code == 401
        for wrong in ("", "x", TOKEN[:-1], TOKEN + "x", "\u00e4"):
            header = {"authorization": f"Bearer {wrong}".encode()}
            assert asked.get(path, headers=header).status_code == 401
            assert asked.get(path, params={"token": wrong}).status_code == 401
    with pytest.raises(WebSocketDisconnect), asked.websocket_connect("/ws"):
        pass


def test_the_token_is_taken_in_a_header() -> None:
    hub = Hub()
    hub.publish(moment())
    asked = client(hub, token=TOKEN, host="camera.example")
    header = {"authorization": f"Bearer {TOKEN}"}
    assert asked.get("/api/moment", headers=header).status_code == 200
    with asked.websocket_connect("/ws", headers=header) as stream:
        assert stream.receive_json()["camera"] == "dock"


def test_the_token_of_a_link_becomes_a_cookie_that_is_not_the_token() -> None:
    hub = Hub()
    hub.publish(moment())
    asked = client(hub, token=TOKEN, host="camera.example")
    answer = asked.get("/", params={"token": TOKEN, "units": "kmh"})
    assert answer.status_code == 303
    assert answer.headers["location"] == "/?units=kmh"
    cookie = answer.headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Lax" in cookie
    assert TOKEN not in cookie
    assert asked.get("/api/moment").status_code == 200
    with asked.websocket_connect("ws://camera.example/ws") as stream:
        assert stream.receive_json()["camera"] == "dock"
    # That of another token opens nothing.
    other = client(hub, token=TOKEN + "2", host="camera.example")
    other.cookies.update(asked.cookies)
    assert other.get("/api/moment").status_code == 401


def test_a_link_does_not_lead_to_another_host() -> None:
    asked = client(token=TOKEN, host="camera.example")
    answer = asked.get("http://camera.example//evil.example/", params={"token": TOKEN})
    assert answer.headers["location"] == "/evil.example/"


@pytest.mark.parametrize(
    ("origin", "allowed"),
    [
        (None, True),
        ("http://127.0.0.1:8080", True),
        ("http://127.0.0.1:9999", False),
        ("https://evil.example", False),
        ("null", False),
    ],
)
def test_only_pages_of_ours_open_the_stream(origin: str | None, allowed: bool) -> None:
    hub = Hub()
    hub.publish(moment())
    headers = {"host": "127.0.0.1:8080"} | ({} if origin is None else {"origin": origin})
    asked = client(hub)
    if allowed:
        with asked.websocket_connect("/ws", headers=headers) as stream:
            assert stream.receive_json()["camera"] == "dock"
    else:
        with pytest.raises(WebSocketDisconnect), asked.websocket_connect("/ws", headers=headers):
            pass


def test_who_asks_too_often_waits() -> None:
    bucket = TokenBucket(rate_per_s=2.0, burst=3.0)
    assert [bucket.take("a", 0.0) for _ in range(4)] == [True, True, True, False]
    assert bucket.take("b", 0.0)
    assert [bucket.take("a", 0.6) for _ in range(2)] == [True, False]
    assert sum(bucket.take("a", 100.0) for _ in range(10)) == 3


def test_a_flood_is_answered_with_429() -> None:
    asked = client()
    assert 429 in {asked.get("/api/about").status_code for _ in range(2000)}


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("8080", "expected HOST:PORT"),
        ("host:port", "expected HOST:PORT"),
        ("127.0.0.1:70000", "expected HOST:PORT"),
        (":8080", "expected HOST:PORT"),
        ("0.0.0.0:8080", "give a token"),
        ("192.168.1.4:8080", "give a token"),
        ("[::]:8080", "give a token"),
        ("camera.example:8080", "give a token"),
        ("localhost.example:8080", "give a token"),
    ],
)
def test_a_wrong_address_is_refused(address: str, said: str) -> None:
    for token in (None, ""):
        with pytest.raises(InputError, match=said):
            LiveServer(address, token=token)


@pytest.mark.parametrize(
    "address", ["127.0.0.1:0", "localhost:0", "[::1]:0", "::1:0", "127.1.2.3:0"]
)
def test_this_machine_needs_no_token(address: str) -> None:
    LiveServer(address)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"type": "Topology"}', '{"type": "Feature", "id": NaN}', "[" * 99999]
)
def test_a_shore_that_is_no_geojson_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "shore.geojson").write_text(text, encoding="utf-8")
    for name in ("shore.geojson", "none.geojson", "."):
        with pytest.raises(InputError):
            LiveServer("127.0.0.1:0", shore=tmp_path / name)


def test_the_shore_is_shown_as_it_was_given(tmp_path: Path) -> None:
    shore = {"type": "FeatureCollection", "features": []}
    (tmp_path / "shore.geojson").write_text(json.dumps(shore), encoding="utf-8")
    server = LiveServer("127.0.0.1:0", shore=tmp_path / "shore.geojson")
    assert client(server.hub).get("/shore.geojson").json() == shore
    assert client().get("/shore.geojson").status_code == 404


def test_one_that_listens_slowly_has_the_two_newest() -> None:
    async def listen() -> list[float | None]:
        listener = Listener()
        moments = [moment(float(i)) for i in range(5)]
        # The newest comes again where it arrived while the listener was let in.
        kept = [listener.offer(one) for one in (*moments, moments[-1])]
        assert kept == [True, True, False, False, False, True]
        assert listener.dropped == 3
        first, second = await listener.next(), await listener.next()
        listener.close()
        assert await listener.next() is None
        return [one and one.time_utc_s - START for one in (first, second)]

    assert asyncio.run(listen()) == [3.0, 4.0]
