from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import chi2

from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.platform import Platform
from sightline.trajectory.forecast import (
    MotionModel,
    MotionState,
    closest_approach,
    closest_approaches,
    follow,
    transition,
)
from sightline.types import Fixes, FloatArray, PointKind, Positions, Track

PLANE = LocalPlane(54.0, 10.0)
STRAIGHT = MotionModel(straight_share=1.0)
STEADY = MotionModel(
    turn_rate_radps=0.0,
    hard_turn_rate_radps=0.0,
    straight_s=1e5,
    turning_s=1e5,
    straight_m2ps3=1e-6,
    turning_m2ps3=1e-6,
)


def state_of(
    mean: list[float],
    covariance: FloatArray | None = None,
    motion: MotionModel = STRAIGHT,
    time_s: float = 0.0,
) -> MotionState:
    doubt = np.eye(4) * 1e-12 if covariance is None else covariance
    return MotionState.of_moments(
        np.array([time_s]), np.array([mean], dtype=float), doubt[None], PLANE, motion
    )


def positions(en: FloatArray, sigma_m: float) -> Positions:
    return Positions(
        en[:, 0], en[:, 1], np.tile(sigma_m**2 * np.eye(2), (len(en), 1, 1)),
        np.zeros(len(en), dtype=bool), PLANE,
    )  # fmt: skip


@pytest.mark.parametrize("lag_s", [1e-3, 0.05, 1.0, 20.0, 300.0])
@pytest.mark.parametrize("turn", [0.0, 0.15, -0.4])
@pytest.mark.parametrize("reverting_s", [4.0, 60.0, 1e4])
def test_the_transition_is_that_of_the_differential_equation(
    lag_s: float, turn: float, reverting_s: float
) -> None:
    drift = np.zeros((4, 4))
    drift[:2, 2:] = np.eye(2)
    drift[2:, 2:] = [[-1.0 / reverting_s, -turn], [turn, -1.0 / reverting_s]]
    noise = np.diag([0.0, 0.0, 1.0, 1.0])
    # Van Loan (1978): both from one matrix exponential, over steps that keep it in range.
    steps = int(np.ceil(lag_s))
    both = np.block([[-drift, noise], [np.zeros((4, 4)), drift.T]]) * (lag_s / steps)
    part = expm(both)
    once = part[4:, 4:].T
    step, spread = np.eye(4), np.zeros((4, 4))
    for _ in range(steps):
        step, spread = once @ step, once @ spread @ once.T + once @ part[:4, 4:]
    got_step, got_spread = (m[0] for m in transition(lag_s, [turn], reverting_s))
    scale = np.sqrt(np.diag(spread))
    np.testing.assert_allclose(got_step, step, rtol=1e-8, atol=1e-8 * max(1.0, lag_s))
    unit = np.outer(scale, scale)
    np.testing.assert_allclose(got_spread / unit, spread / unit, atol=5e-4)
    assert np.linalg.eigvalsh(got_spread).min() > 0.0


@pytest.mark.parametrize("lag_s", [1e-5, 1.03e-3, 1.05e-3, 0.2])
def test_the_noise_of_short_lags_is_that_of_long_ones(lag_s: float) -> None:
    """By quadrature, where differences of nearly equal numbers give way to a series: at 1.04 ms."""
    drift = np.zeros((4, 4))
    drift[:2, 2:] = np.eye(2)
    drift[2:, 2:] = [[-1.0 / 1.2, 0.9], [-0.9, -1.0 / 1.2]]
    nodes, weights = np.polynomial.legendre.leggauss(6)
    moved = [expm(drift * 0.5 * lag_s * (node + 1.0)) for node in nodes]
    spread = sum(
        0.5 * lag_s * weight * one[:, 2:] @ one[:, 2:].T
        for weight, one in zip(weights, moved, strict=True)
    )
    got = transition(lag_s, [-0.9], 1.2)[1][0]
    scale = np.sqrt(np.diag(spread))
    np.testing.assert_allclose(
        got / np.outer(scale, scale), spread / np.outer(scale, scale), atol=5e-6
    )


