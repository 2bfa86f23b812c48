from __future__ import annotations

import logging
import re
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pyais
import pynmea2
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.errors import InputError
from sightline.formats import read_ais, read_fixes, read_headings, write_fixes
from sightline.formats.ais import read_ais_feed
from sightline.types import Fixes

GPX = '<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{}</trkseg></trk></gpx>'
POINT = '<trkpt lat="{}" lon="{}"><time>{}</time></trkpt>'
NOON_S = 1_601_467_200.0  # 2020-09-30T12:00:00Z


def sentence(talker: str, kind: str, *fields: str) -> str:
    return str(pynmea2.parse(f"${talker}{kind},{','.join(fields)}")) + "\r\n"


def rmc(clock: str, latitude: str = "3242.1780,N", longitude: str = "11714.0760,W") -> str:
    return sentence("GP", "RMC", clock, "A", latitude, longitude, "5.0", "90.0", "300920", "", "")


def gga(clock: str, latitude: str = "3242.1780,N", quality: str = "1") -> str:
    place = (latitude, "11714.0760,W", quality)
    return sentence("GP", "GGA", clock, *place, "8", "1.0", "2.0", "M", "-33.9", "M", "", "")


def report(kind: int = 1, mmsi: int = 366123456, second: int = 5, **fields: float) -> list[str]:
    content = {"type": kind, "mmsi": mmsi, "lat": 32.7, "lon": -117.2, "second": second, **fields}
    return pyais.encode_dict(content, talker_id="AI")


def with_checksum(content: str) -> str:
    return f"!{content}*{reduce(xor, content.encode()):02X}"


# A fix every 12 days at least: so far apart that anything could have gone there. None stands at
# 0, 0, where receivers are that know no place.
logs = st.lists(
    st.tuples(
        st.integers(0, 3_000).map(lambda dozen: dozen * 1_036_800_000 + dozen % 1000),
        st.floats(-90.0, 90.0).filter(lambda latitude: abs(latitude) > 0.001),
        st.floats(-180.0, 180.0),
    ),
    min_size=1,
    max_size=20,
    unique_by=lambda fix: fix[0],
).map(sorted)


@pytest.mark.parametrize("suffix", [".csv", ".gpx"])
@given(log=logs)
def test_logs_survive_a_file(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, log: list[tuple[int, float, float]]
) -> None:
    path = tmp_path_factory.mktemp("logs") / f"log{suffix}"
    milliseconds, latitude, longitude = np.array(log).T
    write_fixes(Fixes(milliseconds / 1000.0, latitude, longitude), path)
    read = read_fixes(path)
    np.testing.assert_array_equal(np.round(read.time_utc_s * 1000.0), milliseconds)
    np.testing.assert_allclose(read.latitude_deg, latitude, rtol=0, atol=5.1e-10)
    np.testing.assert_allclose(read.longitude_deg, longitude, rtol=0, atol=5.1e-10)


def test_the_real_log_keeps_every_fix(data_dir: Path) -> None:
    path = data_dir / "tracks-at-sea" / "target.gpx"
    text = path.read_text()
    fixes = read_fixes(path)
    assert len(fixes) == text.count("<trkpt")
    assert fixes.name == "target vessel, 2020-09-30"
    latitudes = [float(value) for value in re.findall(r'lat="([^"]+)"', text)]
    np.testing.assert_array_equal(fixes.latitude_deg, latitudes)
    # 2020-09-30T18:48:18Z, and two fixes of one second later on.
    assert fixes.time_utc_s[0] == 1_601_491_698.0
    assert (np.diff(fixes.time_utc_s) == 0.0).any()


def test_gpx_times_of_any_zone(tmp_path: Path) -> None:
    path = tmp_path / "a.gpx"
    points = "".join(
        POINT.format(32.7, -117.2, stamp)
        for stamp in ("2020-09-30T12:00:00", "2020-09-30T14:00:01.5+02:00", "2020-09-30T12:00:02Z")
    )
    path.write_text(GPX.format(points))
    np.testing.assert_allclose(read_fixes(path).time_utc_s - NOON_S, [0.0, 1.5, 2.0])


