"""The real server: many that listen, one that does not, and an end without threads."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
import urllib.request
from concurrent.futures import ThreadPoolExecutor

import pytest
from web_moments import harbour, moment, target, until
from websockets.sync.client import connect

from sightline.errors import InputError
from sightline.web.server import LiveServer


@pytest.fixture
def server():
    made = LiveServer("127.0.0.1:0")
    made.start()
    yield made
    made.close()


def ws(server: LiveServer) -> str:
    return server.url.replace("http", "ws") + "ws"


def test_each_moment_is_one_message(server: LiveServer) -> None:
    with connect(ws(server), proxy=None) as stream:
        until(lambda: len(server.hub.listeners) == 1)
        for i in range(20):
            one = moment(float(i))
            server.publish(one)
            assert stream.recv(timeout=10.0) == one.text
    until(lambda: not server.hub.listeners)


def test_who_comes_late_sees_the_newest_at_once(server: LiveServer) -> None:
    server.publish(moment(3.0))
    with connect(ws(server), proxy=None) as stream:
        assert json.loads(stream.recv(timeout=10.0))["time_utc"] == "2024-06-01T10:00:03.000Z"


def test_one_that_does_not_read_loses_the_oldest_and_others_lose_nothing(
    server: LiveServer,
) -> None:
    host, port = server._host, server._port
    with socket.socket() as idle, ThreadPoolExecutor(3) as readers:
        idle.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        idle.connect((host, port))
        idle.sendall(
            b"GET /ws HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n\r\n"
        )
        until(lambda: len(server.hub.listeners) == 1)
        count = 120
        got = [threading.Semaphore(0) for _ in range(3)]

        def read(number: int) -> list[str]:
            with connect(ws(server), proxy=None, max_size=None) as stream:
                times = []
                while len(times) < count:
                    times.append(json.loads(stream.recv(timeout=30.0))["time_utc"])
                    got[number].release()
                return times

        futures = [readers.submit(read, i) for i in range(3)]
        until(lambda: len(server.hub.listeners) == 4)
        for i in range(count):
            server.publish(harbour(float(i), 300))
            # Those that keep up are given the time to; the idle one is not waited for.
            assert all(one.acquire(timeout=30.0) for one in got)
        for future in futures:
            times = future.result()
            assert len(set(times)) == count
            assert times == sorted(times)
        assert server.hub.dropped > 0


def test_an_end_says_goodbye_and_leaves_no_thread() -> None:
    before = set(threading.enumerate())
    server = LiveServer("127.0.0.1:0", health=lambda: {"state": "ok"})
    server.start()
    port = server._port
    with urllib.request.urlopen(server.url + "healthz") as answer:
        assert answer.status == 200
    with connect(ws(server), proxy=None) as stream:
        server.publish(moment())
        stream.recv(timeout=10.0)
        server.close()
        with pytest.raises(Exception, match=r"1001|1012"):
            stream.recv(timeout=10.0)
    server.close()
    server.publish(moment())
    until(lambda: not set(threading.enumerate()) - before)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port))


def test_an_address_that_is_taken_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        server = LiveServer(f"127.0.0.1:{taken.getsockname()[1]}")
        with pytest.raises(InputError, match="cannot serve at"):
            server.start()


def test_moments_may_be_published_before_the_start() -> None:
    server = LiveServer("127.0.0.1:0")
    server.publish(moment(0.0, target(1), target(2)))
    server.start()
    with urllib.request.urlopen(server.url + "api/moment") as answer:
        assert len(json.load(answer)["targets"]) == 2
    server.close()


def test_without_the_extra_one_line_says_what_to_install() -> None:
    code = (
        "import sys\n"
        "sys.modules['fastapi'] = None\n"
        "from sightline.errors import InputError\n"
        "from sightline.web.server import LiveServer\n"
        "try:\n"
        "    LiveServer('127.0.0.1:0')\n"
        "except InputError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == 'fastapi is not installed; run: pip install "sightline[live]"\n'


def test_the_module_of_the_server_loads_no_framework() -> None:
    code = (
        "import sys, sightline.web.server, sightline.live.feeds\n"
        "heavy = ('fastapi', 'uvicorn', 'websockets', 'paho')\n"
        "print(*[one for one in heavy if one in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
