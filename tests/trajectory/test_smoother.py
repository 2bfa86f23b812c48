"""The smoother through its public face: closed forms, planted outliers, simulated harbours."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.trajectory import METHODS, NoiseModel, PaperChain, RtsSmoother, method, smoother
from sightline.trajectory.base import measurements
from sightline.trajectory.range_noise import NoiseAtRange
from sightline.types import BoolArray, FloatArray, PointKind, Positions

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from harbour_tracks import EPOCH_UTC_S, Scene, scene

PLANE = LocalPlane(32.7, -117.2)
WHITE = NoiseModel(0.1, 0.8, 1.0, 1.0, 0.0, 0.0)


def _positions(en_m: FloatArray, covariance_m2: FloatArray) -> Positions:
    return Positions(
        east_m=en_m[:, 0],
        north_m=en_m[:, 1],
        covariance_m2=np.broadcast_to(covariance_m2, (len(en_m), 2, 2)),
        extrapolated=np.zeros(len(en_m), dtype=bool),
        plane=PLANE,
    )


def _error(boat: Scene, smoother: RtsSmoother | PaperChain) -> tuple[float, float]:
    """RMS error, metres, and the share of truths inside the 95 % ellipses."""
    track = smoother.apply(boat.time_utc_s, boat.positions, at_utc_s=boat.time_utc_s)
    error = np.stack([track.east_m, track.north_m], axis=1) - boat.truth_m
    distance2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(track.covariance_m2), error)
    return (
        float(np.sqrt((error**2).sum(axis=1).mean())),
        float((distance2 <= -2.0 * np.log(0.05)).mean()),
    )


def test_names() -> None:
    assert METHODS == ("paper", "rts")
    assert method("rts", speed_mps=3.0) == RtsSmoother(speed_mps=3.0)
    assert method("paper") == PaperChain()
    with pytest.raises(InputError, match="'kalman'; known are paper, rts"):
        method("kalman")
    with pytest.raises(InputError, match=r"setting .*'window'; known are window_s"):
        method("paper", window=3)


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("resolution_s", 0.0),
        ("speed_mps", -1.0),
        ("longest_gap_s", float("nan")),
        ("gate_probability", 1.0),
        ("common_share", 1.5),
    ],
)
def test_settings_out_of_range(setting: str, value: float) -> None:
    with pytest.raises(InputError, match=setting):
        method("rts", **{setting: value})
    with pytest.raises(InputError, match="white_along"):
        NoiseModel(0.1, 0.8, -1.0, 1.0, 0.0, 0.0)


def test_equals_the_posterior_of_the_same_gaussian_process() -> None:
    """A covariance that is the same everywhere makes the problem linear: compare densely."""
    rng = np.random.default_rng(5)
    time = np.cumsum(rng.uniform(0.4, 3.0, 25))
    since = time - time[0]
    covariance = np.array([[4.0, 1.0], [1.0, 2.0]])
    measured = np.array([120.0, 80.0]) + np.stack([2.0 * since, -since], axis=1)
    measured = measured + rng.multivariate_normal(np.zeros(2), covariance, time.size)
    early, late = np.minimum.outer(since, since), np.maximum.outer(since, since)
    kernel = 0.1 * (early**2 * late / 2.0 - early**3 / 6.0) + 100.0 * np.outer(since, since)
    noise = np.kron(np.eye(time.size), covariance)
    precision = np.linalg.inv(np.kron(kernel, np.eye(2)) + noise)
    # The first position is a constant of which nothing is known: it is projected out.
    design = np.kron(np.ones((time.size, 1)), np.eye(2))
    seen = precision @ design
    precision -= seen @ np.linalg.inv(design.T @ seen) @ seen.T
    mean = measured.ravel() - noise @ precision @ measured.ravel()
    spread = noise - noise @ precision @ noise

    # Times near zero: POSIX seconds are stored to 2.4e-7 s, which at 2 m/s is 5e-7 m.
    track = RtsSmoother(noise=WHITE, gate_probability=1.0 - 1e-12).apply(
        time, _positions(measured, covariance)
    )
    got = np.stack([track.east_m, track.north_m], axis=1).ravel()
    np.testing.assert_allclose(got, mean, rtol=0.0, atol=1e-8)
    blocks = np.stack([spread[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] for i in range(time.size)])
    np.testing.assert_allclose(track.covariance_m2, blocks, rtol=0.0, atol=1e-8)


def test_constant_velocity_without_noise_is_reproduced() -> None:
    time = 1.6e9 + np.arange(0.0, 40.0, 0.5)
    since = time - time[0]
    en = np.array([-60.0, 90.0]) + np.outer(since, [3.0, 1.5])
    ask = np.array([-4.0, 0.0, 0.3, 17.77, 39.5, 45.0]) + time[0]
    track = RtsSmoother().apply(time, _positions(en, 0.01 * np.eye(2)), at_utc_s=ask)
    expected = np.array([-60.0, 90.0]) + np.outer(ask - time[0], [3.0, 1.5])
    np.testing.assert_allclose(track.east_m, expected[:, 0], atol=1e-3)
    np.testing.assert_allclose(track.north_m, expected[:, 1], atol=1e-3)
    np.testing.assert_allclose(track.velocity_east_mps, 3.0, atol=1e-3)
    np.testing.assert_allclose(track.speed_mps, np.hypot(3.0, 1.5), atol=1e-3)
    np.testing.assert_allclose(track.course_deg, np.degrees(np.arctan2(3.0, 1.5)), atol=0.05)
    assert (track.kind == [2, 0, 1, 1, 0, 2]).all()


def test_a_target_that_may_do_anything_is_where_it_was_measured() -> None:
    rng = np.random.default_rng(2)
    time = np.arange(0.0, 30.0)
    en = 100.0 + rng.normal(0.0, 5.0, (30, 2))
    noise = NoiseModel(1e6, 0.8, 1.0, 1.0, 0.0, 0.0)
    track = RtsSmoother(noise=noise).apply(time, _positions(en, np.eye(2)))
    np.testing.assert_allclose(track.east_m, en[:, 0], atol=1e-3)
    np.testing.assert_allclose(track.covariance_m2, np.tile(np.eye(2), (30, 1, 1)), atol=1e-3)


def test_a_target_that_never_turns_is_on_the_least_squares_line() -> None:
    rng = np.random.default_rng(3)
    time = np.arange(0.0, 30.0)
    en = 100.0 + np.outer(time, [2.0, -1.0]) + rng.normal(0.0, 1.0, (30, 2))
    noise = NoiseModel(1e-9, 0.8, 1.0, 1.0, 0.0, 0.0)
    smoother = RtsSmoother(noise=noise, speed_mps=1e4, gate_probability=1.0 - 1e-12)
    track = smoother.apply(time, _positions(en, np.eye(2)))
    line = np.polynomial.polynomial.polyval(time, np.polynomial.polynomial.polyfit(time, en, 1))
    np.testing.assert_allclose(track.east_m, line[0], atol=1e-3)
    np.testing.assert_allclose(track.north_m, line[1], atol=1e-3)


@given(turn=st.floats(0.0, 2.0 * np.pi), seed=st.integers(0, 3))
@settings(max_examples=10, deadline=None)
def test_turning_the_plane_turns_the_track(turn: float, seed: int) -> None:
    boat = scene(seed, sparse=True)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    en = np.stack([boat.positions.east_m, boat.positions.north_m], axis=1)
    turned = _positions(en @ rotation.T, rotation @ boat.positions.covariance_m2 @ rotation.T)
    # A fixed noise model: a search for one may stop elsewhere within its tolerance.
    smoother = RtsSmoother(noise=NoiseModel(0.2, 0.8, 0.9, 0.9, 0.1, 0.1))
    before = smoother.apply(boat.time_utc_s, boat.positions)
    after = smoother.apply(boat.time_utc_s, turned)
    expected = np.stack([before.east_m, before.north_m], axis=1) @ rotation.T
    np.testing.assert_allclose(np.stack([after.east_m, after.north_m], axis=1), expected, atol=1e-4)
    np.testing.assert_allclose(
        after.covariance_m2, rotation @ before.covariance_m2 @ rotation.T, rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize("seed", range(3))
def test_planted_outliers_are_left_out_and_others_kept(seed: int) -> None:
    clean, dirty = scene(seed), scene(seed, outliers=0.04)
    smoothed = RtsSmoother().smooth(dirty.time_utc_s, dirty.positions)
    known = dirty.positions.known
    en = np.stack([dirty.positions.east_m, dirty.positions.north_m], axis=1)
    sigma = np.sqrt(np.diagonal(clean.positions.covariance_m2, axis1=1, axis2=2))
    far = dirty.outlier & known & (np.abs(en - dirty.truth_m) > 8.0 * sigma).any(axis=1)
    assert far.sum() > 10
    assert not smoothed.used[far].any()
    assert smoothed.used[known & ~dirty.outlier].mean() > 0.99
    assert _error(dirty, RtsSmoother())[0] < 1.15 * _error(clean, RtsSmoother())[0]


def test_an_outlier_in_sparse_measurements_is_left_out() -> None:
    boat = scene(4, sparse=True)
    en = np.stack([boat.positions.east_m, boat.positions.north_m], axis=1)
    covariance = boat.positions.covariance_m2.copy()
    # Half as far: it claims a quarter of the standard deviation that it has along the sight.
    en[7] *= 0.5
    covariance[7] /= 16.0
    smoothed = RtsSmoother().smooth(boat.time_utc_s, _positions(en, covariance))
    assert not smoothed.used[7]
    assert smoothed.used.mean() > 0.9


def test_a_range_that_fell_short_does_not_pull_the_track_to_the_camera() -> None:
    """A boat at rest at 200 m: weights by the stated covariance are biased, ours is not."""
    rng = np.random.default_rng(11)
    foot_px = 3290.0 / 200.0 + rng.normal(0.0, 2.0, 400)
    range_m = 3290.0 / foot_px
    en = np.stack([np.zeros(400), range_m], axis=1)
    covariance = np.zeros((400, 2, 2))
    covariance[:, 0, 0] = (range_m * 0.002) ** 2
    covariance[:, 1, 1] = (2.0 * range_m**2 / 3290.0) ** 2
    weighted = np.average(range_m, weights=1.0 / covariance[:, 1, 1])
    assert weighted < 195.0
    time = 0.5 * np.arange(400.0)
    track = RtsSmoother().apply(time, _positions(en, covariance))
    assert abs(track.north_m.mean() - 200.0) < 2.0


def test_any_time_agrees_with_the_default_times() -> None:
    boat = scene(1, dropouts=True)
    smoother = RtsSmoother()
    track = smoother.apply(boat.time_utc_s, boat.positions, track_id=7, label="boat")
    assert track.track_id == 7
    assert track.label == "boat"
    smoothed = smoother.smooth(boat.time_utc_s, boat.positions)
    again = smoothed.at(track.time_utc_s)
    np.testing.assert_array_equal(track.east_m, again.east_m)
    late = smoothed.at(track.time_utc_s[100:101])
    np.testing.assert_allclose(late.east_m, track.east_m[100])
    np.testing.assert_allclose(late.covariance_m2[0], track.covariance_m2[100])
    # The velocity is the slope of the position.
    step = 1e-3
    middle = 0.5 * (track.time_utc_s[50] + track.time_utc_s[51])
    around = smoothed.at(middle + np.array([-step, 0.0, step]))
    slope = (around.east_m[2] - around.east_m[0]) / (2.0 * step)
    assert slope == pytest.approx(around.velocity_east_mps[1], abs=1e-3)


def test_kinds_and_gaps() -> None:
    time = np.concatenate([np.arange(0.0, 20.0), np.arange(50.0, 70.0)])
    en = np.array([50.0, 100.0]) + np.outer(time, [1.0, 0.5])
    en[5] = np.nan
    positions = _positions(en, np.eye(2))
    at = np.array([-1.0, 4.0, 5.0, 5.5, 19.0, 30.0, 50.0, 69.0, 70.0])
    track = RtsSmoother(noise=WHITE).apply(time, positions, at_utc_s=at)
    m, i, e = PointKind.MEASURED, PointKind.INTERPOLATED, PointKind.EXTRAPOLATED
    assert track.kind.tolist() == [e, m, i, i, m, e, m, m, e]
    bridged = RtsSmoother(noise=WHITE, longest_gap_s=40.0).apply(time, positions, at_utc_s=at)
    assert bridged.kind.tolist() == [e, m, i, i, m, i, m, m, e]
    spread = np.trace(track.covariance_m2, axis1=1, axis2=2)
    assert spread[5] > spread[[1, 2, 4, 6]].max()
    assert 5.0 not in RtsSmoother(noise=WHITE).apply(time, positions).time_utc_s


@given(
    seed=st.integers(0, 50),
    ask=st.lists(st.floats(-30.0, 200.0), min_size=1, max_size=30),
    learn=st.booleans(),
)
@settings(max_examples=25, deadline=None)
def test_covariances_are_positive_definite(seed: int, ask: list[float], learn: bool) -> None:
    boat = scene(seed, sparse=True)
    smoother = RtsSmoother(noise=None if learn else WHITE)
    track = smoother.apply(boat.time_utc_s, boat.positions, at_utc_s=EPOCH_UTC_S + np.array(ask))
    for covariance in (track.covariance_m2, track.velocity_covariance_m2ps2):
        np.testing.assert_array_equal(covariance, np.swapaxes(covariance, 1, 2))
        assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_order_and_repeats_do_not_matter() -> None:
    boat = scene(2, sparse=True)
    rng = np.random.default_rng(0)
    order = rng.permutation(len(boat.time_utc_s))
    smoother = RtsSmoother(noise=WHITE)
    track = smoother.apply(boat.time_utc_s, boat.positions)
    shuffled = smoother.apply(boat.time_utc_s[order], boat.positions[order])
    np.testing.assert_allclose(shuffled.east_m, track.east_m, atol=1e-9)
    # Each box twice: the same track, with less doubt.
    twice = np.repeat(np.arange(len(boat.time_utc_s)), 2)
    doubled = smoother.apply(boat.time_utc_s[twice], boat.positions[twice])
    assert len(doubled) == len(track)
    doubt = [np.trace(t.covariance_m2, axis1=1, axis2=2) for t in (doubled, track)]
    assert (doubt[0] < doubt[1]).all()


def test_one_position_is_a_track() -> None:
    track = RtsSmoother().apply(
        np.array([5.0]),
        _positions(np.array([[10.0, 50.0]]), np.eye(2)),
        at_utc_s=np.array([5.0, 6.0]),
    )
    np.testing.assert_allclose(track.east_m, 10.0, atol=1e-6)
    assert track.kind.tolist() == [PointKind.MEASURED, PointKind.EXTRAPOLATED]
    assert track.covariance_m2[1, 0, 0] > 50.0


@pytest.mark.parametrize("name", METHODS)
def test_bad_input(name: str) -> None:
    nothing = _positions(np.full((3, 2), np.nan), np.eye(2))
    with pytest.raises(InputError, match="track 4: none of its 3 boxes has a position"):
        method(name).apply(np.arange(3.0), nothing, track_id=4)
    some = _positions(np.ones((3, 2)), np.eye(2))
    with pytest.raises(InputError, match="2 times for 3 positions"):
        method(name).apply(np.arange(2.0), some)
    with pytest.raises(InputError, match="1 confidences for 3 positions"):
        method(name).apply(np.arange(3.0), some, confidence=np.ones(1))
    with pytest.raises(InputError, match="asked for is no number"):
        method(name).apply(np.arange(3.0), some, at_utc_s=np.array([1.0, np.nan]))


def test_it_learns_whether_noise_lasts() -> None:
    white = RtsSmoother().smooth(scene(3).time_utc_s, scene(3).positions).noise
    boat = scene(3, correlation_time_s=1.0)
    correlated = RtsSmoother().smooth(boat.time_utc_s, boat.positions).noise
    assert white.white_along == pytest.approx(1.0, abs=0.15)
    assert white.correlated_along < 0.2
    assert correlated.white_along < 0.3
    assert correlated.correlated_along == pytest.approx(1.0, abs=0.3)


def test_it_is_still_on_straights_and_quick_in_turns() -> None:
    """Straight, a half circle in 12 s, straight: less doubt on the legs than in the turn."""
    rng = np.random.default_rng(9)
    time = np.arange(0.0, 92.0, 0.1)
    turned = np.clip((time - 40.0) / 12.0, 0.0, 1.0) * np.pi
    velocity = 4.0 * np.stack([np.cos(turned), np.sin(turned)], axis=1)
    truth = np.array([-80.0, 100.0]) + 0.1 * np.cumsum(velocity, axis=0)
    measured = truth + rng.normal(0.0, 3.0, truth.shape)
    track = RtsSmoother().apply(time, _positions(measured, 9.0 * np.eye(2)))
    doubt = np.sqrt(np.trace(track.covariance_m2, axis1=1, axis2=2))
    legs = ((time > 10.0) & (time < 30.0)) | ((time > 62.0) & (time < 82.0))
    turn = (time > 42.0) & (time < 50.0)
    assert doubt[legs].mean() < 0.75 * doubt[turn].mean()
    error = np.hypot(track.east_m - truth[:, 0], track.north_m - truth[:, 1])
    assert error[legs].mean() < 0.5
    assert error[turn].mean() < 1.0


def test_common_part_stays_whatever_the_number_of_boxes() -> None:
    """Scatter of a third of what is stated: the rest can only be an error of all alike."""
    rng = np.random.default_rng(8)
    time = 0.1 * np.arange(1500.0)
    en = np.array([20.0, 100.0]) + np.outer(time, [1.0, 0.3]) + rng.normal(0.0, 1.0, (1500, 2))
    positions = _positions(en, 9.0 * np.eye(2))
    smoothed = RtsSmoother().smooth(time, positions)
    assert 0.5 < smoothed.common_along < 8.0 / 9.0
    assert smoothed.at(time[700:701]).covariance_m2[0, 0, 0] > 4.5
    told = RtsSmoother(common_share=0.25).apply(time, positions)
    without = RtsSmoother(common_share=0.0).apply(time, positions)
    np.testing.assert_allclose(
        told.covariance_m2 - without.covariance_m2,
        np.tile(9.0 * 0.25 * np.eye(2), (1500, 1, 1)),
        atol=1e-6,
    )
    honest = RtsSmoother().smooth(time, _positions(en, np.eye(2)))
    assert honest.common_along == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("correlation_time_s", "largest_ratio"), [(0.0, 0.65), (1.0, 0.55)], ids=["white", "correlated"]
)
def test_better_than_the_paper_and_honest(correlation_time_s: float, largest_ratio: float) -> None:
    boats = [scene(seed, correlation_time_s=correlation_time_s) for seed in range(24)]
    ours = np.array([_error(boat, RtsSmoother()) for boat in boats])
    paper = np.array([_error(boat, PaperChain()) for boat in boats])
    assert (ours[:, 0] / paper[:, 0]).mean() <= largest_ratio
    assert 0.90 <= ours[:, 1].mean() <= 0.98


@pytest.mark.slow
def test_honest_with_one_box_each_four_seconds() -> None:
    boats = [scene(seed, sparse=True) for seed in range(40)]
    ours = np.array([_error(boat, RtsSmoother()) for boat in boats])
    paper = np.array([_error(boat, PaperChain()) for boat in boats])
    ratio = ours[:, 0] / paper[:, 0]
    assert ratio.mean() <= 0.65
    assert ratio.max() < 2.0
    assert 0.90 <= ours[:, 1].mean() <= 0.98


def test_noise_at_another_range_is_what_was_stated_there() -> None:
    """Along the line of sight it grows with the square of the range, across with the range."""
    range_m, bearing = np.geomspace(60.0, 240.0, 40), np.linspace(-0.5, 0.6, 40)
    sight = np.stack([np.sin(bearing), np.cos(bearing)], axis=1)
    left = np.stack([-np.cos(bearing), np.sin(bearing)], axis=1)
    along_m, across_m = 1e-4 * range_m**2, 0.02 * range_m
    covariance = np.einsum("n,ni,nj->nij", along_m**2, sight, sight)
    covariance += np.einsum("n,ni,nj->nij", across_m**2, left, left)
    time = np.arange(40.0)
    measured, _ = measurements(
        time, _positions(range_m[:, None] * sight, covariance), None, None, 0
    )
    for further in (0.97, 1.04):
        there = further * range_m
        at = NoiseAtRange.of(measured).linearised(there[:, None] * sight)
        first, mixed, second = at.covariance_m2
        np.testing.assert_allclose(first, (1e-4 * there**2) ** 2, rtol=1e-6)
        np.testing.assert_allclose(second, (0.02 * there) ** 2, rtol=1e-6)
        np.testing.assert_allclose(mixed, 0.0, atol=1e-9)


def test_what_went_in_and_out_of_the_gate_stays_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that agrees with the track without it alone would go in and out for ever."""
    time = np.arange(0.0, 20.0, 0.5)
    en = np.array([40.0, 90.0]) + np.outer(time, [2.0, 1.0])
    en[17] += [300.0, -200.0]

    def gate(*given: Any) -> BoolArray:
        used: BoolArray = given[5]
        agrees = np.ones_like(used)
        agrees[17] = not used[17]
        return agrees

    monkeypatch.setattr(smoother, "_gate", gate)
    smooth = RtsSmoother(noise=WHITE).smooth(time, _positions(en, np.eye(2)))
    assert np.flatnonzero(~smooth.used).tolist() == [17]
    track = smooth.at(time)
    np.testing.assert_allclose(track.east_m, 40.0 + 2.0 * time, atol=0.1)
    np.testing.assert_allclose(track.north_m, 90.0 + time, atol=0.1)
