"""Logs of receivers as loggers write them: the vessel is where it was, whatever stands around."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from _support.sentences import (
    LATITUDE_DEG,
    LONGITUDE_DEG,
    NOON_S,
    clock,
    degrees_minutes,
    gga,
    gll,
    gns,
    hdt,
    moment,
    north_deg,
    off_m,
    place,
    received,
    rmc,
    sentence,
    undated_rmc,
    zda,
)

from sightline.errors import InputError
from sightline.formats import read_fixes
from sightline.tally import Tally
from sightline.types import Fixes

SECONDS = range(20)


def read(path: Path, text: str | bytes) -> tuple[Fixes, Tally]:
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    tally = Tally(path)
    return read_fixes(path, tally=tally), tally


def check(fixes: Fixes, seconds: list[float] | range = SECONDS) -> None:
    """Each fix is at its second, where the vessel was."""
    np.testing.assert_allclose(fixes.time_utc_s - NOON_S, list(seconds), rtol=0, atol=1e-5)
    assert off_m(fixes.latitude_deg, fixes.time_utc_s).max() < 0.01


def lines(*makers: Callable[[float], str], end: str = "\r\n") -> str:
    return "".join(make(second) + end for second in SECONDS for make in makers)


@pytest.mark.parametrize(
    "form",
    [
        '2024-06-01T09:59:58.300Z,NMEA0183,"COM3",RMC,"{}"\r\n',
        '2024-06-01T09:59:58.300Z,NMEA0183,"COM3 Port 1",{}\r\n',
        "{}\t2024-06-01T09:59:58.300Z\r\n",
        "{};2024-06-01 09:59:58\n",
        "{} \\\\ comment\r\n",
        "{}   \r\n",
        "\\s:gps,c:1717235998*00\\{}\r\n",
        "[12:00:00.125] RX: {}\r\n",
        "b'{}\\r\\n'\n",
        '{{"nmea": "{}\\r\\n", "n": 1}}\n',
        "{}\r\r\n",
        "{}",
        "{}\r",
    ],
)
def test_what_stands_around_a_sentence_does_not_matter(tmp_path: Path, form: str) -> None:
    text = "".join(form.format(rmc(second)) for second in SECONDS)
    fixes, tally = read(tmp_path / "log.txt", text)
    check(fixes)
    assert not tally.left_out
    assert tally.read == {"sentences": 20, "fixes": 20}


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-8-sig"])
def test_logs_of_powershell(tmp_path: Path, encoding: str) -> None:
    check(read(tmp_path / "log.txt", lines(rmc).encode(encoding))[0])


def test_zeros_that_a_loss_of_power_leaves(tmp_path: Path) -> None:
    text = lines(rmc)
    within = text.index(clock(7)) + 15
    fixes, tally = read(tmp_path / "log.nmea", text[:within] + "\0" * 512 + text[within:])
    check(fixes, [s for s in SECONDS if s != 7])
    assert [left.row for left in tally.left_out.values()] == ["line 8"]


@pytest.mark.parametrize(
    "makers",
    [
        (gga, rmc),
        (gns, zda),
        (gll, zda),
        (gll, rmc),
        (undated_rmc, zda),
        (zda, undated_rmc),
        (lambda second: zda(second, zone="-02,00"), gga),
        (lambda second: rmc(second, status="V"), gns),
        (lambda second: rmc(second, mode="A,D,S"), hdt),
        (lambda second: rmc(second, talker=("GN", "GL", "GA", "GB", "BD")[int(second) % 5]),),
        (lambda second: gga(second, talker="GN"), lambda second: gga(second, talker="GP"), zda),
        (lambda second: gns(second, modes="NAD"), zda),
        (lambda _: sentence("PGRMC,A,2.0,100,6378137.000"), rmc),
        (lambda second: rmc(second)[:-2] + rmc(second)[-2:].lower(),),
    ],
)
def test_kinds_of_sentences(tmp_path: Path, makers: tuple[Callable[[float], str], ...]) -> None:
    text = lines(*makers)
    check(read(tmp_path / "log.nmea", text)[0])


def test_times_without_a_fraction_and_before_nmea_2(tmp_path: Path) -> None:
    def old(second: float) -> str:
        date = clock(second)[:6]
        return sentence(f"GPRMC,{date},A,{place(second)},6.0,0.0,300920,,")

    check(read(tmp_path / "log.nmea", lines(old))[0])


def test_undated_sentences_over_midnight_and_a_night_without_a_word(tmp_path: Path) -> None:
    """One date at the beginning, one after the break; each day in between is counted."""
    evening, morning = 11 * 3600.0, 26 * 3600.0
    seconds = [*range(int(evening), int(evening) + 5000, 500), *range(int(morning), 97000, 500)]
    # 23:00 and on over midnight; then nothing for half a day and more, until 14:00.
    text = zda(evening) + "\n" + "".join(gll(second) + "\n" for second in seconds)
    text = text.replace(gll(morning), gll(morning) + "\n" + zda(morning))
    fixes, _ = read(tmp_path / "log.nmea", text)
    check(fixes, seconds)


def test_a_log_without_a_date_takes_that_of_its_logger(tmp_path: Path) -> None:
    text = "".join(received(second + 0.4, gll(second)) + "\n" for second in SECONDS)
    fixes, tally = read(tmp_path / "log.nmea", text)
    check(fixes)
    assert tally.notes == [
        "its dates are those of the times at which its logger received the sentences"
    ]


@pytest.mark.parametrize(("make", "kind"), [(gll, "GLL"), (undated_rmc, "RMC"), (gga, "GGA")])
def test_a_log_without_a_date_is_refused(
    tmp_path: Path, make: Callable[[float], str], kind: str
) -> None:
    with pytest.raises(InputError, match=f"its 20 {kind} sentences have no date.*log one of these"):
        read(tmp_path / "log.nmea", lines(make))


def test_a_date_from_before_the_fix_is_passed_over(tmp_path: Path) -> None:
    """Receivers begin with a date of their own, which they do not call valid."""
    wrong = sentence(f"GPRMC,{clock(0)},V,,,,,,,220899,,,N")
    text = (wrong + "\n") * 3 + lines(gga, zda)
    fixes, tally = read(tmp_path / "log.nmea", text)
    check(fixes)
    assert tally.left_out["RMC without a fix"].count == 3


@pytest.mark.parametrize("year", ["360", "0", "253402300800", "1999999", "", "-1", "1970"])
def test_years_that_cannot_be(tmp_path: Path, year: str) -> None:
    silly = sentence(f"GPZDA,{clock(3)},30,09,{year},00,00")
    fixes, tally = read(tmp_path / "log.nmea", lines(rmc) + silly)
    check(fixes)
    assert tally.left_out["ZDA with an impossible date"].row == "line 21"
    with pytest.raises(InputError, match="its 20 GGA sentences have no date"):
        read(tmp_path / "log.nmea", silly + "\n" + lines(gga))


def test_a_week_number_that_has_rolled_over(tmp_path: Path) -> None:
    early_s = 1024 * 7 * 86400.0

    def early(second: float) -> str:
        date = dt.datetime.fromtimestamp(NOON_S - early_s + second, dt.UTC).strftime("%d%m%y")
        return sentence(f"GPRMC,{clock(second)},A,{place(second)},6.0,0.0,{date},,,A")

    fixes, tally = read(tmp_path / "log.nmea", lines(early))
    np.testing.assert_allclose(fixes.time_utc_s, NOON_S - early_s + np.arange(20))
    (note,) = tally.notes
    assert note == (
        "its first fix is dated 2001-02-14; a receiver whose week number has rolled over writes "
        "that for 2020-09-30, 1024 weeks later"
    )
    # Where the logger tells the time, it is known.
    text = "".join(received(second, early(second)) + "\n" for second in SECONDS)
    fixes, tally = read(tmp_path / "log.nmea", text)
    check(fixes)
    assert "rolled over" in tally.notes[0]


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        (",,,", "RMC without a place"),
        ("5419.39,N,,", "RMC without a place"),
        ("5419.39,,01008.36,", "RMC without a hemisphere"),
        ("5419.39,N,01008.36,X", "RMC without a hemisphere"),
        ("0000.0000,N,00000.0000,E", "RMC at 0° north, 0° east, which receivers write"),
        ("5461.39,N,01008.36,E", "RMC with a place that cannot be read"),
        ("54x9.39,N,01008.36,E", "RMC with a place that cannot be read"),
        ("9512.00,N,01008.36,E", "RMC with a place that is not on the earth"),
    ],
)
def test_fixes_that_are_none(tmp_path: Path, fields: str, reason: str) -> None:
    bad = [sentence(f"GPRMC,{clock(s)},A,{fields},6.0,0.0,300920,,,A") for s in (5, 6, 7)]
    text = "".join((bad[s - 5] if 5 <= s < 8 else rmc(s)) + "\n" for s in SECONDS)
    fixes, tally = read(tmp_path / "log.nmea", text)
    check(fixes, [s for s in SECONDS if not 5 <= s < 8])
    (found,) = tally.left_out
    assert found.startswith(reason)
    left = tally.left_out[found]
    assert (left.count, left.row) == (3, "line 6")
    assert left.text.startswith(bad[0][:40])


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda s: rmc(s, status="V"), "RMC without a fix"),
        (lambda s: rmc(s, mode="N"), "RMC without a fix"),
        (lambda s: gga(s, quality=0), "GGA without a fix"),
        (lambda s: gns(s, modes="NNN"), "GNS without a fix"),
        (lambda s: gll(s, status="V,N"), "GLL without a fix"),
        (lambda s: rmc(s)[:-2] + "ZZ", "sentences without a checksum"),
        (lambda s: rmc(s).split("*", maxsplit=1)[0], "sentences without a checksum"),
        (lambda s: rmc(s).replace("5419", "5418"), "sentences with a wrong checksum"),
        (lambda s: sentence(f"GPRMC,--5,A,{place(s)},6.0,0.0,300920,,,A"), "RMC with a time"),
        (lambda s: sentence(f"GPRMC,,A,{place(s)},6.0,0.0,300920,,,A"), "RMC without a time"),
    ],
)
def test_sentences_that_give_no_fix(
    tmp_path: Path, make: Callable[[float], str], reason: str
) -> None:
    text = "".join((make(s) if s == 5 else rmc(s)) + "\n" for s in SECONDS)
    fixes, tally = read(tmp_path / "log.nmea", text)
    check(fixes, [s for s in SECONDS if s != 5])
    assert [name.startswith(reason) for name in tally.left_out] == [True]
    assert tally.read["sentences"] == 20


@pytest.mark.parametrize(
    "make",
    [
        lambda s: rmc(s, mode="E"),
        lambda s: gns(s, modes="EN"),
        lambda s: gga(s, quality=8),
        lambda s: gga(s, quality=6),
    ],
)
def test_dead_reckoning_is_no_measurement(tmp_path: Path, make: Callable[[float], str]) -> None:
    fixes, tally = read(tmp_path / "log.nmea", zda(0) + "\n" + lines(make))
    check(fixes)
    assert tally.notes == ["none of its fixes is measured; all are estimated, entered or simulated"]
    # Beside fixes that are, it is left out.
    measured = {"RMC": rmc, "GNS": gns, "GGA": gga}[make(0)[3:6]]
    text = "".join((make(s) if s in (5, 6) else measured(s)) + "\n" for s in SECONDS)
    fixes, tally = read(tmp_path / "log.nmea", zda(0) + "\n" + text)
    check(fixes, [s for s in SECONDS if s not in (5, 6)])
    assert [left.count for left in tally.left_out.values()] == [2]


def test_a_log_without_any_checksum_is_read_with_a_note(tmp_path: Path) -> None:
    text = "".join(rmc(second).split("*", maxsplit=1)[0] + "\r\n" for second in SECONDS)
    fixes, tally = read(tmp_path / "log.nmea", text)
    check(fixes)
    assert not tally.left_out
    assert "no checksum" in tally.notes[0]
    # What is cut short is left out all the same.
    fixes, tally = read(tmp_path / "log.nmea", text[:-30])
    check(fixes, range(19))
    assert [left.count for left in tally.left_out.values()] == [1]


def test_a_second_receiver_is_not_mixed_in(tmp_path: Path) -> None:
    """It lags by half a second, and is 50 m off."""

    def second_receiver(second: float) -> str:
        latitude = place(second + 16.0).split(",")[0]
        body = f"IIRMC,{clock(second)},A,{latitude},{place(second).split(',', 1)[1]}"
        return sentence(f"{body},6.0,0.0,300920,,,A")

    text = lines(rmc, second_receiver) + rmc(20) + "\n"
    fixes, tally = read(tmp_path / "log.nmea", text)
    check(fixes, range(21))
    assert tally.left_out["RMC of another receiver (II)"].count == 20


def test_a_log_of_instruments_that_has_no_place(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no RMC, GGA, GNS or GLL sentence"):
        read(tmp_path / "log.nmea", lines(hdt))
    with pytest.raises(InputError, match="left out: 20 RMC without a fix"):
        read(tmp_path / "log.nmea", lines(lambda s: rmc(s, status="V")))


def test_sentences_of_the_right_kind_after_much_else(tmp_path: Path) -> None:
    talk = sentence("GPGSV,3,1,11,03,03,111,00,04,15,270,00,06,01,010,00,13,06,292,00") + "\r\n"
    check(read(tmp_path / "log.nmea", talk * 1200 + lines(rmc))[0])


def beside(second: float, *, talker: str, source: str = "", metres: float = 8.0) -> str:
    """RMC of a receiver that stands to the east of the first, half a second out of step with it."""
    latitude = place(second + 0.5).split(",E")[0].rpartition(",")[0]
    east = degrees_minutes(LONGITUDE_DEG + metres / 64_900.0, 3)
    body = f"{talker}RMC,{clock(second + 0.5)},A,{latitude},{east},E,6.0,0.0,300920,,,A"
    return (f"\\s:{source}*00\\" if source else "") + sentence(body)


@pytest.mark.parametrize("metres", [1.0, 8.0, 40.0])
@pytest.mark.parametrize("other", ["GN", "II"])
def test_a_receiver_out_of_step_is_not_mixed_in(tmp_path: Path, other: str, metres: float) -> None:
    text = lines(rmc, lambda s: beside(s, talker=other, metres=metres)) + rmc(20) + "\n"
    fixes, tally = read(tmp_path / "log.nmea", text)
    check(fixes, range(21))
    np.testing.assert_allclose(fixes.longitude_deg, LONGITUDE_DEG, rtol=0, atol=1e-8)
    assert tally.left_out[f"RMC of another receiver ({other})"].count == 20
    assert tally.left_out[f"RMC of another receiver ({other})"].row == "line 2"


def test_sources_of_tag_blocks_are_receivers(tmp_path: Path) -> None:
    """The one with more fixes is used, although the other begins."""
    makers = (
        lambda s: beside(s, talker="GP", source="aft") if s % 2 == 0 else "",
        lambda s: f"\\s:mast,n:7*00\\{rmc(s)}",
    )
    fixes, tally = read(tmp_path / "log.nmea", lines(*makers))
    check(fixes)
    np.testing.assert_allclose(fixes.longitude_deg, LONGITUDE_DEG, rtol=0, atol=1e-8)
    assert tally.left_out["RMC of another receiver (GP, aft)"].count == 10


@pytest.mark.parametrize("noise_m", [0.0, 5.0])
def test_a_receiver_that_changes_its_talker_is_one(tmp_path: Path, noise_m: float) -> None:
    """It is GN while it has two systems, and now and then GP for some seconds."""
    names = np.where(np.isin(np.arange(60) % 17, (3, 4, 5, 11)), "GP", "GN")
    off_m = noise_m * np.sin(2.0 * np.arange(60) ** 2)

    def made(second: int) -> str:
        latitude = degrees_minutes(north_deg(second) + off_m[second] / 111_320.0, 2)
        east = degrees_minutes(LONGITUDE_DEG, 3)
        body = f"{names[second]}RMC,{clock(second)},A,{latitude},N,{east},E,6.0,0.0,300920,,,A"
        return sentence(body) + "\r\n"

    fixes, tally = read(tmp_path / "log.nmea", "".join(map(made, range(60))))
    assert len(fixes) == 60
    assert not tally.left_out


@pytest.mark.parametrize("talkers", [("GN", "GL", "GA", "GB"), ("GP", "GL")])
def test_talkers_that_take_turns_in_a_turn_are_one_receiver(
    tmp_path: Path, talkers: tuple[str, ...]
) -> None:
    """It circles at 10 m/s with 20 m radius, so that no line of one talker meets the others'."""
    angle = np.arange(61) * 0.5
    noise = np.random.default_rng(3).normal(0.0, 1.0, (2, 61))
    north_m, east_m = 20.0 * np.cos(angle) + noise[0], 20.0 * np.sin(angle) + noise[1]

    def made(second: int, shift_m: float = 0.0) -> str:
        latitude = degrees_minutes(LATITUDE_DEG + north_m[second] / 111_320.0, 2)
        longitude = LONGITUDE_DEG + (east_m[second] + shift_m) / 64_900.0
        where = f"{latitude},N,{degrees_minutes(longitude, 3)},E"
        talker = talkers[second % len(talkers)]
        return sentence(f"{talker}RMC,{clock(second)},A,{where},6.0,0.0,300920,,,A") + "\r\n"

    fixes, tally = read(tmp_path / "log.nmea", "".join(map(made, range(61))))
    assert len(fixes) == 61
    assert not tally.left_out
    # What is 15 m to the east all the time is another antenna.
    shifted = "".join(made(i, 15.0 * (i % len(talkers) == 1)) for i in range(61))
    _, tally = read(tmp_path / "log.nmea", shifted)
    assert tally.left_out[f"RMC of another receiver ({talkers[1]})"].count == 60 // len(talkers)


