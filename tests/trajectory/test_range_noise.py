"""Measurements along and across the line of sight, against the same written out with matrices."""

from __future__ import annotations

import numpy as np
import pytest

from sightline.geodesy import LocalPlane
from sightline.trajectory.base import Measurements, measurements
from sightline.trajectory.range_noise import Linearised, NoiseAtRange, RobustStart
from sightline.types import FloatArray, Positions

PLANE = LocalPlane(32.7, -117.2)


def measured_at(time_s: FloatArray, en_m: FloatArray, covariance_m2: FloatArray) -> Measurements:
    n = time_s.size
    positions = Positions(
        east_m=en_m[:, 0],
        north_m=en_m[:, 1],
        covariance_m2=np.broadcast_to(covariance_m2, (n, 2, 2)),
        extrapolated=np.zeros(n, dtype=bool),
        plane=PLANE,
    )
    return measurements(time_s, positions, None, None, 0)[0]


def some_covariances(rng: np.random.Generator, n: int, size_m: float = 2.0) -> FloatArray:
    root = rng.normal(0.0, size_m, (n, 2, 2))
    return root @ root.transpose(0, 2, 1) + np.eye(2)


def some_linear(rng: np.random.Generator, n: int) -> Linearised:
    """Measurements about a path, in axes that point anywhere."""
    bearing = rng.uniform(-np.pi, np.pi, n)
    covariance = some_covariances(rng, n)
    return Linearised(
        measured_m=rng.normal(0.0, 5.0, (2, n)),
        sine=np.sin(bearing),
        cosine=np.cos(bearing),
        covariance_m2=np.stack([covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]]),
        reference_m=rng.normal(0.0, 5.0, (n, 2)),
    )


def axes_of(linear: Linearised, k: int) -> FloatArray:
    """Rows: the way along the line of sight, and that to the left of it."""
    east, north = linear.sine[k], linear.cosine[k]
    return np.array([[east, north], [-north, east]])


def matrix(three: FloatArray) -> FloatArray:
    return np.array([[three[0], three[1]], [three[1], three[2]]])


def test_distances_from_a_fitted_path_have_the_covariance_of_residuals() -> None:
    rng = np.random.default_rng(0)
    n = 60
    linear, place = some_linear(rng, n), rng.normal(0.0, 5.0, (n, 2))
    # From fits that are much better than a measurement to ones that are worse than it.
    fitted = some_covariances(rng, n) * np.geomspace(1e-3, 10.0, n)[:, None, None]
    used, share = rng.random(n) < 0.7, np.array([0.7, 1.6])
    three = np.stack([fitted[:, 0, 0], fitted[:, 0, 1], fitted[:, 1, 1]])
    got = linear.squared_distance(place, three, share, used)
    small = large = 0
    for k in range(n):
        turn = axes_of(linear, k)
        noise = np.diag(share) @ matrix(linear.covariance_m2[:, k]) @ np.diag(share)
        fit = turn @ fitted[k] @ turn.T
        total = noise + fit
        if used[k]:
            # The fit of a used one is at most so large a part of its noise.
            largest = np.linalg.eigvals(np.linalg.solve(noise, fit)).real.max()
            small, large = small + (largest < 0.95), large + (largest > 0.95)
            total = noise - min(1.0, 0.95 / largest) * fit
        off = linear.measured_m[:, k] - turn @ place[k]
        assert got[k] == pytest.approx(off @ np.linalg.solve(total, off))
    assert min(small, large, (~used).sum()) > 5


