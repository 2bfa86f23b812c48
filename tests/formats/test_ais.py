"""AIS as receivers log it: parts find their own, and what is lost is counted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from _support.sentences import (
    MMSI,
    NOON_S,
    moment,
    north_deg,
    off_m,
    payload,
    received,
    rmc,
    sentence,
    vdm,
)

from sightline.errors import InputError
from sightline.formats import read_ais, read_fixes
from sightline.formats.ais import read_ais_feed
from sightline.tally import Tally
from sightline.types import Fixes

SECONDS = range(0, 80, 2)
LOST = "parts of AIS messages whose other parts are missing"


def read(path: Path, lines: list[str], mmsi: int | None = None) -> tuple[Fixes, Tally]:
    path.write_text("".join(f"{line}\r\n" for line in lines))
    tally = Tally(path)
    return read_fixes(path, mmsi=mmsi, tally=tally), tally


def check(fixes: Fixes, seconds: list[int] | range = SECONDS) -> None:
    np.testing.assert_array_equal(fixes.time_utc_s - NOON_S, list(seconds))
    # A ten-thousandth of a minute is 0.2 m.
    assert off_m(fixes.latitude_deg, fixes.time_utc_s).max() < 0.2


def parts(second: int, id_: object, *, cut: int = 17, other: object = None) -> list[str]:
    """A report of class B in two sentences, the place in the second; ``other`` is its id."""
    body = payload(19, second, shipname=f"GULL {second}")
    first = vdm(body[:cut], part=f"2,1,{id_}")
    second_part = vdm(body[cut:], part=f"2,2,{id_ if other is None else other}")
    return [received(second, first), second_part]


@pytest.mark.parametrize(
    "id_",
    [
        lambda n: n % 10,
        lambda n: 10 + n,
        lambda n: 100 + n,
        lambda _: "",
        lambda _: 3,
        lambda n: n % 4,
    ],
    ids=["0 to 9", "over 9", "over 99", "none", "always 3", "0 to 3"],
)
def test_parts_of_any_id(tmp_path: Path, id_) -> None:
    lines = [line for n, second in enumerate(SECONDS) for line in parts(second, id_(n))]
    fixes, tally = read(tmp_path / "log.nmea", lines)
    check(fixes)
    assert not tally.left_out
    assert tally.read["AIS sentences"] == 80
    assert tally.read["AIS messages"] == tally.read["fixes"] == 40


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (("AI", "1"), ("AI", "1")),
        (("AI", "A"), ("AI", "1")),
        (("AI", "A"), ("AI", "")),
        (("AI", ""), ("AI", "B")),
        (("BS", "A"), ("BS", "A")),
        (("AB", "B"), ("AB", "B")),
    ],
)
def test_channels_and_talkers(
    tmp_path: Path, first: tuple[str, str], second: tuple[str, str]
) -> None:
    lines = []
    for n, time in enumerate(SECONDS):
        body = payload(19, time)
        one = vdm(body[:17], talker=first[0], part=f"2,1,{n % 10}", channel=first[1])
        two = vdm(body[17:], talker=second[0], part=f"2,2,{n % 10}", channel=second[1])
        lines += [received(time, one), two]
    check(read(tmp_path / "log.nmea", lines)[0])


def test_parts_that_have_changed_places(tmp_path: Path) -> None:
    lines = [line for n, s in enumerate(SECONDS) for line in parts(s, n % 10)[::-1]]
    fixes, tally = read(tmp_path / "log.nmea", lines)
    check(fixes)
    assert not tally.left_out


def test_parts_of_three_and_other_vessels_between_them(tmp_path: Path) -> None:
    lines = []
    for n, second in enumerate(SECONDS):
        body = payload(19, second)
        cuts = [body[:10], body[10:30], body[30:]]
        for number, part in enumerate(cuts, start=1):
            lines.append(received(second, vdm(part, part=f"3,{number},{n % 10}")))
            stranger = payload(1, second, mmsi=211_000_000 + number, lat=54.4)
            lines.append(received(second, vdm(stranger, channel="B")))
    fixes, tally = read(tmp_path / "log.nmea", lines, MMSI)
    check(fixes)
    assert not tally.left_out


@pytest.mark.parametrize("missing", [0, 1])
@pytest.mark.parametrize("ids", ["0 to 9", "none"])
def test_parts_that_are_lost_are_counted(tmp_path: Path, missing: int, ids: str) -> None:
    lines = []
    for n, second in enumerate(SECONDS):
        both = parts(second, n % 10 if ids == "0 to 9" else "")
        lines += both if n % 7 else [both[1 - missing]]
    fixes, tally = read(tmp_path / "log.nmea", lines)
    check(fixes, [second for n, second in enumerate(SECONDS) if n % 7])
    assert tally.left_out[LOST].count == 6
    assert list(tally.left_out) == [LOST]


@pytest.mark.parametrize(
    "other", [lambda n: n + 20, lambda n: (n + 4) % 10, lambda n: (n + 9) % 10]
)
def test_parts_of_other_ids_are_not_joined_with_a_strangers(tmp_path: Path, other) -> None:
    lines = []
    for n, second in enumerate(SECONDS):
        lines += parts(second, n % 10, other=other(n))
    with pytest.raises(InputError, match=f"left out: 80 {LOST} \\(line 1: !AIVDM,2,1,0"):
        read(tmp_path / "log.nmea", lines)


def test_two_stations_with_the_same_ids(tmp_path: Path) -> None:
    """Each has its own sender; only what each logged itself belongs together."""
    lines = []
    for second in SECONDS:
        ours, theirs = payload(19, second), payload(19, second, mmsi=211_000_007, lat=54.4)
        for half in (slice(0, 17), slice(17, None)):
            part = f"2,{1 + bool(half.start)},3"
            stamp = f"c:{NOON_S + second:.0f}"
            lines.append(f"\\s:east,{stamp}*00\\{vdm(ours[half], part=part)}")
            lines.append(f"\\s:west,{stamp}*00\\{vdm(theirs[half], part=part)}")
    fixes, tally = read(tmp_path / "log.nmea", lines, MMSI)
    check(fixes)
    assert not tally.left_out
    (tmp_path / "log.nmea").write_text("\n".join(lines))
    assert sorted(read_ais(tmp_path / "log.nmea")) == [211_000_007, MMSI]


@pytest.mark.parametrize(
    ("order", "again"),
    [((0, 1, 0, 1), "reports received again"), ((0, 1, 1), "AIS sentences received again")],
)
def test_one_message_by_two_stations(tmp_path: Path, order: tuple[int, ...], again: str) -> None:
    lines = []
    for n, second in enumerate(SECONDS):
        both = parts(second, n % 10)
        lines += [both[which] for which in order]
    fixes, tally = read(tmp_path / "log.nmea", lines)
    check(fixes)
    assert not tally.left_out
    assert tally.read[again] == 40


def test_parts_that_say_the_same_as_those_of_the_message_before(tmp_path: Path) -> None:
    """The first part of two reports of a vessel at anchor may be the same, letter by letter."""
    lines = []
    for second in SECONDS:
        lines += parts(second, 3, cut=9)
    fixes, tally = read(tmp_path / "log.nmea", lines)
    check(fixes)
    assert not tally.left_out


def test_sentences_without_a_checksum(tmp_path: Path) -> None:
    whole = [received(s, vdm(payload(1, s))) for s in SECONDS]
    bare = [line[:-3] for line in whole]
    fixes, tally = read(tmp_path / "log.nmea", bare)
    check(fixes)
    assert "no checksum" in tally.notes[0]
    fixes, tally = read(tmp_path / "log.nmea", [*bare[:3], *whole[3:]])
    check(fixes, SECONDS[3:])
    assert tally.left_out["AIS sentences without a checksum"].count == 3


@pytest.mark.parametrize(
    "bad",
    [
        vdm("13:;I6O"),
        vdm(""),
        vdm("13:;I6OP0t0fJNTO5G1C~?wmP000"),
        sentence("AIVDM,2,3,1,A,13:;I6OP0t0fJNTO5G1CQ?wmP000,0", "!"),
        sentence("AIVDM,1,1,,A,13:;I6OP0t0fJNTO5G1CQ?wmP000,9", "!"),
        sentence("AIVDM,1,1", "!"),
        vdm("w" * 28),
    ],
)
def test_messages_that_cannot_be_read_are_counted(tmp_path: Path, bad: str) -> None:
    lines = [received(second, vdm(payload(1, second))) for second in SECONDS]
    fixes, tally = read(tmp_path / "log.nmea", [*lines[:9], received(18, bad), *lines[9:]])
    check(fixes)
    assert [left.row for left in tally.left_out.values()] == ["line 10"]


@pytest.mark.parametrize(
    "stamp",
    ["1" + "0" * 300, "99999999999", "12", "2e9", "1.2.3", "0"],
)
def test_times_of_reception_that_cannot_be(tmp_path: Path, stamp: str) -> None:
    lines = [f"\\c:{stamp}*00\\{vdm(payload(1, second))}" for second in SECONDS]
    with pytest.raises(InputError, match="none of its 40 AIS position reports has a time"):
        read(tmp_path / "log.nmea", lines)


@pytest.mark.parametrize(
    "form",
    [
        "%Y-%m-%d %H:%M:%S,250 INFO {}",
        "%Y%m%dT%H%M%SZ {}",
        "%Y%m%d%H%M%S;{}",
        "%Y-%m-%d,%H:%M:%S,{}",
        '"{}","%Y-%m-%d %H:%M:%S UTC"',
        "%Y-%m-%d %H:%M:%S.123+00:00 {}",
    ],
)
def test_times_of_reception(tmp_path: Path, form: str) -> None:
    lines = [moment(s, form).format(vdm(payload(1, s))) for s in SECONDS]
    check(read(tmp_path / "log.nmea", lines)[0])


def test_the_clock_of_the_receiver_on_board_will_do(tmp_path: Path) -> None:
    lines = [line for s in SECONDS for line in (rmc(s, talker="GP"), vdm(payload(1, s)))]
    fixes, tally = read(tmp_path / "log.nmea", lines, MMSI)
    check(fixes)
    assert "those of the RMC or ZDA before" in tally.notes[0]


@pytest.mark.parametrize("told", [True, False], ids=["speeds", "no speeds"])
@pytest.mark.parametrize(
    ("latitude", "longitude"), [(36.874, -76.349), (54.3195, 10.1450), (54.3233, 10.1494)]
)
def test_a_report_from_elsewhere_is_left_out(
    tmp_path: Path, latitude: float, longitude: float, told: bool
) -> None:
    unknown = {} if told else {"speed": 102.3, "course": 360.0}
    lines = [received(s, vdm(payload(1, s, **unknown))) for s in SECONDS]
    wrong = payload(1, 31, lat=latitude, lon=longitude, **unknown)
    fixes, tally = read(tmp_path / "log.nmea", [*lines[:16], received(31, vdm(wrong)), *lines[16:]])
    check(fixes)
    (reason,) = tally.left_out
    assert "cannot have come" in reason
    assert tally.left_out[reason].row == "line 17"


def test_no_place_and_zero_zero(tmp_path: Path) -> None:
    lines = [received(s, vdm(payload(1, s))) for s in SECONDS]
    none = [vdm(payload(1, 3, lat=91.0, lon=181.0)), vdm(payload(1, 5, lat=0.0, lon=0.0))]
    fixes, tally = read(tmp_path / "log.nmea", [received(3, line) for line in none] + lines)
    check(fixes)
    assert [left.count for left in tally.left_out.values()] == [1, 1]


def test_an_mmsi_of_two_vessels(tmp_path: Path) -> None:
    lines = []
    for second in SECONDS:
        lines.append(received(second, vdm(payload(1, second))))
        if second % 10 == 0:
            # 400 m to the west, at anchor.
            other = payload(1, second + 1, lat=54.3233, lon=10.1333, speed=0.0)
            lines.append(received(second + 1, vdm(other)))
    fixes, tally = read(tmp_path / "log.nmea", lines)
    check(fixes)
    reason = f"reports of another vessel that uses the same MMSI {MMSI}"
    assert tally.left_out[reason].count == 8
    (note,) = tally.notes
    assert note == (
        f"two vessels or more use the same MMSI ({MMSI}); the reports of that with most of them "
        "are kept"
    )


def test_a_vessel_that_speeds_up_while_nothing_is_heard_is_one(tmp_path: Path) -> None:
    """Two minutes of silence in which it goes from 1 to 20 knots, and back."""
    lines = []
    for second in (*range(0, 30, 10), *range(150, 180, 10)):
        gone = 0.0 if second < 30 else 1000.0 / 111_320.0
        report = payload(1, second, lat=54.3 + gone, speed=1.0)
        lines.append(received(second, vdm(report)))
    fixes, tally = read(tmp_path / "log.nmea", lines)
    assert len(fixes) == 6
    assert not tally.left_out


def test_velocities_stay_with_their_reports(tmp_path: Path) -> None:
    path = tmp_path / "log.nmea"
    lines = [received(s, vdm(payload(1, s, speed=5.0 + s / 10.0))) for s in SECONDS]
    wrong = received(31, vdm(payload(1, 31, lat=36.9)))
    path.write_text("\n".join([*lines[:16], wrong, *lines[16:]]))
    vessel = read_ais_feed(path)[MMSI]
    knots = 5.0 + (vessel.fixes.time_utc_s - NOON_S) / 10.0
    np.testing.assert_allclose(vessel.velocity_mps[:, 1], knots * 1852.0 / 3600.0, atol=0.03)
    assert north_deg(0.0) == pytest.approx(vessel.fixes.latitude_deg[0], abs=1e-5)


@pytest.mark.parametrize("ahead_s", [40, -3600, 86400])
@pytest.mark.parametrize("second", [None, 60])
@pytest.mark.parametrize("both", [True, False])
def test_reports_received_by_two_clocks(
    tmp_path: Path, ahead_s: int, second: int | None, both: bool
) -> None:
    """Each station hears all, or they hear them by turns; the second one's clock is off."""
    told = {} if second is None else {"second": second}
    lines = []
    for n, at in enumerate(range(0, 600, 10)):
        report = vdm(payload(1, at, **told))
        if both or n % 2 == 0:
            lines.append(received(at, report))
        if both or n % 2 == 1:
            lines.append(received(at + ahead_s, report))
    fixes, tally = read(tmp_path / "log.nmea", lines)
    check(fixes, range(0, 600, 10 if both else 20))
    (left,) = tally.left_out.items()
    assert left[0] == "position reports received by another clock"
    assert left[1].count == (60 if both else 30)
    assert any("whose clocks disagree" in note for note in tally.notes)


