from __future__ import annotations

import csv
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.clock import FrameClock, presentation_clock, stamped_clock
from sightline.errors import InputError

CLOCKS = ("06", "07", "08", "09", "10", "11", "13", "15", "17", "18", "19", "20", "21")


def frame_times(rng: np.random.Generator, n: int = 3000) -> np.ndarray:
    """A camera whose rate drifts and that holds its breath once in a while."""
    rate = rng.uniform(15.0, 30.0) * np.exp(np.cumsum(rng.normal(0.0, 0.002, n)))
    return 1.6e9 + rng.uniform(0.0, 100.0) + np.cumsum(1.0 / rate)


def timer_stamps(times: np.ndarray, period_s: float, phase_s: float) -> np.ndarray:
    """Stamps of a clock that a timer reads, at the first frame after each tick."""
    tick = np.floor((times - phase_s) / period_s)
    read = np.append(True, np.diff(tick) > 0)
    last_read = np.maximum.accumulate(np.where(read, np.arange(times.size), 0))
    seen = np.where(last_read > 0, times[last_read], phase_s + period_s * tick[0])
    return np.floor(seen)


def test_presentation_times_are_added_to_the_start() -> None:
    clock = presentation_clock(1.6e9, [0.0, 0.04, 0.2, 0.21])
    np.testing.assert_allclose(clock.time_utc_s([2, 0]), [1.6e9 + 0.2, 1.6e9], atol=1e-6)
    np.testing.assert_array_equal(clock.sigma_s([2, 0]), 0.0)


def test_distinct_stamps_are_taken_as_they_are() -> None:
    stamps = np.array([1.6e9, 1.6e9 + 0.047, 1.6e9 + 0.081, 1.6e9 + 2.5])
    clock = stamped_clock([0, 1, 2, 10], stamps)
    np.testing.assert_allclose(clock.time_utc_s([0, 1, 2, 10]), stamps)
    np.testing.assert_allclose(clock.time_utc_s([6]), [(stamps[2] + stamps[3]) / 2.0])
    np.testing.assert_allclose(clock.sigma_s([1]), 0.001 / np.sqrt(12.0))


def test_one_frame_with_one_stamp() -> None:
    clock = stamped_clock([7], [1.6e9 + 0.5])
    assert clock.time_utc_s([7])[0] == 1.6e9 + 0.5
    assert clock.sigma_s([7])[0] == pytest.approx(0.1 / np.sqrt(12.0))


def test_whole_seconds_read_at_every_frame_are_known_to_a_fraction_of_a_frame() -> None:
    times = frame_times(np.random.default_rng(1))
    clock = stamped_clock(np.arange(times.size), np.floor(times))
    error = clock.time_utc_s(np.arange(times.size)) - times
    assert np.abs(error).max() < 0.1
    sigma = clock.sigma_s(np.arange(times.size))
    assert sigma.max() < 0.1
    assert np.mean(np.abs(error) < 2.0 * sigma) > 0.9


def test_a_timer_that_slips_reveals_what_was_cut_off() -> None:
    # 5.03 s against whole seconds: the stamps step by 6 once in 33 readings.
    rng = np.random.default_rng(2)
    times = frame_times(rng, 6000)
    stamps = timer_stamps(times, 5.03, times[0] - 2.0)
    assert set(np.diff(np.unique(stamps))) == {5.0, 6.0}
    clock = stamped_clock(np.arange(times.size), stamps)
    error = clock.time_utc_s(np.arange(times.size)) - times
    assert np.abs(error).max() < 0.35
    assert np.median(clock.sigma_s(np.arange(times.size))) < 0.15


@pytest.mark.slow
def test_times_of_a_timed_clock_are_as_uncertain_as_stated() -> None:
    """Over many recordings: errors bounded by the resolution, and sigma is their size."""
    rng = np.random.default_rng(3)
    worst, standardised = [], []
    for _ in range(60):
        times = frame_times(rng, 2500)
        period = 5.0 + rng.choice([0.0, rng.normal(0.0, 0.03)])
        stamps = timer_stamps(times, period, times[0] - rng.uniform(0.0, period))
        clock = stamped_clock(np.arange(times.size), stamps)
        frames = np.arange(0, times.size, 50)
        error = clock.time_utc_s(frames) - times[frames]
        worst.append(np.abs(error).max())
        standardised.append(np.mean(error) / np.mean(clock.sigma_s(frames)))
    assert max(worst) < 0.8
    # Half a second is the mean of what truncation takes: no bias is left.
    assert abs(np.mean(standardised)) < 3.0 / np.sqrt(60)
    assert 0.7 < np.std(standardised) < 1.2


def test_between_two_known_times_the_uncertainty_is_that_of_a_rate_that_wanders() -> None:
    """Many cameras whose rate is noise, brought to the same two ends: how far apart are they?"""
    frames, duration_s, wander = 100, 5.0, 0.04
    rng = np.random.default_rng(4)
    steps_s = duration_s / frames + rng.normal(
        0.0, wander * duration_s / np.sqrt(frames), (20_000, frames)
    )
    times_s = np.cumsum(steps_s, axis=1)
    share = np.arange(1, frames + 1) / frames
    times_s += share * (duration_s - times_s[:, -1:])
    at = np.array([10, 25, 50, 90])
    spread_s = times_s[:, at - 1].std(axis=0)
    known = FrameClock(
        np.array([0, frames]), np.array([1.6e9, 1.6e9 + duration_s]), np.zeros(2), wander
    )
    np.testing.assert_allclose(known.sigma_s(at), spread_s, rtol=0.03)
    np.testing.assert_array_equal(known.sigma_s([0, frames]), 0.0)
    # What is unsure at the ends comes on top.
    unsure = FrameClock(known.frame, known.knot_utc_s, np.full(2, 0.1), wander)
    np.testing.assert_allclose(unsure.sigma_s(at), np.hypot(0.1, spread_s), rtol=0.03)