def another_clock(second: float, ahead_s: float, metres: float) -> str:
    """RMC of a receiver at another antenna, or whose clock is ahead, of the same talker."""
    where = f"{place(second).rpartition(',')[0].rpartition(',')[0]}"
    east = degrees_minutes(LONGITUDE_DEG + metres / 64_900.0, 3)
    date = moment(second + ahead_s, "%d%m%y")
    return sentence(f"GPRMC,{clock(second + ahead_s)},A,{where},{east},E,6.0,0.0,{date},,,A")


@pytest.mark.parametrize(
    ("lag_s", "ahead_s", "metres"),
    [
        (0.5, 0.0, 6.0),
        (0.3, 0.0, 6.0),
        (0.0, 0.0, 6.0),
        (0.0, 0.4, 3.0),
        (0.0, 2.0, 0.0),
        (0.0, 100.0, 0.0),
        (0.0, -3600.0, 6.0),
        (0.0, 86400.0, 0.0),
        (0.3, 0.0, 2000.0),
    ],
)
def test_a_second_receiver_of_the_same_talker_is_not_mixed_in(
    tmp_path: Path, lag_s: float, ahead_s: float, metres: float
) -> None:
    text = "".join(
        f"{rmc(second)}\r\n{another_clock(second + lag_s, ahead_s, metres)}\r\n"
        for second in range(40)
    )
    fixes, tally = read(tmp_path / "log.nmea", text)
    check(fixes, range(40))
    np.testing.assert_allclose(fixes.longitude_deg, LONGITUDE_DEG, rtol=0, atol=1e-8)
    (left,) = tally.left_out.items()
    assert left[0] == "RMC of another receiver of the same name (GP)"
    assert (left[1].count, left[1].row) == (40, "line 2")
    assert any("log each by itself" in note for note in tally.notes)


