r"""Gauss-Markov chain of the smoother: posterior, likelihood and interpolation.

A target moves with nearly constant velocity, driven by white acceleration of spectral density
``q`` (Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to Tracking and Navigation*,
2001, section 6.2.2). Beside the target's state stand two numbers for the correlated measurement
noise: Ornstein-Uhlenbeck processes of unit variance and time constant ``tau``. A node
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
_CHUNK = 512
_SEEN = [0, 1, 4, 5]
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
        process_noise_scale: (N + 1,) float64, by how much the spectral density of the acceleration
            differs from the usual one: before the first node, between nodes, after the last.
    """

    time_s: FloatArray
    measured_m: FloatArray
    axes: FloatArray
    root_m: FloatArray
    count: FloatArray
    process_noise_scale: FloatArray


@dataclass(frozen=True, eq=False)
class Parameters:
    """Process noise and measurement noise of the chain.

    Attributes:
        q_m2ps3: Spectral density of the acceleration.
        correlation_time_s: Time constant of the correlated noise.
        white: Shares of the stated standard deviation that are white, along and across.
        correlated: Shares that are correlated.
        speed_mps: Standard deviation of each component of the velocity before measurements.
    """

    q_m2ps3: float
    correlation_time_s: float
    white: tuple[float, float]
    correlated: tuple[float, float]
    speed_mps: float