@pytest.mark.parametrize("end", ["first", "last"])
def test_the_ends_of_a_clock_do_not_reach_beyond_a_reading_that_nobody_saw(end: str) -> None:
    """The camera is three times as fast in the first or the last stretch, of whose readings one
    is seen: the timer, and not the rate of the neighbour, says how long it lasted."""
    period_s, frame_s = 5.0, 0.1
    stretches = [np.arange(0.0, period_s, frame_s) + period_s * i for i in range(8)]
    fast = 0 if end == "first" else -1
    stretches[fast] = stretches[fast][0] + np.arange(0.0, period_s, frame_s / 3.0)
    times = 1.6e9 + 0.3 + np.concatenate(stretches)
    stamps = np.repeat([1.6e9 + period_s * i for i in range(8)], [len(s) for s in stretches])
    clock = stamped_clock(np.arange(times.size), stamps)
    error_s = clock.time_utc_s(np.arange(times.size)) - times
    # What a reading cut off is not known to better than a second.
    assert np.abs(error_s).max() < 1.0


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    period=st.floats(2.0, 20.0),
    fps=st.floats(2.0, 60.0),
)
def test_recovered_times_increase_and_never_precede_their_stamp(
    seed: int, period: float, fps: float
) -> None:
    rng = np.random.default_rng(seed)
    n = int(6.0 * period * fps)
    times = 1.6e9 + rng.uniform(0.0, 60.0) + np.cumsum(rng.uniform(0.5, 1.5, n) / fps)
    stamps = timer_stamps(times, period, times[0] - rng.uniform(0.0, period))
    clock = stamped_clock(np.arange(n), stamps)
    recovered = clock.time_utc_s(np.arange(n))
    assert (np.diff(recovered) > 0.0).all()
    steps = np.flatnonzero(np.diff(stamps)) + 1
    cut_off = recovered[steps] - stamps[steps]
    assert (cut_off >= 0.0).all()
    assert (cut_off <= 1.0).all()
    assert (clock.sigma_s(np.arange(n)) > 0.0).all()


@pytest.mark.parametrize("name", CLOCKS)
def test_real_clocks(data_dir: Path, name: str) -> None:
    path = data_dir / "tracks-at-sea" / "clock" / f"{name}.csv"
    with path.open() as file:
        rows = list(csv.DictReader(file))
    frames = np.array([int(row["frame"]) for row in rows])
    stamps = np.array([datetime.fromisoformat(row["utc"]).timestamp() for row in rows])
    clock = stamped_clock(frames, stamps)
    times = clock.time_utc_s(frames)
    assert (np.diff(times) > 0.0).all()
    first = np.flatnonzero(np.diff(stamps)) + 1
    assert ((times[first] >= stamps[first]) & (times[first] <= stamps[first] + 1.0)).all()
    # No frame is shown before its stamp, nor after the reading that would have replaced it.
    longest = np.diff(stamps[first]).max()
    assert (times >= stamps).all()
    assert (times < stamps + longest + 1.0).all()
    rate = 1.0 / np.diff(times)
    assert rate.min() > 18.0
    assert rate.max() < 30.0
    assert 0.1 < np.median(clock.sigma_s(frames)) < 0.35


def test_a_reading_cut_short_by_one_second_pins_the_clock_down(data_dir: Path) -> None:
    """Recording 18 steps by 4 s and then by 6: there, a reading fell just before its second."""
    path = data_dir / "tracks-at-sea" / "clock" / "18.csv"
    with path.open() as file:
        rows = list(csv.DictReader(file))
    stamps = np.array([datetime.fromisoformat(row["utc"]).timestamp() for row in rows])
    clock = stamped_clock(np.arange(stamps.size), stamps)
    first = np.flatnonzero(np.diff(stamps)) + 1
    cut_off = clock.time_utc_s(first) - stamps[first]
    early = int(np.argmin(np.diff(stamps[first]))) + 1
    assert cut_off[early] > 0.8
    assert cut_off[early - 1] < 0.3
    assert cut_off[early + 1] < 0.3


@pytest.mark.parametrize(
    ("frame", "stamp", "message"),
    [
        ([], [], "one time a frame"),
        ([0, 1], [1.0], "one time a frame"),
        ([0, 1, 2], [1.0, np.nan, 2.0], r"row 2 \(frame 1\) has no time"),
        ([0, 2, 2], [1.0, 2.0, 3.0], r"row 3 \(frame 2\) does not follow"),
        ([0, 1, 2], [1.0, 3.0, 2.0], r"row 3 \(frame 2\) is earlier"),
        (range(100), [1.6e9] * 100, "steps 0 times in 100 frames"),
        (range(100), [1.6e9] * 50 + [1.6e9 + 5] * 50, "steps 1 times in 100 frames"),
    ],
)
def test_refused_clocks(frame: list[int], stamp: list[float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        stamped_clock(list(frame), stamp)


def test_frames_beyond_the_clock_have_no_time() -> None:
    clock = FrameClock(np.array([10, 20]), np.array([1.0, 2.0]), np.zeros(2))
    with pytest.raises(InputError, match="frame 21 has no time: the clock runs from frame 10 to"):
        clock.time_utc_s([12, 21])
