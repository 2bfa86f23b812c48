from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from evo.core.metrics import APE, RPE, PoseRelation, StatisticsType, Unit
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom, chi2

from sightline.errors import InputError
from sightline.evaluation.metrics import (
    ScoredPairs,
    absolute_error,
    by_range,
    coverage,
    covered,
    line_of_sight,
    line_of_sight_errors,
    mahalanobis_squared,
    pair_positions,
    pair_track,
    relative_error,
    relative_errors,
)
from sightline.geodesy import LocalPlane
from sightline.types import Fixes, Positions, Track

PLANE = LocalPlane(32.70297, -117.234631)
START = 1_601_494_584.0


def make_pairs(
    time_utc_s, east_m, north_m, true_east_m, true_north_m, *, covariance_m2=None, segment=None
) -> ScoredPairs:
    n = np.size(time_utc_s)
    return ScoredPairs(
        time_utc_s=time_utc_s,
        east_m=east_m,
        north_m=north_m,
        covariance_m2=np.full((n, 2, 2), np.nan) if covariance_m2 is None else covariance_m2,
        true_east_m=true_east_m,
        true_north_m=true_north_m,
        segment=np.zeros(n, np.int64) if segment is None else segment,
        asked=n,
    )


def random_pairs(n: int, seed: int = 0, *, step_s: float | None = 0.0625) -> ScoredPairs:
    """A wandering target and an estimate with noise; regular times are exact in binary."""
    rng = np.random.default_rng(seed)
    steps = rng.uniform(0.05, 2.0, n) if step_s is None else np.full(n, step_s)
    true = np.cumsum(rng.normal(0.0, 1.0, (2, n)), axis=1) + 100.0
    estimate = true + rng.normal(0.0, 3.0, (2, n))
    return make_pairs(START + np.cumsum(steps), *estimate, *true)


def evo_path(time_utc_s, east_m, north_m) -> PoseTrajectory3D:
    n = np.size(time_utc_s)
    return PoseTrajectory3D(
        positions_xyz=np.column_stack([east_m, north_m, np.zeros(n)]),
        orientations_quat_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        timestamps=np.asarray(time_utc_s),
    )


def evo_paths(pairs: ScoredPairs) -> tuple[PoseTrajectory3D, PoseTrajectory3D]:
    return (
        evo_path(pairs.time_utc_s, pairs.true_east_m, pairs.true_north_m),
        evo_path(pairs.time_utc_s, pairs.east_m, pairs.north_m),
    )


@pytest.mark.parametrize("seed", range(3))
def test_absolute_error_is_that_of_evo(seed: int) -> None:
    pairs = random_pairs(500, seed)
    oracle = APE(PoseRelation.translation_part)
    oracle.process_data(evo_paths(pairs))
    ours = absolute_error(pairs)
    assert ours.n == 500
    for value, statistic in (
        (ours.rmse, StatisticsType.rmse),
        (ours.mean, StatisticsType.mean),
        (ours.median, StatisticsType.median),
        (ours.max, StatisticsType.max),
    ):
        assert value == pytest.approx(oracle.get_statistic(statistic), rel=1e-9)
    assert ours.mse == pytest.approx(np.mean(oracle.error**2), rel=1e-9)


@pytest.mark.parametrize("delta_s", [0.0625, 1.0, 5.0])
def test_relative_error_at_regular_times_is_that_of_evo(delta_s: float) -> None:
    pairs = random_pairs(500)
    oracle = RPE(
        PoseRelation.translation_part,
        delta=delta_s / 0.0625,
        delta_unit=Unit.frames,
        all_pairs=True,
    )
    oracle.process_data(evo_paths(pairs))
    ours = relative_error(pairs, delta_s)
    assert ours.n == len(oracle.error) == 500 - round(delta_s / 0.0625)
    assert ours.rmse == pytest.approx(oracle.get_statistic(StatisticsType.rmse), rel=1e-9)
    assert ours.mean == pytest.approx(oracle.get_statistic(StatisticsType.mean), rel=1e-9)
    assert ours.median == pytest.approx(oracle.get_statistic(StatisticsType.median), rel=1e-9)
    assert ours.mse == pytest.approx(np.mean(oracle.error**2), rel=1e-9)


