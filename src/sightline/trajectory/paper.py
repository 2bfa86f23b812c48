"""The paper's trajectory stage (section 4.3), unchanged.

Three steps: a moving average weighted by the detector's confidence, after outliers are rejected;
spline interpolation where nothing was detected; extrapolation with the velocity at the end. The
paper gives positions alone. The velocity is the slope of the spline, and covariances are those
of the positions, carried through the weights as if their errors were independent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.interpolate import make_interp_spline

from sightline.errors import InputError
from sightline.trajectory.base import Measurements, distinct, measurements, point_kinds
from sightline.types import BoolArray, EastNorthPositions, FloatArray, Track

_RAYLEIGH_MEDIAN = np.sqrt(2.0 * np.log(2.0))
_UNKNOWN_SPEED_MPS = 10.0


@dataclass(frozen=True)
class PaperChain:
    """Confidence-weighted moving average, spline, first-order extrapolation.

    Attributes:
        window_s: Width of the window of the average, centred.
        least_confidence: Boxes below it are outliers, unless all are.
        outlier_sigmas: A position further than this from the median of its window, in standard
            deviations estimated from the median distance within the window, is an outlier.
        spline_degree: Of the interpolating polynomials, 1 to 5.
        longest_gap_s: Between averages further apart than this, points are called extrapolated.
    """

    window_s: float = 2.0
    least_confidence: float = 0.3
    outlier_sigmas: float = 4.0
    spline_degree: int = 3
    longest_gap_s: float = 15.0

    def __post_init__(self) -> None:
        for name in ("window_s", "outlier_sigmas", "longest_gap_s"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"paper: {name} is {getattr(self, name):g}; expected above 0")
        if self.spline_degree not in range(1, 6):
            raise InputError(f"paper: spline_degree is {self.spline_degree}; expected 1 to 5")

    def apply(
        self,
        time_utc_s: FloatArray,
        positions: EastNorthPositions,
        *,
        confidence: FloatArray | None = None,
        at_utc_s: FloatArray | None = None,
        track_id: int = 0,
        label: str = "",
    ) -> Track:
        """See `TrajectoryMethod.apply`."""
        measured, at = measurements(time_utc_s, positions, confidence, at_utc_s, track_id)
        epoch = float(measured.time_utc_s[0])
        time = measured.time_utc_s - epoch
        used = self._inliers(time, measured)
        average = self._average(time[used], measured, used)
        position, velocity, covariance, velocity_covariance = average.at(
            at - epoch, self.spline_degree
        )
        return Track(
            track_id=track_id,
            time_utc_s=at,
            east_m=position[:, 0],
            north_m=position[:, 1],
            velocity_east_mps=velocity[:, 0],
            velocity_north_mps=velocity[:, 1],
            covariance_m2=covariance + measured.shared_at(at),
            velocity_covariance_m2ps2=velocity_covariance,
            kind=point_kinds(at, distinct(measured.time_utc_s[used]), self.longest_gap_s),
            plane=positions.plane,
            label=label,
        )

    def _inliers(self, time_s: FloatArray, measured: Measurements) -> BoolArray:
        sure = measured.confidence >= self.least_confidence
        if not sure.any():
            sure = np.ones_like(sure)
        en = measured.en_m[sure]
        middle = self._rolling(time_s[sure], en).median().to_numpy()
        distance = np.hypot(*(en - middle).T)
        usual = self._rolling(time_s[sure], distance).median().to_numpy()[:, 0] / _RAYLEIGH_MEDIAN
        near = np.zeros_like(sure)
        near[sure] = distance <= self.outlier_sigmas * usual
        return near if near.any() else sure

    def _average(self, time_s: FloatArray, measured: Measurements, used: BoolArray) -> _Average:
        weight = np.maximum(measured.confidence[used], 1e-6)
        en, covariance = measured.en_m[used], measured.covariance_m2[used].reshape(-1, 4)
        columns = np.column_stack(
            [weight, weight[:, None] * en, weight[:, None] ** 2 * covariance, weight**2]
        )
        sums = self._rolling(time_s, columns).sum().to_numpy()
        total = sums[:, :1]
        first = np.searchsorted(time_s, distinct(time_s))
        spacing = np.gradient(time_s[first]) if first.size > 1 else np.full(1, self.window_s)
        span = np.maximum(self.window_s, spacing)
        smooth_covariance = (sums[:, 3:7] / total**2)[first].reshape(-1, 2, 2)
        # The slope of a moving average is the difference of what enters and what leaves the
        # window, over its width: 2 / n² of one measurement's variance, for each n / width.
        count = (total[:, 0] ** 2 / sums[:, 7])[first]
        return _Average(
            time_s=time_s[first],
            en_m=(sums[:, 1:3] / total)[first],
            covariance_m2=smooth_covariance,
            velocity_covariance_m2ps2=(2.0 * count / span**2)[:, None, None] * smooth_covariance,
            start=_end_velocity(time_s, en, covariance, time_s - time_s[0], self.window_s),
            stop=_end_velocity(time_s, en, covariance, time_s[-1] - time_s, self.window_s),
        )

    def _rolling(
        self, time_s: FloatArray, columns: FloatArray
    ) -> pd.api.typing.Rolling[pd.DataFrame]:
        table = pd.DataFrame(columns, index=pd.to_timedelta(time_s, unit="s"))
        return table.rolling(pd.Timedelta(seconds=self.window_s), center=True, closed="both")


@dataclass(frozen=True, eq=False)
class _EndVelocity:
    """Velocity (2,) at an end of a track, with its covariance (2, 2)."""

    velocity_mps: FloatArray
    covariance_m2ps2: FloatArray


def _end_velocity(
    time_s: FloatArray,
    en_m: FloatArray,
    covariance_m2: FloatArray,
    from_end_s: FloatArray,
    window_s: float,
) -> _EndVelocity:
    """Slope of the least-squares line through the measurements of the last window."""
    near = from_end_s <= window_s
    if np.ptp(time_s[near]) <= 0.0:
        others = from_end_s[~near]
        if not others.size:
            return _EndVelocity(np.zeros(2), _UNKNOWN_SPEED_MPS**2 * np.eye(2))
        near = from_end_s <= others.min()
    lever = time_s[near] - time_s[near].mean()
    lever /= lever @ lever
    return _EndVelocity(lever @ en_m[near], (lever**2 @ covariance_m2[near]).reshape(2, 2))


@dataclass(frozen=True, eq=False)
class _Average:
    """Moving average at the distinct times of the measurements."""

    time_s: FloatArray
    en_m: FloatArray
    covariance_m2: FloatArray
    velocity_covariance_m2ps2: FloatArray
    start: _EndVelocity
    stop: _EndVelocity

    def at(
        self, time_s: FloatArray, degree: int
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Position and velocity with their covariances, at times (M,)."""
        inner = np.clip(time_s, self.time_s[0], self.time_s[-1])
        position = np.repeat(self.en_m[:1], time_s.size, axis=0)
        velocity = np.repeat(self.start.velocity_mps[None, :], time_s.size, axis=0)
        if self.time_s.size > 1:
            spline = make_interp_spline(self.time_s, self.en_m, k=min(degree, self.time_s.size - 1))
            position, velocity = spline(inner), spline(inner, 1)
        covariance = self._between(self.covariance_m2, inner)
        velocity_covariance = self._between(self.velocity_covariance_m2ps2, inner)
        for end, beyond in ((self.start, time_s < inner), (self.stop, time_s > inner)):
            lag = (time_s - inner)[beyond]
            position[beyond] += lag[:, None] * end.velocity_mps
            velocity[beyond] = end.velocity_mps
            covariance[beyond] += lag[:, None, None] ** 2 * end.covariance_m2ps2
            velocity_covariance[beyond] = end.covariance_m2ps2
        return position, velocity, covariance, velocity_covariance

    def _between(self, matrices: FloatArray, time_s: FloatArray) -> FloatArray:
        flat = matrices.reshape(-1, 4).T
        columns = [np.interp(time_s, self.time_s, column) for column in flat]
        return np.stack(columns, axis=1).reshape(-1, 2, 2)