def test_measurements_that_are_close_in_time_enter_as_their_weighted_mean() -> None:
    rng = np.random.default_rng(1)
    n = 30
    time = np.sort(rng.uniform(0.0, 3.0, n))
    start, velocity = np.array([30.0, 80.0]), np.array([4.0, -2.0])
    path = start + time[:, None] * velocity
    place = path + rng.normal(0.0, 2.0, (n, 2))
    linear = NoiseAtRange.of(
        measured_at(time, place, np.array([[4.0, 1.5], [1.5, 2.0]]))
    ).linearised(path)
    used = rng.random(n) < 0.8

    class Path:
        def position_at(self, time_s: FloatArray) -> FloatArray:
            return start + time_s[:, None] * velocity

    nodes = linear.nodes(time, used, Path(), 0.5)
    cells = np.floor(time / 0.5)
    assert nodes.time_s.size == np.unique(cells[used]).size
    for row, cell in enumerate(np.unique(cells[used])):
        members = np.flatnonzero(used & (cells == cell))
        # All are as sure: their mean, at their mean time, after the motion is taken out.
        off = (place[members] - path[members]).mean(axis=0)
        node_s = time[members].mean()
        assert nodes.time_s[row] == pytest.approx(node_s)
        assert nodes.count[row] == members.size
        axes, root = nodes.axes[row], nodes.root_m[row]
        np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-12)
        ahead = path[members].mean(axis=0) / np.linalg.norm(path[members].mean(axis=0))
        np.testing.assert_allclose(axes[0], ahead, atol=1e-3)
        expected = start + node_s * velocity + off
        np.testing.assert_allclose(axes.T @ nodes.measured_m[row], expected, rtol=1e-9)
        stated = axes.T @ root @ root.T @ axes
        np.testing.assert_allclose(stated, [[4.0, 1.5], [1.5, 2.0]], rtol=1e-9)


def test_a_mean_weighs_each_by_its_precision() -> None:
    rng = np.random.default_rng(2)
    linear = some_linear(rng, 6)

    class Still:
        def position_at(self, time_s: FloatArray) -> FloatArray:
            return np.tile([7.0, -3.0], (time_s.size, 1))

    nodes = linear.nodes(np.linspace(0.0, 0.5, 6), np.ones(6, dtype=bool), Still(), 1.0)
    precision, weighted = np.zeros((2, 2)), np.zeros(2)
    for k in range(6):
        turn = axes_of(linear, k)
        one = turn.T @ np.linalg.inv(matrix(linear.covariance_m2[:, k])) @ turn
        precision += one
        weighted += one @ (turn.T @ linear.measured_m[:, k] - linear.reference_m[k])
    axes, root = nodes.axes[0], nodes.root_m[0]
    expected = np.array([7.0, -3.0]) + np.linalg.solve(precision, weighted)
    np.testing.assert_allclose(axes.T @ nodes.measured_m[0], expected)
    covariance = axes.T @ root @ root.T @ axes / nodes.count[0]
    np.testing.assert_allclose(covariance, np.linalg.inv(precision))


def test_the_first_gate_is_by_the_scatter_where_that_is_larger_than_stated() -> None:
    """Twice the gate: along, the scatter is three times what is stated; across, a tenth of it."""
    n = 101
    along, across = np.linspace(-1.0, 1.0, n), np.linspace(-1.0, 1.0, n)[::-1].copy()
    across[:2] = along[2:4] = 0.0
    # Medians of the sizes of normal deviates are 0.6745 standard deviations.
    along *= 3.0 * 0.6745 / np.median(np.abs(along))
    across *= 0.1 * 0.6745 / np.median(np.abs(across))
    limit = np.sqrt(2.0 * 9.0)
    along[0], along[1], across[2], across[3] = 3.0 * limit * 0.98, 3.0 * limit * 1.02, 4.2, 4.3
    linear = Linearised(
        measured_m=np.stack([along, across]),
        sine=np.zeros(n),
        cosine=np.ones(n),
        covariance_m2=np.tile([[1.0], [0.0], [1.0]], n),
        reference_m=np.zeros((n, 2)),
    )
    near = linear.start_gate(9.0)
    assert np.flatnonzero(~near).tolist() == [1, 3]


