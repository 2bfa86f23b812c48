"""One wrong row of a log says nothing of the others, in whatever format it stands."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from functools import reduce
from operator import xor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.formats import read_fixes, read_headings
from sightline.tally import Tally
from sightline.types import Fixes

START_S = 1_717_236_000.0
N = 40


class Row(NamedTuple):
    """A fix as text."""

    time: str
    latitude: str
    longitude: str


def stamp(second: float) -> str:
    moment = datetime.fromtimestamp(START_S + second, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def north_deg(second: float | np.ndarray) -> np.ndarray:
    """It goes north at 3 m/s."""
    return np.asarray(54.32 + 2.7e-5 * np.asarray(second))


def rows() -> list[Row]:
    return [Row(stamp(i), f"{north_deg(i):.7f}", "10.13") for i in range(N)]


def csv(log: list[Row]) -> str:
    return "time,lat,lon\n" + "".join(",".join(row) + "\n" for row in log)


def newest_first(log: list[Row]) -> str:
    return csv(log[::-1])


def posix(log: list[Row]) -> str:
    """Numbers, where a time is one."""

    def number(text: str) -> str:
        try:
            return f"{datetime.fromisoformat(text).timestamp():.3f}"
        except ValueError:
            return text

    return csv([row._replace(time=number(row.time)) for row in log])


def gpx(log: list[Row]) -> str:
    points = "".join(
        f'<trkpt lat="{row.latitude}" lon="{row.longitude}"><time>{row.time}</time></trkpt>'
        for row in log
    )
    return f'<gpx version="1.1"><trk><trkseg>{points}</trkseg></trk></gpx>'


FORMS: dict[str, Callable[[list[Row]], str]] = {
    "log.csv": csv,
    "reversed.csv": newest_first,
    "posix.csv": posix,
    "log.gpx": gpx,
}
WRONG = {
    "a year too late": (Row(stamp(0).replace("2024", "2080"), "54.32", "10.13"), "is years from"),
    "1970": (Row("1970-01-01T00:00:17.000Z", "54.32", "10.13"), "is years from the others"),
    "the week before": (
        Row("2024-05-25T10:00:17.000Z", "54.32", "10.13"),
        "is not between those before and after",
    ),
    "no time": (Row("", "54.32", "10.13"), "without a time"),
    "no such day": (Row("2024-06-31T10:00:00Z", "54.32", "10.13"), "a time that cannot be read"),
    "noise": (Row("2024-0@", "54.32", "10.13"), "with a time that cannot be read"),
    "zero": (Row("0", "54.32", "10.13"), "with a time that cannot be read"),
    "off the earth": (Row(stamp(17.5), "95.0", "10.13"), "a place that is not on the earth"),
    "far off the earth": (Row(stamp(17.5), "54.3", "3600.5"), "a place that is not on the earth"),
    "no place": (Row(stamp(17.5), "", ""), "without a place"),
    "no such place": (Row(stamp(17.5), "5x.1", "10.13"), "with a place that cannot be read"),
    "zeros": (Row(stamp(17.5), "0.0", "0.0"), "at 0° north, 0° east"),
}


def read(path: Path, text: str) -> tuple[Fixes, Tally]:
    path.write_text(text)
    tally = Tally(path)
    return read_fixes(path, tally=tally), tally


def check(fixes: Fixes, count: int = N) -> None:
    np.testing.assert_allclose(fixes.time_utc_s - START_S, np.arange(count), rtol=0, atol=1e-6)
    np.testing.assert_allclose(fixes.latitude_deg, north_deg(np.arange(count)), rtol=0, atol=1e-7)


@pytest.mark.parametrize("at", [0, 1, 17, N])
@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("name", FORMS)
def test_one_wrong_row_is_left_out(tmp_path: Path, name: str, wrong: str, at: int) -> None:
    row, reason = WRONG[wrong]
    if name == "posix.csv" and row.time.startswith("2024-0@"):
        row = row._replace(time="17x")
    if wrong == "the week before" and (at == 0) != (name == "reversed.csv" and at == N):
        pytest.skip("a fix of the week before may stand there")
    if wrong == "zeros":
        row = row._replace(time=stamp(at - 0.5))
    log = rows()
    log.insert(at, row)
    fixes, tally = read(tmp_path / name, FORMS[name](log))
    if wrong == "the week before" and at in (0, N):
        return
    check(fixes)
    (found,) = tally.left_out
    if name == "posix.csv" and wrong == "1970":
        reason = "with a time that cannot be read"
    assert reason in found
    left = tally.left_out[found]
    number = N - at if name == "reversed.csv" else at
    assert left.count == 1
    assert left.row == (f"point {number + 1}" if name == "log.gpx" else f"line {number + 2}")


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("name", FORMS)
def test_a_third_of_wrong_rows_is_left_out_and_half_refused(
    tmp_path: Path, name: str, wrong: str
) -> None:
    row, reason = WRONG[wrong]

    def spoilt(i: int) -> Row:
        # The same again and again would be one that stands twice.
        return row._replace(latitude=f"54.{i:03d}") if reason.startswith("is ") else row

    log = rows()
    for at in range(N, 3, -4):
        log.insert(at - 1, spoilt(at))
    fixes, tally = read(tmp_path / name, FORMS[name](log))
    check(fixes)
    assert tally.total_left_out == 10
    if wrong in ("no place", "zeros", "a year too late", "1970", "the week before"):
        return
    mixed = [r for i, good in enumerate(rows()) for r in (good, spoilt(2 * i), spoilt(2 * i + 1))]
    with pytest.raises(InputError) as caught:
        read(tmp_path / name, FORMS[name](mixed))
    assert "\n" not in str(caught.value)


def test_a_receiver_that_learns_the_date_late(tmp_path: Path) -> None:
    """Half a minute of 2004 before an hour of 2024."""
    early = [Row(stamp(i).replace("2024", "2004"), "54.32", "10.13") for i in range(30)]
    late = [Row(stamp(i), f"{north_deg(i):.7f}", "10.13") for i in range(3600)]
    for name in ("log.csv", "log.gpx"):
        fixes, tally = read(tmp_path / name, FORMS[name](early + late))
        check(fixes, 3600)
        assert tally.left_out["with a time that is years from the others"].count == 30


@pytest.mark.parametrize("name", FORMS)
def test_a_log_in_no_order_is_refused(tmp_path: Path, name: str) -> None:
    log = rows()
    shuffled = [log[i] for i in np.random.default_rng(0).permutation(N)]
    with pytest.raises(InputError, match="is earlier than the fix before it"):
        read(tmp_path / name, FORMS[name](shuffled))


def test_two_logs_in_the_wrong_order_are_refused(tmp_path: Path) -> None:
    for name in ("log.csv", "log.gpx"):
        with pytest.raises(InputError, match=r"(line 27|point 26): .* is earlier than the fix"):
            read(tmp_path / name, FORMS[name](rows()[15:] + rows()[:15]))


def test_headings_survive_a_wrong_row(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    lines = [f"{','.join(row)},{10.0 + i / 10:.1f}" for i, row in enumerate(rows())]
    lines[7] = "2080-01-01T00:00:00Z,54.32,10.13,99.0"
    lines[9] = ",54.32,10.13,99.0"
    lines[11] = f"{stamp(11)},54.3202970,10.13,north"
    path.write_text("\n".join(["time,lat,lon,heading_deg", *lines]) + "\n")
    tally = Tally(path)
    found = read_headings(path, tally=tally)
    assert found is not None
    kept = np.setdiff1d(np.arange(N), [7, 9, 11])
    np.testing.assert_allclose(found.time_utc_s - START_S, kept)
    np.testing.assert_allclose(found.heading_deg, 10.0 + kept / 10.0)
    assert tally.left_out["with a heading that is no number"].row == "line 13"
    assert len(read_fixes(path)) == N - 2


def track(log: list[Row], name: str = "") -> str:
    return (
        gpx(log)
        .removeprefix('<gpx version="1.1">')
        .removesuffix("</gpx>")
        .replace("<trk>", f"<trk><name>{name}</name>")
    )


def whole(*tracks: str) -> str:
    return f'<gpx version="1.1">{"".join(tracks)}</gpx>'


def test_tracks_that_overlap_are_one_log(tmp_path: Path) -> None:
    """The points of one receiver, which stand in two tracks: they take turns, or lap over."""
    log = rows()
    for tracks in (
        (log[::2], log[1::2]),
        (log[20:], log[:25]),
        (log[:25], log[20:]),
        (log[10:20], log),
        (log[30:], log[:12], log[12:30]),
    ):
        fixes, _ = read(tmp_path / "log.gpx", whole(*map(track, tracks)))
        check(fixes)


def test_of_two_receivers_of_the_same_time_the_longer_track_is_used(tmp_path: Path) -> None:
    """The other begins earlier, half a second out of step and 8 m off, and is used alone there."""
    other = [Row(stamp(i + 0.5), f"{north_deg(i + 0.5):.7f}", "10.130123") for i in range(-20, 15)]
    for tracks in ((rows(), other), (other, rows())):
        fixes, tally = read(tmp_path / "log.gpx", whole(*map(track, tracks)))
        north = north_deg(fixes.time_utc_s - START_S)
        np.testing.assert_allclose(fixes.latitude_deg, north, rtol=0, atol=1e-7)
        inside = fixes.time_utc_s >= START_S
        check(
            Fixes(*(c[inside] for c in (fixes.time_utc_s, fixes.latitude_deg, fixes.longitude_deg)))
        )
        assert (fixes.longitude_deg[inside] == 10.13).all()
        assert (fixes.longitude_deg[~inside] == 10.130123).all()
        assert (~inside).sum() == 20
        assert tally.left_out["of a track of the same times as a longer one"].count == 15


def test_tracks_of_two_vessels_are_refused(tmp_path: Path) -> None:
    far = [row._replace(longitude="10.16") for row in rows()[5:]]
    with pytest.raises(InputError, match=r"track Elsa is of the same times .* and 1,9\d\d m from"):
        read(tmp_path / "log.gpx", whole(track(rows(), "Berta"), track(far, "Elsa")))


@pytest.mark.parametrize("at", [0, 17, N])
@pytest.mark.parametrize("wrong", ["060180", "250524"])
def test_one_wrong_date_of_a_receiver(tmp_path: Path, wrong: str, at: int) -> None:
    """The first day of GPS, and the week before."""
    if wrong == "250524" and at == 0:
        pytest.skip("a fix of the week before may stand there")

    def rmc(second: float, date: str = "010624") -> str:
        moment = datetime.fromtimestamp(START_S + second, UTC)
        clock = moment.strftime("%H%M%S.") + f"{moment.microsecond // 10000:02d}"
        minutes = (float(north_deg(second)) - 54.0) * 60.0
        body = f"GPRMC,{clock},A,54{minutes:010.7f},N,01007.8,E,6.0,0.0,{date},,,A"
        return f"${body}*{reduce(xor, body.encode()):02X}\r\n"

    log = [rmc(i) for i in range(N)]
    log.insert(at, rmc(at - 0.5, wrong))
    path = tmp_path / "log.nmea"
    path.write_text("".join(log))
    tally = Tally(path)
    check(read_fixes(path, tally=tally))
    (left,) = tally.left_out.values()
    assert (left.count, left.row) == (1, f"line {at + 1}")
