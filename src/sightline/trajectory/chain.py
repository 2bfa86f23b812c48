r"""The Gaussian chain behind the smoother: its posterior, its likelihood, its value at any time.

A target moves with nearly constant velocity, driven by white acceleration of spectral density
``q`` (Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to Tracking and Navigation*,
2001, section 6.2.2). Beside the target's state stand two numbers for the part of the measurement
noise that lasts: Ornstein-Uhlenbeck processes of unit variance and time constant ``tau``. A node
of the chain is ``(east, north, velocity east, velocity north, o_1, o_2)``.

The posterior of a linear Gaussian chain has a block tridiagonal precision matrix. Its banded
Cholesky factor is the filter, the solution of the system is the Rauch-Tung-Striebel smoother's
mean, and the factors from either end give its covariances: with the forward Schur complements
:math:`S_k`, the backward ones :math:`T_k` and the diagonal blocks :math:`A_k`, the marginal
precision is :math:`S_k + T_k - A_k` (the two-filter form). The results are those of the recursion,
in compiled code.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpbtrf, dpbtrs

from sightline.types import FloatArray

STATE = 6
BAND = 9
_SEEN = (0, 1, 4, 5)
POSITION_PRECISION = 1e-12
"""Of the first node's position, per square metre: nothing is known of it before measurements."""


@dataclass(frozen=True, eq=False)
class Nodes:
    """Linear measurements of the chain, one a node.

    Attributes:
        time_s: (N,) float64, strictly increasing.
        measured_m: (N, 2) float64, the measured position in the axes of the node.
        axes: (N, 2, 2) float64, the rows are the axes (along the line of sight, across it) as
            east and north components.
        root_m: (N, 2, 2) float64, lower Cholesky factor of one measurement's stated covariance
            in those axes.
        count: (N,) float64, how many measurements the node is the mean of.
        agility: (N + 1,) float64, by how much the spectral density of the acceleration differs
            from the usual one: before the first node, between nodes, after the last.
    """

    time_s: FloatArray
    measured_m: FloatArray
    axes: FloatArray
    root_m: FloatArray
    count: FloatArray
    agility: FloatArray


@dataclass(frozen=True, eq=False)
class Parameters:
    """What drives the chain; every field may be an array of a leading shape K, for K chains.

    Attributes:
        q_m2ps3: Spectral density of the acceleration.
        tau_s: Time constant of the lasting noise.
        white: (K, 2) share of the stated standard deviation that is white, along and across.
        lasting: (K, 2) share that lasts.
        speed_mps: Standard deviation of each component of the velocity before measurements.
    """

    q_m2ps3: FloatArray
    tau_s: FloatArray
    white: FloatArray
    lasting: FloatArray
    speed_mps: float