@dataclass(frozen=True, eq=False)
class Posterior:
    """Smoothed states of the chain.

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
        mean = np.empty((4, time_s.size))
        covariance = np.empty((4, 4, time_s.size))
        for start in range(0, time_s.size, _CHUNK):
            rows = slice(start, start + _CHUNK)
            self._fill(time_s[rows], mean[:, rows], covariance[:, :, rows])
        return mean.T, covariance.transpose(2, 0, 1)

    def _fill(self, time_s: FloatArray, mean: FloatArray, covariance: FloatArray) -> None:
        """As `at`, into (4, M) and (4, 4, M)."""
        last = self.time_s.size - 1
        right = np.searchsorted(self.time_s, time_s)
        inside = (right > 0) & (right <= last)
        if inside.all():
            self._between(time_s, right, mean, covariance)
            return
        part, spread = np.empty((4, inside.sum())), np.empty((4, 4, inside.sum()))
        self._between(time_s[inside], right[inside], part, spread)
        mean[:, inside], covariance[:, :, inside] = part, spread
        outside = ~inside
        end = np.where(right[outside] == 0, 0, last)
        lag = time_s[outside] - self.time_s[end]
        step = _on_both_axes(_transition(lag))
        spread = step @ self.covariance[end] @ _transposed(step)
        spread += _on_both_axes(_diffusion(lag)) * self.q_m2ps3[right[outside], None, None]
        mean[:, outside] = np.einsum("mij,mj->im", step, self.mean[end])
        covariance[:, :, outside] = 0.5 * (spread + _transposed(spread)).transpose(1, 2, 0)

    def _between(
        self, time_s: FloatArray, right: IntArray, mean: FloatArray, covariance: FloatArray
    ) -> None:
        """As `_fill`, for times between nodes ``right - 1`` and ``right``."""
        before, q = right - 1, self.q_m2ps3[right]
        weights, bridge = _bridge(time_s - self.time_s[before], self.time_s[right] - time_s)
        # By node before or after, position or velocity there, and axis.
        joint_mean = self._columns[0][:, before].reshape(4, 2, -1)
        joint = self._columns[1][:, before].reshape(4, 2, 4, 2, -1)
        for i, row in enumerate(weights):
            mean[2 * i : 2 * i + 2] = _weighted(row, joint_mean)
            half = _weighted(row, joint).swapaxes(0, 1)
            for j in range(i + 1):
                block = covariance[2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
                block[...] = _weighted(weights[j], half)
                for axis in (0, 1):
                    block[axis, axis] += bridge[i + j] * q
            block[0, 1] = block[1, 0]
        covariance[:2, 2:] = covariance[2:, :2].swapaxes(0, 1)

    @cached_property
    def _columns(self) -> tuple[FloatArray, FloatArray]:
        """Joint mean and covariance of neighbouring nodes, (8, N - 1) and (64, N - 1)."""
        mean = self.mean.T
        joint_mean = np.concatenate([mean[:, :-1], mean[:, 1:]])
        joint = np.empty((8, 8, self.time_s.size - 1))
        own, cross = self.covariance.transpose(1, 2, 0), self.cross.transpose(1, 2, 0)
        joint[:4, :4], joint[4:, 4:] = own[:, :, :-1], own[:, :, 1:]
        joint[:4, 4:], joint[4:, :4] = cross, cross.swapaxes(0, 1)
        return joint_mean, joint.reshape(64, -1)

    def position_at(self, time_s: FloatArray) -> FloatArray:
        """Mean position (M, 2) at any times (M,), as by `at`."""
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
        """Acceleration energy between nodes, and its effective number of draws.

        Returns:
            Two (N - 1,) arrays: the sum of squares of the smoothed changes, in units of a spectral
            density of 1 m²/s³, and the number of them (at most 4) that the measurements determine.
            Over any stretch the first over the second is the density that fits it best (MacKay,
            *Neural Computation* 4(3), 1992, for the widths of other priors).
        """
        own, cross = self.covariance.transpose(1, 2, 0), self.cross.transpose(1, 2, 0)
        energy, doubt = _energy(np.diff(self.time_s), self.mean.T, own, cross)
        left = doubt / self.q_m2ps3[1:-1]
        return energy, np.minimum(np.maximum(4.0 - left, 0.0), 4.0)


def _energy(
    lag_s: FloatArray, mean: FloatArray, own: FloatArray, cross: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Squared process noise between nodes, in units of a spectral density of 1 m²/s³.

    Args:
        lag_s: (N - 1,) between nodes.
        mean: (4 or more, N) of the nodes.
        own: (4 or more, 4 or more, N) covariance of each node.
        cross: (4 or more, 4 or more, N - 1) covariance of each node with the next.

    Returns:
        Two (N - 1,) arrays: of the mean change, and what its covariance adds to its expectation.
    """
    before, after = own[:, :, :-1], own[:, :, 1:]
    energy, doubt = np.zeros(lag_s.size), np.zeros(lag_s.size)
    pp, pv, vv = 12.0 / lag_s**3, -12.0 / lag_s**2, 4.0 / lag_s
    for p, v in ((0, 2), (1, 3)):
        moved = mean[p, 1:] - mean[p, :-1] - lag_s * mean[v, :-1]
        faster = mean[v, 1:] - mean[v, :-1]
        energy += pp * moved**2 + pv * moved * faster + vv * faster**2
        # Covariances of the node before, moved on to the time of the next, then with the next.
        old_vv = before[v, v]
        old_pv = before[p, v] + lag_s * old_vv
        old_pp = before[p, p] + lag_s * (before[p, v] + old_pv)
        both_pp = cross[p, p] + lag_s * cross[v, p]
        both_pv = cross[p, v] + lag_s * cross[v, v] + cross[v, p]
        doubt += pp * (after[p, p] + old_pp - 2.0 * both_pp)
        doubt += pv * (after[p, v] + old_pv - both_pv)
        doubt += vv * (after[v, v] + old_vv - 2.0 * cross[v, v])
    return energy, doubt


def _transposed(matrices: FloatArray) -> FloatArray:
    return np.swapaxes(matrices, -1, -2)


def _weighted(weights: FloatArray, columns: FloatArray) -> FloatArray:
    """Weighted sum of columns (4, ..., M) with weights (4, M)."""
    out: FloatArray = weights[0] * columns[0]
    for weight, column in zip(weights[1:], columns[1:], strict=True):
        out += weight * column
    return out


