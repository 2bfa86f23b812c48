"""Events, read back by a parser of XML, over real sockets."""

from __future__ import annotations

import math
import socket
import ssl
import struct
import subprocess
from datetime import datetime, timedelta
from pathlib import Path
from shutil import which
from xml.etree import ElementTree

import numpy as np
import pytest
from feed_receivers import HOSTILE, moment, port_of, read_lines, target, udp_receiver, until

from sightline.errors import InputError
from sightline.live.feeds import open_feed
from sightline.live.feeds.cursor_on_target import EventEncoder

SCALE = math.sqrt(-2.0 * math.log(0.05))


def event(one, camera: str = "dock") -> ElementTree.Element:
    (document,) = EventEncoder(camera)(moment(0.04, one))
    return ElementTree.fromstring(document)


def test_an_event_says_unknown_on_the_water_and_where_and_when() -> None:
    found = event(target(name="BOAT", mmsi=211000001))
    assert (found.tag, found.get("version")) == ("event", "2.0")
    assert (found.get("type"), found.get("how")) == ("a-u-S", "m-r")
    assert found.get("uid") == "sightline.dock.17"
    assert found.get("time") == found.get("start") == "2024-06-01T10:00:00.040Z"
    times = [datetime.fromisoformat(found.get(name)) for name in ("time", "stale")]
    assert times[1] - times[0] == timedelta(seconds=10)
    point = found.find("point")
    assert float(point.get("lat")) == pytest.approx(54.3233, abs=1e-7)
    assert float(point.get("lon")) == pytest.approx(10.1394, abs=1e-7)
    assert found.find("detail/contact").get("callsign") == "BOAT"
    assert found.find("detail/track").attrib == {"speed": "3.10", "course": "210.5"}
    assert "MMSI 211000001" in found.find("detail/remarks").text


@pytest.mark.parametrize(
    ("east", "cross", "north"),
    [(4.0, 1.0, 9.0), (400.0, -190.0, 100.0), (9.0, 0.0, 9.0), (25.0, 0.0, 1.0), (1.0, 0.0, 25.0)],
)
def test_the_ellipse_is_that_of_the_covariance(east: float, cross: float, north: float) -> None:
    """Eigenvalues and angle of a symmetric 2 by 2 matrix in closed form."""
    found = event(target(covariance_m2=np.array([[east, cross], [cross, north]])))
    root = math.hypot(0.5 * (east - north), cross)
    major = SCALE * math.sqrt(0.5 * (east + north) + root)
    minor = SCALE * math.sqrt(0.5 * (east + north) - root)
    shape = found.find("detail/shape/ellipse")
    assert float(shape.get("major")) == pytest.approx(major, abs=0.006)
    assert float(shape.get("minor")) == pytest.approx(minor, abs=0.006)
    assert float(found.find("point").get("ce")) == pytest.approx(major, abs=0.006)
    if root > 0.0:
        # Clockwise from north, where the mathematical angle is anticlockwise from east.
        bearing = 90.0 - math.degrees(0.5 * math.atan2(2.0 * cross, east - north))
        apart = (float(shape.get("angle")) - bearing + 90.0) % 180.0 - 90.0
        assert apart == pytest.approx(0.0, abs=0.006)


@pytest.mark.parametrize("name", [HOSTILE, "]]>", "&lt;", "a\0b\x1bc\ud800"])
def test_a_hostile_name_stays_a_name(name: str) -> None:
    found = event(target(name=name), camera=name)
    harmless = event(target(name="boat"))
    assert [one.tag for one in found.iter()] == [one.tag for one in harmless.iter()]
    callsign = found.find("detail/contact").get("callsign")
    assert callsign.replace("\ufffd", "") == "".join(
        one for one in name if one in "\t\n\r" or (one >= " " and one not in "\u202e\ud800")
    )


def test_speed_that_is_not_known_is_not_said_and_no_place_is_no_event() -> None:
    assert event(target(speed_mps=None, course_deg=None)).find("detail/track") is None
    unknown = target(covariance_m2=np.full((2, 2), np.nan))
    assert EventEncoder("dock")(moment(0.0, unknown)) == []


