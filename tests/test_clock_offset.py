"""Clock offsets: when they count, and what is believed of a clock that nobody spoke of."""

from __future__ import annotations

import numpy as np
import pytest

from sightline.clock_offset import ClockOffset, ClockPrior, RecordingClock


def test_an_offset_counts_where_it_is_sure_or_stated() -> None:
    assert ClockOffset(1.0, 0.2).used_s == 1.0
    assert ClockOffset(-1.0, 0.2).used_s == -1.0
    assert ClockOffset(0.3, 0.2).used_s == 0.0
    assert ClockOffset(0.05, 0.2, stated=True).used_s == 0.05
    assert ClockOffset(40.0, 0.12).words == "40.0 ± 0.1 s ahead of the log"
    assert ClockOffset(-2.0, 0.3).words == "2.0 ± 0.3 s behind the log"


def test_a_clock_that_nobody_spoke_of_has_a_cauchy_prior_and_zones() -> None:
    prior = ClockPrior()
    # Of a Cauchy density whose middle bends as a normal one of 0.5 s.
    gamma = 0.5 * np.sqrt(2.0)
    for offset_s in (0.0, 0.5, 3.0, 40.0):
        expected = -np.log1p((offset_s / gamma) ** 2)
        assert prior.log_density(offset_s) == pytest.approx(expected)
        assert prior.log_density(-offset_s) == pytest.approx(expected)
    # Off by a whole zone is likelier than by any other time as long, and India is a zone.
    for zone_s in (3600.0, -5 * 3600.0, 5.5 * 3600.0):
        assert prior.log_density(zone_s) > prior.log_density(zone_s + 200.0) + 5.0


def test_what_is_far_out_is_hardly_pulled() -> None:
    """The slope of the log density, and that of the normal one that stands in for it, are one."""
    prior = ClockPrior()
    for offset_s in (0.2, 1.0, 40.0, 3601.0):
        mean_s, sigma_s = prior.near(offset_s)
        slope = (prior.log_density(offset_s + 1e-4) - prior.log_density(offset_s - 1e-4)) / 2e-4
        assert -(offset_s - mean_s) / sigma_s**2 == pytest.approx(slope, rel=1e-3)
    assert prior.near(40.0)[1] > 20.0
    assert prior.near(3601.0)[0] == 3600.0
    stated = ClockPrior(40.0, 0.1, stated=True)
    assert stated.near(47.0) == (40.0, 0.1)
    assert stated.log_density(40.2) == pytest.approx(-2.0)


def test_what_was_taken_off_before_a_fit_counts_in_what_comes_of_it() -> None:
    clock = RecordingClock(40.0, ClockPrior())
    # The fit tells how much is to be put back: the camera's clock was less ahead.
    assert clock.after(0.5, 0.1).offset_s == 39.5
    assert clock.left is not None
    mean_s, sigma_s = clock.left
    assert mean_s == 40.0
    assert sigma_s > 20.0
    assert RecordingClock().left is None
