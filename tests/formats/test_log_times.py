"""Times of logs in the forms in which loggers, spreadsheets and languages write them."""

from __future__ import annotations

from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.errors import InputError
from sightline.formats import read_clock, read_fixes, read_water_levels
from sightline.formats._times import NotUnderstoodError, read_times
from sightline.tally import Tally

TEN_S = 1_717_236_000  # 2024-06-01T10:00:00Z, by `date -d`.

SAME = [
    "2024-06-01T10:00:00.204Z",
    "  2024-06-01T10:00:00.204Z\n  ",
    "2024-06-01T10:00:00,204Z",
    "2024-06-01t10:00:00.204z",
    "2024-06-01 10:00:00.204",
    "2024-06-01_10:00:00.204Z",
    "2024-06-01 10:00:00.204 Z",
    "2024/06/01 10:00:00.204",
    "2024.06.01 10:00:00.204",
    "2024-6-1T10:00:00.204Z",
    "2024-06-01T10:00:00:204Z",
    "2024-06-01T10:00:00.204000Z",
    "2024-06-01T10:00:00.2040000Z",
    "2024-06-01T10:00:00.204000000Z",
    "2024-06-01T10:00:00.204000000000Z",
    "2024-06-01T12:00:00.204+02:00",
    "2024-06-01T12:00:00.204+0200",
    "2024-06-01T12:00:00.204+02",
    "2024-06-01T12:00:00.204 +02:00",
    "2024-06-01T03:00:00.204-0700",
    "2024-06-01T03:00:00.204\N{MINUS SIGN}07:00",
    "2024-06-01T15:30:00.204+05:30",
    "2024-06-01T15:45:00.204+05:45",
    "2024-06-02T00:00:00.204+14:00",
    "2024-06-01T10:00:00.204 UTC",
    "2024-06-01T10:00:00.204GMT",
    "2024-06-01T12:00:00.204 UTC+2",
    "2024-06-01T12:00:00.204+02:00[Europe/Berlin]",
    "2024-06-01 10:00:00.204 +0000 UTC",
    "2024-06-01 12:00:00.204 +0200 CEST m=+0.012345",
    "20240601T100000.204Z",
    "20240601100000.204",
    "Sat, 01 Jun 2024 10:00:00.204 GMT",
    "01-Jun-2024 10:00:00.204",
    "1 June 2024, 10:00:00.204",
    "Sat Jun  1 10:00:00.204 2024",
    "Jun 1, 2024 10:00:00.204 AM",
    "01.06.2024 10:00:00.204",
    "1.6.2024 10:00:00,204",
    "1717236000.204",
    "1717236000,204",
    "1.717236000204e9",
    "1717236000204",
    "1717236000204000",
    "1717236000204000000",
]


@pytest.mark.parametrize("text", SAME)
def test_one_moment_in_many_forms(text: str) -> None:
    (seconds,) = read_times([text]).time_utc_s
    # Exact to the microsecond, as far as float64 has it.
    assert abs(Fraction(seconds) - TEN_S - Fraction(204, 1000)) < Fraction(1, 2_000_000)


@given(st.datetimes(datetime(1990, 1, 1), datetime(2100, 1, 1)))
def test_forms_agree_with_the_calendar_of_python(moment: datetime) -> None:
    wanted = moment.replace(tzinfo=UTC).timestamp()
    forms = (
        "%Y-%m-%dT%H:%M:%S.%fZ",
        "%Y/%m/%d %I:%M:%S.%f %p",
        "%d.%m.%Y %H:%M:%S,%f",
        "%d %b %Y %H:%M:%S.%f +0000",
        "%a %b %d %H:%M:%S.%f %Y",
        "%Y%m%dT%H%M%S.%fZ",
    )
    for form in forms:
        (seconds,) = read_times([moment.strftime(form)]).time_utc_s
        assert abs(seconds - wanted) < 1e-6, form


def test_whole_seconds_and_fractions_may_be_mixed() -> None:
    texts = ["2024-06-01 10:00:00", "2024-06-01 10:00:01.378", "2024-06-01T10:00:02Z", ""]
    read = read_times(texts)
    np.testing.assert_allclose(read.time_utc_s - TEN_S, [0.0, 1.378, 2.0, np.nan], atol=1e-6)
    assert read.zoneless
    assert not read_times(["2024-06-01T10:00:00Z", "2024-06-01T12:00:00+0200"]).zoneless


@pytest.mark.parametrize(
    ("texts", "seconds"),
    [
        # The thirteenth can only be a day.
        (["01/06/2024 10:00:00", "13/06/2024 10:00:00"], [0, 12 * 86400]),
        (["06/01/2024 10:00:00 AM", "06/13/2024 12:00:00 AM"], [0, 12 * 86400 - 36000]),
        (["06/01/2024 12:00:00 PM", "06/13/2024 12:00:01 pm"], [7200, 12 * 86400 + 7201]),
        # Either way the same.
        (["06/06/2024 10:00:00"], [5 * 86400]),
    ],
)
def test_a_column_tells_whether_the_day_comes_first(texts: list[str], seconds: list[int]) -> None:
    np.testing.assert_array_equal(read_times(texts).time_utc_s - TEN_S, seconds)


