"""The paper's chain against its own definition, written out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.trajectory import PaperChain
from sightline.types import FloatArray, PointKind, Positions

PLANE = LocalPlane(32.7, -117.2)


def _positions(en_m: FloatArray, variance_m2: FloatArray | float = 1.0) -> Positions:
    variance = np.broadcast_to(variance_m2, (len(en_m),))
    return Positions(
        east_m=en_m[:, 0],
        north_m=en_m[:, 1],
        covariance_m2=variance[:, None, None] * np.eye(2),
        extrapolated=np.zeros(len(en_m), dtype=bool),
        plane=PLANE,
    )


def test_average_is_weighted_by_confidence() -> None:
    rng = np.random.default_rng(1)
    time = np.sort(rng.uniform(0.0, 20.0, 120))
    en = rng.normal(0.0, 1.0, (120, 2))
    confidence = rng.uniform(0.4, 1.0, 120)
    variance = rng.uniform(0.5, 2.0, 120)
    chain = PaperChain(window_s=2.0, outlier_sigmas=100.0)
    track = chain.apply(time, _positions(en, variance), confidence=confidence)
    for k in range(120):
        near = np.abs(time - time[k]) <= 1.0
        weight = confidence[near] / confidence[near].sum()
        assert track.east_m[k] == pytest.approx(weight @ en[near, 0], abs=1e-9)
        assert track.covariance_m2[k, 1, 1] == pytest.approx(weight**2 @ variance[near], abs=1e-9)


def test_gaps_are_filled_by_a_spline_through_the_averages() -> None:
    # One box in a window: the average is the box, so the spline goes through the boxes.
    time = np.array([0.0, 3.0, 6.0, 9.0, 18.0, 21.0, 24.0])
    en = np.stack([np.sin(0.2 * time), np.cos(0.2 * time)], axis=1) * 50.0
    ask = np.array([1.0, 10.0, 14.0, 20.0])
    track = PaperChain().apply(time, _positions(en), at_utc_s=ask)
    spline = CubicSpline(time, en)
    np.testing.assert_allclose(track.east_m, spline(ask)[:, 0], atol=1e-9)
    np.testing.assert_allclose(track.velocity_north_mps, spline(ask, 1)[:, 1], atol=1e-9)
    assert (track.kind == PointKind.INTERPOLATED).all()


def test_extrapolation_keeps_the_velocity() -> None:
    time = np.arange(0.0, 10.0, 0.1)
    en = np.array([5.0, 80.0]) + np.outer(time, [2.0, -0.5])
    ask = np.array([-3.0, -1.0, 12.0, 15.0])
    track = PaperChain().apply(time, _positions(en), at_utc_s=ask)
    np.testing.assert_allclose(track.velocity_east_mps, 2.0, atol=1e-9)
    np.testing.assert_allclose(np.diff(track.east_m)[[0, 2]], [4.0, 6.0], atol=1e-9)
    np.testing.assert_allclose(np.diff(track.north_m)[[0, 2]], [-1.0, -1.5], atol=1e-9)
    assert (track.kind == PointKind.EXTRAPOLATED).all()
    assert (np.diff(track.covariance_m2[2:, 0, 0]) > 0.0).all()
    # Between the ends a straight path stays straight.
    inside = PaperChain().apply(time, _positions(en), at_utc_s=np.array([3.33, 7.07]))
    np.testing.assert_allclose(inside.east_m, 5.0 + 2.0 * np.array([3.33, 7.07]), atol=1e-6)


def test_outliers_and_unsure_boxes_are_left_out() -> None:
    rng = np.random.default_rng(4)
    time = np.arange(0.0, 20.0, 0.1)
    en = 100.0 + rng.normal(0.0, 0.5, (200, 2))
    confidence = np.full(200, 0.9)
    en[50] += 40.0
    en[120] += 40.0
    confidence[120] = 0.1
    track = PaperChain().apply(time, _positions(en), confidence=confidence)
    assert np.abs(track.east_m - 100.0).max() < 0.6
    assert np.flatnonzero(track.kind != PointKind.MEASURED)[:1] <= 50
    assert track.kind[50] == track.kind[120] == PointKind.INTERPOLATED
    # Where all are unsure, all are used.
    PaperChain().apply(time, _positions(en), confidence=np.full(200, 0.05))


def test_velocity_covariance_is_that_of_the_slope() -> None:
    """Over many draws the scatter of the velocity is what is stated, within a factor of two."""
    rng = np.random.default_rng(6)
    time = np.arange(0.0, 10.0, 0.1)
    slopes, stated = [], []
    for _ in range(150):
        en = rng.normal(0.0, 1.0, (100, 2))
        track = PaperChain().apply(time, _positions(en), at_utc_s=np.array([5.05, 10.5]))
        slopes.append(track.velocity_east_mps)
        stated.append(track.velocity_covariance_m2ps2[:, 0, 0])
    ratio = np.var(slopes, axis=0) / np.mean(stated, axis=0)
    assert (ratio > 0.5).all()
    assert (ratio < 2.0).all()


def test_one_position() -> None:
    track = PaperChain().apply(
        np.array([1.0]), _positions(np.array([[3.0, 4.0]])), at_utc_s=np.array([1.0, 2.0])
    )
    np.testing.assert_allclose(track.east_m, 3.0)
    assert track.covariance_m2[1, 0, 0] == pytest.approx(101.0)


def test_settings_out_of_range() -> None:
    with pytest.raises(InputError, match="window_s"):
        PaperChain(window_s=0.0)
    with pytest.raises(InputError, match="spline_degree is 7; expected 1 to 5"):
        PaperChain(spline_degree=7)


def test_what_counts_as_an_outlier_is_so_many_standard_deviations_off() -> None:
    """Positions on a circle: the scatter that has this median distance is 1 / 1.1774 of it."""
    time = np.arange(0.0, 20.0, 0.1)
    turn = np.arange(time.size) * np.pi / 2.0
    en = 2.0 * np.stack([np.cos(turn), np.sin(turn)], axis=1).round()
    off = {60: 4.0 * 0.94, 140: 4.0 * 1.06}
    for row, sigmas in off.items():
        en[row] = [sigmas * 2.0 / 1.17741, 0.0]
    track = PaperChain(outlier_sigmas=4.0).apply(time, _positions(en))
    assert np.flatnonzero(track.kind != PointKind.MEASURED).tolist() == [140]


def test_beyond_the_end_the_place_is_as_unsure_as_the_velocity_makes_it() -> None:
    rng = np.random.default_rng(7)
    time = np.arange(0.0, 10.0, 0.1)
    lags = np.array([0.0, 2.0, 6.0, 12.0])
    places, stated = [], []
    for _ in range(200):
        en = rng.normal(0.0, 1.0, (100, 2))
        track = PaperChain().apply(time, _positions(en), at_utc_s=time[-1] + lags)
        places.append(track.east_m)
        stated.append(track.covariance_m2[:, 0, 0])
        grown = track.covariance_m2 - track.covariance_m2[:1]
        by_velocity = (lags**2)[1:, None, None] * track.velocity_covariance_m2ps2[1:]
        np.testing.assert_allclose(grown[1:], by_velocity, rtol=1e-9)
    ratio = np.var(places, axis=0)[1:] / np.mean(stated, axis=0)[1:]
    assert (ratio > 0.5).all()
    assert (ratio < 2.0).all()
