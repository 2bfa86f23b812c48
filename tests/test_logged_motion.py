"""Where a logged vessel was in the gaps of its log, and how far that may be off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from sightline import formats
from sightline.geodesy import LocalPlane
from sightline.logged_motion import (
    GapStates,
    LoggedMotion,
    MotionNoise,
    estimate_motion,
    log_likelihood,
    spikes,
)
from sightline.simulation import Harbour, HarbourSettings
from sightline.synchronisation import distinct
from sightline.types import FloatArray

NOISE = MotionNoise(density_m2ps3=0.3, fix_sigma_m=0.5)
IN_95 = np.sqrt(chi2.ppf(0.95, df=2))


def covariance(one: FloatArray, other: FloatArray, noise: MotionNoise) -> FloatArray:
    """Of places of an integrated Wiener process that begins anywhere, at any velocity."""
    a, b = np.meshgrid(one, other, indexing="ij")
    less = np.minimum(a, b)
    return noise.density_m2ps3 * less**2 * (less / 3.0 + np.abs(a - b) / 2.0) + 1e6 * (1.0 + a * b)


def fixes(count: int = 14) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(3)
    return np.cumsum(rng.uniform(5.0, 15.0, count)), 20.0 * rng.normal(size=(count, 2))


def test_a_gap_is_bridged_as_a_gaussian_process_does() -> None:
    times, places = fixes()
    asked, left = np.array([times[6] + 2.0, times[7] + 0.4, times[7] + 4.5]), np.array([6, 7, 7])
    at = LoggedMotion(times, places, NOISE).at(asked, left)
    own = covariance(times, times, NOISE) + NOISE.fix_sigma_m**2 * np.eye(times.size)
    across = covariance(asked, times, NOISE)
    expected = across @ np.linalg.solve(own, places)
    variance = np.diag(covariance(asked, asked, NOISE) - across @ np.linalg.solve(own, across.T))
    np.testing.assert_allclose(at.east_north_m, expected, atol=2e-3)
    # What is stated is wider by what a handful of fixes does not tell of how a vessel moves.
    np.testing.assert_allclose(at.sigma_m**2 / variance, 1.4, rtol=2e-3)


def test_its_velocity_is_that_of_its_path() -> None:
    times, places = fixes()
    motion, middle = LoggedMotion(times, places, NOISE), times[5] + 3.0
    step = 1e-3
    path = motion.at(np.array([middle - step, middle + step]), np.array([5, 5])).east_north_m
    at = motion.at(np.array([middle]), np.array([5]))
    np.testing.assert_allclose(at.velocity_mps[0], (path[1] - path[0]) / (2 * step), rtol=1e-5)


def test_the_likelihood_is_that_of_the_gaussian_process() -> None:
    times, places = fixes()

    def dense(noise: MotionNoise) -> float:
        own = covariance(times, times, noise) + noise.fix_sigma_m**2 * np.eye(times.size)
        square = float(np.sum(places * np.linalg.solve(own, places)))
        return -0.5 * square - float(np.linalg.slogdet(own)[1])

    other = MotionNoise(density_m2ps3=2.0, fix_sigma_m=0.8)
    found = log_likelihood(times, places, NOISE) - log_likelihood(times, places, other)
    assert found == pytest.approx(dense(NOISE) - dense(other), abs=0.01)


@pytest.mark.parametrize("density", [0.01, 0.3, 3.0])
def test_how_restless_a_vessel_is_its_log_tells(density: float) -> None:
    rng = np.random.default_rng(1)
    step_s, count = 10.0, 150
    push = density * np.array([[step_s**3 / 3, step_s**2 / 2], [step_s**2 / 2, step_s]])
    root = np.linalg.cholesky(push)
    state = np.zeros((2, 2))
    places = []
    for _ in range(count):
        state = np.array([[1.0, step_s], [0.0, 1.0]]) @ state + root @ rng.normal(size=(2, 2))
        places.append(state[0] + 0.3 * rng.normal(size=2))
    found = estimate_motion(step_s * np.arange(count), np.array(places))
    assert found.density_m2ps3 == pytest.approx(density, rel=0.5)


@pytest.mark.parametrize("off_m", [15.0, 60.0, 3000.0])
@pytest.mark.parametrize("every_s", [1, 10])
def test_a_fix_that_leaps_off_does_not_make_a_vessel_restless(off_m: float, every_s: int) -> None:
    harbour = Harbour.random(2, HarbourSettings(duration_s=240.0))
    log = harbour.fixes()[::every_s]
    places = np.stack(harbour.plane.to_plane(log.latitude_deg, log.longitude_deg), axis=1)
    clean = estimate_motion(log.time_utc_s, places)
    assert not spikes(log.time_utc_s, places).any()
    wrong = places.copy()
    wrong[12] += np.array([0.6, 0.8]) * off_m
    found = estimate_motion(log.time_utc_s, wrong)
    if off_m > 12.0 * every_s:
        assert np.flatnonzero(spikes(log.time_utc_s, wrong)).tolist() == [12]
        assert found.density_m2ps3 == pytest.approx(clean.density_m2ps3, rel=0.3)
    # What cannot be told from a turn is one: the ellipses are wider, never narrower.
    assert found.density_m2ps3 > 0.7 * clean.density_m2ps3


def left_out(
    times: FloatArray, places: FloatArray, every_s: float, first_s: float
) -> tuple[GapStates, FloatArray]:
    """What a log that is thinned says of the fixes that were taken out, and where these are."""
    asked = np.arange(times[0] + first_s, times[-1], every_s)
    kept = np.unique(np.searchsorted(times, asked))
    rest = np.setdiff1d(np.arange(kept[0], kept[-1]), kept)
    motion = LoggedMotion.of(times[kept], places[kept])
    left = np.searchsorted(times[kept], times[rest]) - 1
    return motion.at(times[rest], left), places[rest]


@pytest.mark.parametrize("every_s", [10.0, 20.0])
def test_boats_of_a_harbour_are_where_a_thinned_log_says(every_s: float) -> None:
    off, sigma = [], []
    for seed in range(6):
        harbour = Harbour.random(seed, HarbourSettings(duration_s=240.0))
        times = harbour.start_utc_s + np.arange(0.0, 240.0, 1.0)
        truth = harbour.truth(times)
        path = np.stack([truth.east_m, truth.north_m], axis=1)
        at, true = left_out(times, path, every_s, 0.0)
        off.append(np.hypot(*(at.east_north_m - true).T))
        sigma.append(at.sigma_m)
    inside = np.concatenate(off) < IN_95 * np.concatenate(sigma)
    assert 0.90 < inside.mean() < 1.0
    # It is worth more than a straight line, whose error at such turns is as large as the turn.
    assert np.median(np.concatenate(off)) < 6.0 * (every_s / 10.0) ** 2


@pytest.mark.parametrize("every_s", [10.0, 30.0])
def test_a_real_boat_is_where_its_thinned_log_says(data_dir: Path, every_s: float) -> None:
    """Fixes that were taken out lie in the stated ellipses as often as these say."""
    log = distinct(formats.read_fixes(data_dir / "tracks-at-sea" / "target.gpx"))
    plane = LocalPlane(float(log.latitude_deg[0]), float(log.longitude_deg[0]))
    places = np.stack(plane.to_plane(log.latitude_deg, log.longitude_deg), axis=1)
    off, sigma = [], []
    for part in np.split(np.arange(len(log)), np.flatnonzero(np.diff(log.time_utc_s) > 8.0) + 1):
        times = log.time_utc_s[part]
        for first_s in (0.0, every_s / 2.0):
            if np.ptp(times) > 6.0 * every_s:
                at, true = left_out(times, places[part], every_s, first_s)
                off.append(np.hypot(*(at.east_north_m - true).T))
                sigma.append(at.sigma_m)
    inside = np.concatenate(off) < IN_95 * np.concatenate(sigma)
    assert inside.size > 1000
    assert 0.92 < inside.mean() < 0.99