def test_gpx_in_latin_1_without_its_suffix(tmp_path: Path) -> None:
    path = tmp_path / "log.xml"
    head = '<?xml version="1.0" encoding="ISO-8859-1"?>'
    body = GPX.format(POINT.format(1, 2, "2020-09-30T12:00:00Z"))
    path.write_bytes(
        (head + body.replace("<trkseg>", "<name>Möwe</name><trkseg>")).encode("latin-1")
    )
    assert read_fixes(path).name == "Möwe"


def test_an_entity_bomb_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bomb.gpx"
    path.write_text(
        '<?xml version="1.0"?><!DOCTYPE gpx [<!ENTITY a "aaaaaaaaaa">'
        '<!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>' + GPX.format("&b;")
    )
    with pytest.raises(InputError, match=r"bomb\.gpx: declares a document type"):
        read_fixes(path)


@pytest.mark.parametrize(
    ("latitude", "longitude", "expected"),
    [
        ("3242.1780,N", "11714.0760,W", (32.0 + 42.178 / 60, -(117.0 + 14.076 / 60))),
        ("3242.6000,S", "11714.0760,E", (-(32.0 + 42.6 / 60), 117.0 + 14.076 / 60)),
    ],
)
def test_rmc(tmp_path: Path, latitude: str, longitude: str, expected: tuple[float, float]) -> None:
    path = tmp_path / "log.nmea"
    path.write_text(rmc("120000.00", latitude, longitude) + rmc("120001.50", latitude, longitude))
    fixes = read_fixes(path)
    np.testing.assert_allclose(fixes.time_utc_s, [NOON_S, NOON_S + 1.5])
    np.testing.assert_allclose(fixes.latitude_deg, expected[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(fixes.longitude_deg, expected[1], rtol=0, atol=1e-9)


def test_gga_takes_its_date_from_zda_over_midnight(tmp_path: Path) -> None:
    path = tmp_path / "log.nmea"
    zda = sentence("GP", "ZDA", "235958.00", "30", "09", "2020", "00", "00")
    path.write_text(gga("235957.00") + zda + gga("235959.00") + gga("000001.00"))
    np.testing.assert_allclose(read_fixes(path).time_utc_s - NOON_S, [43197.0, 43199.0, 43201.0])


def hdt(heading: str) -> str:
    return sentence("HE", "HDT", heading, "T")


def test_spoilt_headings_are_skipped_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "log.nmea"
    lines = [
        *(rmc("120000.00"), hdt("10.0")),
        *(rmc("120001.00"), hdt("11.0").replace("11.0", "17.0")),
        *(rmc("120002.00"), hdt("north")),
        # A compass that does not know says nothing; that is not spoilt.
        *(rmc("120003.00"), hdt("")),
        *(rmc("120004.00"), hdt("370.0")),
        *(rmc("120005.00").replace("3242", "9942"), hdt("12.0")),
    ]
    path.write_text("".join(lines))
    with caplog.at_level(logging.WARNING):
        found = read_headings(path)
    assert found is not None
    # The fix of the last is spoilt as well, and its second is known all the same.
    np.testing.assert_allclose(found.time_utc_s - NOON_S, [0.0, 4.0, 5.0])
    np.testing.assert_allclose(found.heading_deg, [10.0, 10.0, 12.0])
    assert [record.getMessage() for record in caplog.records] == [
        (
            f"{path}: left out: 1 sentences with a heading with a wrong checksum (line 4: "
            "$HEHDT,17.0,T*1F), 1 HDT with a heading that cannot be read (line 6: $HEHDT,north,T*6E), "
            "1 HDT without a heading (line 8: $HEHDT,,T*01)"
        )
    ]


def test_headings_that_are_whole_are_read_without_a_word(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "log.nmea"
    path.write_text(rmc("120000.00") + hdt("10.0") + rmc("120001.00") + hdt("370.0"))
    with caplog.at_level(logging.WARNING):
        found = read_headings(path)
    assert found is not None
    np.testing.assert_allclose(found.heading_deg, [10.0, 10.0])
    assert not caplog.records


def test_gga_is_used_where_it_is_denser_than_rmc(tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    path.write_text(rmc("120000.00") + "".join(gga(f"12000{i}.00") for i in range(5)))
    np.testing.assert_allclose(read_fixes(path).time_utc_s - NOON_S, np.arange(5.0))


def test_spoilt_sentences_are_skipped_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "log.nmea"
    spoilt = rmc("120001.00").replace("3242", "9942")
    path.write_bytes(
        (rmc("120000.00") + spoilt + rmc("120002.00")).encode() + b"\x80\xff$GPRMC,1200\r\n"
    )
    with caplog.at_level(logging.WARNING):
        fixes = read_fixes(path)
    np.testing.assert_allclose(fixes.time_utc_s - NOON_S, [0.0, 2.0])
    assert "left out: 1 sentences with a wrong checksum (line 2: $GPRMC,120001.00" in caplog.text
    assert "1 sentences without a checksum (line 4: $GPRMC,1200)" in caplog.text


def test_sentences_without_a_fix_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "log.nmea"
    void = sentence("GP", "RMC", "120001.00", "V", "", "", "", "", "", "", "300920", "", "")
    path.write_text(rmc("120000.00") + void + gga("120002.00", quality="0"))
    assert len(read_fixes(path)) == 1
    path.write_text(void)
    with pytest.raises(InputError, match="no sentence gives a fix; left out: 1 RMC without a"):
        read_fixes(path)


@pytest.mark.parametrize(
    "line",
    [
        "\\s:station,c:1601467207*5A\\{}",
        "\\c:1601467207000*00\\{}",
        "1601467207 {}",
        "1601467207.25,{}",
        "2020-09-30T12:00:07Z {}",
        "2020/09/30 12:00:07 {}",
        "2020-09-30T14:00:07+02:00;{}",
        "{},1601467207",
        "{},r003669930,1601467207",
    ],
)
def test_ais_times_of_reception(tmp_path: Path, line: str) -> None:
    path = tmp_path / "log.ais"
    path.write_text(line.format(report(second=5)[0]) + "\n")
    fixes = read_fixes(path)
    # The report tells that it was made at the second before it was received.
    np.testing.assert_array_equal(fixes.time_utc_s, [NOON_S + 5.0])
    np.testing.assert_allclose([fixes.latitude_deg[0], fixes.longitude_deg[0]], [32.7, -117.2])
    assert fixes.name == "366123456"


def test_the_second_of_an_ais_report_may_be_of_the_minute_before(tmp_path: Path) -> None:
    path = tmp_path / "log.ais"
    path.write_text(f"{NOON_S + 61:.0f} {report(second=58)[0]}\n")
    np.testing.assert_array_equal(read_fixes(path).time_utc_s, [NOON_S + 58.0])


@pytest.mark.parametrize(("kind", "refined"), [(1, 5.0), (2, 5.0), (3, 5.0), (18, 5.0), (27, 7.0)])
def test_ais_position_reports(tmp_path: Path, kind: int, refined: float) -> None:
    path = tmp_path / "log.ais"
    path.write_text(f"{NOON_S + 7:.0f} {report(kind)[0]}\n")
    fixes = read_fixes(path)
    assert fixes.time_utc_s[0] == NOON_S + refined
    assert fixes.latitude_deg[0] == pytest.approx(32.7, abs=1e-3)


def test_an_ais_report_in_two_sentences(tmp_path: Path) -> None:
    path = tmp_path / "log.ais"
    payload = report(19, shipname="GULL")[0].split(",")[5]
    first = with_checksum(f"AIVDM,2,1,4,A,{payload[:30]},0")
    second = with_checksum(f"AIVDM,2,2,4,A,{payload[30:]},0")
    other = report(mmsi=2)[0]
    path.write_text(f"{NOON_S + 7:.0f} {first}\n{NOON_S + 7:.0f} {other}\n{second}\n")
    vessels = read_ais(path)
    assert sorted(vessels) == [2, 366123456]
    assert vessels[366123456].time_utc_s[0] == NOON_S + 5.0


def test_ais_reports_come_in_the_order_of_time_and_once(tmp_path: Path) -> None:
    path = tmp_path / "log.ais"
    late, early = report(second=9)[0], report(second=3)[0]
    path.write_text(
        f"{NOON_S + 9:.0f} {late}\n{NOON_S + 10:.0f} {early}\n{NOON_S + 11:.0f} {late}\n"
    )
    np.testing.assert_array_equal(read_fixes(path).time_utc_s - NOON_S, [3.0, 9.0])


@pytest.mark.parametrize(
    ("kind", "speed", "course", "velocity_mps"),
    [
        # ITU-R M.1371: 1023 tenths of a knot and 3600 tenths of a degree are "not available".
        (1, 10.0, 90.0, (10.0 * 1852.0 / 3600.0, 0.0)),
        (1, 102.3, 90.0, None),
        (1, 10.0, 360.0, None),
        (18, 102.3, 90.0, None),
        (18, 10.0, 360.0, None),
        (19, 10.0, 180.0, (0.0, -10.0 * 1852.0 / 3600.0)),
        (1, 102.2, 90.0, (102.2 * 1852.0 / 3600.0, 0.0)),
        # Long-range reports are coarser: 63 knots and 511 degrees.
        (27, 10.0, 90.0, (10.0 * 1852.0 / 3600.0, 0.0)),
        (27, 63.0, 90.0, None),
        (27, 10.0, 511.0, None),
        # A fast ferry is no missing value where knots have tenths.
        (1, 63.0, 90.0, (63.0 * 1852.0 / 3600.0, 0.0)),
    ],
)
def test_ais_velocities_and_those_that_are_not_available(
    tmp_path: Path,
    kind: int,
    speed: float,
    course: float,
    velocity_mps: tuple[float, float] | None,
) -> None:
    path = tmp_path / "log.ais"
    path.write_text(f"{NOON_S + 7:.0f} {report(kind, speed=speed, course=course)[0]}\n")
    (vessel,) = read_ais_feed(path).values()
    wanted = (np.nan, np.nan) if velocity_mps is None else velocity_mps
    np.testing.assert_allclose(vessel.velocity_mps[0], wanted, atol=1e-9)
    # The position is as good as any.
    assert vessel.fixes.latitude_deg[0] == pytest.approx(32.7, abs=1e-3)


def test_ais_positions_that_are_not_available(tmp_path: Path) -> None:
    path = tmp_path / "log.ais"
    nowhere, somewhere = report(lat=91, lon=181)[0], report()[0]
    path.write_text(f"{NOON_S:.0f} {nowhere}\n{NOON_S:.0f} {somewhere}\n")
    assert len(read_fixes(path)) == 1


def test_one_vessel_of_many(tmp_path: Path) -> None:
    path = tmp_path / "log.ais"
    lines = [report(mmsi=mmsi)[0] for mmsi in (211000001, 211000002)]
    path.write_text("".join(f"{NOON_S:.0f} {line}\n" for line in lines))
    assert read_fixes(path, mmsi=211000002).name == "211000002"
    with pytest.raises(InputError, match=r"holds 2 vessels, say which MMSI: 211000001 \(1 fixes\)"):
        read_fixes(path)
    with pytest.raises(InputError, match="no vessel with the MMSI 7; it holds 211000001"):
        read_fixes(path, mmsi=7)


def test_a_log_of_both_kinds(tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    path.write_text(rmc("120000.00") + f"{NOON_S:.0f} {report()[0]}\n")
    assert read_fixes(path).name == ""
    assert read_fixes(path, mmsi=366123456).name == "366123456"


def test_ais_that_is_of_no_use(tmp_path: Path) -> None:
    path = tmp_path / "log.ais"
    path.write_text(report()[0] + "\n")
    with pytest.raises(InputError, match="none of its 1 AIS position reports has a time"):
        read_fixes(path)
    path.write_text(f"{NOON_S:.0f} {report()[0][:-2]}00\n")
    with pytest.raises(InputError, match="left out: 1 AIS sentences with a wrong checksum"):
        read_fixes(path)


@pytest.mark.parametrize(
    ("stamp", "second"),
    [
        ("1601467201.5", 1.5),
        ("2020-09-30T12:00:01.5Z", 1.5),
        ("2020-09-30 12:00:01", 1.0),
        ("2020-09-30T14:00:01+02:00", 1.0),
    ],
)
def test_csv_times(tmp_path: Path, stamp: str, second: float) -> None:
    path = tmp_path / "log.csv"
    path.write_text(f"speed, time_utc, latitude_deg, longitude_deg\n3,{stamp},32.7,-117.2\n\n")
    np.testing.assert_allclose(read_fixes(path).time_utc_s - NOON_S, [second])


HEAD = "time_utc,latitude_deg,longitude_deg\n"
RMC_ROW = rmc("120000.00")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.gpx", "", "is empty"),
        ("a.gpx", GPX.format(""), "has no track points"),
        ("a.gpx", GPX.format('<trkpt lat="1" lon="2"/>'), "none of its 1 points has a time"),
        (
            "a.gpx",
            GPX.format(POINT.format(1, 2, "2020-09-30T12:00:00Z") + '<trkpt lat="1" lon="2"/>'),
            "point 2: has no time",
        ),
        (
            "a.gpx",
            GPX.format(
                POINT.format(1, 2, "2020-09-30T12:00:05Z")
                + POINT.format(1, 2, "2020-09-30T12:00:04Z")
            ),
            "point 2: 2020-09-30T12:00:04.000Z is earlier",
        ),
        (
            "a.gpx",
            GPX.format(POINT.format(-117.2, 32.7, "2020-09-30T12:00:05Z")),
            r"point 1: latitude -117\.2, longitude 32\.7 is not on the earth",
        ),
        ("a.gpx", GPX.format(POINT.format(1, 2, "2020-09-30T12:00:05Z"))[:-20], "cut short"),
        (
            "a.gpx",
            GPX.format(POINT.format("north", 2, "2020-09-30T12:00:05Z")),
            "point 1: north is no",
        ),
        ("a.gpx", "gpx\0\0\0", "is not text"),
        ("a.csv", "when,latitude_deg\n", "lacks the columns time_utc, longitude_deg; found when"),
        ("a.csv", HEAD, "holds no fix"),
        ("a.csv", HEAD + "soon,1,2\n", "line 2: soon is no time"),
        ("a.csv", HEAD + "1,1,2\n\n2,north,2\n", r"line 4: north is no number \(latitude_deg\)"),
        ("a.csv", HEAD + "1,1,\n", r"holds no fix; left out: 1 without a place \(line 2: 1,\)"),
        ("a.csv", HEAD + "1e9,1,2\n1e9,90.1,2\n", "line 3: latitude 90.1, longitude 2 is not on"),
        (
            "a.csv",
            HEAD + "1000000002,1,2\n1000000001,1,2\n",
            "line 3: 2001-09-09T01:46:41.000Z is earlier",
        ),
        ("a.csv", HEAD + "1,2,3,4\n", "more cells than its header has names"),
        ("a.csv", HEAD + "1,2,3\n1,2,3,4,5\n", "line 3: its rows have more cells"),
        ("a.csv", "\0\1\2\3", "is not text"),
        ("a.nmea", RMC_ROW[:-4] + "00\r\n", "left out: 1 sentences with a wrong checksum"),
        ("a.nmea", gga("120000.00"), "1 GGA sentences have no date"),
        (
            "a.nmea",
            rmc("120001.00") + rmc("120000.00"),
            "line 2: 2020-09-30T12:00:00.000Z is earlier",
        ),
        (
            "a.nmea",
            rmc("120001.00", "9542.1780,N"),
            r"1 RMC with a place that is not on the earth \(line 1: \$GPRMC",
        ),
        ("a.log", "hello\n", "is no log that is known"),
    ],
)
def test_refused_logs(tmp_path: Path, name: str, content: str, message: str) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        read_fixes(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_logs_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no such file"):
        read_fixes(tmp_path / "missing.gpx")
    with pytest.raises(InputError, match="is a folder"):
        read_fixes(tmp_path)
    (tmp_path / "a.csv").write_text(HEAD + "1e9,1,2\n")
    with pytest.raises(InputError, match="holds no AIS sentence"):
        read_fixes(tmp_path / "a.csv", mmsi=1)
    with pytest.raises(InputError, match=r"known are \.csv, \.gpx"):
        write_fixes(read_fixes(tmp_path / "a.csv"), tmp_path / "a.kml")