@pytest.mark.parametrize("every_s", [0.1, 0.5, 1.0, 10.0])
@pytest.mark.parametrize("form", ["plain", "whole seconds", "late", "lost", "twice"])
def test_one_receiver_stays_one(tmp_path: Path, every_s: float, form: str) -> None:
    """In a turn, with errors that last, and with times as receivers write them."""
    rng = np.random.default_rng(5)
    seconds = np.arange(200) * every_s
    off_m = np.cumsum(rng.normal(0.0, 0.3, (2, 200)), axis=1) + rng.normal(0.0, 0.5, (2, 200))
    north_m = 60.0 * np.cos(seconds / 12.0) + off_m[0]
    east_m = 60.0 * np.sin(seconds / 12.0) + off_m[1]
    kept = rng.random(200) > 0.1 if form == "lost" else np.ones(200, dtype=bool)
    told = np.floor(seconds) if form == "whole seconds" else seconds
    told = told + (rng.uniform(0.0, 0.3 * every_s, 200) if form == "late" else 0.0)
    lines = []
    for i in np.flatnonzero(kept):
        j = i - i % 2 if form == "twice" else i
        latitude = degrees_minutes(LATITUDE_DEG + north_m[j] / 111_320.0, 2)
        longitude = degrees_minutes(LONGITUDE_DEG + east_m[j] / 64_900.0, 3)
        body = f"GPRMC,{clock(told[i])},A,{latitude},N,{longitude},E,6.0,0.0,300920,,,A"
        lines.append(sentence(body) + "\r\n")
    _, tally = read(tmp_path / "log.nmea", "".join(lines))
    assert not any("another receiver" in reason for reason in tally.left_out)


def test_a_log_after_another_says_where_to_cut(tmp_path: Path) -> None:
    text = lines(lambda s: rmc(s + 300.0)) + lines(rmc)
    with pytest.raises(InputError, match=r"line 21: .* cut it there"):
        read(tmp_path / "log.nmea", text)
