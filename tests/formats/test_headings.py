"""Headings of logs: what a compass said, at the time at which it said it."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from _support.sentences import NOON_S, gga, hdt, moment, north_deg, rmc, sentence, ths, zda

from sightline.errors import InputError
from sightline.formats import read_headings
from sightline.tally import Tally
from sightline.types import Headings

SECONDS = range(30)


def bow_deg(second: float | np.ndarray) -> np.ndarray:
    """It turns through north, 3 degrees a second."""
    return np.asarray((320.0 + 3.0 * np.asarray(second)) % 360.0)


def read(path: Path, sentences: Iterable[str]) -> tuple[Headings | None, Tally]:
    path.write_text("".join(f"{line}\r\n" for line in sentences))
    tally = Tally(path)
    return read_headings(path, tally=tally), tally


def errors_s(found: Headings | None) -> np.ndarray:
    """By how many seconds each heading is stamped too late."""
    assert found is not None
    off = found.heading_deg - bow_deg(found.time_utc_s - NOON_S)
    return -((off + 180.0) % 360.0 - 180.0) / 3.0


@pytest.mark.parametrize("per_s", [1, 2, 5, 10, 20])
def test_headings_share_the_second_of_their_fix(tmp_path: Path, per_s: int) -> None:
    lines = []
    for second in SECONDS:
        lines.append(rmc(second))
        lines += [hdt(bow_deg(second + i / per_s)) for i in range(per_s)]
    found, tally = read(tmp_path / "log.nmea", lines)
    assert len(found) == 30 * per_s == tally.read["headings"]
    np.testing.assert_allclose(errors_s(found), 0.0, atol=0.01)
    np.testing.assert_allclose(np.diff(found.time_utc_s), 1.0 / per_s, atol=1e-5)


@pytest.mark.parametrize("per_s", [1, 5, 10])
def test_headings_that_come_before_their_fix(tmp_path: Path, per_s: int) -> None:
    lines = []
    for second in SECONDS:
        lines += [hdt(bow_deg(second - (per_s - 1 - i) / per_s)) for i in range(per_s)]
        lines.append(rmc(second))
    found, _ = read(tmp_path / "log.nmea", lines)
    assert len(found) == 30 * per_s
    np.testing.assert_allclose(errors_s(found), 0.0, atol=0.01)


def test_headings_of_a_rate_of_their_own(tmp_path: Path) -> None:
    """A gyro that knows nothing of the receiver; 7 headings or 8 from fix to fix."""
    events = [(second, rmc(second)) for second in SECONDS]
    events += [(t, hdt(bow_deg(t))) for t in np.arange(0.03, 29.9, 0.137)]
    found, _ = read(tmp_path / "log.nmea", [line for _, line in sorted(events)])
    assert np.abs(errors_s(found)).max() < 0.15
    assert (np.diff(found.time_utc_s) > 0.0).all()


def test_ten_headings_and_five_fixes_a_second(tmp_path: Path) -> None:
    lines = []
    for second in np.arange(0.0, 20.0, 0.2):
        lines += [rmc(second), hdt(bow_deg(second)), hdt(bow_deg(second + 0.1))]
    found, _ = read(tmp_path / "log.nmea", lines)
    np.testing.assert_allclose(errors_s(found), 0.0, atol=0.01)


def test_a_heading_among_the_sentences_of_one_fix(tmp_path: Path) -> None:
    lines = []
    for second in SECONDS:
        lines += [gga(second), hdt(bow_deg(second)), rmc(second)]
    found, _ = read(tmp_path / "log.nmea", lines)
    np.testing.assert_allclose(errors_s(found), 0.0, atol=0.01)


def test_lost_fixes_and_a_pause(tmp_path: Path) -> None:
    lines = []
    for second in (*range(10), *range(100, 110)):
        if second % 10 not in (3, 4):
            lines.append(rmc(second))
        lines += [hdt(bow_deg(second + i / 5)) for i in range(5)]
    found, _ = read(tmp_path / "log.nmea", lines)
    assert len(found) == 100
    np.testing.assert_allclose(errors_s(found), 0.0, atol=0.01)


def test_the_loggers_times_tell_better(tmp_path: Path) -> None:
    """Its clock is 40.7 s ahead, and headings come just before the next fix."""
    lines = []
    for second in SECONDS:
        for text, at in ((rmc(second), second), (hdt(bow_deg(second + 0.8)), second + 0.8)):
            stamp = moment(at + 40.7, "%Y-%m-%dT%H:%M:%S.%f")
            lines.append(f"{stamp}Z {text}")
    found, _ = read(tmp_path / "log.nmea", lines)
    assert len(found) == 30
    np.testing.assert_allclose(errors_s(found), 0.0, atol=0.01)


@pytest.mark.parametrize("off_s", [-0.6, 0.4, 37.0])
def test_a_zda_of_another_clock_is_passed_over(tmp_path: Path, off_s: float) -> None:
    lines = []
    for second in SECONDS:
        lines += [rmc(second), hdt(bow_deg(second)), zda(second + off_s, talker="ZA")]
    found, _ = read(tmp_path / "log.nmea", lines)
    np.testing.assert_allclose(errors_s(found), 0.0, atol=0.01)


def test_where_zda_is_all_there_is(tmp_path: Path) -> None:
    lines = [line for s in SECONDS for line in (zda(s), hdt(bow_deg(s)))]
    np.testing.assert_allclose(errors_s(read(tmp_path / "log.nmea", lines)[0]), 0.0, atol=0.01)


def test_a_start_without_a_fix(tmp_path: Path) -> None:
    """Receivers begin with a time of their own."""
    wrong = sentence("GPRMC,000000.00,V,,,,,,,010100,,,N")
    lines = [wrong, hdt(11.0)] * 20
    lines += [line for s in SECONDS for line in (rmc(s), hdt(bow_deg(s)))]
    found, tally = read(tmp_path / "log.nmea", lines)
    late = found.time_utc_s >= NOON_S
    assert late.sum() == 30
    np.testing.assert_allclose(errors_s(found)[late], 0.0, atol=0.01)
    assert tally.left_out["headings long before the first fix or after the last"].count > 8


def test_a_wrong_time_without_a_fix_in_the_midst(tmp_path: Path) -> None:
    wrong = sentence("GPRMC,000000.00,V,,,,,,,010100,,,N")
    lines = []
    for second in SECONDS:
        lines += [rmc(second), *([wrong] * (second == 10)), hdt(bow_deg(second))]
    found, _ = read(tmp_path / "log.nmea", lines)
    assert len(found) == 30
    np.testing.assert_allclose(errors_s(found), 0.0, atol=0.01)


@pytest.mark.parametrize("mode", ["A", "E"])
def test_ths(tmp_path: Path, mode: str) -> None:
    lines = [line for s in SECONDS for line in (rmc(s), ths(float(bow_deg(s)), mode))]
    found, tally = read(tmp_path / "log.nmea", lines)
    np.testing.assert_allclose(errors_s(found), 0.0, atol=0.01)
    assert not tally.left_out


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (ths(0.0, "V"), "THS in mode V, not A or E"),
        (ths(12.0, "M"), "THS in mode M, not A or E"),
        (ths(12.0, "S"), "THS in mode S, not A or E"),
        (sentence("HETHS,,V"), "THS in mode V, not A or E"),
        (sentence("HETHS,12.0"), "THS in mode none, not A or E"),
        (sentence("HETHS,,A"), "THS without a heading"),
        (sentence("HETHS,north,A"), "THS with a heading that cannot be read"),
        (sentence("HETHS,nan,A"), "THS with a heading that cannot be read"),
        (sentence("HETHS,1e3,A"), "THS with a heading that cannot be read"),
        (sentence("HETHS,999.9,A"), "THS with a heading that cannot be read"),
        (ths(12.0)[:-2] + "00", "sentences with a heading with a wrong checksum"),
        (ths(12.0)[:-3], "sentences with a heading without a checksum"),
        (sentence("HCHDM,80.0,M"), "magnetic headings (HDM, and"),
        (sentence("HCHDG,80.0,,,,"), "magnetic headings (HDM, and"),
        (sentence("HCHDG,80.0,1.0,E,,"), "magnetic headings (HDM, and"),
        (sentence("HCHDG,80.0,1.0,,4.0,E"), "magnetic headings (HDM, and"),
        (sentence("HEHDT,80.0,M"), "magnetic headings (HDM, and"),
        (hdt(200.0), "headings of HEHDT, which HETHS gives as well"),
    ],
)
def test_headings_that_are_none(tmp_path: Path, bad: str, reason: str) -> None:
    lines = []
    for second in SECONDS:
        lines += [rmc(second), bad if second == 4 else ths(float(bow_deg(second)))]
    found, tally = read(tmp_path / "log.nmea", lines)
    assert len(found) == 29
    np.testing.assert_allclose(errors_s(found), 0.0, atol=0.01)
    (name,) = tally.left_out
    assert name.startswith(reason)
    assert tally.left_out[name].count == 1
    if not name.startswith("headings of"):
        assert tally.left_out[name].row == "line 10"


@pytest.mark.parametrize(
    ("deviation", "variation", "off_deg"),
    [
        ("1.5,E", "4.0,E", 5.5),
        ("1.5,W", "4.0,E", 2.5),
        ("0.0,E", "3.0,W", -3.0),
        (",", "4.0,E", 4.0),
    ],
)
def test_a_magnetic_heading_that_is_given_whole(
    tmp_path: Path, deviation: str, variation: str, off_deg: float
) -> None:
    """To obtain the true heading, easterly deviation and variation are added (NMEA 0183)."""
    lines = []
    for second in SECONDS:
        magnetic = (bow_deg(second) - off_deg) % 360.0
        lines += [rmc(second), sentence(f"HCHDG,{magnetic:.2f},{deviation},{variation}")]
    found, tally = read(tmp_path / "log.nmea", lines)
    np.testing.assert_allclose(errors_s(found), 0.0, atol=0.01)
    assert any("deviation" in note for note in tally.notes) == (deviation == ",")


@pytest.mark.parametrize("bad", [ths(0.0, "V"), sentence("HCHDG,80.0,,,,")])
def test_a_log_without_a_heading_that_can_be_used_says_so(
    tmp_path: Path, bad: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "log.nmea"
    path.write_text("\n".join(line for s in SECONDS for line in (rmc(s), bad)))
    with caplog.at_level(logging.WARNING):
        assert read_headings(path) is None
    said = [record.getMessage() for record in caplog.records]
    assert said[0].startswith(f"{path}: left out: 30 ")
    assert said[1].endswith("the course over ground is to do")


def table(tmp_path: Path, head: str, rows: Iterable[str]) -> Path:
    path = tmp_path / "log.csv"
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


@pytest.mark.parametrize("name", ["heading_deg", "true_heading", "heading_true"])
def test_headings_of_a_table(tmp_path: Path, name: str) -> None:
    rows = [
        f"{moment(s, '%Y-%m-%dT%H:%M:%SZ')},{north_deg(s):.7f},10.1394,"
        + ("" if s == 3 else f"{bow_deg(s):.2f}")
        for s in SECONDS
    ]
    found = read_headings(table(tmp_path, f"time_utc,latitude_deg,longitude_deg,{name}", rows))
    assert len(found) == 29
    np.testing.assert_allclose(errors_s(found), 0.0, atol=0.01)


def test_a_table_that_keeps_whole_seconds(tmp_path: Path) -> None:
    """Ten rows a second share its time, and stand for its tenths."""
    rows = [
        f"{moment(int(t), '%Y-%m-%dT%H:%M:%SZ')},{north_deg(t):.7f},10.1394,{bow_deg(t):.2f}"
        for t in np.arange(0.0, 20.0, 0.1) + 0.05
    ]
    found = read_headings(table(tmp_path, "time_utc,latitude_deg,longitude_deg,heading_deg", rows))
    assert len(found) == 200
    np.testing.assert_allclose(errors_s(found), 0.0, atol=0.01)


def test_errors_name_the_file(tmp_path: Path) -> None:
    rows = [f"{1.6e9 + s * 7 % 20:.0f},54.3,10.1,{10 + s}" for s in SECONDS]
    path = table(tmp_path, "time_utc,latitude_deg,longitude_deg,heading_deg", rows)
    with pytest.raises(InputError, match=r"log\.csv, line 5: .* is earlier than the fix before"):
        read_headings(path)


def test_headings_that_stand_the_newest_first(tmp_path: Path) -> None:
    rows = [f"{1.6e9 + s:.0f},54.3,10.1,{10 + s}" for s in SECONDS][::-1]
    path = table(tmp_path, "time_utc,latitude_deg,longitude_deg,heading_deg", rows)
    found = read_headings(path)
    np.testing.assert_allclose(found.time_utc_s - 1.6e9, SECONDS)
    np.testing.assert_allclose(found.heading_deg, 10.0 + np.array(SECONDS))
