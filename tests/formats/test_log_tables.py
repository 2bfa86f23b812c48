"""Logs as tables of loggers, telephones and spreadsheets."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.formats import read_clock, read_control_points, read_fixes
from sightline.tally import Tally

START_S = 1_717_236_000.0
N = 30
SECONDS = np.cumsum(np.tile([1.0, 0.9, 1.1], N // 3)) - 1.0
LATITUDE = 54.32 + np.round(2e-5 * np.arange(N), 7)
LONGITUDE = 10.13 + np.round(3e-5 * np.arange(N), 7)

Row = tuple[str, str, str]


def iso(second: float) -> str:
    moment = datetime.fromtimestamp(START_S + second, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def decimal(value: float) -> str:
    return f"{value:.9f}"


def minutes(value: float, letter: str) -> str:
    return f"{int(value)}°{(value - int(value)) * 60:.6f}'{letter}"


def packed(value: float) -> str:
    return f"{int(value) * 100 + (value - int(value)) * 60:.6f}"


def dms(value: float, letter: str) -> str:
    whole = int(value * 60)
    return f"{letter}{whole // 60}° {whole % 60}' {(value * 60 - whole) * 60:.5f}\""


def table(
    header: str = "time_utc,latitude_deg,longitude_deg",
    form: str = "{0},{1},{2}",
    *,
    places: bool = True,
    before: str = "",
    rows: list[Row] | None = None,
) -> str:
    if rows is None:
        rows = [
            (iso(second), decimal(latitude), decimal(longitude))
            for second, latitude, longitude in zip(SECONDS, LATITUDE, LONGITUDE, strict=True)
        ]
    return before + header + "\n" + "".join(form.format(*row) + "\n" for row in rows)


def rows_of(time: object, latitude: object, longitude: object) -> list[Row]:
    return [
        (time(second), latitude(north), longitude(east))  # type: ignore[operator]
        for second, north, east in zip(SECONDS, LATITUDE, LONGITUDE, strict=True)
    ]


def german(text: str) -> str:
    return text.replace(".", ",")


def on(form: str) -> object:
    def written(second: float) -> str:
        moment = datetime.fromtimestamp(START_S + second, UTC)
        return moment.strftime(form)[: -3 if form.endswith("%f") else None]

    return written


def ublox(second: float) -> str:
    """NAV-PVT rounds to the nearest second, and the rest may be below zero."""
    whole = round(second)
    moment = datetime.fromtimestamp(START_S + whole, UTC).strftime("%Y,%m,%d,%H,%M,%S")
    return f"{moment},{round((second - whole) * 1e9)}"


GERMAN = rows_of(iso, lambda value: german(decimal(value)), lambda value: german(decimal(value)))
TEXTS = {
    "plain": table(),
    "upper case": table("TIME_UTC,LATITUDE_DEG,LONGITUDE_DEG"),
    "other names": table("Timestamp,Lat,Lng"),
    "names with units": table('"Time (UTC)",Latitude [deg],Longitude (°)'),
    "other columns between": table("id,time,speed,lat,lon,alt", "7,{0},3.1,{1},{2},12"),
    "semicolons": table("time_utc;latitude_deg;longitude_deg", "{0};{1};{2}"),
    "tabs": table("time\tlatitude\tlongitude", "{0}\t{1}\t{2}"),
    "blanks": table("time latitude longitude", "{0}  {1} {2}"),
    "bars": table("time|latitude|longitude", "{0}|{1}|{2}"),
    "decimal commas": table(
        "time;lat;lon",
        "{0};{1};{2}",
        rows=rows_of(
            lambda second: german(iso(second)),
            lambda value: german(decimal(value)),
            lambda value: german(decimal(value)),
        ),
    ),
    "quoted": table('"time_utc","latitude_deg","longitude_deg"', '"{0}","{1}","{2}"'),
    "quoted decimal commas": table(
        "time,lat,lon",
        '{0},"{1}","{2}"',
        rows=rows_of(iso, lambda v: german(decimal(v)), lambda v: german(decimal(v))),
    ),
    "comments": table(before="# logger 1.0\n\n// unit 7\n"),
    "a preamble": table("time,lat,lon", before="Boat tracker\nunit;7\nexported,today\n"),
    "what Excel begins with": table("time;lat;lon", "{0};{1};{2}", before="sep=;\n"),
    "a header in the middle": table().replace(iso(SECONDS[9]), "HERE").replace(
        "HERE", "time_utc,latitude_deg,longitude_deg\n" + iso(SECONDS[9])
    ),
    "trailing separators": table(form="{0},{1},{2},"),
    "blank lines": table(form="{0},{1},{2}\n"),
    "blanks around": table(form=" {0} , {1} , {2} "),
    "date and time": table("date,time,lat,lon", "{0},{1},{2}").replace("T", ","),
    "packed date and time": table(
        "Date,Time,Latitude,Longitude",
        rows=rows_of(on("%Y%m%d,%H%M%S.%f"), decimal, decimal),
    ),
    "hemispheres in columns": table(
        "time,latitude,N/S,longitude,E/W", "{0},{1},N,{2},E"
    ),
    "hemispheres as letters": table("time,LATITUDE N/S,LONGITUDE E/W", "{0},{1}N,{2}E"),
    "degrees and minutes": table(
        rows=rows_of(iso, lambda v: minutes(v, "N"), lambda v: minutes(v, "E"))
    ),
    "degrees, minutes and seconds": table(
        "time\tlat\tlon",
        "{0}\t{1}\t{2}",
        rows=rows_of(iso, lambda v: dms(v, "N"), lambda v: dms(v, "E")),
    ),
    "10^7": table(rows=rows_of(iso, lambda v: f"{v * 1e7:.0f}", lambda v: f"{v * 1e7:.0f}")),
    "named 10^7": table(
        "timestampMs,latitudeE7,longitudeE7",
        rows=rows_of(
            lambda s: f"{(START_S + s) * 1000:.0f}",
            lambda v: f"{v * 1e7:.0f}",
            lambda v: f"{v * 1e7:.0f}",
        ),
    ),
    "POSIX seconds": table(rows=rows_of(lambda s: f"{START_S + s:.3f}", decimal, decimal)),
    "POSIX milliseconds": table(
        rows=rows_of(lambda s: f"{(START_S + s) * 1e3:.0f}", decimal, decimal)
    ),
    "POSIX nanoseconds": table(
        rows=rows_of(lambda s: f"{round((START_S + s) * 1e3)}000000", decimal, decimal)
    ),
    "scientific": table(
        rows=rows_of(lambda s: f"{START_S + s:.12e}", lambda v: f"{v:.9e}", lambda v: f"{v:.9e}")
    ),
    "days of a spreadsheet": table(
        rows=rows_of(lambda s: f"{45444 + (36000 + s) / 86400:.9f}", decimal, decimal)
    ),
    "points and the day first": table(rows=rows_of(on("%d.%m.%Y %H:%M:%S.%f"), decimal, decimal)),
    "zones": table(rows=rows_of(lambda s: iso(s + 7200).replace("Z", "+02:00"), decimal, decimal)),
    "Go": table(
        rows=rows_of(
            lambda s: iso(s).replace("T", " ").replace("Z", "000000 +0000 UTC"), decimal, decimal
        )
    ),
    "a header behind a mark": table("# time,lat,lon"),
    "a header behind marks and words": table(
        "#time\tlat\tlon", "{0}\t{1}\t{2}", before="# unit 7\n"
    ),
    "OwnTracks": table(
        "tst,lat,lon,acc",
        "{0},{1},{2},5",
        rows=rows_of(lambda s: f"{START_S + s:.3f}", decimal, decimal),
    ),
    "BaseDateTime": table("BaseDateTime,LAT,LON,SOG,COG", "{0},{1},{2},6.1,17"),
    "degrees and minutes as NMEA has them": table(
        "time,lat,N/S,lon,E/W", "{0},{1},N,{2},E", rows=rows_of(iso, packed, packed)
    ),
    "degrees and minutes with directions": table(
        "time,lat,lat_dir,lon,lon_dir", "{0},{1},N,{2},E", rows=rows_of(iso, packed, packed)
    ),
    "degrees and minutes with letters": table(
        "utc;latitude;longitude", "{0};{1}N;{2}E", rows=rows_of(iso, packed, packed)
    ),
    "degrees and minutes by name": table(
        "time,lat (ddmm.mmmm),lon (dddmm.mmmm)", rows=rows_of(iso, packed, packed)
    ),
    "newest first": "\n".join(
        [table().splitlines()[0], *reversed(table().splitlines()[1:])]
    ),
    "each row twice": table(form="{0},{1},{2}\n{0},{1},{2}"),
    "rows without a fix": table(form="{0},{1},{2}\n{0},nan,nan\n{0},,\n{0},0,0\n{0},-,null"),
    "cut short": table() + "2024-06-01T10:0",
    "a header over two lines": table('"Time\n(UTC)","Latitude\n(deg)","Longitude\n(deg)"'),
    "a header over three lines": table(
        '"Time";"Latitude\n\n[deg]";"Longitude\n[deg]"', "{0};{1};{2}", before="unit 7\n"
    ),
    "German": table("Zeit;Breite;Länge", "{0};{1};{2}", rows=GERMAN),
    "German in two columns": table(
        "Datum;Uhrzeit;Geogr. Breite;Geogr. Länge", "{0};{1};{2}", rows=rows_of(
            on("%d.%m.%Y;%H:%M:%S,%f"), lambda v: german(decimal(v)), lambda v: german(decimal(v))
        ),
    ),
    "French": table(
        "Horodatage;Latitude;Longitude", "{0};{1};{2}", rows=rows_of(
            on("%d/%m/%Y %H:%M:%S.%f"), lambda v: german(decimal(v)), lambda v: german(decimal(v))
        ),
    ),
    "Spanish": table(
        "Fecha;Hora;Latitud;Longitud", "{0};{1};{2}", rows=rows_of(
            on("%d/%m/%Y;%H:%M:%S.%f"), lambda v: german(decimal(v)), lambda v: german(decimal(v))
        ),
    ),
    "Italian": table("Data e ora,Latitudine,Longitudine"),
    "Dutch": table("Tijdstip,Breedtegraad,Lengtegraad"),
    "parts of a time": table(
        "year,month,day,hour,min,sec,lat,lon",
        rows=rows_of(on("%Y,%m,%d,%H,%M,%S.%f"), decimal, decimal),
    ),
    "parts of a u-blox": table(
        "iTOW,year,month,day,hour,min,sec,nano,lon,lat", "1,{0},{2},{1}",
        rows=rows_of(ublox, lambda v: f"{v * 1e7:.0f}", lambda v: f"{v * 1e7:.0f}"),
    ),
    "parts of a date": table(
        "Year,Month,Day,Time,Lat,Lon", rows=rows_of(on("%Y,%m,%d,%H:%M:%S.%f"), decimal, decimal)
    ),
    "text of a spreadsheet": table("time,lat,lon", "'{0},'{1},'{2}"),
    "text as a formula": table("time,lat,lon", '="{0}",="{1}",="{2}"'),
    "single quotes": table("'time','lat','lon'", "'{0}','{1}','{2}'"),
    "names within names": table("nr,field.time,field.latitude,field.longitude", "7,{0},{1},{2}"),
    "RTKLIB": table(
        "%  UTC                  latitude(deg) longitude(deg)  height(m)   Q  ns",
        "{0}   {1}   {2}   12.0   5   8",
        before="% program   : RTKLIB ver.2.4.2\n",
        rows=rows_of(on("%Y/%m/%d %H:%M:%S.%f"), decimal, decimal),
    ),
    "times of a flight and of the day": table(
        "time(millisecond),datetime(utc),latitude,longitude", "100,{0},{1},{2}"
    ),
    "GoPro": table(
        '"cts","date","GPS (Lat.) [deg]","GPS (Long.) [deg]","GPS (Alt.) [m]"', "1,{0},{1},{2},3"
    ),
}  # fmt: skip


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le"])
@pytest.mark.parametrize("name", TEXTS)
def test_tables_of_other_programs(tmp_path: Path, name: str, encoding: str) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(TEXTS[name].replace("\n", "\r\n").encode(encoding))
    fixes = read_fixes(path)
    np.testing.assert_allclose(fixes.time_utc_s - START_S, SECONDS, rtol=0, atol=1e-4)
    np.testing.assert_allclose(fixes.latitude_deg, LATITUDE, rtol=0, atol=1e-7)
    np.testing.assert_allclose(fixes.longitude_deg, LONGITUDE, rtol=0, atol=1e-7)


def test_south_and_west(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    when = "2024-06-01T10:00:00Z"
    for header, cells in (
        ("time,latitude,N/S,longitude,E/W", f"{when},33.5,S,70.25,W"),
        ("time,lat,lon", f"{when},33.5 S,W 70.25"),
        ("time,lat,lon", f"{when},33° 30.0' S,70° 15' 0.0\" W"),
        ("time,lat,lon", f"{when},-33.5,-70.25"),
        ("time,lat,lon", f"{when},\N{MINUS SIGN}33.5,\N{MINUS SIGN}70.25"),
        ("time,lat,lon", f"{when},-33 30.0,-70 15.0"),
        ("time,lat,lon", f"{when},-335000000,-702500000"),
        ("time,lat,lon", f"{when},-33.5,289.75"),
        ("time,lat,N/S,lon,E/W", f"{when},3330.000,S,07015.000,W"),
        ("time,lat,lon", f"{when},3330S,7015W"),
        ("time,lat_ddmm,lon_ddmm", f"{when},-3330.000,-7015.000"),
    ):
        path.write_text(f"{header}\n{cells}\n".replace('"', ""), encoding="utf-8")
        fixes = read_fixes(path)
        assert fixes.latitude_deg[0] == pytest.approx(-33.5, abs=1e-9), cells
        assert fixes.longitude_deg[0] == pytest.approx(-70.25, abs=1e-9), cells


def test_degrees_and_minutes_near_zero(tmp_path: Path) -> None:
    """Without its zeros nothing tells 0030.0 from thirty degrees."""
    path = tmp_path / "log.csv"
    path.write_text("time,lat,ns,lon,ew\n2024-06-01T10:00:00Z,0030.0,N,00115.0,W\n")
    fixes = read_fixes(path)
    assert fixes.latitude_deg[0] == pytest.approx(0.5, abs=1e-12)
    assert fixes.longitude_deg[0] == pytest.approx(-1.25, abs=1e-12)
    path.write_text("time,lat,ns,lon,ew\n2024-06-01T10:00:00Z,54.5,N,10.25,W\n")
    fixes = read_fixes(path)
    assert (fixes.latitude_deg[0], fixes.longitude_deg[0]) == (54.5, -10.25)


def test_minutes_that_cannot_be_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rows = [
        (iso(s), packed(v), packed(w)) for s, v, w in zip(SECONDS, LATITUDE, LONGITUDE, strict=True)
    ]
    rows[4] = (rows[4][0], "5479.0", rows[4][2])
    path.write_text(table("time,lat,ns,lon,ew", "{0},{1},N,{2},E", rows=rows))
    tally = Tally(path)
    assert len(read_fixes(path, tally=tally)) == N - 1
    assert tally.left_out["with a place that is not on the earth"].row == "line 6"
    assert "degrees and minutes" in "".join(tally.notes)


def test_a_table_needs_no_suffix(tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    path.write_text(TEXTS["tabs"])
    assert len(read_fixes(path)) == N


def test_names_in_latin_1(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes("time,lat (°),lon (°),name\n1717236000,54.3,10.1,Möwe\n".encode("cp1252"))
    assert read_fixes(path).latitude_deg.tolist() == [54.3]


def test_what_is_left_out_of_a_table_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    lines = table().splitlines()
    lines[5] = f"{iso(SECONDS[4])},NaN,NaN"
    lines[7] = f"{iso(SECONDS[6])},,"
    lines[9] = f"{iso(SECONDS[8])},0.0,0.0"
    path.write_text("\n".join([*lines, "2024-06-0"]))
    tally = Tally(path)
    assert len(read_fixes(path, tally=tally)) == N - 3
    assert tally.format == "CSV"
    assert tally.read == {"rows": N + 1, "fixes": N - 3}
    assert tally.left_out["without a place"].count == 2
    assert tally.left_out["without a place"].row == "line 6"
    assert tally.left_out["cut short"].row == f"line {N + 2}"
    assert "1 at 0° north" in tally.reasons()


HEAD = "time_utc,latitude_deg,longitude_deg\n"
WHEN = "2024-06-01T10:00:00Z"
FLOATS = "".join(
    f"{np.float32(START_S + second):.1f},{54.3 + second * 1e-5},10.1\n" for second in range(300)
)
MINUTES = "".join(
    f"2024-06-01 10:0{i // 10},{latitude},10.1\n" for i, latitude in enumerate(LATITUDE)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,timestamp,lat,lon\n", "columns time and timestamp may both be its time; call the"),
        ("time,lat,latitude,lon\n", "columns lat and latitude may both be its latitude"),
        ("time,position\n", "found time, position; if position holds both, make two columns of it"),
        ("time,easting,northing\n", "easting is of a grid in metres: write degrees"),
        (f"{WHEN},54.3,10.1\n", "is its first line a header"),
        ("GPST,latitude,longitude\n", "are those of GPS, whole seconds ahead of UTC"),
        ("year,month,day,lat,lon\n", "none of the hour, the minute and the second"),
        ("field.local_time,lat,lon\n", "its only time is field.local_time, which names no zone"),
        ("Ortszeit;Breite;Länge\n", "its only time is Ortszeit, which names no zone"),
        ("when,lat,lon\n", "lacks the column time_utc; found when, lat, lon"),
        ("local time,lat,lon\n", "its only time is local time, which names no zone"),
        ("time,lat_rad,lon_rad\n1,0.9,0.1\n", "lacks the columns latitude_deg, longitude_deg"),
        (f"time,lat (rad),lon (rad)\n{WHEN},0.9,0.1\n", "column lat .rad. is in radians"),
        (f"time,lat,lon\n{WHEN},54.3,10.1\n10:00:01,54.3,10.1\n", "line 3: 10:00:01 has no date"),
        ("date,lat,lon\n2024-06-01,54.3,10.1\n", "line 2: 2024-06-01 has no time of day .date."),
        (f"time,lat,lon\n{WHEN},54,3,10,1\n", "line 2: its rows have more cells than its header"),
        (f"time,lat,lon\n{WHEN},north,10.1\n", r"line 2: north is no number \(lat\)"),
        (f"time,lat,lon\n{WHEN},54.3 E,10.1\n", r"line 2: 54\.3 E is no number \(lat\)"),
        (f"time,lat,lon\n{WHEN},54 61.0 N,10 1.0 E\n", r"line 2: 54 61\.0 N is no number"),
        (f"time,lat,lon\n{WHEN},5419.367,1008.354\n", r"line 2: latitude 5419\.37, longitude 1008"),
        (f"time,lat,lon\n{WHEN},54322782,10139230\n", r"may be in degrees × 10\^7 or degrees × 10"),
        (f"time,lat,lon\n{WHEN},54.3,1{'0' * 400}\n", r"line 2: 1000.*\.\.\. is no number \(lon\)"),
        (f"time,lat,lon\n{WHEN},1{'0' * 5000},1\n", r"line 2: 1000.*\.\.\. is no number \(lat\)"),
        (HEAD + f"1{'0' * 400},1,2\n", "line 2: 1000.* is no time"),
        (HEAD + FLOATS, r"line .*: 17172\d+\.0 is the time of 1\d\d different places"),
        (
            HEAD + MINUTES,
            r"line 2: 2024-06-01 10:00 is the time of 10 different places; the times were",
        ),
        (HEAD + f"{WHEN},nan,nan\n", "holds no fix; left out: 1 without a place .line 2: nan, nan"),
        (HEAD + f"{WHEN},0,0\n{WHEN},0,0\n", "no more than 0 of its 2 fixes can be true"),
        (HEAD + f'"{WHEN},54.3,10.1\n', "line 2: is no row of a table"),
        (HEAD + f"{WHEN},{'9' * 200_000},1\n", "field larger than field limit"),
    ],
)
def test_tables_that_are_refused_by_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message) as caught:
        read_fixes(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 700


def test_clocks_and_points_in_other_dialects(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    text = "# made by hand\nframe;utc\n0;1717236000,25\n1;1717236000,5\n2;1717236000,75\n"
    for encoding in ("utf-8-sig", "utf-16"):
        path.write_bytes(text.encode(encoding))
        np.testing.assert_allclose(read_clock(path).knot_utc_s - START_S, [0.25, 0.5, 0.75])
    path.write_text(text + "x;1717236001\n")
    with pytest.raises(InputError, match=r"line 6: x is no number \(frame\)"):
        read_clock(path)
    path.write_text("x_px\ty_px\tlatitude_deg\tlongitude_deg\n1.5\t2\t54.3\t10.1\n")
    np.testing.assert_array_equal(read_control_points(path).pixel_px, [[1.5, 2.0]])


UTM = (
    '"{}": {{"x_px": {}, "y_px": 2, "hemisphere": "N", "zone_utm": 32, '
    '"lon_utm": {}, "lat_utm": 5673186.1}}'
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"1":' + "[" * 100_000, "is damaged or cut short"),
        ("{" + UTM.format(1, "1" + "0" * 400, 844098.0) + "}", "point 1 is incomplete"),
        ("{" + UTM.format(1, "1" + "0" * 5000, 844098.0) + "}", "is damaged"),
        ("{" + UTM.format(1, 5, "NaN") + "}", "point 1 is incomplete"),
        ("{" + UTM.format(1, 5, 844098.0).replace("32", "NaN") + "}", "point 1 is incomplete"),
        ("{" + UTM.format(1, 5, 844098.0).replace("32", "32.5") + "}", "point 1 is incomplete"),
        # A point lost before the last three digits of an easting.
        (
            "{" + ",".join(UTM.format(i, i, 844090.0 + i) for i in range(3))
            + "," + UTM.format("mole", 9, 84408.005) + "}",
            "point mole lies 7.. km from the others",
        ),
    ],
)  # fmt: skip
def test_control_points_that_cannot_be(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "points.otrfpts"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_control_points(path)
    assert "\n" not in str(caught.value)


def at_zone(hours: float) -> list[Row]:
    return [
        (iso(second + hours * 3600.0)[:-1], decimal(latitude), decimal(longitude))
        for second, latitude, longitude in zip(SECONDS, LATITUDE, LONGITUDE, strict=True)
    ]


def read_text(path: Path, text: str) -> tuple[np.ndarray, Tally]:
    path.write_text(text, encoding="utf-8")
    tally = Tally(path)
    return read_fixes(path, tally=tally).time_utc_s - START_S, tally


@pytest.mark.parametrize(
    ("header", "hours"),
    [
        ("Time (UTC+2)", 2.0),
        ("time [GMT-05:00]", -5.0),
        ("datetime(+0530)", 5.5),
        ("timestamp (UTC)", 0.0),
        ("Time (GMT+0)", 0.0),
    ],
)
def test_the_zone_of_a_column_may_stand_in_its_name(
    tmp_path: Path, header: str, hours: float
) -> None:
    text = table(f"{header},lat,lon", rows=at_zone(hours))
    found_s, tally = read_text(tmp_path / "log.csv", text)
    np.testing.assert_allclose(found_s, SECONDS, rtol=0, atol=1e-3)
    assert not any("name no zone" in note for note in tally.notes)
    assert (hours != 0.0) == any("taken for those of UTC" in note for note in tally.notes)


@pytest.mark.parametrize("time", ["{}Z", "{}+00:00", "{} UTC"])
def test_a_time_that_names_its_zone_goes_before_the_name_of_its_column(
    tmp_path: Path, time: str
) -> None:
    rows = [(time.format(when), *place) for when, *place in at_zone(0.0)]
    found_s, _ = read_text(tmp_path / "log.csv", table("Time (UTC+2),lat,lon", rows=rows))
    np.testing.assert_allclose(found_s, SECONDS, rtol=0, atol=1e-3)


@pytest.mark.parametrize("zone", ["+02:00", "UTC+2", "+0200"])
def test_the_zone_of_a_row_may_stand_beside_its_time(tmp_path: Path, zone: str) -> None:
    text = table("time,tz,lat,lon", f"{{0}},{zone},{{1}},{{2}}", rows=at_zone(2.0))
    found_s, _ = read_text(tmp_path / "log.csv", text)
    np.testing.assert_allclose(found_s, SECONDS, rtol=0, atol=1e-3)


@pytest.mark.parametrize("header", ["time (Europe/Berlin)", "time [CEST]", "time (local time)"])
def test_a_zone_that_is_no_number_of_hours_is_refused(tmp_path: Path, header: str) -> None:
    with pytest.raises(InputError, match="write it as UTC"):
        read_text(tmp_path / "log.csv", table(f"{header},lat,lon", rows=at_zone(2.0)))


def test_numbers_of_gps_are_no_posix_seconds(tmp_path: Path) -> None:
    """GPS is 315,964,782 s behind, so that 2024 would be 2014."""
    rows = [(f"{START_S - 315_964_782.0 + s:.3f}", "54.3", "10.1") for s in SECONDS]
    with pytest.raises(InputError, match="GPS counts from 1980"):
        read_text(tmp_path / "log.csv", table("gps time,lat,lon", rows=rows))


def test_a_second_device_in_a_table_is_not_mixed_in(tmp_path: Path) -> None:
    rows = table("device,time,lat,lon", "A,{0},{1},{2}").splitlines()
    others = [
        ("B", iso(second), decimal(latitude + 0.001), decimal(longitude))
        for second, latitude, longitude in zip(SECONDS, LATITUDE, LONGITUDE, strict=True)
    ]
    lines = [rows[0]]
    for own, other in zip(rows[1:], others, strict=True):
        lines += [own, ",".join(other)]
    path = tmp_path / "log.csv"
    found_s, tally = read_text(path, "\n".join(lines))
    np.testing.assert_allclose(found_s, SECONDS, rtol=0, atol=1e-3)
    assert tally.left_out["of another receiver"].count == N
    assert any("two receivers" in note for note in tally.notes)


def test_a_mark_of_utf8_before_json_is_no_part_of_it(tmp_path: Path) -> None:
    rows = [
        f'{{"time": "{iso(second)}", "lat": {latitude}, "lon": {longitude}}}\n'
        for second, latitude, longitude in zip(SECONDS, LATITUDE, LONGITUDE, strict=True)
    ]
    found_s, tally = read_text(tmp_path / "log.jsonl", "\ufeff" + "".join(rows))
    np.testing.assert_allclose(found_s, SECONDS, rtol=0, atol=1e-3)
    assert not tally.left_out
