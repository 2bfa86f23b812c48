"""The chain against the same linear model, solved as one dense system."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from sightline.trajectory import gauss_markov_chain as chain
from sightline.types import FloatArray


def _nodes(seed: int, n: int) -> chain.Nodes:
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.0, 2.0 * np.pi, n)
    axes = np.stack([np.sin(angle), np.cos(angle), -np.cos(angle), np.sin(angle)], axis=1)
    root = np.tril(rng.uniform(-1.0, 1.0, (n, 2, 2)))
    root[:, (0, 1), (0, 1)] = rng.uniform(0.5, 3.0, (n, 2))
    return chain.Nodes(
        time_s=np.cumsum(rng.uniform(0.3, 2.0, n)),
        measured_m=rng.normal(0.0, 20.0, (n, 2)),
        axes=axes.reshape(n, 2, 2),
        root_m=root,
        count=rng.integers(1, 6, n).astype(float),
        process_noise_scale=rng.uniform(0.1, 5.0, n + 1),
    )


def _parameters(**changes: Any) -> chain.Parameters:
    return replace(
        chain.Parameters(
            q_m2ps3=0.3,
            correlation_time_s=0.9,
            white=(0.6, 0.8),
            correlated=(0.5, 0.3),
            speed_mps=10.0,
        ),
        **changes,
    )


def _white_root(nodes: chain.Nodes, p: chain.Parameters, k: int) -> FloatArray:
    return np.diag(p.white) @ nodes.root_m[k] / np.sqrt(nodes.count[k])


def _batch(
    nodes: chain.Nodes, p: chain.Parameters, extra_s: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Least squares over all states at once: one row a measurement, a step, a prior."""
    times = np.sort(np.concatenate([nodes.time_s, extra_s]))
    size = times.size
    tau = p.correlation_time_s
    rows, values = [], []

    def add(blocks: dict[int, FloatArray], value: FloatArray, root: FloatArray) -> None:
        row = np.zeros((root.shape[0], 6 * size))
        for state, block in blocks.items():
            row[:, 6 * state : 6 * state + 6] = block
        rows.append(np.linalg.solve(root, row))
        values.append(np.linalg.solve(root, value))

    prior_sd = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0]) / np.sqrt(chain.POSITION_PRECISION)
    prior_sd += np.array([0.0, 0.0, p.speed_mps, p.speed_mps, 1.0, 1.0])
    add({0: np.eye(6)}, np.zeros(6), np.diag(prior_sd))
    for k in range(size - 1):
        dt = times[k + 1] - times[k]
        step = np.eye(6)
        step[0, 2] = step[1, 3] = dt
        step[4, 4] = step[5, 5] = np.exp(-dt / tau)
        noise = np.zeros((6, 6))
        part = np.searchsorted(nodes.time_s, 0.5 * (times[k] + times[k + 1]))
        q = p.q_m2ps3 * nodes.process_noise_scale[part]
        for i in (0, 1):
            noise[i, i], noise[i + 2, i + 2] = q * dt**3 / 3.0, q * dt
            noise[i, i + 2] = noise[i + 2, i] = q * dt**2 / 2.0
            noise[i + 4, i + 4] = 1.0 - np.exp(-2.0 * dt / tau)
        add({k: -step, k + 1: np.eye(6)}, np.zeros(6), np.linalg.cholesky(noise))
    for k, time in enumerate(nodes.time_s):
        correlated = np.diag(p.correlated) @ nodes.root_m[k]
        sees = np.hstack([nodes.axes[k], np.zeros((2, 2)), correlated])
        add(
            {int(np.searchsorted(times, time)): sees},
            nodes.measured_m[k],
            _white_root(nodes, p, k),
        )
    matrix, target = np.vstack(rows), np.concatenate(values)
    # By QR and not by the normal equations, which would square the condition number.
    orthogonal, triangle = np.linalg.qr(matrix)
    mean = np.linalg.solve(triangle, orthogonal.T @ target)
    inverse = np.linalg.inv(triangle)
    return times, mean.reshape(size, 6), (inverse @ inverse.T).reshape(size, 6, size, 6)


