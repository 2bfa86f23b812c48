"""What is published and written, received by the programs in which people look for it."""

from __future__ import annotations

import json
import socket
import subprocess
import time
import urllib.request
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from client_programs import client, free_port, listens, running, until

from moments import START, target
from sightline.formats import write_tracks
from sightline.geodesy import LocalPlane
from sightline.live.feeds import open_feed
from sightline.moment import Moment
from sightline.types import PointKind, Track

PLANE = LocalPlane(54.32, 10.14)


def _moment(time_utc_s: float, **columns: object) -> Moment:
    return Moment(time_utc_s, "sender", "dock", (target(**columns),))


@pytest.mark.slow
def test_taky_hands_events_on_with_their_ellipse(tmp_path: Path) -> None:
    taky = client("taky", "pip install taky, in an environment of its own")
    port = free_port()
    (tmp_path / "logs").mkdir()
    (tmp_path / "taky.conf").write_text(
        f"[taky]\nhostname = localhost\nbind_ip = 127.0.0.1\nserver_address = 127.0.0.1\n"
        f"root_dir = {tmp_path}\n"
        f"[cot_server]\nport = {port}\nmon_port = {free_port()}\nlog_cot = {tmp_path / 'logs'}\n"
        f"[dp_server]\nupload_path = {tmp_path}\n[ssl]\nenabled = false\n",
        encoding="utf-8",
    )
    with (
        running(taky, "-c", tmp_path / "taky.conf", port=port, folder=tmp_path),
        socket.create_connection(("127.0.0.1", port), timeout=10.0) as other,
    ):
        # Whoever else is there, as a user of ATAK.
        now = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        later = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(time.time() + 600.0))
        other.sendall(
            f'<event version="2.0" uid="ANDROID-1" type="a-f-G-U-C" time="{now}" start="{now}" '
            f'stale="{later}" how="m-g"><point lat="54.3" lon="10.1" hae="0" ce="5" le="5"/>'
            f'<detail><contact callsign="ALPHA"/><__group name="Cyan" role="Team Member"/>'
            f"</detail></event>".encode()
        )
        feed = open_feed(f"tcp://127.0.0.1:{port}", kind="cot", camera="dock")
        until(lambda: feed.connected)
        heard = b""
        other.settimeout(1.0)
        end_s = time.monotonic() + 20.0
        while b"a-u-S" not in heard or b"</event>" not in heard.partition(b"a-u-S")[2]:
            assert time.monotonic() < end_s, heard
            feed.publish(_moment(time.time(), name="ANNA", mmsi=211000001))
            try:
                heard += other.recv(65536)
            except TimeoutError:
                continue
        feed.close()
    begin = heard.rindex(b"<event", 0, heard.index(b"a-u-S"))
    end = heard.index(b"</event>", begin) + len(b"</event>")
    event = ElementTree.fromstring(heard[begin:end])
    point = event.find("point")
    assert point is not None
    assert float(point.attrib["lat"]) == pytest.approx(54.3233, abs=1e-6)
    # By the eigenvalues of [[4, 1], [1, 9]] and the 95 % quantile of chi-square with two degrees.
    half_m = float(np.sqrt(5.991 * np.linalg.eigvalsh([[4.0, 1.0], [1.0, 9.0]])[-1]))
    assert float(point.attrib["ce"]) == pytest.approx(half_m, abs=0.1)
    assert event.find("detail/track") is not None
    ellipse = event.find("detail/shape/ellipse")
    assert ellipse is not None
    assert float(ellipse.attrib["major"]) == pytest.approx(half_m, abs=0.1)


@pytest.mark.slow
def test_signal_k_gives_vessels_back(tmp_path: Path) -> None:
    server = client("signalk-server", "npm install signalk-server, with Node.js")
    pytest.importorskip("websockets", reason="needs sightline[live]")
    port = free_port()
    settings = {
        "interfaces": {"appstore": False},
        "pipedProviders": [],
        "mdns": False,
        "port": port,
    }
    (tmp_path / "settings.json").write_text(json.dumps(settings), encoding="utf-8")
    environment = {
        "PORT": str(port),
        "SIGNALK_NODE_CONFIG_DIR": str(tmp_path),
        "TCPSTREAMPORT": "0",
    }
    url = f"http://127.0.0.1:{port}/signalk/v1/api/vessels"
    with running(server, "-c", tmp_path, port=port, folder=tmp_path, environment=environment):
        feed = open_feed(f"ws://127.0.0.1:{port}", kind="signalk", camera="dock")
        until(lambda: feed.connected, 60.0)

        def vessels() -> list[dict]:
            feed.publish(_moment(time.time(), name="ANNA", mmsi=211000001))
            with urllib.request.urlopen(url, timeout=10.0) as answer:
                return list(json.load(answer).values())

        until(lambda: any(one.get("name") == "ANNA" for one in vessels()), 40.0)
        (anna,) = [one for one in vessels() if one.get("name") == "ANNA"]
        feed.close()
    place = anna["navigation"]["position"]["value"]
    assert (place["latitude"], place["longitude"]) == pytest.approx((54.3233, 10.1394), abs=1e-7)
    assert anna["navigation"]["speedOverGround"]["value"] == pytest.approx(3.1, abs=0.01)
    course = anna["navigation"]["courseOverGroundTrue"]["value"]
    assert course == pytest.approx(np.radians(210.5), abs=0.001)


def _track(number: int) -> Track:
    n = 10
    k = np.arange(n)
    return Track(
        track_id=number,
        time_utc_s=START + k,
        east_m=50.0 * number + 3.0 * k,
        north_m=100.0 + 4.0 * k,
        velocity_east_mps=np.full(n, 3.0),
        velocity_north_mps=np.full(n, 4.0),
        covariance_m2=np.tile(np.diag([4.0, 9.0]), (n, 1, 1)),
        velocity_covariance_m2ps2=np.tile(np.eye(2), (n, 1, 1)),
        kind=np.full(n, PointKind.MEASURED, dtype=np.int8),
        plane=PLANE,
        label="boat",
    )


_READ = """
import json, sys, movingpandas
found = movingpandas.read_mf_json(sys.argv[1], "track_id")
rows = [[int(one.id), len(one.df), one.get_length(), str(one.get_start_time())] for one in found]
print(json.dumps(rows))
"""


@pytest.mark.slow
def test_movingpandas_reads_moving_features(tmp_path: Path) -> None:
    python = client("movingpandas-python", "a link to the Python of an environment that has it")
    write_tracks([_track(1), _track(2)], tmp_path / "tracks.mfjson")
    done = subprocess.run(
        [python, "-c", _READ, tmp_path / "tracks.mfjson"],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    rows = json.loads(done.stdout.splitlines()[-1])
    assert [row[:2] for row in rows] == [[1, 10], [2, 10]]
    for row in rows:
        # Nine seconds at 5 m/s.
        assert row[2] == pytest.approx(45.0, rel=0.005)
        assert row[3].startswith("2024-06-01 10:00:00")


def test_servers_that_do_not_start_are_told(tmp_path: Path) -> None:
    port = free_port()
    assert not listens(port)
    with (
        pytest.raises(pytest.skip.Exception, match="does not start here: nothing here"),
        running("sh", "-c", "echo nothing here; exit 3", port=port, folder=tmp_path),
    ):
        pass
