r"""Measurements along and across the line of sight, with the noise of the range predicted.

The camera stands at the origin of the plane. A measurement's axes are the direction in which it
was seen and the one to the left of it; its bearing is good, its range less so, and both the more
so the nearer the target.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pandas as pd

from sightline.trajectory.base import Measurements
from sightline.trajectory.chain import Nodes
from sightline.types import BoolArray, FloatArray

_LARGEST_POWER = 3.0
_REACH_SIGMAS = 5.0
_REACH = 0.05
_NEAREST_M = 1e-3
_MEDIAN_ABS_NORMAL = 0.6745


class Reference(Protocol):
    """A path about which measurements are linearised."""

    def position_at(self, time_s: FloatArray) -> FloatArray:
        """East and north (M, 2), metres, at times (M,)."""
        ...


@dataclass(frozen=True, eq=False)
class RobustStart:
    """A path through running medians, which no single outlier moves.

    Attributes:
        time_s: (N,) float64.
        en_m: (N, 2) float64.
    """

    time_s: FloatArray
    en_m: FloatArray

    @classmethod
    def of(
        cls, time_s: FloatArray, en_m: FloatArray, window_s: float = 2.0, at_least: int = 5
    ) -> RobustStart:
        """Medians over a window of time, or of a number of neighbours where it holds fewer.

        Args:
            time_s: (N,) rising.
            en_m: (N, 2).
            window_s: Width of the window.
            at_least: Number of neighbours.
        """
        # Medians depend on the axes: along and across the mean direction, they turn with the plane.
        axes = _sight(en_m.mean(axis=0, keepdims=True))[1][0]
        table = pd.DataFrame(en_m @ axes.T, index=pd.to_timedelta(time_s, unit="s"))
        near = table.rolling(pd.Timedelta(seconds=window_s), center=True)
        half = 0.5 * window_s
        count = np.searchsorted(time_s, time_s + half) - np.searchsorted(time_s, time_s - half)
        enough = (count >= at_least)[:, None]
        few = table.reset_index(drop=True).rolling(at_least, center=True, min_periods=1).median()
        return cls(time_s, np.where(enough, near.median().to_numpy(), few.to_numpy()) @ axes)

    def position_at(self, time_s: FloatArray) -> FloatArray:
        """See `Reference`."""
        return np.stack([np.interp(time_s, self.time_s, column) for column in self.en_m.T], axis=1)


@dataclass(frozen=True, eq=False)
class NoiseAtRange:
    """Measurements, and how their noise grows with range.

    Attributes:
        en_m: (N, 2) float64, measured, east and north.
        stated_m2: (N, 2, 2) float64, covariance as stated, east and north.
        range_m: (N,) float64, measured.
        axes: (N, 2, 2) float64, rows along and across the direction measured.
        covariance_m2: (N, 2, 2) float64, as stated, in these axes.
        powers: (2,) float64, of the range, to which the standard deviations along and across
            grow, fitted to what is stated; None where the covariance is the same everywhere.
    """

    en_m: FloatArray
    stated_m2: FloatArray
    range_m: FloatArray
    axes: FloatArray
    covariance_m2: FloatArray
    powers: FloatArray | None

    @classmethod
    def of(cls, measured: Measurements) -> NoiseAtRange:
        """Reads from the covariances how the noise grows."""
        range_m, axes = _sight(measured.en_m)
        stated = measured.covariance_m2
        covariance = axes @ stated @ np.swapaxes(axes, 1, 2)
        powers = None
        if not np.allclose(stated, stated[0], rtol=1e-6, atol=0.0):
            log_range = np.log(range_m)
            log_sigma = 0.5 * np.log(np.diagonal(covariance, axis1=1, axis2=2))
            spread = log_range - log_range.mean()
            # Where all ranges are the same the power does not matter: a camera's, weakly held.
            expected, weight = np.array([2.0, 1.0]), 1e-6
            powers = (spread @ log_sigma + weight * expected) / (spread @ spread + weight)
            powers = np.clip(powers, 0.0, _LARGEST_POWER)
        return cls(measured.en_m, stated, range_m, axes, covariance, powers)

    def linearised(self, reference_m: FloatArray) -> Linearised:
        """The measurements as linear ones, about a path.

        In polar form the bearing is that of the path and not the one measured: in the measured
        direction every measurement across the line of sight would agree with a target that
        stands still at the camera.

        Args:
            reference_m: (N, 2) where the target is taken to have been at their times.
        """
        at, axes = _sight(reference_m)
        if self.powers is None:
            return Linearised(
                measured_m=np.einsum("nij,nj->ni", axes, self.en_m),
                axes=axes,
                covariance_m2=axes @ self.stated_m2 @ np.swapaxes(axes, 1, 2),
                reference_m=reference_m,
            )
        # Far from a measurement, and more so on the other side of the camera, its equation is
        # nothing like a straight line: go from the measurement towards the path, not all the way.
        sigma = np.sqrt(np.diagonal(self.covariance_m2, axis1=1, axis2=2)) / self.range_m[:, None]
        reach = _REACH_SIGMAS * sigma + _REACH
        along, across = np.einsum("nij,nj->in", self.axes, reference_m)
        bearing = np.clip(np.arctan2(across, along), -reach[:, 1], reach[:, 1])
        ratio = np.clip(np.log(self.range_m / at), -reach[:, 0], reach[:, 0])
        at = self.range_m * np.exp(-ratio)
        cosine, sine = np.cos(bearing), np.sin(bearing)
        turn = np.stack([cosine, sine, -sine, cosine], axis=1).reshape(-1, 2, 2)
        p = self.powers[0]
        # z(range) - z(at), times dr/dz at the reference: metres again, with the noise there.
        shift = at * (np.expm1((1.0 - p) * ratio) / (1.0 - p) if abs(1.0 - p) > 1e-9 else ratio)
        scale = np.exp(-ratio[:, None] * self.powers)
        return Linearised(
            measured_m=np.stack([at + shift, -at * bearing], axis=1),
            axes=turn @ self.axes,
            covariance_m2=self.covariance_m2 * scale[:, :, None] * scale[:, None, :],
            reference_m=reference_m,
        )

    def common_covariance(
        self, en_m: FloatArray, share_along: float, share_across: float
    ) -> FloatArray:
        """Covariance (M, 2, 2), east and north, of a share of what is stated, at places (M, 2)."""
        if share_along == 0.0 and share_across == 0.0:
            return np.zeros((en_m.shape[0], 2, 2))
        shares = np.sqrt([share_along, share_across])
        range_m, axes = _sight(en_m)
        if self.powers is None:
            covariance = axes @ self.stated_m2[0] @ np.swapaxes(axes, 1, 2)
        else:
            sigma = np.sqrt(np.diagonal(self.covariance_m2, axis1=1, axis2=2))
            typical = np.median(sigma / self.range_m[:, None] ** self.powers, axis=0)
            covariance = (typical * range_m[:, None] ** self.powers)[:, :, None] ** 2 * np.eye(2)
        covariance = covariance * shares[:, None] * shares
        out: FloatArray = np.swapaxes(axes, 1, 2) @ covariance @ axes
        return out


def determinant(matrices: FloatArray) -> FloatArray:
    """(N,) of (N, 2, 2)."""
    out: FloatArray = matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0]
    return out


def inverse(matrices: FloatArray) -> FloatArray:
    """(N, 2, 2) of (N, 2, 2): written out, many times faster than the general routine."""
    out = np.empty_like(matrices)
    out[:, 0, 0], out[:, 1, 1] = matrices[:, 1, 1], matrices[:, 0, 0]
    out[:, 0, 1], out[:, 1, 0] = -matrices[:, 0, 1], -matrices[:, 1, 0]
    out /= determinant(matrices)[:, None, None]
    return out


def _sight(en_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ranges (N,) and axes (N, 2, 2), rows along and across, of the directions to places (N, 2)."""
    range_m = np.maximum(np.hypot(*en_m.T), _NEAREST_M)
    bearing = np.arctan2(en_m[:, 0], en_m[:, 1])
    sine, cosine = np.sin(bearing), np.cos(bearing)
    axes = np.stack([sine, cosine, -cosine, sine], axis=1).reshape(-1, 2, 2)
    return range_m, axes