@pytest.mark.parametrize("step_s", [0.11, 0.9])
def test_the_first_path_goes_through_running_medians(step_s: float) -> None:
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.uniform(0.5, 1.5, 80)) * step_s
    en = np.array([60.0, 20.0]) + np.cumsum(rng.normal(0.0, 1.0, (80, 2)), axis=0)
    en[40] += 500.0
    start = RobustStart.of(time, en, window_s=2.0, at_least=5)
    ahead = en.mean(axis=0) / np.linalg.norm(en.mean(axis=0))
    turn = np.array([ahead, [-ahead[1], ahead[0]]])
    few = 0
    for at, got in zip(start.time_s, start.en_m, strict=True):
        middle = int(np.flatnonzero(time == at)[0])
        near = np.flatnonzero((time >= at - 1.0) & (time < at + 1.0))
        if near.size < 5:
            near = np.arange(max(middle - 2, 0), min(middle + 3, 80))
            few += 1
        np.testing.assert_allclose(got, np.median(en[near] @ turn.T, axis=0) @ turn, atol=1e-9)
    assert (few > 20) == (step_s > 0.5)
    # Some seven in a window, each at a measurement.
    assert np.unique(np.floor(start.time_s / 0.3)).size == start.time_s.size
    assert start.time_s.size == np.unique(np.floor(time / 0.3)).size
    between = 0.25 * start.time_s[4] + 0.75 * start.time_s[5]
    expected = 0.25 * start.en_m[4] + 0.75 * start.en_m[5]
    np.testing.assert_allclose(start.position_at(np.array([between]))[0], expected)


def test_medians_are_of_a_sample_where_a_window_holds_many() -> None:
    """2 000 in a window, in rising order: the median of any even sample is near the middle."""
    time = np.linspace(0.0, 4.0, 4000)
    en = np.stack([np.zeros(4000), 50.0 + time], axis=1)
    start = RobustStart.of(time, en, window_s=2.0)
    inner = (start.time_s > 1.0) & (start.time_s < 3.0)
    np.testing.assert_allclose(
        start.en_m[inner], np.stack([0.0 * start.time_s, 50.0 + start.time_s], 1)[inner], atol=0.05
    )


def test_noise_grows_with_the_range_to_the_power_that_is_stated() -> None:
    """Along as the square of the range, across as the range: a camera above a plane."""
    rng = np.random.default_rng(4)
    n = 40
    range_m, bearing = np.geomspace(30.0, 300.0, n), rng.uniform(-1.0, 1.0, n)
    ahead = np.stack([np.sin(bearing), np.cos(bearing)], axis=1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    along, across = 2e-4 * range_m**2, 3e-3 * range_m
    covariance = (
        along[:, None, None] ** 2 * ahead[:, :, None] * ahead[:, None, :]
        + across[:, None, None] ** 2 * left[:, :, None] * left[:, None, :]
    )
    noise = NoiseAtRange.of(measured_at(np.arange(float(n)), range_m[:, None] * ahead, covariance))
    assert noise.powers is not None
    np.testing.assert_allclose(noise.powers, [2.0, 1.0], rtol=1e-6)
    there = np.array([[0.0, 100.0], [60.0, 80.0], [-200.0, 0.0]])
    common = noise.common_covariance(there, 0.5, 0.2)
    for place, got in zip(there, common, strict=True):
        far = np.linalg.norm(place)
        axes = np.array([place, [-place[1], place[0]]]) / far
        variances = np.diag([0.5 * (2e-4 * far**2) ** 2, 0.2 * (3e-3 * far) ** 2])
        np.testing.assert_allclose(got, axes.T @ variances @ axes, rtol=1e-6, atol=1e-12)
    assert not noise.common_covariance(there, 0.0, 0.0).any()
    # One of both alone is enough.
    alone = noise.common_covariance(there[:1], 0.0, 0.2)[0]
    np.testing.assert_allclose(alone, np.diag([0.2 * 0.3**2, 0.0]), rtol=1e-6, atol=1e-12)


def test_what_is_stated_alike_everywhere_has_no_power() -> None:
    rng = np.random.default_rng(5)
    place = rng.uniform(50.0, 90.0, (10, 2))
    stated = np.array([[4.0, 1.5], [1.5, 2.0]])
    noise = NoiseAtRange.of(measured_at(np.arange(10.0), place, stated))
    assert noise.powers is None
    common = noise.common_covariance(np.array([[30.0, 40.0]]), 1.0, 1.0)
    np.testing.assert_allclose(common[0], stated)