@dataclass(frozen=True, eq=False)
class Posterior:
    """The smoothed chain.

    Attributes:
        time_s: (N,) float64.
        mean: (N, 4) float64, position and velocity.
        covariance: (N, 4, 4) float64.
        cross: (N - 1, 4, 4) float64, covariance of a node with the next.
        q_m2ps3: (N + 1,) float64, spectral density of the acceleration before the first node,
            between nodes, after the last.
    """

    time_s: FloatArray
    mean: FloatArray
    covariance: FloatArray
    cross: FloatArray
    q_m2ps3: FloatArray

    def at(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (M, 4) and covariance (M, 4, 4) of position and velocity at any times (M,).

        Between two nodes the state given both is Gaussian with the bridge of the motion model,
        whose mean is the cubic Hermite polynomial; beyond the ends the velocity stays as it is
        and the uncertainty grows.
        """
        last = self.time_s.size - 1
        right = np.searchsorted(self.time_s, time_s)
        outside = (right == 0) | (right > last)
        mean = np.empty((time_s.size, 4))
        covariance = np.empty((time_s.size, 4, 4))

        end = np.where(right[outside] == 0, 0, last)
        lag = time_s[outside] - self.time_s[end]
        step = _on_both_axes(_transition(lag))
        mean[outside] = np.einsum("mij,mj->mi", step, self.mean[end])
        covariance[outside] = step @ self.covariance[end] @ _transposed(step)
        covariance[outside] += (
            _on_both_axes(_diffusion(lag)) * self.q_m2ps3[right[outside], None, None]
        )

        b = right[~outside]
        a = b - 1
        hold, pull, bridge = _bridge(
            time_s[~outside] - self.time_s[a], self.time_s[b] - time_s[~outside]
        )
        hold, pull = _on_both_axes(hold), _on_both_axes(pull)
        mean[~outside] = np.einsum("mij,mj->mi", hold, self.mean[a])
        mean[~outside] += np.einsum("mij,mj->mi", pull, self.mean[b])
        mixed = hold @ self.cross[a] @ _transposed(pull)
        covariance[~outside] = (
            hold @ self.covariance[a] @ _transposed(hold)
            + pull @ self.covariance[b] @ _transposed(pull)
            + mixed
            + _transposed(mixed)
            + _on_both_axes(bridge) * self.q_m2ps3[b, None, None]
        )
        return mean, 0.5 * (covariance + _transposed(covariance))

    def position_at(self, time_s: FloatArray) -> FloatArray:
        """Mean position (M, 2) at any times (M,), as `at` has it."""
        inner = np.clip(time_s, self.time_s[0], self.time_s[-1])
        position = self.mean[:, :2]
        if self.time_s.size > 1:
            b = np.clip(np.searchsorted(self.time_s, inner), 1, self.time_s.size - 1)
            gap = (self.time_s[b] - self.time_s[b - 1])[:, None]
            s = (inner - self.time_s[b - 1])[:, None] / gap
            start, stop = self.mean[b - 1], self.mean[b]
            placed = (
                (1.0 + 2.0 * s) * (1.0 - s) ** 2 * start[:, :2]
                + s * (1.0 - s) ** 2 * gap * start[:, 2:]
                + s**2 * (3.0 - 2.0 * s) * stop[:, :2]
                - s**2 * (1.0 - s) * gap * stop[:, 2:]
            )
        else:
            placed = np.repeat(position, time_s.size, axis=0)
        velocity = np.where((time_s < self.time_s[0])[:, None], self.mean[0, 2:], self.mean[-1, 2:])
        out: FloatArray = placed + (time_s - inner)[:, None] * velocity
        return out

    def acceleration_energy(self) -> tuple[FloatArray, FloatArray]:
        """How hard the target accelerated between nodes, and how many draws that was seen from.

        Returns:
            Two (N - 1,) arrays: the sum of squares of the smoothed changes, in units of a spectral
            density of 1 m²/s³, and the number of them (at most 4) that the measurements determine.
            Over any stretch the first over the second is the density that fits it best (MacKay,
            *Neural Computation* 4(3), 1992, for the widths of other priors).
        """
        lag = np.diff(self.time_s)
        step = _on_both_axes(_transition(lag))
        change = self.mean[1:] - np.einsum("nij,nj->ni", step, self.mean[:-1])
        mixed = step @ self.cross
        doubt = self.covariance[1:] + step @ self.covariance[:-1] @ _transposed(step)
        doubt -= mixed + _transposed(mixed)
        unit = _on_both_axes(_inverse_diffusion(lag))
        energy = np.einsum("ni,nij,nj->n", change, unit, change)
        left = np.einsum("nij,nji->n", unit, doubt) / self.q_m2ps3[1:-1]
        return energy, np.clip(4.0 - left, 0.0, 4.0)


def _transposed(matrices: FloatArray) -> FloatArray:
    return np.swapaxes(matrices, -1, -2)


def _on_both_axes(matrices: FloatArray) -> FloatArray:
    """(M, 2, 2) of position and velocity along one axis, for both axes: (M, 4, 4)."""
    out = np.zeros((matrices.shape[0], 4, 4))
    for axis in (0, 1):
        out[:, axis::2, axis::2] = matrices
    return out


def _two_by_two(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
    return np.stack([a, b, c, d], axis=-1).reshape(-1, 2, 2)


def _transition(lag_s: FloatArray) -> FloatArray:
    one, zero = np.ones_like(lag_s), np.zeros_like(lag_s)
    return _two_by_two(one, lag_s, zero, one)


def _diffusion(lag_s: FloatArray) -> FloatArray:
    """Of the state after a lag, forwards or backwards in time, for a spectral density of 1."""
    span = np.abs(lag_s)
    crossed = lag_s * span / 2.0
    return _two_by_two(span**3 / 3.0, crossed, crossed, span)


def _inverse_diffusion(lag_s: FloatArray) -> FloatArray:
    crossed = -6.0 / lag_s**2
    return _two_by_two(12.0 / lag_s**3, crossed, crossed, 4.0 / lag_s)


def _bridge(first_s: FloatArray, second_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The state between two known ones: weights (M, 2, 2) of either, and what stays unknown.

    Args:
        first_s: (M,) seconds since the one before.
        second_s: (M,) seconds until the one after.
    """
    gap = first_s + second_s
    early = _diffusion(first_s)
    later = _transition(second_s)
    pull = early @ _transposed(later) @ _inverse_diffusion(gap)
    hold = _transition(first_s) - pull @ _transition(gap)
    return hold, pull, early - pull @ later @ early


@dataclass(frozen=True, eq=False)
class _System:
    """Precision, right-hand side and constants of K chains of N nodes each.

    Attributes:
        band: (K, N, 6, 9) lower diagonals: ``band[k, n, j, d]`` is the entry ``d`` below the
            diagonal in the column of component j of node n.
        right: (K, N, 6).
        minus_two_log: (K,) the terms of -2 log likelihood that do not need the solution.
        whitened: (2, K, N) measurements in units of their white noise.
        design: (2, 6, K, N) what they measure of a node, in the same units.
    """

    band: FloatArray
    right: FloatArray
    minus_two_log: FloatArray
    whitened: FloatArray
    design: FloatArray


def _system(nodes: Nodes, parameters: Parameters) -> _System:
    q = np.atleast_1d(parameters.q_m2ps3)[:, None] * nodes.agility[None, 1:-1]
    tau = np.atleast_1d(parameters.tau_s)[:, None]
    white = np.atleast_2d(parameters.white)
    lasting = np.atleast_2d(parameters.lasting)
    k, n = tau.shape[0], nodes.time_s.size
    band = np.zeros((k, n, STATE, BAND))
    minus_two_log = np.zeros(k)

    lag = np.diff(nodes.time_s)[None, :]
    a, b, c = 12.0 / (q * lag**3), 6.0 / (q * lag**2), 2.0 / (q * lag)
    for i in (0, 1):
        band[:, :-1, i, 0] += a
        band[:, :-1, i, 2] += b
        band[:, :-1, i + 2, 0] += 2.0 * c
        band[:, :-1, i, 6] -= a
        band[:, :-1, i, 8] += b
        band[:, :-1, i + 2, 4] -= b
        band[:, :-1, i + 2, 6] += c
        band[:, 1:, i, 0] += a
        band[:, 1:, i, 2] -= b
        band[:, 1:, i + 2, 0] += 2.0 * c
        band[:, 0, i, 0] += POSITION_PRECISION
        band[:, 0, i + 2, 0] += parameters.speed_mps**-2.0
    minus_two_log -= 2.0 * np.log(12.0 / (q**2 * lag**4)).sum(axis=1)

    kept = np.exp(-lag / tau)
    fresh = -1.0 / np.expm1(-2.0 * lag / tau)
    for i in (4, 5):
        band[:, :-1, i, 0] += kept**2 * fresh
        band[:, :-1, i, 6] -= kept * fresh
        band[:, 1:, i, 0] += fresh
        band[:, 0, i, 0] += 1.0
    minus_two_log -= 2.0 * np.log(fresh).sum(axis=1)

    # One row a measurement, in units of its white noise: written out by component, since stacks
    # of 2 x 2 products would take most of the time.
    l11, l21, l22 = nodes.root_m[:, 0, 0], nodes.root_m[:, 1, 0], nodes.root_m[:, 1, 1]
    size = np.sqrt(nodes.count)
    first = (size / l11) / white[:, :1]
    mixed = (-size * l21 / (l11 * l22)) / white[:, :1]
    second = (size / l22) / white[:, 1:]
    minus_two_log -= 2.0 * np.log(first * second).sum(axis=1)
    share = lasting / white
    axes, measured = nodes.axes, nodes.measured_m
    design = np.zeros((2, STATE, k, n))
    for i in (0, 1):
        design[0, i] = first * axes[:, 0, i]
        design[1, i] = mixed * axes[:, 0, i] + second * axes[:, 1, i]
    design[0, 4] = size * share[:, :1]
    design[1, 4] = (size * l21 / l22) * (share[:, 1:] - share[:, :1])
    design[1, 5] = size * share[:, 1:]
    whitened = np.stack([first * measured[:, 0], mixed * measured[:, 0] + second * measured[:, 1]])

    right = np.zeros((k, n, STATE))
    for j in _SEEN:
        right[..., j] = design[0, j] * whitened[0] + design[1, j] * whitened[1]
        for i in _SEEN:
            if i >= j:
                band[..., j, i - j] += design[0, i] * design[0, j] + design[1, i] * design[1, j]
    return _System(band, right, minus_two_log, whitened, design)


def _factor(band: FloatArray) -> FloatArray:
    """The banded Cholesky factor of a (..., 6, 9) stack of columns."""
    factor, info = dpbtrf(band.reshape(-1, BAND).T, lower=1)
    if info != 0:
        raise np.linalg.LinAlgError(f"precision matrix is not positive definite at row {info}")
    columns: FloatArray = factor.T.reshape(band.shape)
    return columns


def minus_two_log_likelihood(nodes: Nodes, parameters: Parameters) -> FloatArray:
    """-2 log likelihood of the measurements under K sets of parameters, up to one constant.

    Args:
        nodes: N measurements, their positions about the origin of the measured ones.
        parameters: Fields of leading shape K.

    Returns:
        (K,) float64.
    """
    system = _system(nodes, parameters)
    factor = _factor(system.band)
    solution, _ = dpbtrs(factor.reshape(-1, BAND).T, system.right.reshape(-1), lower=1)
    solution = solution.reshape(system.right.shape)
    fit = np.zeros(factor.shape[0])
    for row, whitened in zip(system.design, system.whitened, strict=True):
        rest = whitened - sum(row[j] * solution[..., j] for j in _SEEN)
        fit += (rest * whitened).sum(axis=1)
    determinant = 2.0 * np.log(factor[..., 0]).sum(axis=(1, 2))
    out: FloatArray = system.minus_two_log + determinant + fit
    return out


def smooth(nodes: Nodes, parameters: Parameters) -> Posterior:
    """The posterior of position and velocity at the nodes, for one set of parameters."""
    system = _system(nodes, parameters)
    band = system.band[0]
    n = band.shape[0]
    forward = _factor(band)
    solution, _ = dpbtrs(forward.reshape(-1, BAND).T, system.right.reshape(-1), lower=1)
    flat = band.reshape(-1, BAND)
    size = flat.shape[0]
    # Row j, diagonal d of the reversed matrix is row size - 1 - j - d, diagonal d of this one.
    source = size - 1 - np.arange(size)[:, None] - np.arange(BAND)[None, :]
    reversed_band = np.where(
        source >= 0, flat[np.maximum(source, 0), np.arange(BAND)[None, :]], 0.0
    )
    backward = _factor(reversed_band.reshape(band.shape))
    schur = _gram(_lower_blocks(forward))
    schur_back = _gram(_lower_blocks(backward))[::-1, ::-1, ::-1]
    lower = _lower_blocks(band)
    diagonal = lower + _transposed(np.tril(lower, -1))
    covariance = np.asarray(np.linalg.inv(schur + schur_back - diagonal), dtype=np.float64)
    cross = np.empty((n - 1, STATE, STATE))
    if n > 1:
        cross = -np.linalg.solve(schur[:-1], _coupling(band)) @ covariance[1:]
    return Posterior(
        time_s=nodes.time_s,
        mean=solution.reshape(n, STATE)[:, :4],
        covariance=covariance[:, :4, :4],
        cross=cross[:, :4, :4],
        q_m2ps3=np.atleast_1d(parameters.q_m2ps3)[0] * nodes.agility,
    )


def _lower_blocks(band: FloatArray) -> FloatArray:
    out = np.zeros((band.shape[0], STATE, STATE))
    for j in range(STATE):
        out[:, j:, j] = band[:, j, : STATE - j]
    return out


def _gram(lower: FloatArray) -> FloatArray:
    return lower @ _transposed(lower)


def _coupling(band: FloatArray) -> FloatArray:
    """(N - 1, 6, 6) blocks of the precision between a node (rows) and the next (columns)."""
    out = np.zeros((band.shape[0] - 1, STATE, STATE))
    for j in range(STATE):
        reached = min(STATE, j + BAND - STATE)
        out[:, j, :reached] = band[:-1, j, STATE - j : STATE - j + reached]
    return out
