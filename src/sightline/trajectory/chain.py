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
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dpbtrf, dpbtrs

from sightline.types import FloatArray, IntArray

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
        if not outside.any():
            return self._between(time_s, right)
        mean = np.empty((time_s.size, 4))
        covariance = np.empty((time_s.size, 4, 4))
        mean[~outside], covariance[~outside] = self._between(time_s[~outside], right[~outside])
        end = np.where(right[outside] == 0, 0, last)
        lag = time_s[outside] - self.time_s[end]
        step = _on_both_axes(_transition(lag))
        mean[outside] = np.einsum("mij,mj->mi", step, self.mean[end])
        covariance[outside] = step @ self.covariance[end] @ _transposed(step)
        covariance[outside] += (
            _on_both_axes(_diffusion(lag)) * self.q_m2ps3[right[outside], None, None]
        )
        covariance[outside] += _transposed(covariance[outside])
        covariance[outside] *= 0.5
        return mean, covariance

    def _between(self, time_s: FloatArray, right: IntArray) -> tuple[FloatArray, FloatArray]:
        """As `at`, for times between nodes ``right - 1`` and ``right``."""
        before, q = right - 1, self.q_m2ps3[right]
        weights, bridge = _bridge(time_s - self.time_s[before], self.time_s[right] - time_s)
        # By node before or after, position or velocity there, and axis.
        joint_mean = self._columns[0][:, before].reshape(4, 2, -1)
        joint = self._columns[1][:, before].reshape(4, 2, 4, 2, -1)
        mean = np.empty((4, time_s.size))
        covariance = np.empty((4, 4, time_s.size))
        for i, row in enumerate(weights):
            mean[2 * i : 2 * i + 2] = _weighted(row, joint_mean)
            half = _weighted(row, joint)
            for j in range(i + 1):
                block = _weighted(weights[j], half.swapaxes(0, 1))
                for axis in (0, 1):
                    block[axis, axis] += bridge[i + j] * q
                block[0, 1] = block[1, 0] if i == j else block[0, 1]
                covariance[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = block
        covariance[:2, 2:] = covariance[2:, :2].swapaxes(0, 1)
        return mean.T, covariance.transpose(2, 0, 1)

    @cached_property
    def _columns(self) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance of two neighbouring nodes together, (8, N - 1) and (64, N - 1)."""
        mean = self.mean.T
        joint_mean = np.concatenate([mean[:, :-1], mean[:, 1:]])
        joint = np.empty((8, 8, self.time_s.size - 1))
        own, cross = self.covariance.transpose(1, 2, 0), self.cross.transpose(1, 2, 0)
        joint[:4, :4], joint[4:, 4:] = own[:, :, :-1], own[:, :, 1:]
        joint[:4, 4:], joint[4:, :4] = cross, cross.swapaxes(0, 1)
        return joint_mean, joint.reshape(64, -1)

    def position_at(self, time_s: FloatArray) -> FloatArray:
        """Mean position (M, 2) at any times (M,), as `at` has it."""
        if self.time_s.size == 1:
            return self.mean[:, :2] + (time_s - self.time_s)[:, None] * self.mean[:, 2:]
        right = np.clip(np.searchsorted(self.time_s, time_s), 1, self.time_s.size - 1)
        gap = (self.time_s[1:] - self.time_s[:-1])[right - 1]
        s = (time_s - self.time_s[right - 1]) / gap
        inner = np.minimum(np.maximum(s, 0.0), 1.0)
        beyond = (s - inner) * gap
        rest = 1.0 - inner
        later = inner * inner * (3.0 - 2.0 * inner)
        early = inner * rest * rest * gap + np.minimum(beyond, 0.0)
        late = np.maximum(beyond, 0.0) - inner * inner * rest * gap
        start, stop = self.mean.T[:, right - 1], self.mean.T[:, right]
        out: FloatArray = start[:2] + later * (stop[:2] - start[:2])
        out += early * start[2:] + late * stop[2:]
        return out.T

    def acceleration_energy(self) -> tuple[FloatArray, FloatArray]:
        """How hard the target accelerated between nodes, and how many draws that was seen from.

        Returns:
            Two (N - 1,) arrays: the sum of squares of the smoothed changes, in units of a spectral
            density of 1 m²/s³, and the number of them (at most 4) that the measurements determine.
            Over any stretch the first over the second is the density that fits it best (MacKay,
            *Neural Computation* 4(3), 1992, for the widths of other priors).
        """
        lag = np.diff(self.time_s)
        mean = self.mean.T
        own, cross = self.covariance.transpose(1, 2, 0), self.cross.transpose(1, 2, 0)
        before, after = own[:, :, :-1], own[:, :, 1:]
        energy, left = np.zeros(lag.size), np.zeros(lag.size)
        unit = np.stack([12.0 / lag**3, -12.0 / lag**2, 4.0 / lag])
        for p, v in ((0, 2), (1, 3)):
            moved = mean[p, 1:] - mean[p, :-1] - lag * mean[v, :-1]
            faster = mean[v, 1:] - mean[v, :-1]
            energy += unit[0] * moved**2 + unit[1] * moved * faster + unit[2] * faster**2
            # Covariance of the node before, moved on, with the change: by position and velocity.
            moved_p = cross[p, p] + lag * cross[v, p] - before[p, p] - 2.0 * lag * before[p, v]
            moved_p -= lag**2 * before[v, v]
            moved_v = cross[p, v] + lag * cross[v, v] - before[p, v] - lag * before[v, v]
            faster_p = cross[v, p] - before[v, p] - lag * before[v, v]
            faster_v = cross[v, v] - before[v, v]
            stepped = before[p, p] + 2.0 * lag * before[p, v] + lag**2 * before[v, v]
            left += unit[0] * (after[p, p] - stepped - 2.0 * moved_p)
            mixed = after[p, v] - before[p, v] - lag * before[v, v] - moved_v - faster_p
            left += unit[1] * mixed
            left += unit[2] * (after[v, v] - before[v, v] - 2.0 * faster_v)
        return energy, np.minimum(np.maximum(4.0 - left / self.q_m2ps3[1:-1], 0.0), 4.0)


def _transposed(matrices: FloatArray) -> FloatArray:
    return np.swapaxes(matrices, -1, -2)


def _weighted(weights: FloatArray, columns: FloatArray) -> FloatArray:
    """Sum of columns (4, ..., M) with weights (4, M)."""
    out: FloatArray = weights[0] * columns[0]
    for weight, column in zip(weights[1:], columns[1:], strict=True):
        out += weight * column
    return out


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


def _bridge(first_s: FloatArray, second_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The state between two known ones: how it depends on them, and what stays unknown.

    Args:
        first_s: (M,) seconds since the one before.
        second_s: (M,) seconds until the one after.

    Returns:
        Weights (2, 4, M) with which position and velocity are made of position and velocity
        before and after (the cubic Hermite polynomials and their slopes); and (3, M) variance of
        the position, covariance, and variance of the velocity that remain, for a spectral density
        of 1.
    """
    gap = first_s + second_s
    s, r = first_s / gap, second_s / gap
    later = s * s * (3.0 - 2.0 * s)
    steep = 6.0 * s * r / gap
    weights = np.stack(
        [
            *(1.0 - later, r * r * first_s, later, -s * s * second_s),
            *(-steep, r * (1.0 - 3.0 * s), steep, s * (1.0 - 3.0 * r)),
        ]
    ).reshape(2, 4, -1)
    both = s * r
    remains = np.stack(
        [
            (both * gap) ** 2 * both * gap / 3.0,
            both * both * gap * (second_s - first_s) / 2.0,
            both * gap * (1.0 - 3.0 * both),
        ]
    )
    return weights, remains


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
    reversed_band = np.zeros_like(flat)
    for d in range(BAND):
        reversed_band[: size - d, d] = flat[: size - d, d][::-1]
    backward = _factor(reversed_band.reshape(band.shape))
    # From here on with the nodes last: loops over 6 x 6 entries, each over all nodes.
    lower, lower_back = (
        np.ascontiguousarray(factor.transpose(1, 2, 0)) for factor in (forward, backward)
    )
    precision = _gram(lower) + _gram(lower_back)[::-1, ::-1, ::-1]
    for j in range(STATE):
        own = band[:, j, : STATE - j].T
        precision[j:, j] -= own
        precision[j, j + 1 :] -= own[1:]
    covariance = _inverse(precision)[:, :4]
    covariance[:4] = 0.5 * (covariance[:4] + covariance[:4].swapaxes(0, 1))
    return Posterior(
        time_s=nodes.time_s,
        mean=np.ascontiguousarray(solution.reshape(n, STATE)[:, :4].T).T,
        covariance=covariance[:4].transpose(2, 0, 1),
        cross=_cross(lower, covariance).transpose(2, 0, 1),
        q_m2ps3=np.atleast_1d(parameters.q_m2ps3)[0] * nodes.agility,
    )


def _gram(lower: FloatArray) -> FloatArray:
    """(6, 6, N) products L Lᵀ of the diagonal blocks of a factor (6, 9, N)."""
    out = np.zeros((STATE, STATE, lower.shape[2]))
    for j in range(STATE):
        column = lower[j, : STATE - j]
        out[j:, j:] += column[:, None] * column
    return out


def _inverse(matrices: FloatArray) -> FloatArray:
    """(6, 6, N) of symmetric positive definite (6, 6, N), which it overwrites: Gauss and Jordan."""
    for p in range(STATE):
        row = matrices[p] / matrices[p, p]
        row[p] = 1.0 / matrices[p, p]
        column = matrices[:, p].copy()
        column[p] = 0.0
        matrices[:, p] = 0.0
        matrices -= column[:, None] * row
        matrices[p] = row
    return matrices


def _cross(lower: FloatArray, covariance: FloatArray) -> FloatArray:
    """(4, 4, N - 1) covariance of each node's position and velocity with those of the next.

    A node given the next has the mean ``-L⁻ᵀ Bᵀ x``, where L is its block of the factor, and B
    the one below it.

    Args:
        lower: (6, 9, N) columns of the factor.
        covariance: (6, 4, N) of all of a node with its position and velocity.
    """
    own, after = lower[:, :, :-1], covariance[:, :, 1:]
    # Row j of -Bᵀ times the covariance: B has entries down to two below its diagonal.
    out = np.zeros((STATE, 4, own.shape[2]))
    for j in range(STATE):
        for i in range(min(STATE, j + BAND - STATE)):
            out[j] -= own[j, STATE + i - j] * after[i]
    for j in reversed(range(STATE)):
        for i in range(j + 1, STATE):
            out[j] -= own[j, i - j] * out[i]
        out[j] /= own[j, 0]
    return out[:4]