@pytest.mark.parametrize("n", [1, 2, 3, 12])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_smoother_equals_batch_least_squares(seed: int, n: int) -> None:
    nodes, p = _nodes(seed, n), _parameters()
    _, mean, covariance = _batch(nodes, p, np.empty(0))
    posterior = chain.smooth(nodes, p)
    np.testing.assert_allclose(posterior.mean, mean[:, :4], rtol=1e-8, atol=1e-8)
    own = np.stack([covariance[k, :4, k, :4] for k in range(n)])
    np.testing.assert_allclose(posterior.covariance, own, rtol=1e-8, atol=1e-8)
    for k in range(n - 1):
        np.testing.assert_allclose(
            posterior.cross[k], covariance[k, :4, k + 1, :4], rtol=1e-8, atol=1e-8
        )


def test_any_time_equals_a_state_without_a_measurement() -> None:
    nodes, p = _nodes(3, 8), _parameters()
    span = nodes.time_s[-1] - nodes.time_s[0]
    extra = np.sort(nodes.time_s[0] + span * np.array([0.03, 0.21, 0.22, 0.5, 0.77, 1.4]))
    times, mean, covariance = _batch(nodes, p, extra)
    at, spread = chain.smooth(nodes, p).at(extra)
    for i, k in enumerate(np.searchsorted(times, extra)):
        np.testing.assert_allclose(at[i], mean[k, :4], rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(spread[i], covariance[k, :4, k, :4], rtol=1e-8, atol=1e-8)


def test_before_the_first_node_the_velocity_holds() -> None:
    posterior = chain.smooth(_nodes(4, 6), _parameters())
    early = posterior.time_s[:1] - 5.0
    mean, covariance = posterior.at(early)
    first = posterior.mean[0]
    np.testing.assert_allclose(mean[0, :2], first[:2] - 5.0 * first[2:])
    np.testing.assert_allclose(mean[0, 2:], first[2:])
    assert np.linalg.eigvalsh(covariance[0]).min() > 0.0
    assert (np.diag(covariance[0]) > np.diag(posterior.covariance[0])).all()


@given(share=st.lists(st.floats(-0.3, 1.3), min_size=1, max_size=20))
@settings(max_examples=40, deadline=None)
def test_position_alone_is_that_of_the_state(share: list[float]) -> None:
    posterior = chain.smooth(_nodes(5, 7), _parameters())
    times = posterior.time_s[0] + np.array(share) * np.ptp(posterior.time_s)
    np.testing.assert_allclose(
        posterior.position_at(times), posterior.at(times)[0][:, :2], rtol=1e-9, atol=1e-9
    )


def _log_density(nodes: chain.Nodes, p: chain.Parameters) -> float:
    """Of all measurements as one normal vector, from the covariance function of the motion."""
    n = nodes.time_s.size
    since = nodes.time_s - nodes.time_s[0]
    early, late = np.minimum.outer(since, since), np.maximum.outer(since, since)
    q, tau = p.q_m2ps3, p.correlation_time_s
    motion = q * (early**2 * late / 2.0 - early**3 / 6.0)
    motion += p.speed_mps**2 * np.outer(since, since) + 1.0 / chain.POSITION_PRECISION
    total = np.zeros((2 * n, 2 * n))
    for a in range(n):
        for b in range(n):
            kept = np.exp(-abs(since[a] - since[b]) / tau)
            roots = [np.diag(p.correlated) @ nodes.root_m[k] for k in (a, b)]
            block = motion[a, b] * nodes.axes[a] @ nodes.axes[b].T + kept * roots[0] @ roots[1].T
            total[2 * a : 2 * a + 2, 2 * b : 2 * b + 2] = block
        root = _white_root(nodes, p, a)
        total[2 * a : 2 * a + 2, 2 * a : 2 * a + 2] += root @ root.T
    return float(multivariate_normal(np.zeros(2 * n), total).logpdf(nodes.measured_m.ravel()))


def test_likelihood_ratios_are_those_of_the_normal_density(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The dense covariance cannot hold a position of 1e6 m beside metres in double precision.
    monkeypatch.setattr(chain, "POSITION_PRECISION", 1e-4)
    nodes = replace(_nodes(6, 10), process_noise_scale=np.ones(11))
    variants = [
        _parameters(),
        _parameters(q_m2ps3=2.0),
        _parameters(correlation_time_s=3.0),
        _parameters(white=(1.4, 0.2)),
        _parameters(correlated=(0.1, 2.0)),
    ]
    expected = np.array([-2.0 * _log_density(nodes, p) for p in variants])
    got = np.array([chain.minus_two_log_likelihood(nodes, p)[0] for p in variants])
    np.testing.assert_allclose(got - got[0], expected - expected[0], rtol=1e-8, atol=1e-7)


@pytest.mark.parametrize("n", [1, 2, 15])
@pytest.mark.parametrize("q_m2ps3", [0.02, 0.3, 5.0])
def test_gradient_of_the_likelihood_is_its_slope(q_m2ps3: float, n: int) -> None:
    nodes = _nodes(8, n)
    logs = np.log([q_m2ps3, 0.9, 0.6, 0.8, 0.5, 0.3])

    def value(at: FloatArray) -> tuple[float, FloatArray]:
        q, tau, *shares = np.exp(at).tolist()
        p = _parameters(q_m2ps3=q, correlation_time_s=tau, white=shares[:2], correlated=shares[2:])
        return chain.minus_two_log_likelihood(nodes, p)

    step = 1e-4 * np.eye(6)
    slope = [(value(logs + one)[0] - value(logs - one)[0]) / 2e-4 for one in step]
    np.testing.assert_allclose(value(logs)[1], slope, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("q_m2ps3", [0.02, 0.3, 5.0])
def test_energy_and_draws_are_the_slope_of_the_likelihood(q_m2ps3: float) -> None:
    """By Fisher's identity: d(-2 log L) / d log q is the draws less the energy over q."""
    nodes = replace(_nodes(7, 15), process_noise_scale=np.ones(16))
    step = 1e-4
    up, down = (
        chain.minus_two_log_likelihood(nodes, _parameters(q_m2ps3=q_m2ps3 * np.exp(sign * step)))[0]
        for sign in (1.0, -1.0)
    )
    energy, draws = chain.smooth(nodes, _parameters(q_m2ps3=q_m2ps3)).acceleration_energy()
    assert ((draws > 0.0) & (draws < 4.0)).all()
    slope = draws.sum() - energy.sum() / q_m2ps3
    assert slope == pytest.approx((up - down) / (2.0 * step), abs=1e-4)


def test_before_the_first_node_place_and_velocity_are_wrong_in_opposite_ways() -> None:
    """Backwards in time a velocity that was higher puts the place further back: by draws."""
    posterior = chain.smooth(_nodes(4, 6), _parameters())
    lag_s, steps = 5.0, 2000
    _, covariance = posterior.at(posterior.time_s[:1] - lag_s)
    # The velocity wanders in small steps back from the first node, and the place follows it.
    left_s = lag_s * (1.0 - (np.arange(steps) + 0.5) / steps)
    by_step = np.stack([-left_s, np.ones(steps)])
    wandered = posterior.q_m2ps3[0] * lag_s / steps * by_step @ by_step.T
    back = np.kron([[1.0, -lag_s], [0.0, 1.0]], np.eye(2))
    expected = back @ posterior.covariance[0] @ back.T + np.kron(wandered, np.eye(2))
    np.testing.assert_allclose(covariance[0], expected, rtol=1e-5, atol=1e-9)
