from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from _support.traffic import Traffic
from scipy.optimize import approx_fprime, minimize_scalar
from scipy.stats import chi2, multivariate_normal

from sightline.camera.correlated_noise import (
    HEAVE_CORRELATION_TIME_S,
    LONGEST_BLOCK_S,
    MOST_IN_BLOCK,
    CorrelatedError,
    Whitening,
    blocks_of,
    gap_covariance,
    thinned,
)
from sightline.camera.parameters import LOG_FOCAL, PITCH
from sightline.camera.priors import PixelNoise
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.observations import CameraObservations
from sightline.types import FloatArray

NOISE = PixelNoise(
    correlated_m=1.5,
    correlation_time_s=20.0,
    offset_m=0.8,
    antenna_share=0.3,
    lasting_m=0.5,
    lasting_row_px=1.2,
    lasting_column_px=2.1,
    lasting_time_s=3.0,
    heave_m=0.3,
)
PARTS = tuple(
    name
    for name in NOISE.__dataclass_fields__
    if name not in ("row_px", "row_m", "column_px", "place_m", "middle_m")
)


class World:
    """Point correspondences of two recordings and two without a time, and the covariance of their
    pixels, summed pair by pair. Of the second recording there may be as many as of the first."""

    def __init__(self, seed: int = 0, *, gaps: bool = False, even: bool = False) -> None:
        rng = np.random.default_rng(seed)
        self.time_s = np.concatenate([rng.uniform(0.0, 50.0, 9), [np.nan, np.nan]])
        self.group = np.array([0, 0, 0, 0, 1, 1, 1, 1, 1, 0, 1])
        if even:
            self.time_s[8] = np.nan
        self.variance_px2 = rng.uniform(0.5, 4.0, (11, 2))
        self.by_place = rng.normal(0.0, 5.0, (11, 2, 2))
        self.pixel_px = rng.normal(0.0, 10.0, (11, 2))
        # Fixes 20 s apart, of which the log of the second recording has no gaps.
        begin = 20.0 * np.floor(self.time_s / 20.0)
        self.gap_s = np.stack([begin, begin + 20.0], axis=1)
        own = rng.uniform(2.0, 6.0, 11)
        of_log = (self.group == 0) | even
        self.sigma_m = np.where(of_log & np.isfinite(begin) & gaps, own, 0.0)
        self.by_height = rng.normal(0.0, 8.0, (11, 2))
        self.half_lengths_m = rng.normal(0.0, 3.0, (11, 2))

    def drift(self, i: int, j: int, noise: PixelNoise) -> float:
        """Covariance of two places on the lines between fixes, whose errors decay with time."""
        total = 0.0
        for one in (0, 1):
            for other in (0, 1):
                share = 1.0
                for box, side in ((i, one), (j, other)):
                    late = (self.time_s[box] - self.gap_s[box, 0]) / 20.0
                    share *= late if side else 1.0 - late
                apart = abs(self.gap_s[i, one] - self.gap_s[j, other])
                total += share * np.exp(-apart / noise.correlation_time_s)
        return float(noise.correlated_m**2 * total)

    def strays(self, i: int, j: int) -> float:
        """Covariance of two places that gaps make."""
        if self.gap_s[i, 0] != self.gap_s[j, 0]:
            return 0.0
        off = (self.time_s[i] - self.time_s[j]) / (0.42 * 20.0)
        return float(self.sigma_m[i] * self.sigma_m[j] * np.exp(-0.5 * off**2))

    def pair(self, i: int, j: int, noise: PixelNoise) -> FloatArray:
        """(2, 2) covariance of column and row of two boxes of one log."""
        lag = abs(self.time_s[i] - self.time_s[j])
        lasting = np.exp(-lag / noise.lasting_time_s)
        metres = self.drift(i, j, noise) + self.strays(i, j)
        metres += noise.offset_m**2 + noise.lasting_m**2 * lasting
        out = metres * self.by_place[i] @ self.by_place[j].T
        out += np.diag([noise.lasting_column_px**2, noise.lasting_row_px**2]) * lasting
        ahead = [self.by_place[k] @ self.half_lengths_m[k] for k in (i, j)]
        out += noise.antenna_share**2 * np.outer(*ahead)
        heave = noise.heave_m**2 * np.exp(-lag / HEAVE_CORRELATION_TIME_S)
        out += heave * np.outer(self.by_height[i], self.by_height[j])
        return np.asarray(out)

    def covariance(self, variance_px2: FloatArray, noise: PixelNoise = NOISE) -> FloatArray:
        """(22, 22) of columns and rows, box by box."""
        out = np.zeros((11, 2, 11, 2))
        for i in np.flatnonzero(np.isfinite(self.time_s)):
            for j in np.flatnonzero(np.isfinite(self.time_s)):
                if self.group[i] == self.group[j]:
                    out[i, :, j] = self.pair(i, j, noise)
        return out.reshape(22, 22) + np.diag(variance_px2.ravel())

    def whitening(self, noise: PixelNoise = NOISE) -> Whitening:
        return Whitening(
            blocks_of(self.time_s, self.group, self.sigma_m, self.gap_s),
            self.variance_px2,
            self.by_place,
            noise,
            self.by_height,
            self.half_lengths_m,
        )