def test_the_covariance_of_a_straight_forecast_is_the_integrated_ornstein_uhlenbeck_one() -> None:
    motion = MotionModel(straight_share=1.0, straight_s=20.0, straight_m2ps3=0.3)
    state = state_of([10.0, 50.0, 3.0, -1.0], motion=motion)
    lags, tau, q = np.array([1.0, 5.0, 30.0, 120.0]), 20.0, 0.3
    forecast = state.forecast(lags)
    kept = np.exp(-lags / tau)
    sigma2 = 0.5 * q * tau
    np.testing.assert_allclose(forecast.east_m, 10.0 + 3.0 * tau * (1.0 - kept))
    np.testing.assert_allclose(forecast.velocity_north_mps, -kept)
    position = sigma2 * tau**2 * (2.0 * lags / tau - 3.0 + 4.0 * kept - kept**2)
    np.testing.assert_allclose(forecast.covariance_m2[:, 0, 0], position, rtol=1e-6)
    np.testing.assert_allclose(forecast.covariance_m2[:, 1, 1], position, rtol=1e-6)
    np.testing.assert_allclose(forecast.covariance_m2[:, 0, 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(
        forecast.velocity_covariance_m2ps2[:, 0, 0], sigma2 * (1.0 - kept**2), rtol=1e-6
    )
    assert (forecast.kind == PointKind.EXTRAPOLATED).all()


def test_a_forecast_does_not_depend_on_the_times_asked_for_between() -> None:
    state = state_of([10.0, 50.0, 3.0, -1.0], np.diag([4.0, 9.0, 0.3, 0.2]), MotionModel())
    once, often = state.forecast([40.0]), state.forecast(np.arange(2.0, 41.0, 2.0))
    np.testing.assert_allclose(once.east_m[-1], often.east_m[-1])
    np.testing.assert_allclose(once.covariance_m2[-1], often.covariance_m2[-1])
    np.testing.assert_allclose(state.ahead(0.0).mean, state.mean)


def simulated(
    rng: np.random.Generator, motion: MotionModel, seconds: float, step_s: float
) -> FloatArray:
    """(N, 4) a target that moves as the model says, seen at every step."""
    moves, noises = transition(step_s, motion.turn_rates_radps, motion.revertings_s)
    roots = [
        np.linalg.cholesky(q * noise)
        for q, noise in zip(motion.accelerations_m2ps3, noises, strict=True)
    ]
    state = np.array([rng.uniform(-60, 60), rng.uniform(80, 200), *rng.normal(0.0, 2.0, 2)])
    mode = rng.choice(motion.shares.size, p=motion.shares)
    out = [state]
    for _ in range(int(seconds / step_s)):
        if rng.random() > np.exp(-step_s / motion.mode_s):
            mode = rng.choice(motion.shares.size, p=motion.shares)
        state = moves[mode] @ state + roots[mode] @ rng.standard_normal(4)
        out.append(state)
    return np.array(out)


def inside_95(
    known: MotionModel, true: MotionModel, *, sigma_m: float, seen: int, step_s: float = 0.5
) -> dict[float, float]:
    """How often the ellipses of a filter hold targets that move as a model says."""
    inside: dict[float, list[bool]] = {5.0: [], 10.0: [], 30.0: [], 60.0: []}
    for seed in range(150):
        rng = np.random.default_rng(seed)
        truth = simulated(rng, true, 110.0, step_s)
        rows = np.arange(0, 81, seen)
        measured = truth[rows, :2] + rng.normal(0.0, sigma_m, (rows.size, 2))
        last = follow(rows * step_s, positions(measured, sigma_m), known)[-1:]
        for lag_s, held in inside.items():
            mean, covariance = last.ahead(lag_s).moments()
            off = mean[0, :2] - truth[rows[-1] + int(lag_s / step_s), :2]
            squared = off @ np.linalg.solve(covariance[0, :2, :2], off)
            held.append(bool(squared <= chi2.ppf(0.95, 2)))
    return {lag_s: float(np.mean(held)) for lag_s, held in inside.items()}


@pytest.mark.slow
def test_ellipses_hold_the_truth_of_simulated_motion() -> None:
    for share in inside_95(MotionModel(), MotionModel(), sigma_m=3.0, seen=8).values():
        assert 0.90 <= share <= 0.99


@pytest.mark.slow
def test_ellipses_hold_boats_that_turn_harder_than_most() -> None:
    """All turns are at 16 degrees a second, where a tenth of them are expected to be such."""
    small = replace(MotionModel(), turn_rate_radps=0.28, hard_share=0.0)
    shares = inside_95(MotionModel(), small, sigma_m=1.0, seen=4)
    without = inside_95(replace(MotionModel(), hard_share=0.0), small, sigma_m=1.0, seen=4)
    assert min(shares.values()) > 0.87
    assert shares[5.0] > without[5.0] + 0.03
    assert shares[10.0] > without[10.0] + 0.03


def test_a_target_that_was_long_out_of_sight_is_begun_anew() -> None:
    rng = np.random.default_rng(3)
    truth = simulated(rng, MotionModel(), 100.0, 1.0)
    measured = truth[:, :2] + rng.normal(0.0, 2.0, truth[:, :2].shape)
    rows = np.r_[0:20, 60:80]
    whole = follow(rows.astype(float), positions(measured[rows], 2.0))
    after = follow(np.arange(60.0, 80.0), positions(measured[60:80], 2.0))
    for name in ("weight", "mean", "covariance"):
        np.testing.assert_array_equal(getattr(whole, name)[20:], getattr(after, name))
    kept = follow(rows.astype(float), positions(measured[rows], 2.0), MotionModel(forgotten_s=60.0))
    assert not np.array_equal(kept.mean[20], after.mean[0])


def test_nothing_that_comes_later_changes_what_was_known() -> None:
    rng = np.random.default_rng(0)
    truth = simulated(rng, MotionModel(), 40.0, 1.0)
    seen = truth[:, :2] + rng.normal(0.0, 2.0, (len(truth), 2))
    times = 1e9 + np.arange(len(truth)) * 1.0
    whole, part = follow(times, positions(seen, 2.0)), follow(times[:15], positions(seen[:15], 2.0))
    np.testing.assert_array_equal(whole.mean[:15], part.mean)
    np.testing.assert_array_equal(whole.covariance[:15], part.covariance)


def test_turns_are_recognised_and_carried_on() -> None:
    times = np.arange(0.0, 24.0, 1.0)
    rate, speed = 0.15, 4.0
    place = np.stack([np.sin(rate * times), 1.0 - np.cos(rate * times)], axis=1) * speed / rate
    seen = place + np.array([0.0, 100.0])
    state = follow(times, positions(seen, 0.5), MotionModel(mode_s=60.0))[-1:]
    # Counter-clockwise, as east turns to north.
    assert state.weight[0].argmax() == 1
    then = np.array([np.sin(rate * 28.0), 1.0 - np.cos(rate * 28.0)]) * speed / rate
    straight = seen[-1] + 5.0 * (seen[-1] - seen[-2])
    forecast = state.forecast([5.0])
    at = np.array([forecast.east_m[0], forecast.north_m[0]])
    goal = then + np.array([0.0, 100.0])
    assert np.hypot(*(at - goal)) < 0.5 * np.hypot(*(straight - goal))


def test_one_wild_position_does_not_throw_the_state_off() -> None:
    times = np.arange(0.0, 30.0, 1.0)
    seen = np.stack([3.0 * times - 40.0, np.full(30, 120.0)], axis=1)
    spoilt = seen.copy()
    spoilt[25] += [60.0, 80.0]
    clean, wild = (follow(times, positions(p, 2.0))[-1:] for p in (seen, spoilt))
    gap = clean.moments()[0][0, :2] - wild.moments()[0][0, :2]
    assert np.hypot(*gap) < 3.0


@pytest.mark.parametrize(
    ("mean", "when", "distance"),
    [
        ([100.0, 30.0, -5.0, 0.0], 20.0, 30.0),
        ([100.0, 100.0, -5.0, -5.0], 20.0, 0.0),
        ([30.0, 40.0, 3.0, 4.0], 0.0, 50.0),
        ([30.0, 40.0, 0.0, 0.0], 0.0, 50.0),
        ([6000.0, 30.0, -5.0, 0.0], 600.0, np.hypot(3000.0, 30.0)),
    ],
)
def test_the_closest_approach_of_a_straight_line(
    mean: list[float], when: float, distance: float
) -> None:
    got = closest_approach(state_of(mean, time_s=1e9))
    assert got.in_s == pytest.approx(when, abs=1e-6)
    assert got.time_utc_s == pytest.approx(1e9 + when)
    assert got.distance_m == pytest.approx(distance, abs=1e-6)


def test_targets_that_meet_do_so_at_one_place_and_time() -> None:
    one = state_of([0.0, 100.0, 4.0, 0.0], time_s=1000.0)
    other = state_of([85.0, 80.0, 0.0, 1.0], time_s=995.0)
    got = closest_approach(one, other)
    # Five seconds after its own time the other is at (85, 85).
    relative, velocity = np.array([-85.0, 15.0]), np.array([4.0, -1.0])
    when = -relative @ velocity / (velocity @ velocity)
    assert got.in_s == pytest.approx(when, rel=1e-2)
    assert got.distance_m == pytest.approx(np.hypot(*(relative + when * velocity)), abs=0.3)
    assert closest_approaches([one, other]) == {(0, 1): got}
    back = closest_approach(other, one)
    assert (back.in_s, back.distance_m) == pytest.approx((got.in_s, got.distance_m))


def test_the_uncertainty_of_an_approach_is_that_of_draws() -> None:
    motion = MotionModel(straight_share=1.0, straight_m2ps3=1e-9)
    covariance = np.diag([9.0, 4.0, 0.02, 0.03])
    covariance[0, 2] = covariance[2, 0] = 0.2
    mean = np.array([120.0, 60.0, -4.0, 0.5])
    got = closest_approach(state_of(mean.tolist(), covariance, motion))
    rng = np.random.default_rng(0)
    drawn = rng.multivariate_normal(mean, covariance, 40_000)
    place, velocity = drawn[:, :2], drawn[:, 2:]
    when = -(place * velocity).sum(axis=1) / (velocity**2).sum(axis=1)
    apart = np.hypot(*(place + when[:, None] * velocity).T)
    assert got.in_sigma_s == pytest.approx(when.std(), rel=0.05)
    assert got.distance_sigma_m == pytest.approx(apart.std(), rel=0.05)


def test_a_track_alone_can_be_forecast() -> None:
    # By its last point: the one before was faster, and less sure.
    less = np.array([9.0, 1.0])[:, None, None]
    track = Track(
        7, np.array([0.0, 1.0]), np.array([0.0, 3.0]), np.array([70.0, 90.0]),
        np.array([9.0, 3.0]), np.array([5.0, 0.0]), less * np.diag([4.0, 1.0]),
        less * 0.25 * np.eye(2), np.zeros(2, dtype=np.int8), PLANE, "ferry",
    )  # fmt: skip
    state = MotionState.of_track(track, STRAIGHT)
    forecast = state.forecast([10.0], track_id=track.track_id, label=track.label)
    assert (forecast.track_id, forecast.label, forecast.time_utc_s[0]) == (7, "ferry", 11.0)
    assert forecast.east_m[0] == pytest.approx(33.0, rel=0.02)
    assert forecast.north_m[0] == pytest.approx(90.0, rel=0.02)
    # Var p + 2 t cov + t² var v, with the correlation of a steady state.
    expected = 4.0 + 2.0 * 10.0 * np.sqrt(0.5) * 2.0 * 0.5 + 100.0 * 0.25
    grown = STRAIGHT.straight_m2ps3 * 1000.0 / 3.0
    assert forecast.covariance_m2[0, 0, 0] == pytest.approx(expected + grown, rel=0.03)


def _bad_track() -> Track:
    nothing = np.full((1, 2, 2), np.nan)
    one = np.zeros(1)
    return Track(3, one, one, one, one, one, nothing, nothing, one.astype(np.int8), PLANE)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: MotionModel(mode_s=0.0), "mode_s is 0"),
        (lambda: MotionModel(speed_mps=float("nan")), "speed_mps is nan"),
        (lambda: MotionModel(straight_share=1.5), "at most 1"),
        (lambda: MotionState.of_track(_bad_track()), "nothing can be forecast"),
        (lambda: state_of([0, 1, 0, 0]).forecast([5.0, 5.0]), "must be positive and increase"),
        (lambda: state_of([0, 1, 0, 0]).forecast([0.0]), "must be positive and increase"),
        (lambda: state_of([0, 1, 0, 0])[:0].forecast([5.0]), "of one target"),
        (lambda: closest_approach(state_of([0, 1, 0, 0])[:0]), "one target to another"),
        (lambda: closest_approach(state_of([0, 1, 0, 0]), horizon_s=0.0), "must be positive"),
        (lambda: follow(np.zeros(0), positions(np.empty((0, 2)), 1.0)), "at least one"),
    ],
)
def test_what_makes_no_sense_is_refused(call: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()


def test_what_the_platform_is_off_in_its_velocity_takes_the_forecast_along() -> None:
    state = state_of([10.0, 20.0, 1.0, 0.0], np.diag([1.0, 1.0, 0.25, 0.25]))
    own = np.array([[2.0, 0.3], [0.3, 0.04]])
    plain = state.ahead(30.0).moments()[1][0]
    carried = state.carried(own[None]).ahead(30.0).moments()[1][0]
    # The place's own part is in the positions already.
    added = 2.0 * 30.0 * 0.3 + 30.0**2 * 0.04
    np.testing.assert_allclose(
        carried - plain, np.kron([[added, 0.3 + 1.2], [1.5, 0.04]], np.eye(2))
    )


@pytest.mark.slow
def test_ellipses_from_a_vessel_hold_for_targets_that_go_straight() -> None:
    """The vessel's receiver is off, and so it does not know its own velocity."""
    times = np.arange(0.0, 90.0)
    inside = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        way = times[:, None] * rng.normal(0.0, 1.5, 2)
        target = [30.0, 200.0] + times[:, None] * rng.normal(0.0, 2.0, 2)
        off = 1.5 * rng.standard_normal(way.shape)
        for i in range(1, len(off)):
            off[i] = np.exp(-0.05) * off[i - 1] + np.sqrt(1.0 - np.exp(-0.1)) * off[i]
        platform = Platform(Fixes(times, *PLANE.to_geographic(*(way + off).T)))
        pose = platform.pose(times, PLANE, until_then=True)
        seen = target - way + pose.en_m + 0.5 * rng.standard_normal(way.shape)
        followed = follow(times, positions(seen, 0.5), STEADY, camera_position_m=pose.en_m)
        states = followed.carried(pose.covariance)[40::10]
        mean, covariance = states.ahead(60.0).moments()
        true = target[40::10] + 60.0 * (target[1] - target[0])
        gone = mean[:, :2] - true
        distance2 = np.einsum("ni,nij,nj->n", gone, np.linalg.inv(covariance[:, :2, :2]), gone)
        # Of the same, the ellipse of somebody who trusts the vessel's log.
        naive = followed[40::10].ahead(60.0).moments()[1][:, :2, :2]
        distances = [distance2, np.einsum("ni,nij,nj->n", gone, np.linalg.inv(naive), gone)]
        inside.append(np.array(distances) <= chi2.ppf(0.95, 2))
    share, trusting = np.mean(inside, axis=(0, 2))
    assert 0.9 <= share <= 0.99
    assert trusting < share - 0.05


def test_boxes_whose_errors_last_do_not_make_a_target_too_sure() -> None:
    """Ten boxes a second, whose errors are alike for 0.6 s: by simulated targets."""
    times, duration_s, sigma_m = np.arange(0.0, 6.0, 0.1), 0.6, 1.5
    kept = np.exp(-0.1 / duration_s)
    inside = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        error = rng.normal(0.0, sigma_m, (times.size, 2))
        for i in range(1, times.size):
            error[i] = kept * error[i - 1] + np.sqrt(1.0 - kept**2) * error[i]
        start, speed = np.array([30.0, 200.0]), rng.normal(0.0, 2.0, 2)
        truth = start + times[:, None] * speed
        mean, covariance = follow(times, positions(truth + error, sigma_m))[-1:].moments()
        off = mean[0] - np.concatenate([truth[-1], speed])
        inside.append(off @ np.linalg.solve(covariance[0], off) < chi2.ppf(0.95, 4))
    assert np.mean(inside) >= 0.85


def test_accelerations_until_an_approach_make_it_unsure() -> None:
    """By targets that are simulated step by step under white acceleration."""
    density = 0.003
    motion = MotionModel(straight_share=1.0, straight_s=1e6, straight_m2ps3=density)
    mean = np.array([120.0, 60.0, -4.0, 0.5])
    got = closest_approach(state_of(mean.tolist(), np.diag([1.0, 1.0, 1e-4, 1e-4]), motion))
    rng = np.random.default_rng(1)
    state = rng.multivariate_normal(mean, np.diag([1.0, 1.0, 1e-4, 1e-4]), 20_000)
    nearest = np.full(len(state), np.inf)
    step_s = 0.1
    for _ in range(500):
        state[:, :2] += step_s * state[:, 2:]
        state[:, 2:] += rng.normal(0.0, np.sqrt(density * step_s), (len(state), 2))
        nearest = np.minimum(nearest, np.hypot(state[:, 0], state[:, 1]))
    assert got.distance_m == pytest.approx(nearest.mean(), rel=0.02)
    assert got.distance_sigma_m == pytest.approx(nearest.std(), rel=0.1)