def test_udp_carries_an_event_a_datagram() -> None:
    with udp_receiver() as receiver:
        feed = open_feed(f"udp://127.0.0.1:{port_of(receiver)}", kind="cot", camera="dock")
        feed.publish(moment(0.0, target(1), target(2)))
        found = [ElementTree.fromstring(receiver.recv(9000)).get("uid") for _ in range(2)]
        feed.close()
    assert found == ["sightline.dock.1", "sightline.dock.2"]


def test_a_multicast_group_gets_the_events() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("", 0))
        receiver.settimeout(3.0)
        group = struct.pack("4sl", socket.inet_aton("239.2.3.1"), socket.INADDR_ANY)
        try:
            receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        except OSError as error:
            pytest.skip(f"no multicast here: {error}")
        feed = open_feed(f"udp://239.2.3.1:{port_of(receiver)}", kind="cot", camera="dock")
        feed.publish(moment())
        try:
            found = receiver.recv(9000)
        except TimeoutError:
            assert not feed.lost
            pytest.skip("multicast does not come back to this machine")
        finally:
            feed.close()
    assert ElementTree.fromstring(found).get("uid") == "sightline.dock.17"


def test_tcp_carries_events_and_a_server_that_returns_gets_the_next() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        feed = open_feed(f"tcp://127.0.0.1:{port_of(server)}", kind="cot", camera="dock")
        feed.publish(moment(0.0))
        first, _ = server.accept()
        with first:
            assert ElementTree.fromstring(b"\n".join(read_lines(first, 2))).tag == "event"
        feed.publish(moment(1.0))
        until(lambda: feed.lost == 1)
        feed.publish(moment(2.0))
        second, _ = server.accept()
        with second:
            found = ElementTree.fromstring(b"\n".join(read_lines(second, 2)))
        feed.close()
    assert found.get("time") == "2024-06-01T10:00:02.000Z"


@pytest.fixture
def certificate(tmp_path: Path) -> Path:
    if which("openssl") is None:
        pytest.skip("openssl is not installed")
    path = tmp_path / "both.pem"
    subprocess.run(
        [
            *("openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256"),
            *("-nodes", "-days", "2", "-subj", "/CN=localhost", "-addext"),
            *("subjectAltName=DNS:localhost", "-keyout", path, "-out", tmp_path / "own.pem"),
        ],
        check=True,
        capture_output=True,
    )
    path.write_bytes(path.read_bytes() + (tmp_path / "own.pem").read_bytes())
    return path


def test_tls_carries_events_to_a_server_that_is_trusted(
    certificate: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("SIGHTLINE_TAK_CA", "SIGHTLINE_TAK_CERT"):
        monkeypatch.setenv(name, str(certificate))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate)
    context.load_verify_locations(certificate)
    context.verify_mode = ssl.CERT_REQUIRED
    with socket.create_server(("127.0.0.1", 0)) as server:
        feed = open_feed(f"tls://localhost:{port_of(server)}", kind="cot", camera="dock")
        feed.publish(moment())
        made, _ = server.accept()
        with context.wrap_socket(made, server_side=True) as reader:
            found = ElementTree.fromstring(b"\n".join(read_lines(reader, 2)))
            feed.publish(moment(1.0))
            read_lines(reader, 2)
        feed.close()
    assert found.get("uid") == "sightline.dock.17"


def test_tls_sends_nothing_to_a_server_that_is_not_trusted(
    certificate: Path, caplog: pytest.LogCaptureFixture
) -> None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate)
    with socket.create_server(("127.0.0.1", 0)) as server:
        feed = open_feed(f"tls://localhost:{port_of(server)}", kind="cot", camera="dock")
        made, _ = server.accept()
        with pytest.raises(ssl.SSLError, match="UNKNOWN_CA"):
            context.wrap_socket(made, server_side=True)
        until(lambda: any("certificate verify failed" in one.message for one in caplog.records))
        feed.close()


def test_a_certificate_that_cannot_be_read_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SIGHTLINE_TAK_CERT", str(tmp_path / "none.pem"))
    with pytest.raises(InputError, match="SIGHTLINE_TAK_CERT"):
        open_feed("tls://localhost:1", kind="cot", camera="dock")