def test_gaps_of_logs_with_as_many_boxes_are_weighed_each_by_its_own() -> None:
    world = World(2, gaps=True, even=True)
    share = np.linspace(0.5, 2.0, 11)

    def strays(time_s: FloatArray) -> FloatArray:
        blocks = blocks_of(time_s, world.group, world.sigma_m, world.gap_s)
        whitening = Whitening(
            [block.with_gaps(share[block.rows]) for block in blocks],
            world.variance_px2,
            world.by_place,
            NOISE,
            world.by_height,
            world.half_lengths_m,
        )
        pull = whitening.backward(whitening.forward(world.pixel_px[:, :, None]))[:, :, 0]
        return whitening.strays(pull, share)

    together = strays(world.time_s)
    for log in (0, 1):
        own = (world.group == log) & np.isfinite(world.time_s)
        alone = strays(np.where(own, world.time_s, np.nan))
        np.testing.assert_allclose(together[own], alone[own], rtol=1e-9)
        assert np.abs(alone[own] - share[own]).min() > 0.01


KINDS = pytest.mark.parametrize(("gaps", "even"), list(product([False, True], repeat=2)))


@KINDS
def test_residuals_become_independent_of_unit_variance(gaps: bool, even: bool) -> None:
    world = World(gaps=gaps, even=even)
    whitening = world.whitening()
    made = whitening.forward(np.eye(22).reshape(11, 2, 22)).reshape(22, 22)
    covariance = world.covariance(world.variance_px2)
    np.testing.assert_allclose(made @ covariance @ made.T, np.eye(22), atol=1e-10)
    assert whitening.log_determinant() == pytest.approx(0.5 * np.linalg.slogdet(covariance)[1])


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_a_gap_is_as_wide_as_a_t_distribution_makes_it_likeliest(seed: int) -> None:
    """The largest density of residuals and variance, the inverse of that a gamma variable."""
    world = World(seed, gaps=True)
    world.time_s[:4] = [3.0, 7.0, 12.0, 16.0]
    world.gap_s[:4] = 0.0, 20.0
    world.sigma_m[:4] = 4.0, 6.0, 6.0, 4.0
    blocks = blocks_of(world.time_s, world.group, world.sigma_m, world.gap_s)
    share = np.ones(11)
    for _ in range(300):
        whitening = Whitening(
            [block.with_gaps(share[block.rows]) for block in blocks],
            world.variance_px2,
            world.by_place,
            NOISE,
            world.by_height,
            world.half_lengths_m,
        )
        pull = whitening.backward(whitening.forward(world.pixel_px[:, :, None]))[:, :, 0]
        share = whitening.strays(pull, share)
    sigma_m, residual = world.sigma_m, world.pixel_px.ravel()

    def negative_log(log: float) -> float:
        world.sigma_m = sigma_m * np.exp(0.5 * log)
        covariance = world.covariance(world.variance_px2)
        value = 0.5 * residual @ np.linalg.solve(covariance, residual)
        value += 0.5 * np.linalg.slogdet(covariance)[1]
        # Of four degrees of freedom, as a density of the logarithm.
        return float(value - (-2.0 * log - 2.0 * np.exp(-log)))

    best = minimize_scalar(negative_log, bounds=(-4.0, 4.0), method="bounded").x
    assert share[:4] == pytest.approx(np.exp(best), rel=1e-3)
    # Of what has no gap nothing is known.
    np.testing.assert_array_equal(share[4:], 1.0)


@KINDS
def test_the_likeliest_errors_are_conditional_means(gaps: bool, even: bool) -> None:
    """Of the drift of a log with its gaps, of its offset and its antenna's, and of a box's."""
    world = World(gaps=gaps, even=even)
    whitening = world.whitening()
    pulled = whitening.backward(whitening.forward(world.pixel_px[:, :, None]))[:, :, 0]
    solved = np.linalg.solve(world.covariance(world.variance_px2), world.pixel_px.ravel())
    np.testing.assert_allclose(pulled.ravel(), solved, rtol=1e-9)
    expected = np.zeros((3, 11, 2))
    timed = np.flatnonzero(np.isfinite(world.time_s))
    for i in timed:
        for j in timed:
            if world.group[i] != world.group[j]:
                continue
            metres = world.by_place[j].T @ solved.reshape(11, 2)[j]
            lag = abs(world.time_s[i] - world.time_s[j])
            expected[0, i] += (world.drift(i, j, NOISE) + world.strays(i, j)) * metres
            expected[1, i] += NOISE.offset_m**2 * metres
            half = [world.half_lengths_m[k] for k in (i, j)]
            expected[1, i] += NOISE.antenna_share**2 * half[0] * (half[1] @ metres)
            expected[2, i] += NOISE.lasting_m**2 * np.exp(-lag / NOISE.lasting_time_s) * metres
    for found, right in zip(whitening.correlated_error(pulled), expected, strict=True):
        np.testing.assert_allclose(found, right, rtol=1e-9, atol=1e-12)