@pytest.mark.parametrize("delta_s", [0.3, 1.0, 7.7])
def test_relative_error_at_irregular_times_is_that_of_evo(delta_s: float) -> None:
    pairs = random_pairs(400, 4, step_s=None)
    first = pairs.time_utc_s[pairs.time_utc_s + delta_s <= pairs.time_utc_s[-1]]
    # evo is given each pose and the one Δ later, interpolated, in turn.
    times = np.column_stack([first, first + delta_s]).ravel()

    def at(values):
        return np.interp(times, pairs.time_utc_s, values)

    stamps = np.arange(times.size, dtype=float)
    oracle = RPE(PoseRelation.translation_part, delta=1, delta_unit=Unit.frames)
    oracle.process_data(
        (
            evo_path(stamps, at(pairs.true_east_m), at(pairs.true_north_m)),
            evo_path(stamps, at(pairs.east_m), at(pairs.north_m)),
        )
    )
    np.testing.assert_allclose(
        relative_errors(pairs, delta_s), oracle.error[::2], rtol=1e-9, atol=1e-12
    )


def test_the_numbers_of_a_table_worked_by_hand() -> None:
    # Errors 3, 4 and 5 m at true distances of 30, 40 and 50 m.
    pairs = make_pairs(
        START + np.arange(3.0),
        [33.0, 0.0, 30.0],
        [0.0, 44.0, 45.0],
        [30.0, 0.0, 30.0],
        [0.0, 40.0, 40.0],
    )
    ape = absolute_error(pairs)
    assert (ape.n, ape.mean, ape.median, ape.max) == (3, 4.0, 4.0, 5.0)
    assert ape.mse == pytest.approx(50.0 / 3.0)
    assert ape.rmse == pytest.approx(np.sqrt(50.0 / 3.0))
    assert ape.p90 == pytest.approx(4.8)
    assert ape.per_range == pytest.approx(0.1)
    # The error vector moves by (-3, 4), then by (0, 1).
    rpe = relative_error(pairs, 1.0)
    assert (rpe.delta_s, rpe.n, rpe.mean, rpe.median) == (1.0, 2, 3.0, 3.0)
    assert rpe.mse == pytest.approx(13.0)
    assert rpe.rmse == pytest.approx(np.sqrt(13.0))


coordinates = st.floats(-500.0, 500.0, allow_nan=False)
paths = st.lists(st.tuples(*[coordinates] * 4), min_size=3, max_size=12)


def path_pairs(rows, turn_rad: float = 0.0, shift=(0.0, 0.0), offset=(0.0, 0.0)) -> ScoredPairs:
    table = np.array(rows).reshape(-1, 2, 2)  # row, estimate or truth, axis
    turned = table @ np.array(
        [[np.cos(turn_rad), np.sin(turn_rad)], [-np.sin(turn_rad), np.cos(turn_rad)]]
    )
    estimate, true = turned[:, 0] + shift + np.asarray(offset), turned[:, 1] + shift
    return make_pairs(START + np.arange(len(table)), *estimate.T, *true.T)


@given(paths, st.floats(-np.pi, np.pi), st.tuples(coordinates, coordinates))
def test_moving_and_turning_everything_changes_no_error(rows, turn_rad, shift) -> None:
    before, after = path_pairs(rows), path_pairs(rows, turn_rad, shift)
    assert absolute_error(after).rmse == pytest.approx(absolute_error(before).rmse, abs=1e-9)
    assert absolute_error(after).median == pytest.approx(absolute_error(before).median, abs=1e-9)
    assert relative_error(after, 1.5).rmse == pytest.approx(
        relative_error(before, 1.5).rmse, abs=1e-9
    )


@given(paths, st.tuples(coordinates, coordinates))
def test_the_relative_error_does_not_see_a_constant_offset(rows, offset) -> None:
    before, after = path_pairs(rows), path_pairs(rows, offset=offset)
    assert relative_error(after).rmse == pytest.approx(relative_error(before).rmse, abs=1e-9)


@given(paths)
def test_an_estimate_that_is_the_truth_has_no_error(rows) -> None:
    same = path_pairs([(*row[2:], *row[2:]) for row in rows])
    assert absolute_error(same).max == 0.0
    assert relative_error(same).rmse == 0.0


@given(paths)
def test_along_and_across_make_up_the_error(rows) -> None:
    pairs = path_pairs(rows)
    along, across = line_of_sight_errors(pairs)
    away = pairs.true_range_m > 1e-3
    np.testing.assert_allclose(
        np.hypot(along, across)[away], pairs.error_m[away], rtol=1e-9, atol=1e-9
    )
    assert np.isnan(along[~away]).all()


