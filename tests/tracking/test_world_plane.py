"""The earth as a measurement model, against an extended Kalman filter that is written out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sightline.geodesy import LocalPlane
from sightline.platform import Platform
from sightline.tracking import WorldTrackerSettings
from sightline.tracking.world import WorldPlane
from sightline.types import Boxes, Fixes, FloatArray, Headings, Positions

PLANE = LocalPlane(54.0, 10.0)
SETTINGS = WorldTrackerSettings(
    acceleration_m2ps3=0.6, speed_mps=3.0, correlation_time_s=0.8, earth_gate=3.0, loose_gate=4.5
)
BOX = [300.0, 200.0, 330.0, 220.0]


def boxes_of(n: int, time_utc_s: float = 0.0) -> Boxes:
    """All alike, numbered by their frame."""
    return Boxes.of([BOX] * n, time_utc_s=time_utc_s, frame=np.arange(n))


def placed_at(
    en_m: FloatArray, covariance_m2: FloatArray, shared_m2: float = 0.0
) -> Callable[[Boxes], Positions]:
    """A model that finds the box of frame k at place k; nowhere where that is not finite."""

    def locate(boxes: Boxes) -> Positions:
        k = boxes.frame
        return Positions(
            east_m=en_m[k, 0],
            north_m=en_m[k, 1],
            covariance_m2=covariance_m2[k],
            extrapolated=np.zeros(k.size, dtype=bool),
            plane=PLANE,
            shared_covariance_m2=np.tile(shared_m2 * np.eye(2), (k.size, 1, 1)),
        )

    return locate


def some_places(rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray]:
    """On all sides of the camera, with covariances that are neither round nor upright."""
    bearing, range_m = rng.uniform(-np.pi, np.pi, n), rng.uniform(30.0, 80.0, n)
    root = rng.normal(0.0, 2.0, (n, 2, 2))
    en = np.stack([range_m * np.sin(bearing), range_m * np.cos(bearing)], axis=1)
    return en, root @ root.transpose(0, 2, 1) + np.eye(2)


def sight_of(en_m: FloatArray) -> FloatArray:
    """Bearing from north and inverse range."""
    return np.array([np.arctan2(en_m[0], en_m[1]), 1.0 / np.linalg.norm(en_m)])


def slope_of(en_m: FloatArray) -> FloatArray:
    """Derivatives of the sight, by differences."""
    step = 1e-4
    columns = []
    for axis in np.eye(2):
        apart = sight_of(en_m + step * axis) - sight_of(en_m - step * axis)
        columns.append(apart / (2.0 * step))
    return np.stack(columns, axis=1)


def difference(one: FloatArray, other: FloatArray) -> FloatArray:
    off = one - other
    return np.array([np.angle(np.exp(1j * off[0])), off[1]])


@pytest.mark.parametrize("on_board", [False, True])
def test_what_is_measured_is_bearing_and_inverse_range_from_the_camera(on_board: bool) -> None:
    rng = np.random.default_rng(0)
    en, covariance = some_places(rng, 12)
    eye = np.array([12.0, -7.0]) if on_board else np.zeros(2)
    seconds = np.array([-1.0, 0.0, 1.0])
    there = np.tile(PLANE.to_geographic(eye[:1], eye[1:]), (1, 3))
    platform = Platform(Fixes(seconds, *there), Headings(seconds, np.zeros(3)))
    plane = WorldPlane(
        placed_at(en, covariance, shared_m2=0.5), SETTINGS, platform if on_board else None
    )
    measured = plane.measure(boxes_of(12))
    for k in range(12):
        # A twentieth of what the places have in common stays.
        own = covariance[k] - 0.95 * 0.5 * np.eye(2)
        slope = slope_of(en[k] - eye)
        np.testing.assert_allclose(measured["line_of_sight"][k], sight_of(en[k] - eye), rtol=1e-6)
        np.testing.assert_allclose(measured["noise"][k], slope @ own @ slope.T, rtol=1e-5)
    assert (measured["placed"] == 1.0).all()


def test_what_has_no_place_or_no_covariance_is_not_placed() -> None:
    en, covariance = some_places(np.random.default_rng(1), 4)
    en[1, 0] = covariance[2, 0, 1] = covariance[2, 1, 0] = np.nan
    covariance[3] *= np.inf
    measured = WorldPlane(placed_at(en, covariance), SETTINGS).measure(boxes_of(4))
    assert measured["placed"].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert all(
        np.isfinite(measured[name]).all() for name in ("line_of_sight", "noise", "en", "own")
    )


def test_what_is_beside_the_camera_is_not_nearer_than_a_metre() -> None:
    en = np.array([[0.3, 0.4], [0.0, 0.0], [0.6, -0.8]])
    measured = WorldPlane(placed_at(en, np.tile(np.eye(2), (3, 1, 1))), SETTINGS).measure(
        boxes_of(3)
    )
    np.testing.assert_allclose(measured["line_of_sight"][:, 1], 1.0)
    assert np.isfinite(measured["noise"]).all()


def transition(lag_s: float) -> FloatArray:
    """Of east, north and their velocities."""
    return np.block([[np.eye(2), lag_s * np.eye(2)], [np.zeros((2, 2)), np.eye(2)]])


def accumulated(lag_s: float) -> FloatArray:
    """What white acceleration adds, by quadrature (exact for polynomials)."""
    density = np.diag([0.0, 0.0, SETTINGS.acceleration_m2ps3, SETTINGS.acceleration_m2ps3])
    nodes, weights = np.polynomial.legendre.leggauss(4)
    parts = [
        0.5 * lag_s * w * transition(s) @ density @ transition(s).T
        for s, w in zip(0.5 * lag_s * (nodes + 1.0), weights, strict=True)
    ]
    return np.sum(parts, axis=0)


def test_targets_are_followed_by_the_textbooks_extended_kalman_filter() -> None:
    rng = np.random.default_rng(2)
    n = 6
    en, covariance = some_places(rng, 4 * n)
    # Beside each other over the moments, the first of them about the south, where bearings wrap.
    en = np.tile(en[:n], (4, 1)) + rng.normal(0.0, 1.5, (4 * n, 2))
    en[::n] = [[-0.4, -60.0], [0.5, -61.0], [-0.6, -60.0], [0.7, -59.0]]
    plane = WorldPlane(placed_at(en, covariance), SETTINGS)
    measured = plane.measure(boxes_of(4 * n))
    state = plane.start(measured[:n])
    mean = [np.array([*en[k], 0.0, 0.0]) for k in range(n)]
    doubt = [np.zeros((4, 4)) for _ in range(n)]
    for k in range(n):
        doubt[k][:2, :2] = covariance[k]
        doubt[k][2:, 2:] = SETTINGS.speed_mps**2 * np.eye(2)
    for moment, lag_s in ((1, 0.1), (2, 1.2), (3, 2.5)):
        plane.predict(state, lag_s)
        plane.update(state, np.full(n, lag_s), measured[moment * n : (moment + 1) * n])
        # So many boxes within what lasts (to either side) count as one.
        repeated = max(1.0, 2.0 * SETTINGS.correlation_time_s / lag_s)
        for k in range(n):
            f, row = transition(lag_s), moment * n + k
            at, p = f @ mean[k], f @ doubt[k] @ f.T + accumulated(lag_s)
            h = np.hstack([slope_of(at[:2]), np.zeros((2, 2))])
            slope = slope_of(en[row])
            r = repeated * slope @ covariance[row] @ slope.T
            gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
            left = np.eye(4) - gain @ h
            mean[k] = at + gain @ difference(sight_of(en[row]), sight_of(at[:2]))
            doubt[k] = left @ p @ left.T + gain @ r @ gain.T
            np.testing.assert_allclose(state["place"][k], mean[k], rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(state["doubt"][k], doubt[k], rtol=1e-4, atol=1e-5)


def test_of_several_each_is_corrected_by_its_own_box_or_begins_with_it() -> None:
    """One with a place and a placed box, one whose box has none, one new, one with neither."""
    en, covariance = some_places(np.random.default_rng(3), 8)
    en[4:] = en[:4] + 1.0
    en[[2, 3, 5, 7]] = np.nan
    plane = WorldPlane(placed_at(en, covariance), SETTINGS)
    measured = plane.measure(boxes_of(8))
    state = plane.start(measured[:4])
    plane.predict(state, 2.0)
    before, alone = state.copy(), state[:1].copy()
    plane.update(state, np.full(4, 2.0), measured[4:])
    plane.update(alone, np.full(1, 2.0), measured[4:5])
    assert state["placed"].tolist() == [1.0, 1.0, 1.0, 0.0]
    np.testing.assert_allclose(state["place"][0], alone["place"][0])
    assert (state["place"][0] != before["place"][0]).all()
    np.testing.assert_array_equal(state["place"][1], before["place"][1])
    np.testing.assert_array_equal(state["doubt"][1], before["doubt"][1])
    np.testing.assert_allclose(state["place"][2], [*en[6], 0.0, 0.0])
    np.testing.assert_allclose(state["doubt"][2][:2, :2], covariance[6])


def test_pairs_and_their_costs_are_those_of_all_pairs_looked_at_one_by_one() -> None:
    rng = np.random.default_rng(4)
    n = 24
    en, covariance = some_places(rng, 2 * n)
    en[:, 1] = np.abs(en[:, 1])
    # Within a few standard deviations of a target each; some have no place.
    en[n:] = en[:n] + rng.normal(0.0, 9.0, (n, 2))
    en[[3, n + 5]] = np.nan
    plane = WorldPlane(placed_at(en, covariance), SETTINGS)
    measured = plane.measure(boxes_of(2 * n))
    state = plane.start(measured[:n])
    silent_s = np.where(np.arange(n) % 2, SETTINGS.image_s, SETTINGS.image_s + 0.1)
    i, j, cost = plane.candidates(state, silent_s, measured[n:])
    found = dict(zip(zip(i.tolist(), j.tolist(), strict=True), cost.tolist(), strict=True))
    expected = {}
    only_loose = far = 0
    for target in range(n):
        for box in range(n):
            # All boxes are one in the image, where the distance is zero and all is shared.
            if np.isnan(en[target, 0]) or np.isnan(en[n + box, 0]):
                expected[target, box] = 1.0
                continue
            to, at = slope_of(en[target]), slope_of(en[n + box])
            off = difference(sight_of(en[n + box]), sight_of(en[target]))
            spread = to @ covariance[target] @ to.T + at @ covariance[n + box] @ at.T
            distance = np.sqrt(off @ np.linalg.solve(spread, off))
            loose = bool(target % 2)
            if distance <= (SETTINGS.loose_gate if loose else SETTINGS.earth_gate):
                expected[target, box] = min(distance / SETTINGS.earth_gate, 3.0)
                only_loose += distance > SETTINGS.earth_gate
            else:
                far += 1
    assert found == pytest.approx(expected, rel=1e-5, abs=1e-6)
    assert min(only_loose, far) >= 5


def test_what_is_just_within_a_gate_on_the_earth_is_possible() -> None:
    en, covariance = some_places(np.random.default_rng(5), 1)
    exactly = WorldTrackerSettings(loose_gate=0.0, stitch_gate=0.0)
    plane = WorldPlane(placed_at(en, covariance), exactly)
    measured = plane.measure(boxes_of(1))
    i, _, _ = plane.candidates(plane.start(measured), np.zeros(1), measured)
    assert i.tolist() == [0]
    i, _, _ = plane.continuations(plane.start(measured), np.zeros(1), plane.start(measured))
    assert i.tolist() == [0]


def test_far_beyond_the_gate_the_earth_costs_no_more() -> None:
    en = np.array([[0.0, 50.0], [40.0, 50.0]])
    settings = WorldTrackerSettings(earth_gate=1.0, loose_gate=1000.0)
    plane = WorldPlane(placed_at(en, np.tile(np.eye(2), (2, 1, 1))), settings)
    measured = plane.measure(boxes_of(2))
    _, _, cost = plane.candidates(plane.start(measured[:1]), np.zeros(1), measured)
    np.testing.assert_allclose(cost, [0.0, 3.0])


def test_lost_targets_go_on_as_new_ones_of_like_place_velocity_and_size() -> None:
    rng = np.random.default_rng(6)
    n = 20
    en, covariance = some_places(rng, 2 * n)
    en[n:] = en[:n] + rng.normal(0.0, 6.0, (n, 2))
    en[[2, n + 7]] = np.nan
    plane = WorldPlane(placed_at(en, covariance), SETTINGS)
    measured = plane.measure(boxes_of(2 * n))
    ended, begun = plane.start(measured[:n]), plane.start(measured[n:])
    for state in (ended, begun):
        state["place"][:, 2:] = rng.normal(0.0, 6.0, (n, 2))
        root = rng.normal(0.0, 1.0, (n, 4, 4))
        state["doubt"] += root @ root.transpose(0, 2, 1)
        state["log_size"] += rng.choice([0.0, 0.3, 0.5], (n, 2))
    # Logarithms of sizes that differ by 1 in all are still alike.
    ended["log_size"][0], begun["log_size"][0] = [1.0, 2.0], [1.5, 1.5]
    begun["place"][0] = ended["place"][0]
    expected = {}
    for i in range(n):
        for j in range(n):
            off = begun["place"][j] - ended["place"][i]
            spread = ended["doubt"][i] + begun["doubt"][j]
            distance = np.sqrt(off @ np.linalg.inv(spread) @ off)
            unlike = np.abs(ended["log_size"][i] - begun["log_size"][j]).sum()
            placed = np.isfinite(en[i, 0]) and np.isfinite(en[n + j, 0])
            if placed and distance <= SETTINGS.stitch_gate and unlike <= 1.0:
                expected[i, j] = distance + unlike
    i, j, cost = plane.continuations(ended, np.zeros(n), begun)
    found = dict(zip(zip(i.tolist(), j.tolist(), strict=True), cost.tolist(), strict=True))
    assert found == pytest.approx(expected)
    assert (0, 0) in found
    assert n / 2 < len(found) < n * n / 2
