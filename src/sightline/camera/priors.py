"""Priors of the camera, its target and its sources of boxes, and the noise of a foot point."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sightline.camera.parameters import (
    CAMERA,
    CURVATURE,
    HEADING,
    K1,
    K2,
    LOG_FOCAL,
    LOG_HEIGHT,
    PITCH,
    POSITION,
    PRINCIPAL_DX,
    PRINCIPAL_DY,
    ROLL,
    TARGET,
    ParameterLayout,
    camera_vector,
)
from sightline.types import FloatArray

ANY_ASPECT_SPREAD = (0.5 - 4.0 / np.pi**2, 0.5 - 4.0 / np.pi**2, 1.0 / np.pi - 4.0 / np.pi**2)
"""Variances of ``|cos|`` and of ``|sin|`` of such an aspect, and their covariance."""


ANY_ASPECT = 2.0 / np.pi


"""The mean of ``|cos|`` and of ``|sin|`` of the aspect, for a target that may head anywhere."""


@dataclass(frozen=True)
class NoisePrior:
    """Prior of one part of `PixelNoise`: log-normal, or exponential.

    The exponential is a penalised complexity prior (Simpson et al. 2017): a part that nothing asks
    for goes to zero. Where a part is there for sure, however small, the prior keeps away from zero
    (Chung et al. 2013), since the likelihood of a handful of targets often has its mode there.

    Attributes:
        typical: Median of a log-normal, mean of an exponential one.
        log_sigma: Standard deviation of the logarithm; 0 for an exponential.
        positive: Whether it keeps away from zero.
    """

    typical: float
    log_sigma: float = 0.0
    positive: bool = False

    def penalty(self, log: float) -> tuple[float, float]:
        """Negative logarithm of the density at the logarithm of a value, and its derivative."""
        if self.log_sigma > 0.0:
            belief = (log - math.log(self.typical)) / self.log_sigma
            return 0.5 * belief**2, belief / self.log_sigma
        share = math.exp(log) / self.typical
        return (share - log, share - 1.0) if self.positive else (share, share)

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and largest logarithm."""
        reach = 4.0 * self.log_sigma or _EXPONENTIAL_REACH
        return math.log(self.typical) - reach, math.log(self.typical) + reach

    def start(self, value: float) -> float:
        """Logarithm from which a search may begin, near a value."""
        low, high = self.bounds
        log = math.log(value if value > 0.0 else _START_SHARE * self.typical)
        # At a bound a part of no size has no slope, and would stay there.
        return min(max(log, low + _INSIDE), high - _INSIDE)


_EXPONENTIAL_REACH, _START_SHARE, _INSIDE = 6.0, 0.3, 0.7

HEAVE_M = 0.15
"""Median of the heave of a camera on a vessel before any data, metres."""

NOISE_PRIORS = {
    # Drawn and detected boxes differ by a pixel or two, and by more in their columns.
    "row_px": NoisePrior(1.0, 0.7),
    "column_px": NoisePrior(2.0, 0.7),
    "row_m": NoisePrior(0.15, 1.0),
    "place_m": NoisePrior(1.0),
    # A phone's receiver is some metres off, for half a minute or for as long as it is watched.
    "correlated_m": NoisePrior(3.0),
    "correlation_time_s": NoisePrior(20.0, 0.5),
    "offset_m": NoisePrior(3.0, positive=True),
    # Of half a length: a receiver stands anywhere on its boat.
    "antenna_share": NoisePrior(0.3, 0.7),
    # A step, a swell, a wake: a second or two.
    "lasting_m": NoisePrior(1.0, positive=True),
    "lasting_row_px": NoisePrior(1.0),
    "lasting_column_px": NoisePrior(1.0),
    "lasting_time_s": NoisePrior(2.0, 1.0),
    "heave_m": NoisePrior(HEAVE_M, 1.0),
}
"""Priors of the parts of `PixelNoise` that are estimated, by their names."""