def test_the_relative_error_never_crosses_from_one_segment_to_the_next() -> None:
    one = random_pairs(40, 1)
    other = random_pairs(40, 2)
    both = ScoredPairs.concatenate([one, other])
    expected = np.concatenate([relative_errors(one, 0.5), relative_errors(other, 0.5)])
    np.testing.assert_array_equal(np.sort(relative_errors(both, 0.5)), np.sort(expected))


def test_the_relative_error_does_not_depend_on_the_order_of_rows() -> None:
    pairs = random_pairs(100, 3)
    rows = np.random.default_rng(0).permutation(100)
    shuffled = make_pairs(
        pairs.time_utc_s[rows],
        pairs.east_m[rows],
        pairs.north_m[rows],
        pairs.true_east_m[rows],
        pairs.true_north_m[rows],
    )
    assert relative_error(shuffled) == relative_error(pairs)


def test_nothing_is_interpolated_over_a_long_gap() -> None:
    times = START + np.array([0.0, 1.0, 30.0, 31.0])
    pairs = make_pairs(times, np.arange(4.0) ** 2, np.zeros(4), np.zeros(4), np.zeros(4))
    # 0 -> 1 and 30 -> 31 end on a pose; 1 -> 2 lies in the gap; 31 -> 32 after the end.
    np.testing.assert_allclose(relative_errors(pairs, 1.0), [1.0, 5.0])
    # 1 -> 30 ends on a pose, though the pose before that is far away; 0 -> 29 does not.
    np.testing.assert_allclose(relative_errors(pairs, 29.0), [3.0])
    np.testing.assert_allclose(
        relative_errors(pairs, 1.0, largest_gap_s=60.0), [1.0, 3.0 / 29.0, 5.0]
    )


def test_two_estimates_of_one_time_count_as_their_mean_in_the_relative_error() -> None:
    pairs = make_pairs(
        START + np.array([0.0, 0.0, 1.0]), [1.0, 3.0, 7.0], np.zeros(3), np.zeros(3), np.zeros(3)
    )
    np.testing.assert_allclose(relative_errors(pairs, 1.0), [5.0])


@pytest.mark.parametrize("delta_s", [0.0, -1.0, np.nan, np.inf])
def test_a_relative_error_over_no_time_is_refused(delta_s: float) -> None:
    with pytest.raises(InputError, match="must be positive"):
        relative_error(random_pairs(5), delta_s)


def test_bias_along_is_too_far_and_across_is_clockwise() -> None:
    # A target due east at 100 m, seen 10 m too far and 2 m too far south, which is to the right.
    found = line_of_sight(make_pairs([START], [110.0], [-2.0], [100.0], [0.0]))
    assert (found.bias_along, found.bias_across) == pytest.approx((10.0, 2.0))
    assert (found.rmse_along, found.rmse_across) == pytest.approx((10.0, 2.0))


def gaussian_pairs(n: int, stated_scale: float, seed: int = 0) -> ScoredPairs:
    """Errors drawn from covariances of any shape, stated ``stated_scale`` times as large."""
    rng = np.random.default_rng(seed)
    factor = rng.normal(0.0, 4.0, (n, 2, 2)) + 3.0 * np.eye(2)
    covariance = factor @ factor.transpose(0, 2, 1)
    error = (factor @ rng.normal(size=(n, 2, 1)))[:, :, 0]
    true = rng.uniform(-300.0, 300.0, (n, 2))
    return make_pairs(
        START + np.arange(n),
        *(true + error).T,
        *true.T,
        covariance_m2=stated_scale * covariance,
    )


def test_coverage_of_true_covariances_is_the_stated_probability() -> None:
    n = 20_000
    found = coverage(gaussian_pairs(n, 1.0))
    assert found.n == n
    for share, probability in ((found.p50, 0.5), (found.p95, 0.95)):
        low, high = binom.interval(0.9999, n, probability)
        assert low / n <= share <= high / n


def test_coverage_with_the_logs_error_is_the_stated_probability_where_the_log_is_off() -> None:
    n = 20_000
    exact = gaussian_pairs(n, 1.0, 3)
    off = np.random.default_rng(4).normal(0.0, 3.0, (2, n))
    found = coverage(
        replace(
            exact,
            true_east_m=exact.true_east_m + off[0],
            true_north_m=exact.true_north_m + off[1],
            reference_sigma_m=np.full(n, 3.0),
        )
    )
    assert found.reference_sigma_m == pytest.approx(3.0)
    for share, probability in ((found.p50_with_log, 0.5), (found.p95_with_log, 0.95)):
        low, high = binom.interval(0.9999, n, probability)
        assert low / n <= share <= high / n
    assert found.p50 < 0.4
    assert found.p95 < 0.85


