"""The clock offset of places beside a log, where path, places and clock are known."""

from __future__ import annotations

import numpy as np
import pytest

from sightline.clock_offset import ClockPrior
from sightline.evaluation.clock_match import match_clock
from sightline.geodesy import LocalPlane
from sightline.types import Fixes, FloatArray, Positions

PLANE = LocalPlane(54.3233, 10.1394)
START_S = 1_717_236_000.0
SIGMA_M = 2.0


def path(since_s: FloatArray) -> FloatArray:
    """(N, 2) of a boat that turns to and fro, 4 m/s on average."""
    phase = since_s / 15.0
    return np.stack([60.0 * np.sin(phase), 120.0 + 25.0 * np.sin(1.7 * phase + 0.4)], axis=1)


def log(lead_s: float = 200.0, end_s: float = 90.0) -> Fixes:
    since_s = np.arange(-lead_s, end_s + lead_s)
    return Fixes(START_S + since_s, *PLANE.to_geographic(*path(since_s).T))


def places(since_s: FloatArray, seed: int = 0) -> Positions:
    noise = np.random.default_rng(seed).normal(0.0, SIGMA_M, (since_s.size, 2))
    covariance = np.tile(SIGMA_M**2 * np.eye(2), (since_s.size, 1, 1))
    none = np.zeros(since_s.size, dtype=bool)
    return Positions(
        *(path(since_s) + noise).T, covariance, none, PLANE, np.zeros((since_s.size, 2, 2))
    )


@pytest.mark.parametrize("offset_s", [0.0, 1.0, -7.3, 40.0, 3600.0, 3612.0, -19800.0])
def test_the_offset_is_found_within_three_sigma(offset_s: float) -> None:
    since_s = np.arange(0.0, 90.0, 1.5)
    seen = places(since_s)
    found = match_clock(START_S + since_s + offset_s, seen, log())
    assert found is not None
    assert abs(found.offset_s - offset_s) < 3.0 * found.sigma_s
    assert found.sigma_s < 0.6
    assert found.used_s == (found.offset_s if abs(offset_s) > 0.0 else 0.0)


def test_errors_are_as_large_as_is_stated() -> None:
    since_s = np.arange(0.0, 60.0, 2.5)
    scores = []
    for seed in range(40):
        seen = places(since_s, seed)
        found = match_clock(START_S + since_s + 3.0, seen, log())
        assert found is not None
        scores.append((found.offset_s - 3.0) / found.sigma_s)
    # A receiver may stand ahead or astern on its hull, which here it does not.
    assert np.abs(scores).max() < 3.0


def test_a_stated_clock_holds_what_the_places_leave_open() -> None:
    """A boat that keeps its course and speed tells no clock from a shift along its path."""
    since_s = np.arange(0.0, 60.0, 2.0)
    straight = np.stack([4.0 * since_s - 100.0, np.full(since_s.size, 150.0)], axis=1)
    long_s = np.arange(-100.0, 160.0)
    fixes = Fixes(
        START_S + long_s, *PLANE.to_geographic(4.0 * long_s - 100.0, np.full(long_s.size, 150.0))
    )
    # All places may lie 40 m further along together.
    covariance = np.tile(np.diag([40.0**2, 1.0]) + np.eye(2), (since_s.size, 1, 1))
    seen = Positions(
        straight[:, 0] + 8.0,
        straight[:, 1],
        covariance,
        np.zeros(since_s.size, dtype=bool),
        PLANE,
        covariance - np.eye(2),
    )
    open_s = match_clock(START_S + since_s, seen, fixes)
    held = match_clock(START_S + since_s, seen, fixes, prior=ClockPrior(0.0, 0.1, stated=True))
    assert open_s is not None
    assert held is not None
    assert abs(held.offset_s) < 0.2
    assert open_s.used_s == 0.0


def test_too_few_places_tell_nothing() -> None:
    since_s = np.array([3.0, 9.0])
    seen = places(since_s)
    assert match_clock(START_S + since_s, seen, log()) is None
    since_s = np.arange(0.0, 30.0)
    seen = places(since_s)
    far = START_S + since_s + 20.0 * 86400.0
    assert match_clock(far, seen, log()) is None