@KINDS
def test_slopes_are_those_of_the_likelihood_with_parameters_integrated_out(
    gaps: bool, even: bool
) -> None:
    world = World(gaps=gaps, even=even)
    design = np.random.default_rng(5).normal(0.0, 3.0, (11, 2, 3))
    # A parameter that only one of the recordings depends on.
    design[world.group == 1, :, 2] = 0.0
    flat = design.reshape(22, 3)

    def negative_log(variance: FloatArray, logs: FloatArray) -> float:
        noise = replace(NOISE, **dict(zip(PARTS, np.exp(logs).tolist(), strict=True)))
        covariance = world.covariance(variance.reshape(11, 2), noise) + flat @ flat.T
        return -float(multivariate_normal(cov=covariance).logpdf(world.pixel_px.ravel()))

    whitening = world.whitening()
    white = whitening.forward(np.concatenate([design, world.pixel_px[:, :, None]], axis=2))
    table = white.reshape(22, 4)
    covariance = np.linalg.inv(table[:, :3].T @ table[:, :3] + np.eye(3))
    step = covariance @ table[:, :3].T @ table[:, 3]
    solved = whitening.backward(white)
    by_variance, by_part = whitening.gradient(
        solved[:, :, 3] - solved[:, :, :3] @ step, solved[:, :, :3], covariance
    )
    given, logs = world.variance_px2.ravel(), np.log([getattr(NOISE, name) for name in PARTS])
    expected = approx_fprime(given, lambda v: negative_log(v, logs), 1e-6)
    np.testing.assert_allclose(by_variance.ravel(), expected, atol=1e-4)
    expected = approx_fprime(logs, lambda t: negative_log(given, t), 1e-6)
    np.testing.assert_allclose([by_part[name] for name in PARTS], expected, atol=1e-4)


def test_where_no_fixes_are_known_a_log_errs_at_the_times_of_its_boxes() -> None:
    world = World()
    block = blocks_of(world.time_s, world.group)[0]
    own = world.time_s[block.rows[0]]
    expected = np.exp(-np.abs(own[:, None] - own[None, :]) / 20.0)
    np.testing.assert_allclose(block.log_kernel(20.0)[0], expected)


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


def test_a_coordinate_sees_its_share_of_the_errors() -> None:
    """What logs and boxes have in common a moment later, in one coordinate of the place."""
    world = World()
    rng = np.random.default_rng(3)
    by_pixel, hull = rng.normal(0.0, 1.0, (11, 2)), rng.uniform(0.1, 0.5, 11)
    direction, aboard = rng.normal(0.0, 1.0, (11, 2)), rng.normal(0.0, 1.0, 11)
    error = CorrelatedError(
        world.time_s, world.group, NOISE, direction, by_pixel, aboard, hull, by_heave=0.2
    )
    expected = np.zeros((11, 11))
    for i in range(9):
        for j in range(9):
            if world.group[i] != world.group[j]:
                continue
            # Smooth below a second, since fixes come a second apart and are interpolated.
            lag = np.sqrt((world.time_s[i] - world.time_s[j]) ** 2 + 1.0) - 1.0
            lasting = np.exp(-lag / NOISE.lasting_time_s)
            metres = NOISE.correlated_m**2 * np.exp(-lag / NOISE.correlation_time_s)
            metres += NOISE.offset_m**2 + NOISE.lasting_m**2 * lasting
            pixels = NOISE.lasting_column_px**2 * by_pixel[i, 0] * by_pixel[j, 0]
            pixels += NOISE.lasting_row_px**2 * by_pixel[i, 1] * by_pixel[j, 1]
            expected[i, j] = metres * (direction[i] @ direction[j]) + lasting * pixels
            expected[i, j] += NOISE.antenna_share**2 * aboard[i] * aboard[j] + hull[i] * hull[j]
            heave = (0.2 * NOISE.heave_m) ** 2
            expected[i, j] += heave * np.exp(-lag / HEAVE_CORRELATION_TIME_S)
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
    assert max(block.rows.shape[1] for block in blocks) <= MOST_IN_BLOCK
    in_blocks = np.sort(np.concatenate([block.rows.ravel() for block in blocks]))
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
