"""How much is lost by not waiting: what is published at once beside what is known later.

Of a target whose velocity is a random walk and whose place is measured with white noise, the
variance of the place is four times as large at once (Kalman and Bucy) as it is when all that
follows is known: the stationary solutions are sqrt(2) q^(1/4) r^(3/4) and a quarter of that. So its
error is twice as large, whatever the noise. What errors have in common brings the two closer.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from sightline.live.filter import USUAL_NOISE, TargetFilter

TARGETS, RATE_HZ = 300, 5.0
SIGMA_M = np.array([2.0, 6.0])


def test_nobody_does_better_at_once_than_twice_the_error() -> None:
    q, r = 0.3, 4.0
    drift = np.array([[0.0, 1.0], [0.0, 0.0]])
    measured = np.array([[1.0, 0.0]])
    # The stationary covariance of the filter, and of the smoother from both directions.
    ahead = solve_continuous_are(drift.T, measured.T, np.diag([0.0, q]), np.array([[r]]))
    back = ahead * np.array([[1.0, -1.0], [-1.0, 1.0]])
    both = np.linalg.inv(np.linalg.inv(ahead) + np.linalg.inv(back))
    assert ahead[0, 0] == pytest.approx(np.sqrt(2.0) * q**0.25 * r**0.75)
    assert np.sqrt(ahead[0, 0] / both[0, 0]) == pytest.approx(2.0)


def _system(step_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Along one axis: place, speed and the error that lasts, and how they are measured."""
    noise, kept = USUAL_NOISE, np.exp(-step_s / USUAL_NOISE.correlation_time_s)
    move = np.array([[1.0, step_s, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, kept]])
    added = np.zeros((3, 3))
    added[:2, :2] = noise.acceleration_m2ps3 * np.array(
        [[step_s**3 / 3.0, step_s**2 / 2.0], [step_s**2 / 2.0, step_s]]
    )
    added[2, 2] = 1.0 - kept**2
    seen = np.array([[1.0, 0.0, noise.correlated_along]])
    return move, added, seen, np.array([[noise.white_along**2]])


def test_ellipses_hold_what_they_say_and_errors_are_the_least_that_can_be() -> None:
    """Of targets that move as the filter takes them to; far away, where the earth is flat."""
    rng = np.random.default_rng(3)
    step_s, looks = 1.0 / RATE_HZ, 200
    move, added, seen, white = _system(step_s)
    # East and north of each: place and speed; errors are in standard deviations.
    place = np.tile([0.0, 2000.0], (TARGETS, 1))
    speed = rng.standard_normal((TARGETS, 2))
    lasting = rng.standard_normal((TARGETS, 2))
    root = np.linalg.cholesky(added[:2, :2])
    found, ids = TargetFilter(), np.arange(TARGETS)
    own = np.tile(np.diag(SIGMA_M**2), (TARGETS, 1, 1))
    nothing = np.zeros((TARGETS, 2, 2))
    squared, held = [], []
    for k in range(looks):
        walk = rng.standard_normal((TARGETS, 2, 2)) @ root.T
        place, speed = place + step_s * speed + walk[:, :, 0], speed + walk[:, :, 1]
        fresh = np.sqrt(added[2, 2]) * rng.standard_normal((TARGETS, 2))
        lasting = move[2, 2] * lasting + fresh
        error = USUAL_NOISE.correlated_along * lasting
        error = error + USUAL_NOISE.white_along * rng.standard_normal((TARGETS, 2))
        found.predict(step_s * k)
        found.update(ids, place + SIGMA_M * error, own, nothing)
        if k < looks // 2:
            continue
        mean, covariance = found.moments()
        off = mean[:, :2] - place
        solved = np.linalg.solve(covariance[:, :2, :2], off[:, :, None])[:, :, 0]
        held.append((np.einsum("ni,ni->n", off, solved) < 5.991).mean())
        squared.append((off**2).mean(axis=0))
    assert np.mean(held) == pytest.approx(0.95, abs=0.01)
    # The least: Riccati's equation, iterated for a coordinate of each standard deviation.
    for axis, sigma_m in enumerate(SIGMA_M):
        p = np.diag([sigma_m**2, 1.0, 1.0])
        measured = seen * [1.0, 0.0, sigma_m]
        for _ in range(2000):
            p = move @ p @ move.T + added
            gain = p @ measured.T / (measured @ p @ measured.T + sigma_m**2 * white)
            p = p - gain @ measured @ p
        assert np.sqrt(np.mean(squared, axis=0)[axis] / p[0, 0]) == pytest.approx(1.0, abs=0.03)