@dataclass(frozen=True)
class CameraPrior:
    """Prior of a camera, as means and standard deviations.

    Attributes:
        height_m: Median; ``log_height_sigma`` is the standard deviation of its logarithm.
        log_height_sigma: See ``height_m``.
        pitch_deg: Mean and standard deviation.
        roll_deg: Mean and standard deviation.
        focal_widths: Median focal length in image widths.
        log_focal_sigma: Standard deviation of the logarithm of the focal length.
        k1_sigma: About zero.
        k2_sigma: About zero.
        half_length_m: Mean and standard deviation; of the target.
        half_beam_m: Mean and standard deviation; of the target.
        heading_deg: Mean and standard deviation; None: nobody knows it.
        principal_widths: Mean of the principal point, to the right of the middle of the image and
            below it, image widths.
        principal_sigma_widths: Its standard deviation along either axis, image widths.
        curvature: Mean and standard deviation of the curvature along sight lines, as a share of the
            earth's: refraction over warm or cold water may take all of it, or none.
        position_sigma_m: Of the camera about the place that the scene states.
        bias_px: Mean of each source's lower edge, pixels; negative where boxes end too high.
        bias_px_sigma: Its standard deviation.
        bias_m_sigma: Of each source's lower edge, metres of height at the target.
        unseen_px: The mean of a source that was not learned from, pixels. It has a mean of its own
            where the sources learned from are of another kind: detectors, and people who draw.
        unseen_m: The same in metres of height at the target.
        clock_sigma_s: Of each recording's clock against the log: logs and clocks often keep whole
            seconds.
    """

    height_m: float = 5.0
    log_height_sigma: float = 1.0
    pitch_deg: tuple[float, float] = (5.0, 15.0)
    roll_deg: tuple[float, float] = (0.0, 3.0)
    focal_widths: float = 0.8
    log_focal_sigma: float = 0.3
    k1_sigma: float = 0.15
    k2_sigma: float = 0.1
    half_length_m: tuple[float, float] = (0.0, 2.0)
    half_beam_m: tuple[float, float] = (0.0, 1.0)
    position_sigma_m: float = 3.0
    heading_deg: tuple[float, float] | None = None
    principal_widths: tuple[float, float] = (0.0, 0.0)
    principal_sigma_widths: float = 0.015
    curvature: tuple[float, float] = (6.0 / 7.0, 0.5)
    bias_px: float = 0.0
    bias_px_sigma: float = 2.0
    bias_m_sigma: float = 0.3
    unseen_px: float = 0.0
    unseen_m: float = 0.0
    clock_sigma_s: float = 0.5

    def moments(
        self,
        image_size_px: tuple[int, int],
        n_sources: int,
        n_clocks: int,
        *,
        position_known: bool,
    ) -> tuple[FloatArray, FloatArray]:
        """Means and standard deviations of the whole parameter vector.

        A heading that nobody knows has no prior (infinite standard deviation), and neither has the
        position of a camera of which nobody knows where it stands.
        """
        heading_deg, heading_sigma_deg = self.heading_deg or (0.0, np.inf)
        layout = ParameterLayout(n_sources, n_clocks)
        mean, sigma = np.zeros(layout.size), np.zeros(layout.size)
        mean[CAMERA] = camera_vector(
            {
                LOG_HEIGHT: np.log(self.height_m),
                PITCH: np.radians(self.pitch_deg[0]),
                ROLL: np.radians(self.roll_deg[0]),
                HEADING: np.radians(heading_deg),
                LOG_FOCAL: np.log(self.focal_widths * image_size_px[0]),
                PRINCIPAL_DX: self.principal_widths[0] * image_size_px[0],
                PRINCIPAL_DY: self.principal_widths[1] * image_size_px[0],
                CURVATURE: self.curvature[0],
            }
        )
        sigma[CAMERA] = camera_vector(
            {
                LOG_HEIGHT: self.log_height_sigma,
                PITCH: np.radians(self.pitch_deg[1]),
                ROLL: np.radians(self.roll_deg[1]),
                HEADING: np.radians(heading_sigma_deg),
                LOG_FOCAL: self.log_focal_sigma,
                K1: self.k1_sigma,
                K2: self.k2_sigma,
                PRINCIPAL_DX: self.principal_sigma_widths * image_size_px[0],
                PRINCIPAL_DY: self.principal_sigma_widths * image_size_px[0],
                CURVATURE: self.curvature[1],
            }
        )
        sigma[POSITION] = self.position_sigma_m if position_known else np.inf
        mean[TARGET], sigma[TARGET] = np.transpose([self.half_length_m, self.half_beam_m])
        for index in range(n_sources):
            own = layout.source(index)
            mean[own] = self.bias_px, 0.0
            sigma[own] = self.bias_px_sigma, self.bias_m_sigma
        sigma[layout.clocks] = self.clock_sigma_s
        return mean, sigma


