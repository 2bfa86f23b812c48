from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _support.traffic import Traffic
from scipy.optimize import approx_fprime
from scipy.stats import chi2, multivariate_normal

from sightline.camera.correlated_noise import (
    HEAVE_CORRELATION_TIME_S,
    LONGEST_BLOCK_S,
    MOST_IN_BLOCK,
    LogError,
    Whitening,
    blocks_of,
    gap_covariance,
    thinned,
)
from sightline.camera.parameters import LOG_FOCAL, PITCH
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.observations import CameraObservations
from sightline.types import FloatArray

DRIFT_M, DRIFT_S = 1.5, 20.0


class World:
    """PointCorrespondences of two recordings and two without a time, and the covariance of their
    pixels."""

    def __init__(self, seed: int = 0, *, gaps: bool = False) -> None:
        rng = np.random.default_rng(seed)
        self.time_s = np.concatenate([rng.uniform(0.0, 50.0, 9), [np.nan, np.nan]])
        self.group = np.array([0, 0, 0, 0, 1, 1, 1, 1, 1, 0, 1])
        self.variance_px2 = rng.uniform(0.5, 4.0, (11, 2))
        self.by_place = rng.normal(0.0, 5.0, (11, 2, 2))
        self.pixel_px = rng.normal(0.0, 10.0, (11, 2))
        # Fixes 20 s apart, of which the log of the second recording has no gaps.
        begin = 20.0 * np.floor(self.time_s / 20.0)
        self.gap_s = np.stack([begin, begin + 20.0], axis=1)
        own = rng.uniform(2.0, 6.0, 11)
        self.sigma_m = np.where((self.group == 0) & np.isfinite(begin) & gaps, own, 0.0)

    def kernel(
        self, correlated_m: float = DRIFT_M, correlation_time_s: float = DRIFT_S
    ) -> FloatArray:
        """(11, 11) of the correlated error, one pair of sightings after the other."""
        out = np.zeros((11, 11))
        for i in range(11):
            for j in range(11):
                if self.group[i] == self.group[j] and i < 9 and j < 9:
                    apart = np.sqrt((self.time_s[i] - self.time_s[j]) ** 2 + 1.0) - 1.0
                    out[i, j] = correlated_m**2 * np.exp(-apart / correlation_time_s)
                    if self.gap_s[i, 0] == self.gap_s[j, 0]:
                        strays = (self.time_s[i] - self.time_s[j]) / (0.42 * 20.0)
                        out[i, j] += self.sigma_m[i] * self.sigma_m[j] * np.exp(-0.5 * strays**2)
        return out

    def covariance(
        self,
        variance_px2: FloatArray,
        correlated_m: float = DRIFT_M,
        correlation_time_s: float = DRIFT_S,
    ) -> FloatArray:
        """(22, 22) of columns and rows, box by box."""
        shared = np.einsum(
            "iab,ij,jcb->iajc",
            self.by_place,
            self.kernel(correlated_m, correlation_time_s),
            self.by_place,
        )
        return shared.reshape(22, 22) + np.diag(variance_px2.ravel())

    def whitening(
        self, correlated_m: float = DRIFT_M, correlation_time_s: float = DRIFT_S
    ) -> Whitening:
        return Whitening(
            blocks_of(self.time_s, self.group, self.sigma_m, self.gap_s),
            self.variance_px2,
            self.by_place,
            correlated_m,
            correlation_time_s,
        )


@pytest.mark.parametrize("gaps", [False, True])
def test_residuals_become_independent_of_unit_variance(gaps: bool) -> None:
    world = World(gaps=gaps)
    whitening = world.whitening()
    made = whitening.forward(np.eye(22).reshape(11, 2, 22)).reshape(22, 22)
    covariance = world.covariance(world.variance_px2)
    np.testing.assert_allclose(made @ covariance @ made.T, np.eye(22), atol=1e-10)
    assert whitening.log_determinant() == pytest.approx(0.5 * np.linalg.slogdet(covariance)[1])