def _on_both_axes(matrices: FloatArray) -> FloatArray:
    """Extend (M, 2, 2) for position and velocity along one axis to both: (M, 4, 4)."""
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
    """Process noise after a lag, forwards or backwards in time, for a spectral density of 1."""
    span = np.abs(lag_s)
    crossed = lag_s * span / 2.0
    return _two_by_two(span**3 / 3.0, crossed, crossed, span)


def _bridge(first_s: FloatArray, second_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bridge between two known states: interpolation weights and residual covariance.

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
    """Precision matrix, right-hand side and constants of a chain of N nodes.

    Attributes:
        band: (6, 9, N) lower diagonals: ``band[j, d, n]`` is the entry ``d`` below the diagonal
            in the column of component j of node n.
        right: (6, N).
        minus_two_log: The terms of -2 log likelihood that do not need the solution.
        whitened: (2, N) measurements in units of their white noise.
        design: (2, 4, N) what they measure of a node's position and correlated noise, in these
            units.
    """

    band: FloatArray
    right: FloatArray
    minus_two_log: float
    whitened: FloatArray
    design: FloatArray


def _system(nodes: Nodes, parameters: Parameters) -> _System:
    q = parameters.q_m2ps3 * nodes.process_noise_scale[1:-1]
    n = nodes.time_s.size
    band = np.zeros((STATE, BAND, n))

    lag = np.diff(nodes.time_s)
    c = 2.0 / (q * lag)
    b = 3.0 * c / lag
    a = 2.0 * b / lag
    position, velocity = band[:2], band[2:4]
    position[:, 0, :-1] = a
    position[:, 0, 1:] += a
    position[:, 0, 0] += POSITION_PRECISION
    position[:, 2, :-1] = b
    position[:, 2, 1:] -= b
    velocity[:, 0, :-1] = 2.0 * c
    velocity[:, 0, 1:] += 2.0 * c
    velocity[:, 0, 0] += parameters.speed_mps**-2.0
    position[:, 6, :-1] = -a
    position[:, 8, :-1] = b
    velocity[:, 4, :-1] = -b
    velocity[:, 6, :-1] = c

    kept = np.exp(-lag / parameters.correlation_time_s)
    fresh = 1.0 / (1.0 - kept * kept)
    correlated = band[4:6]
    correlated[:, 0, :-1] = kept * kept * fresh
    correlated[:, 0, 1:] += fresh
    correlated[:, 0, 0] += 1.0
    correlated[:, 6, :-1] = -kept * fresh
    # Of the motion, 12 / (q² lag⁴) is 3 c² / lag².
    minus_two_log = -2.0 * float(np.log(3.0 * (c / lag) ** 2 * fresh).sum())

    # One row a measurement, in units of its white noise.
    (white, white_across), (share, share_across) = parameters.white, parameters.correlated
    l11, l21, l22 = nodes.root_m[:, 0, 0], nodes.root_m[:, 1, 0], nodes.root_m[:, 1, 1]
    size = np.sqrt(nodes.count)
    first, second = size / (l11 * white), size / (l22 * white_across)
    lean = l21 / l22
    mixed = -lean * first
    minus_two_log -= 2.0 * float(np.log(first * second).sum())
    axes, measured = nodes.axes, nodes.measured_m
    design = np.zeros((2, 4, n))
    for i in (0, 1):
        design[0, i] = first * axes[:, 0, i]
        design[1, i] = mixed * axes[:, 0, i] + second * axes[:, 1, i]
    design[0, 2] = size * (share / white)
    design[1, 2] = (size * lean) * (share_across / white_across - share / white)
    design[1, 3] = size * (share_across / white_across)
    whitened = np.stack([first * measured[:, 0], mixed * measured[:, 0] + second * measured[:, 1]])

    right = np.zeros((STATE, n))
    right[_SEEN] = design[0] * whitened[0] + design[1] * whitened[1]
    for place, j in enumerate(_SEEN):
        products = design[0, place:] * design[0, place] + design[1, place:] * design[1, place]
        for i, product in zip(_SEEN[place:], products, strict=True):
            band[j, i - j] += product
    return _System(band, right, minus_two_log, whitened, design)


def _factor(band: FloatArray) -> FloatArray:
    """Banded Cholesky factor of rows (6 N, 9), each a column of the matrix."""
    factor, info = dpbtrf(band.T, lower=1)
    if info != 0:
        raise np.linalg.LinAlgError(f"precision matrix is not positive definite at row {info}")
    return np.asarray(factor.T)


@dataclass(frozen=True, eq=False)
class _Solution:
    """Posterior of a chain, the nodes last.

    Attributes:
        mean: (6, N).
        covariance: (6, 6, N).
        cross: (6, 6, N - 1), of a node with the next.
        log_determinant: Of the precision matrix.
    """

    mean: FloatArray
    covariance: FloatArray
    cross: FloatArray
    log_determinant: float


def _solve(system: _System) -> _Solution:
    flat = np.ascontiguousarray(system.band.transpose(2, 0, 1)).reshape(-1, BAND)
    size = flat.shape[0]
    forward = _factor(flat)
    solution, _ = dpbtrs(forward.T, system.right.T.reshape(-1), lower=1)
    # Row j, diagonal d of the reversed matrix is row size - 1 - j - d, diagonal d of this one.
    reversed_flat = np.zeros_like(flat)
    for d in range(BAND):
        reversed_flat[: size - d, d] = flat[: size - d, d][::-1]
    backward = _factor(reversed_flat)
    columns, columns_back = (
        np.ascontiguousarray(factor.reshape(-1, STATE, BAND).transpose(1, 2, 0))
        for factor in (forward, backward)
    )
    lower, lower_back = _lower_blocks(columns), _lower_blocks(columns_back)
    precision = np.einsum("ikn,jkn->ijn", lower, lower)
    precision += np.einsum("ikn,jkn->ijn", lower_back, lower_back)[::-1, ::-1, ::-1]
    for j in range(STATE):
        own = system.band[j, : STATE - j]
        precision[j:, j] -= own
        precision[j, j + 1 :] -= own[1:]
    covariance = _inverse(precision)
    covariance = 0.5 * (covariance + covariance.swapaxes(0, 1))
    return _Solution(
        mean=np.ascontiguousarray(solution.reshape(-1, STATE).T),
        covariance=covariance,
        cross=_cross(lower, columns, covariance),
        log_determinant=2.0 * float(np.log(forward[:, 0]).sum()),
    )


def smooth(nodes: Nodes, parameters: Parameters) -> Posterior:
    """Posterior of position and velocity at the nodes."""
    solution = _solve(_system(nodes, parameters))
    return Posterior(
        time_s=nodes.time_s,
        mean=solution.mean[:4].T,
        covariance=solution.covariance[:4, :4].transpose(2, 0, 1),
        cross=solution.cross[:4, :4].transpose(2, 0, 1),
        q_m2ps3=parameters.q_m2ps3 * nodes.process_noise_scale,
    )


def minus_two_log_likelihood(nodes: Nodes, parameters: Parameters) -> tuple[float, FloatArray]:
    """-2 log likelihood of the measurements, up to a constant, and its gradient.

    By Fisher's identity the gradient is the expectation, over the smoothed chain, of the gradient
    of the joint density of chain and measurements (Cappé, Moulines and Rydén, *Inference in Hidden
    Markov Models*, 2005, section 10.1.3).

    Args:
        nodes: N measurements, their positions about the origin of the measured ones.
        parameters: Of the chain.

    Returns:
        The value, and (6,) its derivatives by the logarithms of ``q_m2ps3``,
        ``correlation_time_s``, ``white`` along and across, ``correlated`` along and across.
    """
    system = _system(nodes, parameters)
    solution = _solve(system)
    mean, own, cross = solution.mean, solution.covariance, solution.cross
    rest = system.whitened - (system.design * mean[_SEEN]).sum(axis=1)
    value = system.minus_two_log + solution.log_determinant + float((rest * system.whitened).sum())

    lag = np.diff(nodes.time_s)
    energy, doubt = _energy(lag, mean, own, cross)
    q = parameters.q_m2ps3 * nodes.process_noise_scale[1:-1]
    by_q = 4.0 * lag.size - ((energy + doubt) / q).sum()

    # Of the correlated noise: o' = kept o + sqrt(1 - kept²) draw, for both components at once.
    kept = np.exp(-lag / parameters.correlation_time_s)
    fresh = 1.0 / (1.0 - kept * kept)
    old, both, new = np.zeros((3, lag.size))
    for j in (4, 5):
        old += mean[j, :-1] ** 2 + own[j, j, :-1]
        both += mean[j, :-1] * mean[j, 1:] + cross[j, j]
        new += mean[j, 1:] ** 2 + own[j, j, 1:]
    drawn = fresh * (new - 2.0 * kept * both + kept * kept * old)
    by_kept = 2.0 * fresh * (kept * (drawn - 2.0) - (both - kept * old))
    by_correlation_time = (by_kept * kept * lag).sum() / parameters.correlation_time_s

    # Second moments of the white errors (in units of them), and with the correlated noise.
    seen = own[np.ix_(_SEEN, _SEEN)]
    pulled = (system.design[:, :, None] * seen).sum(axis=1)
    along2, across2 = rest * rest + (pulled * system.design).sum(axis=1)
    product = rest[0] * rest[1] + (pulled[0] * system.design[1]).sum(axis=0)
    (along_o1, _), (across_o1, across_o2) = rest[:, None] * mean[4:] - pulled[:, 2:]
    lean = nodes.root_m[:, 1, 0] / nodes.root_m[:, 1, 1]
    size = np.sqrt(nodes.count)
    n = nodes.time_s.size
    gradient = [
        by_q,
        by_correlation_time,
        2.0 * (n - (along2 - lean * product).sum()),
        2.0 * (n - (across2 + lean * product).sum()),
        -2.0
        * parameters.correlated[0]
        / parameters.white[0]
        * (size @ (along_o1 - lean * across_o1)),
        -2.0
        * parameters.correlated[1]
        / parameters.white[1]
        * (size @ (lean * across_o1 + across_o2)),
    ]
    return value, np.array(gradient)


def _lower_blocks(columns: FloatArray) -> FloatArray:
    """(6, 6, N) diagonal blocks of a banded factor, from its columns (6, 9, N)."""
    out = np.zeros((STATE, STATE, columns.shape[2]))
    for j in range(STATE):
        out[j:, j] = columns[j, : STATE - j]
    return out


def _inverse(matrices: FloatArray) -> FloatArray:
    """Invert (6, 6, N) symmetric positive definite matrices in place (Gauss-Jordan)."""
    for p in range(STATE):
        row = matrices[p] / matrices[p, p]
        row[p] = 1.0 / matrices[p, p]
        column = matrices[:, p].copy()
        column[p] = 0.0
        matrices[:, p] = 0.0
        matrices -= column[:, None] * row
        matrices[p] = row
    return matrices


def _cross(lower: FloatArray, columns: FloatArray, covariance: FloatArray) -> FloatArray:
    """(6, 6, N - 1) cross-covariance of each node with the next.

    A node given the next has the mean ``-L⁻ᵀ Bᵀ x``, where L is its block of the factor, and B
    the one below it.

    Args:
        lower: (6, 6, N) diagonal blocks of the factor.
        columns: (6, 9, N) its columns.
        covariance: (6, 6, N) of the nodes.
    """
    minus_below = np.zeros((STATE, STATE, columns.shape[2] - 1))
    for j in range(STATE):
        reached = min(STATE, j + BAND - STATE)
        minus_below[j, :reached] = -columns[j, STATE - j : STATE - j + reached, :-1]
    out = np.einsum("jin,ikn->jkn", minus_below, covariance[:, :, 1:])
    for j in reversed(range(STATE)):
        out[j] /= lower[j, j, :-1]
        out[:j] -= lower[j, :j, None, :-1] * out[j]
    return np.asarray(out)
