"""The image as a measurement model, against a Kalman filter and pairs that are written out."""

from __future__ import annotations

import numpy as np
import pytest

from sightline.tracking.image import ImagePlane, ImageTrackerSettings
from sightline.tracking.plane import Columns, white_acceleration
from sightline.types import Boxes, FloatArray

SETTINGS = ImageTrackerSettings(
    gate=3.0,
    least_overlap=0.25,
    position_noise=0.13,
    size_noise=0.3,
    acceleration=0.7,
    growth=0.4,
)
H = np.eye(6)[[0, 2, 4, 5]]


def transition(lag_s: float) -> FloatArray:
    """Of x, its velocity, y, its velocity, and the logarithms of width and height."""
    out = np.eye(6)
    out[0, 1] = out[2, 3] = lag_s
    return out


def accumulated(lag_s: float, area: float) -> FloatArray:
    """What white acceleration and growth add, by quadrature (exact for polynomials)."""
    density = np.zeros((6, 6))
    density[1, 1] = density[3, 3] = SETTINGS.acceleration**2 * area
    density[4, 4] = density[5, 5] = SETTINGS.growth**2
    nodes, weights = np.polynomial.legendre.leggauss(4)
    parts = [
        0.5 * lag_s * w * transition(s) @ density @ transition(s).T
        for s, w in zip(0.5 * lag_s * (nodes + 1.0), weights, strict=True)
    ]
    return np.sum(parts, axis=0)


def noise_of_box(area: float) -> FloatArray:
    at, of_size = SETTINGS.position_noise**2 * area, SETTINGS.size_noise**2
    return np.diag([at, at, of_size, of_size])


def seen(xyxy: FloatArray) -> FloatArray:
    """Centre across and down, logarithms of width and height."""
    x0, y0, x1, y1 = xyxy
    return np.array([(x0 + x1) / 2, (y0 + y1) / 2, np.log(x1 - x0), np.log(y1 - y0)])


def some_boxes(rng: np.random.Generator, n: int, spread_px: float = 20.0) -> FloatArray:
    low = rng.uniform(0.0, spread_px, (n, 2))
    return np.concatenate([low, low + rng.uniform(4.0, 30.0, (n, 2))], axis=1)