@pytest.mark.parametrize("scale", [0.25, 4.0])
def test_coverage_of_false_covariances_follows_the_chi_square(scale: float) -> None:
    n = 20_000
    probabilities = np.array([0.1, 0.5, 0.9, 0.95])
    expected = chi2.cdf(chi2.ppf(probabilities, 2) * scale, 2)
    found = covered(gaussian_pairs(n, scale, 1), probabilities)
    low, high = binom.interval(0.9999, n, expected)
    assert ((low / n <= found) & (found <= high / n)).all()


def test_mahalanobis_distance_is_that_of_the_inverse() -> None:
    pairs = gaussian_pairs(200, 1.0, 2)
    error = np.stack([pairs.true_east_m - pairs.east_m, pairs.true_north_m - pairs.north_m], 1)
    expected = np.einsum("ni,nij,nj->n", error, np.linalg.inv(pairs.covariance_m2), error)
    np.testing.assert_allclose(mahalanobis_squared(pairs), expected, rtol=1e-9)


def test_coverage_of_what_states_no_covariance_is_not_known() -> None:
    found = coverage(random_pairs(5))
    assert found.n == 0
    assert np.isnan(found.p50)
    assert np.isnan(found.p95)


def test_coverage_is_over_those_pairs_that_state_a_covariance() -> None:
    """Every second pair states none; the others are counted one by one."""
    pairs = gaussian_pairs(101, 0.5, 5)
    covariance = pairs.covariance_m2.copy()
    covariance[::2] = np.nan
    reference_sigma_m = np.linspace(0.5, 6.0, 101)
    mixed = replace(pairs, covariance_m2=covariance, reference_sigma_m=reference_sigma_m)
    inside = np.zeros(4, dtype=int)
    for i in range(1, 101, 2):
        off = np.array(
            [pairs.true_east_m[i] - pairs.east_m[i], pairs.true_north_m[i] - pairs.north_m[i]]
        )
        for k, stated in enumerate(
            (covariance[i], covariance[i] + reference_sigma_m[i] ** 2 * np.eye(2))
        ):
            distance = off @ np.linalg.inv(stated) @ off
            inside[2 * k :][:2] += distance <= chi2.ppf([0.5, 0.95], 2)
    found = coverage(mixed)
    assert found.n == 50
    assert found.reference_sigma_m == pytest.approx(np.sqrt(np.mean(reference_sigma_m[1::2] ** 2)))
    shares = (found.p50, found.p95, found.p50_with_log, found.p95_with_log)
    np.testing.assert_allclose(shares, inside / 50)
    assert len(set(inside.tolist())) == 4


def test_a_stated_certainty_holds_only_where_it_is_right() -> None:
    pairs = make_pairs(
        START + np.arange(2.0),
        [0.0, 1.0],
        [5.0, 5.0],
        [0.0, 0.0],
        [5.0, 5.0],
        covariance_m2=np.zeros((2, 2, 2)),
    )
    np.testing.assert_array_equal(mahalanobis_squared(pairs), [0.0, np.inf])
    assert coverage(pairs).p95 == 0.5
    # As does one that is flat: to the sides of a line, or along it.
    flat = replace(pairs, covariance_m2=np.full((2, 2, 2), 4.0))
    np.testing.assert_array_equal(mahalanobis_squared(flat), [0.0, np.inf])
    along = replace(flat, true_east_m=[0.0, 2.0], true_north_m=[5.0, 6.0])
    np.testing.assert_array_equal(mahalanobis_squared(along), [0.0, np.inf])


def test_bins_of_range_hold_every_pair_once() -> None:
    pairs = gaussian_pairs(500, 1.0, 3)
    bins = by_range(pairs)
    assert sum(row.n for row in bins) == 500
    assert sum(row.n * row.rmse**2 for row in bins) / 500 == pytest.approx(
        absolute_error(pairs).mse
    )
    near = pairs.true_range_m < 25.0
    assert (bins[0].from_m, bins[0].to_m, bins[0].n) == (0.0, 25.0, near.sum())
    assert bins[0].median == pytest.approx(np.median(pairs.error_m[near]))


def test_no_pairs_make_no_numbers() -> None:
    nothing = ScoredPairs.concatenate([])
    assert absolute_error(nothing).n == relative_error(nothing).n == coverage(nothing).n == 0
    assert np.isnan(absolute_error(nothing).rmse)
    assert np.isnan(relative_error(nothing).rmse)
    assert np.isnan(line_of_sight(nothing).bias_along)
    assert np.isnan(nothing.share)
    assert by_range(nothing) == ()


