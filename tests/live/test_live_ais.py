from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyais
import pytest
from cameras import free_port

from sightline.errors import InputError
from sightline.formats import AisReport, AisStream
from sightline.geodesy import LocalPlane
from sightline.live.ais import AisMatcher, AisReceiver, check_ais
from sightline.moment import Moment, TargetState
from sightline.tally import Tally

PLANE = LocalPlane(54.32, 10.14)
START_S = 1_717_236_000.0


def _sentences(mmsi: int, latitude: float, longitude: float, **more: object) -> list[str]:
    message = {"type": 18, "mmsi": mmsi, "lat": latitude, "lon": longitude, "second": 60}
    return pyais.encode_dict({**message, **more}, talker_id="AI", sentence_type="VDM")


def _name(mmsi: int, name: str) -> list[str]:
    message = {"type": 5, "mmsi": mmsi, "shipname": name, "imo": 0}
    return pyais.encode_dict(message, talker_id="AI", sentence_type="VDM")


def test_reports_come_line_by_line() -> None:
    stream = AisStream(Tally("ais"))
    (line,) = _sentences(211000001, 54.0, 10.0, speed=10.0, course=90.0)
    assert stream.add(line, None) == []
    (report,) = stream.add(line, START_S)
    assert (report.mmsi, report.time_utc_s) == (211000001, START_S)
    assert report.velocity_mps == pytest.approx((5.144, 0.0), abs=1e-3)
    (report,) = stream.add(rf"\c:1717236007*52\{line}", None)
    assert report.time_utc_s == START_S + 7.0
    first, second = _name(211000001, "ALBATROS")
    assert stream.add(first, START_S) == []
    (named,) = stream.add(second, START_S)
    assert named.name == "ALBATROS"
    assert np.isnan(named.latitude_deg)
    damaged = line[:-1] + ("0" if line[-1] != "0" else "1")
    assert stream.add(damaged, START_S) == []
    assert stream.add("nonsense \x00 $!", START_S) == []


def _report(mmsi: int, time_s: float, east: float, north: float, name: str = "") -> AisReport:
    latitude, longitude = PLANE.to_geographic(east, north)
    return AisReport(mmsi, time_s, float(latitude), float(longitude), (3.0, 0.0), name)


def _moment(time_s: float, places: dict[int, tuple[float, float]]) -> Moment:
    targets = []
    for number, (east, north) in places.items():
        latitude, longitude = PLANE.to_geographic(east, north)
        covariance = np.diag([16.0, 64.0])
        target = TargetState(
            number, float(latitude), float(longitude), covariance, 3.0, 90.0, "measured"
        )
        targets.append(target)
    return Moment(time_s, "sender", "quay", tuple(targets))


def test_a_target_that_moves_as_a_vessel_does_is_named_and_another_is_not() -> None:
    matcher = AisMatcher(PLANE)
    rng = np.random.default_rng(2)
    for k in range(60):
        now = START_S + k
        if k % 8 == 0:
            matcher.take(_report(211000001, now, 3.0 * k, 200.0, "ALBATROS"))
            matcher.take(_report(211000002, now, 3.0 * k, 260.0))
            # Nobody sees it.
            matcher.take(_report(211000003, now, 3.0 * k + 500.0, 900.0, "FAR"))
        off = rng.standard_normal(2) * [4.0, 8.0]
        places = {
            1: (3.0 * k + off[0], 200.0 + off[1]),
            2: (3.0 * k - off[0], 260.0 - off[1]),
            3: (100.0, 600.0),
        }
        moment = matcher.identify(_moment(now, places))
    first, second, dark = moment.targets
    assert (first.mmsi, first.name) == (211000001, "ALBATROS")
    assert (second.mmsi, second.name) == (211000002, None)
    assert first.match is not None
    assert first.match > 0.9
    assert (dark.mmsi, dark.name, dark.match) == (None, None, None)


def test_a_vessel_that_says_nothing_any_more_names_nobody() -> None:
    matcher = AisMatcher(PLANE)
    matcher.take(_report(211000001, START_S, 0.0, 200.0))
    matcher.identify(_moment(START_S, {1: (0.0, 200.0)}))
    moment = matcher.identify(_moment(START_S + 900.0, {2: (0.0, 200.0)}))
    assert moment.targets[0].mmsi is None
    assert len(matcher) == 0


def until(condition: Callable[[], bool], most_s: float = 10.0) -> None:
    end_s = time.monotonic() + most_s
    while not condition():
        assert time.monotonic() < end_s, "it did not come to that"
        time.sleep(0.02)


def _line(mmsi: int) -> bytes:
    (line,) = _sentences(mmsi, 54.0, 10.0, speed=1.0, course=0.0)
    return f"{line}\r\n".encode()


def test_a_file_that_grows_a_socket_that_ends_and_datagrams(tmp_path: Path) -> None:
    file = tmp_path / "ais.nmea"
    file.write_bytes(b"\\c:1717236000*55\\" + _line(211000001) + _line(211000009))
    matcher = AisMatcher(PLANE)
    receiver = AisReceiver(str(file), matcher)
    receiver.start()
    # Of what stood there without a time nobody knows when it was.
    until(lambda: len(matcher) == 1)
    with file.open("ab") as more:
        more.write(_line(211000002)[:10])
        more.flush()
        more.write(_line(211000002)[10:])
    until(lambda: len(matcher) == 2)
    receiver.close()

    with socket.create_server(("127.0.0.1", 0)) as server:
        receiver = AisReceiver(f"tcp://127.0.0.1:{server.getsockname()[1]}", matcher)
        receiver.start()
        for mmsi in (211000003, 211000004):
            connection, _ = server.accept()
            with connection:
                connection.sendall(_line(mmsi))
        until(lambda: len(matcher) == 4)
        receiver.close()

    port = free_port()
    receiver = AisReceiver(f"udp://127.0.0.1:{port}", matcher)
    receiver.start()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def sent() -> bool:
            sender.sendto(_line(211000005), ("127.0.0.1", port))
            return len(matcher) == 5

        until(sent)
    receiver.close()
    assert not [t for t in threading.enumerate() if t.name == "sightline-ais"]


@pytest.mark.parametrize("address", ["http://host:1", "tcp://host", "udp://:10110", "none.nmea"])
def test_what_is_no_receiver_is_refused(address: str) -> None:
    with pytest.raises(InputError, match=r"no such file|expected a file"):
        check_ais(address)
