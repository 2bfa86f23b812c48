"""Sizes of the targets that a camera has seen, as their boxes' widths tell them.

A box ends where the near side of a hull meets the water: half a length nearer than the middle of a
target that is seen from ahead, half a beam nearer than that of one seen from abeam. How large a
target is, the width of its box says, and whether that is its length or its beam, nobody knows of
a single box. So sizes are taken as log-normal about that of a typical target, courses as any, and
what a width makes of the two is looked up (Bayes' rule on a grid).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sightline.types import FloatArray

BEAM_SHARE = 0.35
"""Beam over length: of ships 0.15, of boats and cars 0.4, of people 1 and more."""

# Of the logarithm of a width: margins that people and detectors leave, and masts and wakes.
_WIDTH_SIGMA = 0.25
USUAL_SPREAD = 0.4
"""Standard deviation of the logarithm of the sizes of targets before any has been seen, which
counts as much as one target that differs by this from the typical one."""

_ANGLES, _SIZES, _WIDTHS = 24, 41, 64
_REACH = 4.0


@dataclass(frozen=True)
class TargetSizes:
    """Distribution of the sizes of targets.

    Attributes:
        half_length_m: Half of the length of a typical target, as widths of boxes tell it.
        log_sigma: Standard deviation of the logarithm of the sizes.
        wider: How many times as wide as hulls boxes are, as hulls of stated size tell.
    """

    half_length_m: float
    log_sigma: float
    wider: float = 1.0

    @classmethod
    def of(cls, half_length_m: FloatArray, wider: float = 1.0) -> TargetSizes:
        """The distribution from half the lengths of some targets, (K,) metres, at least one."""
        logs = np.log(half_length_m)
        middle = float(np.median(logs))
        spread = np.sqrt((USUAL_SPREAD**2 + np.sum((logs - middle) ** 2)) / (1.0 + logs.size))
        return cls(float(np.exp(middle)), float(spread), wider)

    def reach(self, width_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """How far hulls of some apparent widths reach towards the camera.

        Args:
            width_m: (N,) metres; not-finite ones count as the typical.

        Returns:
            Shares of the typical half length and of the typical half beam along the line of sight,
            (N,) each, and the (3, N) variances and covariance of the two: of length, beam, both.
        """
        table = self._table
        log_width = np.log(np.maximum(width_m, 1e-6) / (2.0 * self.wider * self.half_length_m))
        log_width = np.nan_to_num(log_width)
        out = [np.interp(log_width, self._log_widths, row) for row in table]
        return out[0], out[1], np.stack(out[2:])

    def reach_one(self, width_m: float) -> tuple[float, float, float, float, float]:
        """As `reach`, for one width: the two shares, then variances and covariance."""
        first, step, rows = self._rows
        at = (math.log(max(width_m, 1e-6) / (2.0 * self.wider * self.half_length_m)) - first) / step
        at = min(max(at, 0.0), _WIDTHS - 1.000001)
        index = int(at)
        late = at - index
        below, above = rows[index], rows[index + 1]
        length, beam, *spread = (
            (1.0 - late) * one + late * other for one, other in zip(below, above, strict=True)
        )
        return length, beam, spread[0], spread[1], spread[2]

    @cached_property
    def _rows(self) -> tuple[float, float, list[list[float]]]:
        widths = self._log_widths
        return float(widths[0]), float(widths[1] - widths[0]), self._table.T.tolist()

    @cached_property
    def _log_widths(self) -> FloatArray:
        span = _REACH * (self.log_sigma + _WIDTH_SIGMA)
        return np.linspace(-span - 1.1, span + 0.1, _WIDTHS)

    @cached_property
    def _table(self) -> FloatArray:
        angle = (np.arange(_ANGLES) + 0.5) * (0.5 * np.pi / _ANGLES)
        log_size = np.linspace(-_REACH, _REACH, _SIZES) * self.log_sigma
        prior = np.exp(-0.5 * np.linspace(-_REACH, _REACH, _SIZES) ** 2)
        seen = np.log(np.sin(angle) + BEAM_SHARE * np.cos(angle))[None, :] + log_size[:, None]
        off = (self._log_widths[:, None, None] - seen) / _WIDTH_SIGMA
        weight = prior[None, :, None] * np.exp(-0.5 * off**2)
        weight /= weight.sum(axis=(1, 2), keepdims=True)
        length = np.exp(log_size)[:, None] * np.cos(angle)[None, :]
        beam = np.exp(log_size)[:, None] * np.sin(angle)[None, :]

        def mean(values: FloatArray) -> FloatArray:
            return np.asarray(np.einsum("wsa,sa->w", weight, values))

        by_length, by_beam = mean(length), mean(beam)
        return np.stack(
            [
                by_length,
                by_beam,
                mean(length**2) - by_length**2,
                mean(beam**2) - by_beam**2,
                mean(length * beam) - by_length * by_beam,
            ]
        )