@dataclass(frozen=True, eq=False)
class Linearised:
    """Linear measurements about a path.

    Attributes:
        measured_m: (N, 2) float64, along and across.
        axes: (N, 2, 2) float64.
        covariance_m2: (N, 2, 2) float64, in the axes.
        reference_m: (N, 2) float64, the path, east and north.
    """

    measured_m: FloatArray
    axes: FloatArray
    covariance_m2: FloatArray
    reference_m: FloatArray

    def residual(self, en_m: FloatArray) -> FloatArray:
        """(N, 2) measured less where the target is taken to be, along and across."""
        out: FloatArray = self.measured_m - np.einsum("nij,nj->ni", self.axes, en_m)
        return out

    def start_gate(self, gate: float) -> BoolArray:
        """Which measurements lie near the path, by the scatter of all of them about it.

        Args:
            gate: Of the squared distance in units of that scatter, or of the stated covariance
                where that is larger.
        """
        sigma = np.sqrt(np.diagonal(self.covariance_m2, axis1=1, axis2=2))
        distance = np.abs(self.residual(self.reference_m)) / sigma
        distance /= np.maximum(1.0, np.median(distance, axis=0) / _MEDIAN_ABS_NORMAL)
        near: BoolArray = (distance**2).sum(axis=1) <= 2.0 * gate
        return near

    def nodes(
        self, time_s: FloatArray, used: BoolArray, reference: Reference, resolution_s: float
    ) -> Nodes:
        """The used measurements, those within a stretch of time as one: their weighted mean.

        Args:
            time_s: (N,) rising.
            used: (N,) which ones.
            reference: The path that they were linearised about; its motion within a stretch is
                taken out before the mean.
            resolution_s: Length of a stretch.
        """
        t = time_s[used]
        cell = np.floor(t / resolution_s)
        first = np.flatnonzero(np.concatenate([[True], np.diff(cell) > 0.0]))
        count = np.diff(np.append(first, t.size)).astype(np.float64)
        node_s = np.add.reduceat(t, first) / count

        axes = self.axes[used]
        information = np.swapaxes(axes, 1, 2) @ inverse(self.covariance_m2[used]) @ axes
        offset = np.einsum("nji,nj->ni", axes, self.residual(self.reference_m)[used])
        weighted = np.einsum("nij,nj->ni", information, offset)
        mean_covariance = inverse(np.add.reduceat(information, first))
        mean_offset = np.einsum("nij,nj->ni", mean_covariance, np.add.reduceat(weighted, first))
        node_axes = _sight(np.add.reduceat(axes[:, 0], first))[1]
        position = reference.position_at(node_s) + mean_offset
        single = node_axes @ mean_covariance @ np.swapaxes(node_axes, 1, 2)
        root_m = np.linalg.cholesky(single * count[:, None, None])
        return Nodes(
            time_s=node_s,
            measured_m=np.einsum("nij,nj->ni", node_axes, position),
            axes=node_axes,
            root_m=np.asarray(root_m, dtype=np.float64),
            count=count,
            agility=np.ones(count.size + 1),
        )