def test_what_comes_late_is_of_no_other_clock(tmp_path: Path) -> None:
    """A network brings some reports minutes late, with the time at which they came."""
    rng = np.random.default_rng(2)
    seconds = np.arange(0, 1200, 10)
    late_s = np.where(rng.random(seconds.size) < 0.3, rng.uniform(1.0, 25.0, seconds.size), 0.0)
    order = np.argsort(seconds + rng.uniform(0.0, 60.0, seconds.size))
    lines = [received(float(seconds[i] + late_s[i]), vdm(payload(1, seconds[i]))) for i in order]
    fixes, tally = read(tmp_path / "log.nmea", lines)
    check(fixes, range(0, 1200, 10))
    assert not tally.left_out


def test_a_report_that_two_stations_heard_counts_once_without_its_second(tmp_path: Path) -> None:
    lines = []
    for at in range(0, 400, 10):
        report = vdm(payload(1, at, second=60))
        lines += [received(at + 3, report), received(at, report)]
    fixes, tally = read(tmp_path / "log.nmea", lines)
    check(fixes, range(0, 400, 10))
    assert tally.read["reports received again"] == 40


def test_reports_of_long_range_are_rough(tmp_path: Path) -> None:
    """Their places are told to a tenth of a minute, 185 m, and would spoil those of the others."""
    lines = [received(at, vdm(payload(27 if at % 40 == 0 else 1, at))) for at in range(0, 400, 10)]
    fixes, tally = read(tmp_path / "log.nmea", lines)
    assert len(fixes) == 30
    assert off_m(fixes.latitude_deg, fixes.time_utc_s).max() < 0.2
    (left,) = tally.left_out.items()
    assert left[0].startswith("reports of long range (type 27)")
    assert left[1].count == 10
    fixes, tally = read(
        tmp_path / "log.nmea", [received(at, vdm(payload(27, at))) for at in range(0, 3600, 180)]
    )
    assert len(fixes) == 20
    assert any("their places may be 130 m off" in note for note in tally.notes)