def test_a_target_at_the_camera_has_no_error_per_range() -> None:
    ape = absolute_error(make_pairs([START], [3.0], [4.0], [0.0], [0.0]))
    assert ape.rmse == 5.0
    assert np.isnan(ape.per_range)


def log_of(time_utc_s, east_m, north_m) -> Fixes:
    return Fixes(np.asarray(time_utc_s), *PLANE.to_geographic(east_m, north_m))


def test_positions_are_paired_with_the_log_between_its_fixes() -> None:
    log = log_of(START + np.array([0.0, 4.0, 20.0]), [0.0, 40.0, 40.0], [100.0, 100.0, 100.0])
    times = START + np.array([1.0, 2.0, 12.0, 20.0, 99.0, np.nan])
    positions = Positions(
        east_m=[11.0, np.nan, 0.0, 40.0, 0.0, 0.0],
        north_m=[100.0, np.nan, 0.0, 103.0, 0.0, 0.0],
        covariance_m2=np.tile(np.eye(2), (6, 1, 1)),
        extrapolated=np.zeros(6, bool),
        plane=PLANE,
    )
    pairs = pair_positions(times, positions, log)
    # 12 lies in a gap of 16 s, 99 after the log; 2 has no position though the log knows it.
    np.testing.assert_array_equal(pairs.time_utc_s, times[[0, 3]])
    np.testing.assert_allclose(pairs.error_m, [1.0, 3.0], atol=1e-6)
    assert (pairs.asked, pairs.without_position, pairs.share) == (6, 1, 2 / 6)
    assert len(pair_positions(times, positions, log, largest_gap_s=16.0)) == 3


@pytest.mark.parametrize("seed", range(3))
def test_what_the_log_does_not_know_is_not_missed(seed: int) -> None:
    """Each time looked at by itself: is it between two near fixes, and is there a position?"""
    rng = np.random.default_rng(seed)
    stamps = START + np.cumsum(rng.uniform(1.0, 15.0, 12))
    log = log_of(stamps, np.zeros(12), np.full(12, 100.0))
    times = rng.uniform(stamps[0] - 20.0, stamps[-1] + 20.0, 200)
    places = np.where(rng.random(200) < 0.5, np.nan, 1.0)
    positions = Positions(
        east_m=places,
        north_m=places + 100.0,
        covariance_m2=np.tile(np.eye(2), (200, 1, 1)),
        extrapolated=np.zeros(200, bool),
        plane=PLANE,
    )
    near = [
        any(a <= time <= b and b - a <= 8.0 for a, b in itertools.pairwise(stamps))
        for time in times
    ]
    pairs = pair_positions(times, positions, log)
    assert pairs.asked == 200
    assert len(pairs) == sum(near & np.isfinite(places))
    assert pairs.without_position == sum(near & np.isnan(places))
    assert 0 < pairs.without_position < np.isnan(places).sum()


def test_a_track_is_paired_at_its_own_times() -> None:
    times = START + np.arange(0.0, 10.0, 0.5)
    n = times.size
    track = Track(
        track_id=7,
        time_utc_s=times,
        east_m=10.0 * (times - START),
        north_m=np.full(n, 50.0),
        velocity_east_mps=np.full(n, 10.0),
        velocity_north_mps=np.zeros(n),
        covariance_m2=np.tile(np.eye(2), (n, 1, 1)),
        velocity_covariance_m2ps2=np.tile(np.eye(2), (n, 1, 1)),
        kind=np.zeros(n, np.int8),
        plane=PLANE,
    )
    log = log_of(START + np.array([2.0, 6.0]), [20.0, 60.0], [48.0, 48.0])
    pairs = pair_track(track, log)
    np.testing.assert_array_equal(pairs.time_utc_s, times[4:13])
    np.testing.assert_allclose(pairs.error_m, 2.0, atol=1e-6)
    assert pairs.asked == n


def test_tables_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match=r"ScoredPairs.north_m has shape \(1,\), expected \(2,\)"):
        make_pairs([0.0, 1.0], [0.0, 0.0], [0.0], [0.0, 0.0], [0.0, 0.0])
    with pytest.raises(InputError, match="true_east_m"):
        make_pairs([0.0], [0.0], [0.0], [np.nan], [0.0])
    nowhere = Positions([], [], np.empty((0, 2, 2)), [], PLANE)
    with pytest.raises(InputError, match="0 positions need as many times"):
        pair_positions([START], nowhere, log_of([START], [0.0], [0.0]))