def test_day_numbers_of_spreadsheets() -> None:
    # 2024-06-01 is day 45444 (Microsoft's own table of DATEVALUE).
    texts = ["45444.416666667", "45444.416678241", "45444.416689815"]
    read = read_times(texts)
    np.testing.assert_allclose(read.time_utc_s - TEN_S, [0.0, 1.0, 2.0], atol=1e-4)
    assert "spreadsheet" in read.assumed[0]


def test_a_leap_second_is_the_one_after_it() -> None:
    leap, after = read_times(["2016-12-31T23:59:60.5Z", "2017-01-01T00:00:00.5Z"]).time_utc_s
    assert leap == after == datetime(2017, 1, 1, tzinfo=UTC).timestamp() + 0.5


@pytest.mark.parametrize(
    ("texts", "row", "why"),
    [
        (["soon"], 0, "is no time; expected ISO 8601"),
        (["2024-06-01T10:00:00Z", "2024-13-01T10:00:00Z"], 1, "is no time"),
        (["2024-02-30T10:00:00Z"], 0, "is no time"),
        (["2024-06-01T25:00:00Z"], 0, "no such time of day"),
        (["2024-06-01T10:60:00Z"], 0, "is no time"),
        (["2024-06-01T10:00:00+25:00"], 0, "is no time"),
        (["2024-06-01 13:00:00 PM"], 0, "there is no hour 13"),
        (["06/01/2024 09:59:58 AM", "06/01/2024 10:00:00 AM"], 0, "day first or the month"),
        (["13/06/2024 10:00:00", "06/13/2024 10:00:00"], 1, "in another order than others"),
        (["01/06/24 10:00:00"], 0, "a year of two digits"),
        (["10:00:00.204"], 0, "has no date"),
        (["2024-06-01T10:00:00 CEST"], 0, "names the zone CEST"),
        (["35998.000", "35999.186", "36000.204"], 0, "has no date"),
        (["0.0", "1.0"], 0, "has no date"),
        # Apple counts from 2001; .NET in 100 ns from the year 1; Windows from 1601.
        (["738928800"], 0, "has no date"),
        (["638528328000000000"], 0, "is no time"),
        (["133617204000000000"], 0, "is no time"),
        (["1717236000", "1717236001000"], 1, "is no time in POSIX seconds"),
        (["1e300"], 0, "is no time"),
        (["-1717236000"], 0, "is no time"),
        (["9" * 5000], 0, "is no time"),
        (["0000-01-01T00:00:00Z"], 0, "is no time"),
        (["9999-12-31T23:59:59Z"], 0, "is no time"),
        (["nan"], 0, "is no time"),
    ],
)
def test_texts_that_are_no_time(texts: list[str], row: int, why: str) -> None:
    with pytest.raises(NotUnderstoodError, match=why) as caught:
        read_times(texts)
    assert caught.value.row == row


@given(st.text(max_size=40))
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        (seconds,) = read_times([text]).time_utc_s
    except NotUnderstoodError:
        return
    assert np.isfinite(seconds) == bool(text.split())


GPX = '<gpx version="1.1"><trk><trkseg>{}</trkseg></trk></gpx>'
POINT = '<trkpt lat="54.3" lon="{}"><time>{}</time></trkpt>'


@pytest.mark.parametrize("text", SAME)
@pytest.mark.parametrize("kind", ["gpx", "csv", "clock", "water"])
def test_tables_and_xml_read_the_same_times(tmp_path: Path, text: str, kind: str) -> None:
    path = tmp_path / f"log.{'gpx' if kind == 'gpx' else 'csv'}"
    if kind == "gpx":
        path.write_text(GPX.format(POINT.format("10.1", text)), encoding="utf-8")
        times = read_fixes(path).time_utc_s
    elif kind == "csv":
        path.write_text(f'time_utc,latitude_deg,longitude_deg\n"{text}",54.3,10.1\n', "utf-8")
        times = read_fixes(path).time_utc_s
    elif kind == "clock":
        path.write_text(f'frame,utc\n0,"{text}"\n', encoding="utf-8")
        times = read_clock(path).knot_utc_s
    else:
        rows = f'"{text}",1\n2024-06-02T10:00:00Z,2\n'
        path.write_text(f"time_utc,water_level_m\n{rows}", encoding="utf-8")
        times = read_water_levels(path).time_utc_s[:1]
    np.testing.assert_allclose(times, [TEN_S + 0.204], rtol=0, atol=1e-6)


def test_a_time_of_gpx_that_is_not_understood_is_shown(tmp_path: Path) -> None:
    path = tmp_path / "log.gpx"
    points = POINT.format(1, "2024-06-01T10:00:00Z") + POINT.format(2, "gestern um zehn")
    path.write_text(GPX.format(points))
    with pytest.raises(InputError, match=r"log\.gpx, point 2: gestern um zehn is no time"):
        read_fixes(path)


def test_what_was_assumed_of_times_is_noted(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("time,lat,lon\n13.06.2024 10:00:00,54.3,10.1\n")
    tally = Tally(path)
    read_fixes(path, tally=tally)
    assert tally.notes == [
        "its dates are read day first",
        "its times name no zone and are taken for UTC",
    ]
