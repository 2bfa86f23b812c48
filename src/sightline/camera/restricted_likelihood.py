"""Restricted likelihood of the noise of a camera fit, and the most probable noise under it.

The likelihood of the residuals as a function of their covariance, with the parameters integrated
out as Gaussian effects, linearised where they are (restricted maximum likelihood; Patterson and
Thompson 1971). Each part of the noise has a weak prior, `NOISE_PRIORS`, under which a part that
nothing asks for goes to zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from sightline.camera.correlated_noise import Block, Whitening
from sightline.camera.priors import NOISE_PRIORS, PixelNoise
from sightline.types import BoolArray, FloatArray

_WHITE = ("row_px", "row_m", "column_px", "place_m")
_CORRELATED = ("correlated_m", "correlation_time_s", "offset_m", "antenna_share")
_LASTING = (
    "lasting_m",
    "lasting_row_px",
    "lasting_column_px",
    "lasting_time_s",
)
# A step that gains less than this tells nothing.
_ENOUGH_NATS = 0.002


@dataclass(frozen=True, eq=False)
class RestrictedLikelihood:
    """Negative logarithm of the restricted likelihood, with its gradient.

    Attributes:
        residual_px: (N, 2) float64, columns and rows.
        jacobian: (N, 2, P) float64, by the parameters.
        by_point: (N, 2, 3) float64, by east, north and up of the place, pixels a metre.
        pixels_per_metre: (N,) float64, image scale; zero for control points.
        is_box: (N,) bool.
        known_m2: (N,) float64, variance of each place that is known.
        weight: (N, 2) float64, how much each column and row counts, 0 to 1.
        blocks: Of correlated errors; empty where no times are known.
        half_lengths_m: (N, 2) float64, of the targets along their courses.
        precision: (P, P) float64, of the priors of the parameters.
        off_mean: (P,) float64, of the parameters off their prior means.
    """

    residual_px: FloatArray
    jacobian: FloatArray
    by_point: FloatArray
    pixels_per_metre: FloatArray
    is_box: BoolArray
    known_m2: FloatArray
    weight: FloatArray
    blocks: list[Block]
    half_lengths_m: FloatArray
    precision: FloatArray
    off_mean: FloatArray

    @cached_property
    def _per_metre(self) -> FloatArray:
        return np.asarray(np.sum(self.by_point[:, :, :2] ** 2, axis=2))

    @cached_property
    def _parts(self) -> FloatArray:
        """(4, N, 2) variances are these times the squares of the white parts of the noise."""
        parts = np.zeros((len(_WHITE), *self.residual_px.shape))
        parts[0, :, 1] = 1.0
        parts[1, :, 1] = self.pixels_per_metre**2
        parts[2, :, 0] = 1.0
        parts[3] = np.where(self.is_box[:, None], self._per_metre, 0.0)
        return parts

    @cached_property
    def _columns(self) -> FloatArray:
        """(N, 2, P + 1) Jacobian and residual."""
        return np.concatenate([self.jacobian, self.residual_px[:, :, None]], axis=2)

    def __call__(self, noise: PixelNoise) -> tuple[float, dict[str, float]]:
        """The value, and its derivatives by the logarithms of the parts of the noise.

        Raises:
            LinAlgError: The covariance is not positive definite.
        """
        size = self.off_mean.size
        squares = np.array([getattr(noise, name) ** 2 for name in _WHITE])
        known = self.known_m2[:, None] * self._per_metre
        variance = (np.tensordot(squares, self._parts, 1) + known) / self.weight
        whitening = Whitening(
            self.blocks,
            variance,
            self.by_point[:, :, :2],
            noise,
            self.by_point[:, :, 2],
            self.half_lengths_m,
        )
        both = whitening.forward(self._columns)
        flat = both.reshape(-1, size + 1)
        factor = cho_factor(
            flat[:, :-1].T @ flat[:, :-1] + self.precision, lower=True, check_finite=False
        )
        slope = flat[:, :-1].T @ flat[:, -1] - self.precision @ self.off_mean
        step = cho_solve(factor, slope, check_finite=False)
        value = 0.5 * float(flat[:, -1] @ flat[:, -1] - slope @ step)
        value += 0.5 * float(self.off_mean @ self.precision @ self.off_mean)
        value += whitening.log_determinant() + float(np.log(np.diag(factor[0])).sum())
        solved = whitening.backward(both)
        by_variance, gradient = whitening.gradient(
            solved[:, :, -1] - solved[:, :, :-1] @ step,
            solved[:, :, :-1],
            cho_solve(factor, np.eye(size), check_finite=False),
        )
        by_part = 2.0 * squares * np.tensordot(self._parts, by_variance / self.weight, 2)
        return value, gradient | dict(zip(_WHITE, by_part.tolist(), strict=True))


def _estimated(likelihood: RestrictedLikelihood, *, heaving: bool) -> list[str]:
    """Names of the parts of the noise that a likelihood tells."""
    if not likelihood.blocks:
        return [*_WHITE]
    # On a vessel what lasts a second or two is its heave.
    return [*_WHITE, *_CORRELATED, *(("heave_m",) if heaving else _LASTING)]


def negative_log_evidence(
    likelihood: RestrictedLikelihood, noise: PixelNoise, *, heaving: bool = False
) -> float:
    """Negative logarithm of the density of data and noise, the parameters integrated out.

    Models of the same data whose priors differ can be compared by it: it holds how wide these are.

    Args:
        likelihood: Of the residuals.
        noise: Estimated.
        heaving: Whether the camera heaves.

    Raises:
        LinAlgError: A covariance is not positive definite.
    """
    value, _ = likelihood(noise)
    for name in _estimated(likelihood, heaving=heaving):
        size = getattr(noise, name)
        value += NOISE_PRIORS[name].penalty(math.log(size))[0] if size > 0.0 else 0.0
    held = np.diag(likelihood.precision)
    return value - 0.5 * float(np.log(held[held > 0.0]).sum())


def most_probable_noise(
    likelihood: RestrictedLikelihood, before: PixelNoise, *, heaving: bool = False
) -> PixelNoise:
    """The noise that is most probable under a likelihood and `NOISE_PRIORS`.

    Args:
        likelihood: Of the residuals.
        before: Where the search begins.
        heaving: Whether the camera heaves.

    Raises:
        LinAlgError: A covariance on the way is not positive definite.
    """
    names = _estimated(likelihood, heaving=heaving)
    priors = [NOISE_PRIORS[name] for name in names]

    def noise_at(logs: FloatArray) -> PixelNoise:
        return replace(before, **dict(zip(names, np.exp(logs).tolist(), strict=True)))

    def negative_log(logs: FloatArray) -> tuple[float, FloatArray]:
        value, slopes = likelihood(noise_at(logs))
        beliefs = [prior.penalty(log) for prior, log in zip(priors, logs.tolist(), strict=True)]
        value += sum(belief for belief, _ in beliefs)
        gradient = [slopes[name] + slope for name, (_, slope) in zip(names, beliefs, strict=True)]
        return value, np.array(gradient)

    start = [prior.start(getattr(before, name)) for prior, name in zip(priors, names, strict=True)]
    size = max(abs(negative_log(np.array(start))[0]), 1.0)
    best = minimize(
        negative_log,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=[prior.bounds for prior in priors],
        options={"maxiter": 25, "ftol": _ENOUGH_NATS / size},
    )
    found = noise_at(best.x)
    # Where no two fixes are near in time, correlated noise cannot be estimated.
    return found if likelihood.blocks else replace(found, correlated_m=0.0)