@pytest.mark.parametrize("gaps", [False, True])
def test_the_likeliest_error_is_the_conditional_mean(gaps: bool) -> None:
    world = World(gaps=gaps)
    whitening = world.whitening()
    pulled = whitening.backward(whitening.forward(world.pixel_px[:, :, None]))[:, :, 0]
    solved = np.linalg.solve(world.covariance(world.variance_px2), world.pixel_px.ravel())
    np.testing.assert_allclose(pulled.ravel(), solved, rtol=1e-9)
    expected = np.einsum("ij,jab,ja->ib", world.kernel(), world.by_place, solved.reshape(11, 2))
    np.testing.assert_allclose(whitening.correlated_error(pulled), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("gaps", [False, True])
def test_slopes_are_those_of_the_likelihood_with_parameters_integrated_out(gaps: bool) -> None:
    world = World(gaps=gaps)
    design = np.random.default_rng(5).normal(0.0, 3.0, (11, 2, 3))
    flat = design.reshape(22, 3)

    def negative_log(variance: FloatArray, correlated_m: float, correlation_time_s: float) -> float:
        covariance = (
            world.covariance(variance.reshape(11, 2), correlated_m, correlation_time_s)
            + flat @ flat.T
        )
        return -float(multivariate_normal(cov=covariance).logpdf(world.pixel_px.ravel()))

    whitening = world.whitening()
    white = whitening.forward(np.concatenate([design, world.pixel_px[:, :, None]], axis=2))
    table = white.reshape(22, 4)
    covariance = np.linalg.inv(table[:, :3].T @ table[:, :3] + np.eye(3))
    step = covariance @ table[:, :3].T @ table[:, 3]
    solved = whitening.backward(white)
    by_variance, by_size, by_length, _ = whitening.gradient(
        solved[:, :, 3] - solved[:, :, :3] @ step, solved[:, :, :3], covariance, DRIFT_S
    )
    given = world.variance_px2.ravel()
    expected = approx_fprime(given, lambda v: negative_log(v, DRIFT_M, DRIFT_S), 1e-6)
    np.testing.assert_allclose(by_variance.ravel(), expected, atol=1e-4)
    logs = np.log([DRIFT_M, DRIFT_S])
    expected = approx_fprime(logs, lambda t: negative_log(given, *np.exp(t)), 1e-6)
    np.testing.assert_allclose([by_size, by_length], expected, atol=1e-4)


def test_what_a_vessel_does_in_a_gap_is_half_alike_at_half_a_gap() -> None:
    """Of an integrated Wiener process whose ends are known, places and velocities."""
    span = 20.0
    since_s = np.linspace(2.0, 18.0, 9)
    times = np.array([0.0, span])

    def places(a: FloatArray, b: FloatArray) -> FloatArray:
        a, b = np.meshgrid(a + 1.0, b + 1.0, indexing="ij")
        less = np.minimum(a, b)
        return less**2 * (less / 3.0 + np.abs(a - b) / 2.0) + 1e5 * (1.0 + a * b)

    # Fixes before and after the gap tell the velocities at its ends.
    around = np.concatenate([times - span, times, times + span])
    around = np.unique(around)
    own = places(around, around) + 1e-6 * np.eye(around.size)
    across = places(since_s, around)
    true = places(since_s, since_s) - across @ np.linalg.solve(own, across.T)
    sigma = np.sqrt(np.diag(true))
    found = gap_covariance(since_s, sigma, np.tile(times, (9, 1)))
    np.testing.assert_allclose(np.diag(found), np.diag(true))
    correlation, expected = found / np.outer(sigma, sigma), true / np.outer(sigma, sigma)
    assert np.abs(correlation - expected).max() < 0.35
    assert np.abs(correlation - expected).mean() < 0.12
    assert np.linalg.eigvalsh(found).min() > -1e-9
    two = gap_covariance(since_s[:2], sigma[:2], np.array([[0.0, 3.0], [3.0, 6.0]]))
    assert two[0, 1] == 0.0


def test_a_coordinate_sees_its_share_of_the_error() -> None:
    world = World()
    error = LogError(world.time_s, world.by_place[:, 0], world.group, DRIFT_M, DRIFT_S)
    expected = world.covariance(np.zeros((11, 2)))[::2, ::2]
    np.testing.assert_allclose(error.covariance(), expected, rtol=1e-12, atol=1e-12)
    some = np.array([1, 4, 6, 10])
    np.testing.assert_allclose(error[some].covariance(), expected[np.ix_(some, some)], rtol=1e-12)


def test_vessels_of_one_feed_have_errors_of_their_own() -> None:
    """As one error of all of them, those of single receivers would seem to be the camera's."""
    squares = []
    for seed in range(4):
        traffic = Traffic.random(seed, vessels=5, unlogged=0)
        boxes, owner = traffic.boxes(clutter=0.0), traffic.owner(clutter=0.0)
        east_north_m, velocity_mps = np.full((2, len(boxes), 2), np.nan)
        for mmsi, path in traffic.paths().items():
            own = owner == mmsi
            at = path.at(boxes.time_utc_s[own] + traffic.offset_s)
            east_north_m[own], velocity_mps[own] = at.east_north_m, at.velocity_mps
        rows = np.flatnonzero(np.isfinite(east_north_m).all(axis=1))[::4]
        model = CameraRegressor(traffic.camera.image_size_px, residual=False, starts=2)
        model.fit_observations(
            CameraObservations(
                boxes.xyxy_px[rows],
                east_north_m[rows],
                velocity_mps=velocity_mps[rows],
                time_s=boxes.time_utc_s[rows],
                vessel=owner[rows],
            )
        )
        sigma = np.sqrt(np.diag(model.fit_.covariance))[[PITCH, LOG_FOCAL]]
        true = traffic.camera
        off = [
            np.radians(model.camera_.pitch_deg - true.pitch_deg),
            np.log(model.camera_.focal_px / true.focal_length_px),
        ]
        squares.append((np.array(off) / sigma) ** 2)
    assert np.sum(squares) < chi2.ppf(0.995, 8)


def test_sightings_that_come_faster_than_needed_are_thinned_evenly() -> None:
    time = np.concatenate([np.linspace(0.0, LONGEST_BLOCK_S, 4000), [np.nan] * 5, np.arange(30.0)])
    group = np.repeat([0, 0, 1], [4000, 5, 30])
    chosen = thinned(time, group)
    assert np.sum(chosen < 4000) == MOST_IN_BLOCK
    assert chosen[0] == 0
    assert 3999 in chosen
    np.testing.assert_array_equal(chosen[-35:], np.arange(4000, 4035))
    blocks = blocks_of(time[chosen], group[chosen])
    assert max(block.rows.size for block in blocks) <= MOST_IN_BLOCK
    in_blocks = np.sort(np.concatenate([block.rows for block in blocks]))
    np.testing.assert_array_equal(in_blocks, np.flatnonzero(np.isfinite(time[chosen])))


def test_a_longer_log_tells_more_however_fast_it_comes() -> None:
    """What counts is boxes in a time: ten minutes keep ten times as many as one."""
    minutes = 10
    time = np.arange(0.0, minutes * LONGEST_BLOCK_S, 0.1)
    chosen = thinned(time, np.zeros(time.size, dtype=np.int64))
    assert chosen.size == pytest.approx(minutes * MOST_IN_BLOCK, abs=minutes)
    a_minute = np.histogram(time[chosen], minutes, (0.0, minutes * LONGEST_BLOCK_S))[0]
    np.testing.assert_allclose(a_minute, MOST_IN_BLOCK, atol=2)
    # Two logs at once are two logs, each with as many.
    both = thinned(np.tile(time, 2), np.repeat([0, 1], time.size))
    assert both.size == 2 * chosen.size


HEAVE_M = 0.3


def heaving(world: World, heave_m: float = HEAVE_M) -> tuple[FloatArray, FloatArray]:
    """(11, 2) pixels a metre of height, and the covariance (22, 22) that the heave adds."""
    by_height = np.random.default_rng(11).normal(0.0, 8.0, (11, 2))
    kernel = world.kernel(heave_m, HEAVE_CORRELATION_TIME_S)
    return by_height, np.einsum("ia,ij,jc->iajc", by_height, kernel, by_height).reshape(22, 22)


def test_heave_is_another_error_that_lasts() -> None:
    world = World()
    by_height, added = heaving(world)
    whitening = Whitening(
        *(blocks_of(world.time_s, world.group), world.variance_px2, world.by_place),
        *(DRIFT_M, DRIFT_S, by_height, HEAVE_M),
    )
    covariance = world.covariance(world.variance_px2) + added
    made = whitening.forward(np.eye(22).reshape(11, 2, 22)).reshape(22, 22)
    np.testing.assert_allclose(made @ covariance @ made.T, np.eye(22), atol=1e-10)

    def negative_log(logs: FloatArray) -> float:
        heave_m, correlated_m = np.exp(logs)
        total = world.covariance(world.variance_px2, correlated_m) + heaving(world, heave_m)[1]
        return -float(multivariate_normal(cov=total).logpdf(world.pixel_px.ravel()))

    solved = whitening.backward(whitening.forward(world.pixel_px[:, :, None]))
    nothing = np.zeros((11, 2, 1))
    _, by_size, _, by_heave = whitening.gradient(
        solved[:, :, 0], nothing, np.zeros((1, 1)), DRIFT_S
    )
    expected = approx_fprime(np.log([HEAVE_M, DRIFT_M]), negative_log, 1e-6)
    np.testing.assert_allclose([by_heave, by_size], expected, rtol=1e-3, atol=1e-4)


def test_heave_moves_ranges_of_a_recording_together() -> None:
    world = World()
    plain = LogError(world.time_s, world.by_place[:, 0], world.group, DRIFT_M, DRIFT_S)
    lifted = replace(plain, heave=0.05)
    np.testing.assert_allclose(
        lifted.covariance() - plain.covariance(),
        world.kernel(0.05, HEAVE_CORRELATION_TIME_S),
        atol=1e-12,
    )