def of(state: Columns, row: int) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of a row, as one vector and one matrix."""
    one = state[row]
    (x, y), (vx, vy) = one["centre"], one["velocity"]
    covariance = np.zeros((6, 6))
    covariance[:2, :2] = covariance[2:4, 2:4] = one["motion"]
    covariance[4, 4] = covariance[5, 5] = one["shape_variance"]
    return np.array([x, vx, y, vy, *one["log_size"]]), covariance


def test_targets_are_followed_by_the_textbooks_kalman_filter() -> None:
    rng = np.random.default_rng(0)
    plane = ImagePlane(SETTINGS)
    first = some_boxes(rng, 3)
    state = plane.start(plane.measure(Boxes.of(first)))
    known = []
    for box in first:
        x, y, log_width, log_height = seen(box)
        area = np.exp(log_width + log_height)
        at, of_size = SETTINGS.position_noise**2 * area, SETTINGS.size_noise**2
        # A new target moves by its own size in a second, one way or the other.
        known.append(
            (
                np.array([x, 0.0, y, 0.0, log_width, log_height]),
                np.diag([at, area, at, area, of_size, of_size]),
            )
        )
    for lag_s in (0.3, 1.7, 0.05):
        plane.predict(state, lag_s)
        for k, (mean, covariance) in enumerate(known):
            f, q = transition(lag_s), accumulated(lag_s, np.exp(mean[4] + mean[5]))
            known[k] = f @ mean, f @ covariance @ f.T + q
            np.testing.assert_allclose(of(state, k)[0], known[k][0], rtol=1e-12)
            np.testing.assert_allclose(of(state, k)[1], known[k][1], rtol=1e-12, atol=1e-12)
        boxes = some_boxes(rng, 3)
        plane.update(state, np.full(3, lag_s), plane.measure(Boxes.of(boxes)))
        for k, (mean, covariance) in enumerate(known):
            r = noise_of_box(np.exp(mean[4] + mean[5]))
            gain = covariance @ H.T @ np.linalg.inv(H @ covariance @ H.T + r)
            # Joseph's form, which holds for any gain.
            left = np.eye(6) - gain @ H
            known[k] = (
                mean + gain @ (seen(boxes[k]) - H @ mean),
                left @ covariance @ left.T + gain @ r @ gain.T,
            )
            np.testing.assert_allclose(of(state, k)[0], known[k][0], rtol=1e-10)
            np.testing.assert_allclose(of(state, k)[1], known[k][1], rtol=1e-10, atol=1e-10)


def test_white_acceleration_is_the_same_in_one_step_as_in_two() -> None:
    (f_a, q_a), (f_b, q_b), (f, q) = (white_acceleration(lag_s) for lag_s in (0.3, 1.9, 2.2))
    np.testing.assert_allclose(f_b @ f_a, f)
    np.testing.assert_allclose(f_b @ q_a @ f_b.T + q_b, q)
    # Velocity wanders like Brownian motion of density 1.
    assert q[1, 1] == 2.2


def overlap_of(one: FloatArray, other: FloatArray) -> float:
    across = min(one[2], other[2]) - max(one[0], other[0])
    down = min(one[3], other[3]) - max(one[1], other[1])
    shared = max(across, 0.0) * max(down, 0.0)
    both = sum((box[2] - box[0]) * (box[3] - box[1]) for box in (one, other))
    return shared / (both - shared)


def test_pairs_and_their_costs_are_those_of_all_pairs_looked_at_one_by_one() -> None:
    rng = np.random.default_rng(1)
    plane = ImagePlane(SETTINGS)
    by_gate = by_overlap = of_another_size = 0
    for _ in range(80):
        targets, boxes = some_boxes(rng, 8, 60.0), some_boxes(rng, 9, 60.0)
        state = plane.start(plane.measure(Boxes.of(targets)))
        state["motion"][:, 0, 0] *= rng.uniform(0.0, 3.0, 8)
        state["centre"] += rng.uniform(-5.0, 5.0, (8, 2))
        expected = {}
        for i in range(8):
            x, y = state["centre"][i]
            width, height = np.exp(state["log_size"][i])
            own = np.array([x - width / 2, y - height / 2, x + width / 2, y + height / 2])
            variance = state["motion"][i, 0, 0] + noise_of_box(width * height)[0, 0]
            for j in range(9):
                off = seen(boxes[j])[:2] - [x, y]
                distance = np.sqrt(off @ off / variance)
                unlike = np.abs(seen(boxes[j])[2:] - np.log([width, height])).sum()
                overlap = overlap_of(own, boxes[j])
                if unlike >= np.log(9.0):
                    of_another_size += distance <= SETTINGS.gate
                elif distance <= SETTINGS.gate or overlap >= SETTINGS.least_overlap:
                    by_gate += overlap < SETTINGS.least_overlap
                    by_overlap += distance > SETTINGS.gate
                    cost = distance / SETTINGS.gate + (1.0 - overlap) + unlike / 2.0
                    expected[i, j] = cost
        i, j, cost = plane.candidates(state, np.zeros(8), plane.measure(Boxes.of(boxes)))
        found = dict(zip(zip(i.tolist(), j.tolist(), strict=True), cost.tolist(), strict=True))
        assert found == pytest.approx(expected)
    assert min(by_gate, by_overlap, of_another_size) > 10


UNIT = (10.0, 10.0, 11.0, 11.0)


@pytest.mark.parametrize(
    ("box", "settings", "possible"),
    [
        # Two sizes off, four times the standard deviation of half a size.
        ((12.0, 10.0, 13.0, 11.0), {"gate": 4.0}, True),
        ((10.0, 8.0, 11.0, 9.0), {"gate": 4.0}, True),
        ((12.0, 10.0, 13.0, 11.0), {"gate": 3.9}, False),
        # A quarter of what either covers.
        ((9.0, 9.0, 11.0, 11.0), {"gate": 0.5, "least_overlap": 0.25}, True),
        ((9.0, 9.0, 11.0, 11.0), {"gate": 0.5, "least_overlap": 0.26}, False),
        # Three times as large.
        ((9.0, 9.0, 12.0, 12.0), {"gate": 4.0}, False),
        ((9.0, 9.0, 11.99, 12.0), {"gate": 4.0}, True),
    ],
)
def test_what_is_just_possible_is_as_the_settings_say(
    box: tuple[float, ...], settings: dict[str, float], possible: bool
) -> None:
    plane = ImagePlane(ImageTrackerSettings(position_noise=0.5, **settings))
    state = plane.start(plane.measure(Boxes.of([UNIT])))
    state["motion"] = 0.0
    i, _, _ = plane.candidates(state, np.zeros(1), plane.measure(Boxes.of([box])))
    assert bool(i.size) == possible


def test_no_boxes_and_no_targets_make_no_pairs() -> None:
    plane = ImagePlane(SETTINGS)
    none, one = (plane.measure(Boxes.of(boxes)) for boxes in ([], [UNIT]))
    for state, measured in ((none, one), (one, none), (none, none)):
        i, j, cost = plane.candidates(plane.start(state), np.zeros(len(state)), measured)
        assert i.size == j.size == cost.size == 0
    assert all(part.size == 0 for part in plane.continuations(one, np.zeros(1), one))
