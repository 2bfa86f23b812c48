"""What a camera leaves of the positions: Gaussian processes in bearing and log-range.

Errors of a single camera lie along the line of sight and grow with the square of the range, so
that the residual is learned in bearing and in the logarithm of the range. The box's apparent
height and width, in metres at the range that the camera found, are among the inputs: a box drawn
too small for its range is a box whose lower edge is too high.

Errors of one recording are alike (the same annotator on the same day, the same tide). A process
that took them for independent would learn them as if they came with the place; so each recording
has an offset of its own, and a new recording's unknown offset is part of the stated uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize

from sightline.types import FloatArray, IntArray

MOST_POINTS = 2000
"""Exact inference is fine to about this many points; more are thinned evenly."""

_MOST_FOR_LEARNING = 300
_CHUNK = 2048


@dataclass(frozen=True)
class Hyperparameters:
    """Of one Gaussian process, all positive.

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
    def from_log(cls, values: FloatArray) -> Hyperparameters:
        """From the logarithms that `to_log` gives."""
        positive = [float(v) for v in np.exp(values)]
        return cls(positive[0], tuple(positive[1:-2]), positive[-2], positive[-1])


class ResidualProcess:
    """One Gaussian process with an offset for each recording and noise that differs by point.

    Args:
        inputs: (N, D) float64.
        targets: (N,) float64.
        noise: (N,) float64, the standard deviation of each target.
        group: (N,) int64, the recording of each.
        hyperparameters: Absent: the most probable under priors about ``length_scales``.
        length_scales: (D,) what is believed of the length scales.
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
    ) -> None:
        chosen = _thin(len(targets), MOST_POINTS)
        self.inputs, self.targets = inputs[chosen], targets[chosen]
        self.noise, self.group = noise[chosen], group[chosen]
        self.length_scales = length_scales
        self.hyperparameters = hyperparameters or self._most_probable()
        h = self.hyperparameters
        self._scaled = self.inputs / np.array(h.length_scales)
        covariance = _covariance(
            h.to_log(), self._scaled, self.noise, _same(self.group), scaled=True
        )[0]
        lower = cholesky(covariance, lower=True)
        self._weights = solve_triangular(
            lower.T, solve_triangular(lower, self.targets, lower=True), lower=False
        )
        # Its product with the kernel gives the variance explained, in one matrix product.
        self._whitening = np.ascontiguousarray(
            solve_triangular(lower, np.eye(len(self.targets)), lower=True).T
        )
        self._squares = np.einsum("nd,nd->n", self._scaled, self._scaled)

    def predict(self, inputs: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and variance in a recording that was not learned from, noise included.

        Args:
            inputs: (M, D) float64.
            noise: (M,) float64, standard deviations.

        Returns:
            Two (M,) float64 arrays.
        """
        h = self.hyperparameters
        mean, explained = np.empty(len(inputs)), np.empty(len(inputs))
        scaled = inputs / np.array(h.length_scales)
        for start in range(0, len(inputs), _CHUNK):
            rows = slice(start, start + _CHUNK)
            part = scaled[rows]
            kernel = part @ self._scaled.T
            kernel -= 0.5 * np.einsum("nd,nd->n", part, part)[:, None]
            kernel -= 0.5 * self._squares
            np.exp(np.minimum(kernel, 0.0, out=kernel), out=kernel)
            kernel *= h.amplitude**2
            mean[rows] = kernel @ self._weights
            whitened = kernel @ self._whitening
            explained[rows] = np.einsum("nm,nm->n", whitened, whitened)
        variance = np.maximum(h.amplitude**2 - explained, 0.0)
        return mean, variance + h.recording**2 + (h.noise * noise) ** 2

    def _most_probable(self) -> Hyperparameters:
        chosen = _thin(len(self.targets), _MOST_FOR_LEARNING)
        inputs, targets = self.inputs[chosen], self.targets[chosen]
        noise, same = self.noise[chosen], _same(self.group[chosen])
        typical = float(np.sqrt(np.mean(noise**2)))
        centre = Hyperparameters(0.7 * typical, self.length_scales, 0.5 * typical, 1.0).to_log()
        width = np.array([0.7, *([0.5] * len(self.length_scales)), 0.7, 0.5])

        def negative_log(t: FloatArray) -> tuple[float, FloatArray]:
            covariance, slopes = _covariance(t, inputs, noise, same)
            lower = cholesky(covariance, lower=True)
            half = solve_triangular(lower, np.eye(len(targets)), lower=True)
            inverse = half.T @ half
            weights = inverse @ targets
            belief = (t - centre) / width
            value = 0.5 * targets @ weights + np.log(np.diag(lower)).sum() + 0.5 * belief @ belief
            inner = inverse - np.outer(weights, weights)
            gradient = np.array([0.5 * np.sum(inner * slope) for slope in slopes])
            return float(value), gradient + belief / width

        best = minimize(
            negative_log,
            centre,
            jac=True,
            method="L-BFGS-B",
            bounds=list(zip(centre - 4.0 * width, centre + 4.0 * width, strict=True)),
            options={"maxiter": 60},
        )
        return Hyperparameters.from_log(best.x)


def _thin(n: int, most: int) -> IntArray:
    """Indices of at most ``most`` of ``n`` rows, evenly spread."""
    return np.unique(np.linspace(0, max(n - 1, 0), min(n, most)).round().astype(np.int64))


def _same(group: IntArray) -> FloatArray:
    return np.asarray(group[:, None] == group[None, :], dtype=np.float64)


def _covariance(
    log_parameters: FloatArray,
    inputs: FloatArray,
    noise: FloatArray,
    same: FloatArray,
    *,
    scaled: bool = False,
) -> tuple[FloatArray, list[FloatArray]]:
    """The covariance of the targets and its derivatives by the logarithms of the parameters."""
    h = Hyperparameters.from_log(log_parameters)
    points = inputs if scaled else inputs / np.array(h.length_scales)
    squares = [(points[:, None, d] - points[None, :, d]) ** 2 for d in range(points.shape[1])]
    smooth = h.amplitude**2 * np.exp(-0.5 * sum(squares, np.zeros_like(same)))
    shared = h.recording**2 * same
    own = np.diag((h.noise * noise) ** 2)
    jitter = 1e-10 * (h.amplitude**2 + h.recording**2) * np.eye(len(noise))
    slopes = [2.0 * smooth, *(smooth * square for square in squares), 2.0 * shared, 2.0 * own]
    return smooth + shared + own + jitter, slopes
