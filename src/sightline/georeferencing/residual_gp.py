"""Gaussian processes on the residual of a camera model, in bearing and log-range.

Errors of a single camera lie along the line of sight and grow with the square of the range, so
that the residual is learned in bearing and in the logarithm of the range. The box's apparent
height and width, in metres at the range that the camera found, are among the inputs: a box drawn
too small for its range is a box whose lower edge is too high.

Errors of one recording are alike (the same annotator on the same day, the same tide). A process
that took them for independent would learn them as if they came with the place; so each recording
has an offset of its own, and a new recording's unknown offset is part of the stated uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky, lapack, solve_triangular
from scipy.optimize import minimize

from sightline.camera.correlated_noise import CorrelatedError
from sightline.types import FloatArray, IntArray

MOST_POINTS = 2000
"""Exact inference is fine to about this many points; more are thinned evenly."""

_MOST_FOR_LEARNING = 300
_FEWEST_FOLDS = 4
# So that a block of the kernel stays in the cache.
_KERNEL_SIZE = 131072
_BLOCK = 64
# Of the logarithm of a length scale, before any data.
_LENGTH_SPREAD = 0.5
# So many times that shorter than expected is no smooth process any more.
_ROUGH = 3.0
# By how much the variance of a new recording's offset is raised at most for want of recordings.
_MOST_WIDENED = 3.0
# Share of the process's variance that predictions may miss of what the training points explain.
_LOST = 1e-4


@dataclass(frozen=True)
class Hyperparameters:
    """Hyperparameters of one Gaussian process, all positive.

    Attributes:
        amplitude: Standard deviation of the smooth part.
        length_scales: One an input.
        recording: Standard deviation of a recording's own offset.
        noise: What the stated noise of each point is to be multiplied with.
    """

    amplitude: float
    length_scales: tuple[float, ...]
    recording: float
    noise: float

    def to_log(self) -> FloatArray:
        """(3 + D,) logarithms: amplitude, length scales, recording, noise."""
        return np.log([self.amplitude, *self.length_scales, self.recording, self.noise])

    @classmethod
    def from_log(cls, values: ArrayLike) -> Hyperparameters:
        """The hyperparameters from their logarithms, to within rounding."""
        return cls.from_list(np.exp(np.asarray(values, dtype=np.float64)).tolist())

    def to_list(self) -> list[float]:
        """The 3 + D values themselves: amplitude, length scales, recording, noise."""
        return [self.amplitude, *self.length_scales, self.recording, self.noise]

    @classmethod
    def from_list(cls, values: Sequence[float]) -> Hyperparameters:
        """The same hyperparameters, bit for bit, from what `to_list` gives.

        Raises:
            ValueError: A value is not positive and finite, or there are too few.
        """
        amplitude, *length_scales, recording, noise = (float(value) for value in values)
        if not all(0.0 < value < np.inf for value in (amplitude, *length_scales, recording, noise)):
            raise ValueError("a hyperparameter is not a positive number")
        return cls(amplitude, tuple(length_scales), recording, noise)


class ResidualProcess:
    """A Gaussian process with an offset for each recording and heteroscedastic noise.

    Args:
        inputs: (N, D) float64.
        targets: (N,) float64.
        noise: (N,) float64, the standard deviation of each target.
        group: (N,) int64, the recording of each.
        hyperparameters: Absent: the most probable under priors about ``length_scales``.
        length_scales: (D,) prior medians of the length scales.
        log_error: What correlated errors of logs and boxes make of the targets. They come with a
            target and not with a place, so that nothing of them is predicted. Absent: nothing.
    """

    def __init__(
        self,
        inputs: FloatArray,
        targets: FloatArray,
        noise: FloatArray,
        group: IntArray,
        *,
        length_scales: tuple[float, ...],
        hyperparameters: Hyperparameters | None = None,
        log_error: CorrelatedError | None = None,
    ) -> None:
        chosen = _thin(len(targets), MOST_POINTS)
        self.inputs, self.targets = inputs[chosen], targets[chosen]
        self.noise, self.group = noise[chosen], group[chosen]
        self.log_error = None if log_error is None else log_error[chosen]
        self.length_scales = length_scales
        self.hyperparameters = hyperparameters or self._most_probable()
        h = self.hyperparameters
        scaled = self.inputs / np.array(h.length_scales)
        smooth = h.amplitude**2 * np.exp(-0.5 * _squared_differences(scaled).sum(axis=0))
        rest = _rest(h, self.noise, _same(self.group))
        if self.log_error is not None:
            rest += self.log_error.covariance()
        self._weights = cho_solve(cho_factor(smooth + rest, lower=True), self.targets)
        # The product with it is most of the work, and seven digits of a variance are plenty.
        whitening = _trapezoid(_whitening(smooth, rest))
        self._whitening = np.ascontiguousarray(whitening, dtype=np.float32)
        # The kernel's exponent, for a point x: x·y - |x|²/2 - |y|²/2 + log amplitude².
        half = np.log(h.amplitude**2) - 0.5 * np.einsum("nd,nd->n", scaled, scaled)
        self._exponents = np.concatenate([scaled.T, np.ones((1, len(scaled))), half[None, :]])

    def predict(self, inputs: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Predictive mean and variance in an unseen recording, noise included.

        The variance errs to the larger side, by at most a ten thousandth of the process's own.

        Args:
            inputs: (M, D) float64.
            noise: (M,) float64, standard deviations.

        Returns:
            Two (M,) float64 arrays.
        """
        h = self.hyperparameters
        m, dimensions = inputs.shape
        mean, explained = np.empty(m), np.empty(m)
        points = np.empty((dimensions + 2, m))
        scaled = points[:dimensions]
        np.divide(inputs.T, np.array(h.length_scales)[:, None], out=scaled)
        points[dimensions] = -0.5 * np.einsum("dm,dm->m", scaled, scaled)
        points[dimensions + 1] = 1.0
        chunk = max(_KERNEL_SIZE // len(self.targets), 1)
        for start in range(0, m, chunk):
            rows = slice(start, start + chunk)
            kernel = points[:, rows].T @ self._exponents
            np.exp(kernel, out=kernel)
            mean[rows] = kernel @ self._weights
            explained[rows] = self._explained(kernel.astype(np.float32))
        variance = np.maximum(h.amplitude**2 - explained, 0.0)
        return mean, variance + self._of_new_recording + (h.noise * noise) ** 2

    @property
    def too_rough(self) -> bool:
        """Whether it varies over far shorter lengths than what a camera leaves does."""
        shorter = np.log(self.length_scales) - np.log(self.hyperparameters.length_scales)
        return bool(shorter.max() > _ROUGH * _LENGTH_SPREAD)

    def gain(self) -> tuple[float, float]:
        """By how much the process places what was left out better, and how sure that is.

        Each recording is left out in turn and predicted from the others; one alone is parted into
        stretches. The gain of a recording is by how much the mean square of its targets falls, over
        their stated variance, when the predictions are taken off.

        Returns:
            The mean gain of a recording, and its standard error.
        """
        fold = self.group
        if np.unique(fold).size < _FEWEST_FOLDS:
            fold = np.arange(len(fold)) * _FEWEST_FOLDS // max(len(fold), 1)
        h = self.hyperparameters
        logged = 0.0 if self.log_error is None else self.log_error.covariance()
        scaled = self.inputs / np.array(h.length_scales)
        smooth = h.amplitude**2 * np.exp(-0.5 * _squared_differences(scaled).sum(axis=0))
        rest = _rest(h, self.noise, _same(self.group)) + logged
        variance = self.noise**2 + np.diag(logged + np.zeros_like(rest))
        lower = cholesky(smooth + rest, lower=True, check_finite=False)
        weights = cho_solve((lower, True), self.targets, check_finite=False)
        inverse = _inverse(lower)
        gains = []
        for one in np.unique(fold):
            left, kept = np.flatnonzero(fold == one), np.flatnonzero(fold != one)
            # Of the covariance of what is kept, by that of all (partitioned inverse).
            apart = np.linalg.solve(inverse[np.ix_(left, left)], weights[left])
            of_kept = weights[kept] - inverse[np.ix_(kept, left)] @ apart
            expected = smooth[np.ix_(left, kept)] @ of_kept
            own = self.targets[left]
            gains.append(np.sum((own**2 - (own - expected) ** 2) / variance[left]))
        total = np.array(gains)
        error = np.std(total, ddof=1) * np.sqrt(total.size)
        return float(total.sum() / len(self.targets)), float(error / len(self.targets))

    def _explained(self, kernel: NDArray[np.float32]) -> NDArray[np.float32]:
        """(M,) variance explained by the training points, from the kernel (M, N)."""
        out = np.zeros(len(kernel), dtype=np.float32)
        for first in range(0, self._whitening.shape[1], _BLOCK):
            # Above these rows the block is zero.
            whitened = kernel[:, first:] @ self._whitening[first:, first : first + _BLOCK]
            out += np.einsum("nm,nm->n", whitened, whitened)
        return out

    def predict_one(self, inputs: tuple[float, ...]) -> tuple[float, float]:
        """As `predict`, for one point (D,), and without the noise."""
        h = self.hyperparameters
        exponent = np.array([*inputs, *[x * x for x in inputs], 1.0]) @ self._quadratic
        kernel = np.exp(exponent)
        whitened = kernel.astype(np.float32) @ self._whitening
        variance = h.amplitude**2 - float(whitened @ whitened)
        return float(kernel @ self._weights), max(variance, 0.0) + self._of_new_recording

    @cached_property
    def _of_new_recording(self) -> float:
        """Variance of the offset of an unseen recording.

        How much recordings differ was itself estimated from few of them: the offset of another
        one follows Student's t with about as many degrees of freedom as there were recordings, n,
        which has n / (n - 2) times the variance.
        """
        count = np.unique(self.group).size
        widened = count / (count - 2.0) if count > 2 else _MOST_WIDENED
        return float(self.hyperparameters.recording**2 * min(widened, _MOST_WIDENED))

    @cached_property
    def _quadratic(self) -> FloatArray:
        """(2 D + 1, N) the kernel's exponent by a point's inputs, their squares, and 1."""
        scales = np.array(self.hyperparameters.length_scales)
        scaled = self._exponents[: len(scales)]
        squares = np.repeat(-0.5 / scales[:, None] ** 2, scaled.shape[1], axis=1)
        return np.concatenate([scaled / scales[:, None], squares, self._exponents[-1:]])

    def _most_probable(self) -> Hyperparameters:
        chosen = _thin(len(self.targets), _MOST_FOR_LEARNING)
        typical = float(np.sqrt(np.mean(self.noise[chosen] ** 2)))
        centre = Hyperparameters(0.7 * typical, self.length_scales, 0.5 * typical, 1.0).to_log()
        width = np.array([0.7, *([_LENGTH_SPREAD] * len(self.length_scales)), 0.7, 0.5])
        likelihood = LogLikelihood(
            self.inputs[chosen],
            self.targets[chosen],
            self.noise[chosen],
            self.group[chosen],
            None if self.log_error is None else self.log_error[chosen],
        )

        def negative_log(t: FloatArray) -> tuple[float, FloatArray]:
            value, gradient = likelihood(t)
            belief = (t - centre) / width
            return 0.5 * float(belief @ belief) - value, belief / width - gradient

        best = minimize(
            negative_log,
            centre,
            jac=True,
            method="L-BFGS-B",
            bounds=list(zip(centre - 4.0 * width, centre + 4.0 * width, strict=True)),
            options={"maxiter": 60},
        )
        return Hyperparameters.from_log(best.x)


class LogLikelihood:
    """Log-likelihood of targets as a function of the hyperparameters' logarithms.

    Args:
        inputs: (N, D) float64.
        targets: (N,) float64.
        noise: (N,) float64, the standard deviation of each target.
        group: (N,) int64, the recording of each.
        log_error: As in `ResidualProcess`.
    """

    def __init__(
        self,
        inputs: FloatArray,
        targets: FloatArray,
        noise: FloatArray,
        group: IntArray,
        log_error: CorrelatedError | None = None,
    ) -> None:
        self._logged = 0.0 if log_error is None else log_error.covariance()
        self._targets, self._noise, self._same = targets, noise, _same(group)
        self._squares = _squared_differences(inputs).reshape(inputs.shape[1], -1)

    def __call__(self, log_parameters: FloatArray) -> tuple[float, FloatArray]:
        """The log-likelihood up to a constant, and its gradient.

        Args:
            log_parameters: (3 + D,) as `Hyperparameters.to_log` gives them.
        """
        h = Hyperparameters.from_log(log_parameters)
        per_scale = np.array(h.length_scales) ** -2.0
        n = len(self._targets)
        smooth = h.amplitude**2 * np.exp(-0.5 * (per_scale @ self._squares)).reshape(n, n)
        rest = _rest(h, self._noise, self._same) + self._logged
        lower = cholesky(smooth + rest, lower=True, check_finite=False)
        weights = cho_solve((lower, True), self._targets, check_finite=False)
        value = -0.5 * float(self._targets @ weights) - float(np.log(np.diag(lower)).sum())
        inverse = _inverse(lower)
        inner = np.outer(weights, weights) - inverse
        by_smooth = (inner * smooth).ravel()
        gradient = np.concatenate(
            [
                [by_smooth.sum()],
                0.5 * per_scale * (self._squares @ by_smooth),
                [h.recording**2 * np.vdot(inner, self._same)],
                [h.noise**2 * (np.diag(inner) @ self._noise**2)],
            ]
        )
        return value, gradient


def _inverse(lower: FloatArray) -> FloatArray:
    """(N, N) inverse of the matrix whose Cholesky factor is given."""
    inverse, _ = lapack.dpotri(lower, lower=True)
    # Of the symmetric inverse only the lower triangle is there.
    inverse += np.tril(inverse, -1).T
    return np.asarray(inverse)


def _rest(h: Hyperparameters, noise: FloatArray, same: FloatArray) -> FloatArray:
    """(N, N) covariance of the recording offsets and the noise."""
    out = h.recording**2 * same
    jitter = 1e-10 * (h.amplitude**2 + h.recording**2)
    out[np.diag_indices_from(out)] += (h.noise * noise) ** 2 + jitter
    return out


def _whitening(smooth: FloatArray, rest: FloatArray) -> FloatArray:
    """Low-rank whitening T, (N, R), for which ``|Tᵀ k|²`` is ``kᵀ (smooth + rest)⁻¹ k``.

    A smooth kernel has fewer directions than points. It is whitened by what is not smooth,
    ``W = L⁻¹ smooth L⁻ᵀ``, and taken apart into eigenvectors (of a pivoted Cholesky
    decomposition, which has fewer columns than W). In units of the process's variance, the
    squares of the kernel's vector of a point along the eigenvectors, each divided by its λ, add up
    to at most 1, wherever the point lies: noiseless training points would explain no more than all
    of the variance. Of each of these shares λ / (1 + λ) is explained. So leaving out all
    eigenvectors for which that is at most a tolerance loses no more than the tolerance in all. What
    is left out makes the stated variance larger, never smaller.
    """
    lower = cholesky(rest, lower=True)
    half = solve_triangular(lower, smooth, lower=True)
    whitened = solve_triangular(lower, half.T, lower=True)
    factor, pivots, rank, _ = lapack.dpstrf(whitened, tol=0.01 * _LOST / len(smooth), lower=True)
    columns = np.zeros((len(smooth), rank))
    columns[pivots - 1] = np.tril(factor)[:, :rank]
    basis, upper = np.linalg.qr(columns)
    values, vectors = np.linalg.eigh(upper @ upper.T)
    needed = values > _LOST * (1.0 + values)
    directions = basis @ (vectors[:, needed] / np.sqrt(1.0 + values[needed]))
    return np.asarray(solve_triangular(lower, directions, lower=True, trans="T"))


def _trapezoid(whitening: FloatArray) -> FloatArray:
    """(N, R) lower trapezoidal factor with the same product with its own transpose."""
    return np.asarray(np.linalg.qr(whitening.T)[1].T)


def _thin(n: int, most: int) -> IntArray:
    """Indices of at most ``most`` of ``n`` rows, evenly spread."""
    return np.unique(np.linspace(0, max(n - 1, 0), min(n, most)).round().astype(np.int64))


def _same(group: IntArray) -> FloatArray:
    return np.asarray(group[:, None] == group[None, :], dtype=np.float64)


def _squared_differences(points: FloatArray) -> FloatArray:
    """(D, N, N) squared differences between points (N, D)."""
    return np.square(points.T[:, :, None] - points.T[:, None, :])
