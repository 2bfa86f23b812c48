from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.formats import read_fixes, write_fixes
from sightline.plausibility import check_near, distance_m, implausible
from sightline.tally import Tally
from sightline.types import Fixes, FloatArray

START_S = 1_717_236_000.0
LATITUDE_DEG, LONGITUDE_DEG = 54.3, 10.1
M_PER_DEG = 111_195.0

Log = tuple[FloatArray, FloatArray, FloatArray]


def on_earth(
    time_s: FloatArray,
    east_m: FloatArray,
    north_m: FloatArray,
    longitude_deg: float = LONGITUDE_DEG,
) -> Log:
    """A log of places around a point, on a sphere; good to a thousandth within kilometres."""
    across = longitude_deg + east_m / M_PER_DEG / np.cos(np.radians(LATITUDE_DEG))
    across = (across + 180.0) % 360.0 - 180.0
    return START_S + time_s, LATITUDE_DEG + north_m / M_PER_DEG, across


def boat(
    seed: int, *, n: int = 212, every_s: float = 1.0, noise_m: float = 0.5
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A boat at 5 m/s that turns now and then, by a tenth of a radian a second."""
    rng = np.random.default_rng(seed)
    time_s = np.cumsum(every_s * rng.uniform(0.8, 1.2, n))
    turn = np.repeat(rng.choice([-0.1, 0.0, 0.1], n // 10 + 1), 10)[:n]
    heading = np.cumsum(turn * every_s)
    east = np.cumsum(5.0 * every_s * np.sin(heading)) + noise_m * rng.standard_normal(n)
    north = np.cumsum(5.0 * every_s * np.cos(heading)) + noise_m * rng.standard_normal(n)
    return time_s, east, north


@pytest.mark.parametrize("off_m", [30.0, 60.0, 150.0, 300.0, 1000.0, 3000.0])
@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_one_wrong_fix_of_two_hundred_is_found_and_no_other(off_m: float, seed: int) -> None:
    time_s, east, north = boat(seed)
    rng = np.random.default_rng(100 + seed)
    row, way = int(rng.integers(5, 205)), rng.uniform(0.0, 2.0 * np.pi)
    east[row] += off_m * np.sin(way)
    north[row] += off_m * np.cos(way)
    assert np.flatnonzero(~implausible(*on_earth(time_s, east, north)).kept).tolist() == [row]


@pytest.mark.parametrize("off_m", [15.0, 20.0])
def test_fifteen_metres_within_a_second_are_found_where_the_log_is_good(off_m: float) -> None:
    for seed in range(5):
        time_s, east, north = boat(seed, noise_m=0.1)
        time_s = np.arange(212.0)
        east[77] += off_m
        kept = implausible(*on_earth(time_s, east, north)).kept
        assert np.flatnonzero(~kept).tolist() == [77]


@pytest.mark.parametrize("length", [2, 3, 6, 10])
@pytest.mark.parametrize("off_m", [80.0, 800.0, 2_000_000.0])
def test_a_short_stretch_that_is_off_is_found(length: int, off_m: float) -> None:
    time_s, east, north = boat(7)
    log = on_earth(time_s, east, north)
    latitude = log[1].copy()
    latitude[100 : 100 + length] -= off_m / M_PER_DEG
    kept = implausible(log[0], latitude, log[2]).kept
    assert np.flatnonzero(~kept).tolist() == list(range(100, 100 + length))


def test_several_wrong_fixes_are_found_each() -> None:
    time_s, east, north = boat(8)
    wrong = [20, 22, 90, 91, 150]
    east[wrong] += [300.0, -200.0, 120.0, -700.0, 5000.0]
    kept = implausible(*on_earth(time_s, east, north)).kept
    assert np.flatnonzero(~kept).tolist() == wrong


@pytest.mark.parametrize("noise_m", [0.02, 0.5, 2.0, 4.0])
@pytest.mark.parametrize("every_s", [0.1, 1.0, 2.0, 10.0])
def test_a_good_log_loses_nothing(every_s: float, noise_m: float) -> None:
    for seed in range(5):
        log = on_earth(*boat(seed, every_s=every_s, noise_m=noise_m))
        assert implausible(*log).kept.all()


@pytest.mark.parametrize(
    ("speed_mps", "brake_mps2"),
    [
        (8.0, 3.0),
        (30.0, 9.0),
        # A train.
        (85.0, 1.0),
    ],
)
def test_hard_driving_is_no_fault(speed_mps: float, brake_mps2: float) -> None:
    time_s = np.arange(0.0, 120.0)
    # It drives off, brakes to a stand, and drives off again, as hard as it can.
    phase = time_s % 40.0
    speed = np.minimum(speed_mps, np.minimum(phase, 40.0 - phase) * brake_mps2)
    for quarter in (np.zeros(120), np.where(time_s % 20 < 10, 0.0, np.pi / 2.0)):
        east, north = np.cumsum(speed * np.sin(quarter)), np.cumsum(speed * np.cos(quarter))
        assert implausible(*on_earth(time_s, east, north)).kept.all()


def test_a_step_without_a_return_is_kept() -> None:
    time_s, east, north = boat(3)
    east[100:] += 40.0
    assert implausible(*on_earth(time_s, east, north)).kept.all()


def test_a_gap_is_no_jump() -> None:
    time_s, east, north = boat(3)
    time_s[100:] += 600.0
    east[100:] += 3000.0
    assert implausible(*on_earth(time_s, east, north)).kept.all()


@pytest.mark.parametrize("row", [0, 1, 210, 211])
def test_a_wrong_fix_at_an_end_is_found(row: int) -> None:
    time_s, east, north = boat(4)
    east[row] += 90.0
    kept = implausible(*on_earth(time_s, east, north)).kept
    assert not kept[row]
    assert (~kept).sum() <= 2


def test_the_date_line_is_no_jump() -> None:
    time_s, east, north = boat(5)
    log = on_earth(time_s, east - east[100], north, longitude_deg=180.0)
    assert log[2].min() < -179.0
    assert log[2].max() > 179.0
    assert implausible(*log).kept.all()


def test_a_vessel_moored_on_the_date_line_stays_there() -> None:
    rng = np.random.default_rng(0)
    east, north = 2.0 * rng.standard_normal((2, 200))
    log = on_earth(np.arange(200.0), east, north, longitude_deg=180.0)
    assert (np.diff(np.sign(log[2])) != 0).sum() > 50
    assert implausible(*log).kept.all()


def test_between_sparse_fixes_there_is_time_to_go_out_and_back() -> None:
    time_s = np.arange(0.0, 2000.0, 10.0)
    east, north = 5.0 * time_s, np.zeros(200)
    # 200 m within 10 s, from rest to rest, is 8 m/s².
    north[77] = 200.0
    assert implausible(*on_earth(time_s, east, north)).kept.all()
    # 300 m is 12 m/s².
    north[77] = 300.0
    assert np.flatnonzero(~implausible(*on_earth(time_s, east, north)).kept).tolist() == [77]


def test_what_a_poor_receiver_means_is_kept() -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        time_s, east, north = boat(seed, n=1000, noise_m=0.0)
        # Errors with tails heavier than those of the normal distribution, as among buildings.
        east, north = east + rng.laplace(0.0, 3.0, 1000), north + rng.laplace(0.0, 3.0, 1000)
        assert implausible(*on_earth(time_s, east, north)).kept.all()


@pytest.mark.parametrize("digits", [2, 3, 4, 5])
def test_places_that_were_rounded_are_kept(digits: int) -> None:
    for seed in range(5):
        time_s, latitude, longitude = on_earth(*boat(seed, n=500))
        for unit in (1.0, 60.0):
            places = (np.round(axis * unit, digits) / unit for axis in (latitude, longitude))
            assert implausible(time_s, *places).kept.all()


def test_zeros_are_no_place_but_off_ghana() -> None:
    time_s, latitude, longitude = on_earth(*boat(6))
    latitude[[3, 50, 51]] = longitude[[3, 50, 51]] = 0.0
    found = implausible(time_s, latitude, longitude)
    assert np.flatnonzero(found.nowhere).tolist() == [3, 50, 51]
    assert found.kept.sum() == 209
    # A survey there has fixes all around.
    there = implausible(time_s, latitude - latitude, (time_s - time_s[100]) * 1e-5)
    assert there.kept.all()


def test_more_than_one_vessel_in_a_log_is_refused(tmp_path: Path) -> None:
    time_s, latitude, longitude = on_earth(*boat(1))
    latitude[::2] += 1.0
    write_fixes(Fixes(time_s, latitude, longitude), tmp_path / "two.csv")
    with pytest.raises(InputError, match=r"two\.csv: no more than 106 of its 212 fixes can be tr"):
        read_fixes(tmp_path / "two.csv")


@pytest.mark.parametrize("suffix", [".csv", ".gpx"])
def test_all_readers_leave_out_and_say_what(
    tmp_path: Path, suffix: str, caplog: pytest.LogCaptureFixture
) -> None:
    time_s, latitude, longitude = on_earth(*boat(2))
    latitude[40] += 200.0 / M_PER_DEG
    latitude[[60, 61]] = longitude[[60, 61]] = 0.0
    longitude[90] += 30.0
    path = tmp_path / f"log{suffix}"
    write_fixes(Fixes(time_s, latitude, longitude), path)
    tally = Tally(path)
    fixes = read_fixes(path, tally=tally)
    assert not caplog.records
    assert len(fixes) == 208
    assert tally.read["fixes"] == 208
    rows = {".csv": "line 62", ".gpx": "point 61"}
    where = {reason: (left.count, left.row) for reason, left in tally.left_out.items()}
    zero = "at 0° north, 0° east, which receivers write that have no fix"
    assert where[zero] == (2, rows[suffix])
    assert sum(count for count, _ in where.values()) == 4
    assert read_fixes(path).time_utc_s.tolist() == fixes.time_utc_s.tolist()
    assert len(caplog.records) == 1
    assert "left out: 2 at 0° north" in caplog.text


def test_the_real_log_loses_nothing(data_dir: Path) -> None:
    log = read_fixes(data_dir / "tracks-at-sea" / "target.gpx")
    assert implausible(log.time_utc_s, log.latitude_deg, log.longitude_deg).kept.all()


def test_a_wrong_fix_in_the_real_log_is_found(data_dir: Path) -> None:
    log = read_fixes(data_dir / "tracks-at-sea" / "target.gpx")
    for row in (300, 900, 1500):
        latitude = log.latitude_deg.copy()
        latitude[row] += 3000.0 / M_PER_DEG
        kept = implausible(log.time_utc_s, latitude, log.longitude_deg).kept
        assert np.flatnonzero(~kept).tolist() == [row]


def test_distances_on_the_earth() -> None:
    # A minute of latitude is a nautical mile, within half a per cent.
    one = np.array([10.0])
    assert distance_m(one, one, one + 1 / 60, one)[0] == pytest.approx(1852.0, rel=5e-3)
    # A tenth of a degree across the date line, at 60 degrees half as far as at the equator.
    west, east = np.array([179.95]), np.array([-179.95])
    sixty = np.array([60.0])
    assert distance_m(sixty, west, sixty, east)[0] == pytest.approx(5_560.0, rel=5e-3)


def test_a_log_far_from_the_camera_is_refused() -> None:
    time_s, latitude, longitude = on_earth(*boat(1))
    near = Fixes(time_s, latitude, longitude)
    check_near(near, 54.3, 10.2, "a.csv", "the camera")
    swapped = Fixes(time_s, longitude, latitude)
    with pytest.raises(
        InputError, match=r"a\.csv: its nearest fix is 6,\d\d\d km from the camera.*swapped"
    ):
        check_near(swapped, 54.3, 10.2, "a.csv", "the camera")
    with pytest.raises(InputError, match="is it the right log"):
        check_near(near, -33.9, 151.2, "a.csv", "the camera")


def test_swapped_columns_are_told_where_latitude_and_longitude_are_alike() -> None:
    """Haifa, 32.8 N 35.0 E, is 320 km from where its columns lie the other way round."""
    time_s, latitude, longitude = on_earth(*boat(1))
    north, east = latitude - 54.3 + 32.8, longitude - 10.2 + 35.0
    check_near(Fixes(time_s, north, east), 32.8, 35.0, "a.csv", "the camera")
    with pytest.raises(InputError, match=r"nearest fix is 3\d\d km from the camera.*swapped"):
        check_near(Fixes(time_s, east, north), 32.8, 35.0, "a.csv", "the camera")
    # As far, and no nearer the other way round.
    check_near(Fixes(time_s, north + 3.0, east), 32.8, 35.0, "a.csv", "the camera")