@dataclass(frozen=True)
class SourcePrior:
    """Prior of the lower-edge bias of one source, instead of that of `CameraPrior`.

    Attributes:
        bias_px: Mean and standard deviation.
        bias_m: Mean and standard deviation.
    """

    bias_px: tuple[float, float]
    bias_m: tuple[float, float]


@dataclass(frozen=True)
class PixelNoise:
    """Standard deviations of a foot point, in pixels and in metres at the target.

    Attributes:
        row_px: Of the row, pixels.
        row_m: Of the row, metres of height at the target.
        column_px: Of the column, pixels.
        place_m: Of the place itself, metres east and metres north, anew for each box: error of the
            log, and of the middle of the box as the middle of the hull. The two cannot be
            told apart.
        correlated_m: Of the log's correlated error, metres east and metres north.
        correlation_time_s: Its correlation time: it decays as ``exp(-Δt / correlation_time_s)``.
        heave_m: Of the camera's height, which moves all rows together for about a second: of a
            camera on a vessel.
        middle_m: How far the middle of the box lies ahead of the log's receiver, metres, as a root
            mean square; to which side, the course says.
    """

    row_px: float = 1.5
    row_m: float = 0.2
    column_px: float = 3.0
    place_m: float = 1.0
    correlated_m: float = 1.0
    correlation_time_s: float = 20.0
    heave_m: float = 0.0
    middle_m: float = 0.0
    offset_m: float = 0.0
    antenna_share: float = 0.0
    lasting_m: float = 0.0
    lasting_row_px: float = 0.0
    lasting_column_px: float = 0.0
    lasting_time_s: float = 2.0

    def variances_px2(self, squared_pixels_per_metre: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Variances of column and row, square pixels, each (N,), without the place's.

        Args:
            squared_pixels_per_metre: (N,) the square of how large a metre at the target looks.
        """
        row_m2 = self.row_m**2 + self.heave_m**2
        return (
            np.full_like(squared_pixels_per_metre, self.column_px**2),
            self.row_px**2 + row_m2 * squared_pixels_per_metre,
        )

    def lasting_px2(self) -> tuple[float, float]:
        """Variances of column and row that last, square pixels."""
        return self.lasting_column_px**2, self.lasting_row_px**2

    def scaled(self, factor: float) -> PixelNoise:
        """The same noise, scaled by a factor."""
        return PixelNoise(
            self.row_px * factor,
            self.row_m * factor,
            self.column_px * factor,
            self.place_m * factor,
            self.correlated_m * factor,
            self.correlation_time_s,
            self.heave_m * factor,
            self.middle_m,
            self.offset_m * factor,
            self.antenna_share * factor,
            self.lasting_m * factor,
            self.lasting_row_px * factor,
            self.lasting_column_px * factor,
            self.lasting_time_s,
        )
