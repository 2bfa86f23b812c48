r"""Measurements along and across the line of sight, with noise at the predicted range.

The camera stands at the origin of the plane. A measurement's axes are the direction in which it
was seen and the one to the left of it; its bearing is good, its range less so, and both the more
so the nearer the target.

Symmetric 2 x 2 matrices are three rows here, ``(3, N)``: first variance, covariance, second
variance. Written out by component, the algebra of a track's thousands of small matrices takes a
fraction of the time that stacks of matrices take.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sightline.trajectory.base import Measurements
from sightline.trajectory.gauss_markov_chain import Nodes
from sightline.types import BoolArray, FloatArray, IntArray

_LARGEST_POWER = 3.0
_REACH_SIGMAS = 5.0
_REACH = 0.05
_NEAREST_M = 1e-3
_MEDIAN_ABS_NORMAL = 0.6745
_MEDIAN_OF = 25
"""A running median is of at most so many measurements, evenly spread over its window."""


class Reference(Protocol):
    """Path about which measurements are linearised."""

    def position_at(self, time_s: FloatArray) -> FloatArray:
        """East and north (M, 2), metres, at times (M,)."""
        ...


@dataclass(frozen=True, eq=False)
class RobustStart:
    """Initial path through running medians, robust to single outliers.

    Attributes:
        time_s: (K,) float64.
        en_m: (K, 2) float64.
    """

    time_s: FloatArray
    en_m: FloatArray

    @classmethod
    def of(
        cls, time_s: FloatArray, en_m: FloatArray, window_s: float = 2.0, at_least: int = 5
    ) -> RobustStart:
        """Running medians over a time window, or over a number of neighbours where it holds fewer.

        Args:
            time_s: (N,) rising.
            en_m: (N, 2).
            window_s: Width of the window; there are some seven medians in one.
            at_least: Number of neighbours.
        """
        # Medians depend on the axes: along and across the mean direction, they turn with the plane.
        _, sine, cosine = _line_of_sight(*en_m.mean(axis=0, keepdims=True).T)
        turn = np.array([[sine[0], cosine[0]], [-cosine[0], sine[0]]])
        middle = _firsts(np.floor(time_s / (0.15 * window_s)))
        first, stop = np.searchsorted(
            time_s, time_s[middle] + 0.5 * window_s * np.array([[-1.0], [1.0]])
        )
        few = stop - first < at_least
        first = np.where(few, np.maximum(middle - at_least // 2, 0), first)
        stop = np.where(few, np.minimum(middle + at_least // 2 + 1, time_s.size), stop)
        count = np.minimum(stop - first, _MEDIAN_OF)
        member = np.arange(int(count.max()))[:, None]
        chosen = first + member * (stop - first) // count
        values = (turn @ en_m.T)[:, np.minimum(chosen, time_s.size - 1)]
        values[:, member >= count] = np.inf
        values.sort(axis=1)
        column = np.arange(middle.size)
        medians = 0.5 * (values[:, (count - 1) // 2, column] + values[:, count // 2, column])
        return cls(time_s[middle], medians.T @ turn)

    def position_at(self, time_s: FloatArray) -> FloatArray:
        """See `Reference`."""
        return np.stack([np.interp(time_s, self.time_s, column) for column in self.en_m.T]).T


@dataclass(frozen=True, eq=False)
class NoiseAtRange:
    """Measurements, with their noise as a power of the range.

    Attributes:
        en_m: (2, N) float64, measured, east and north.
        stated_m2: (3, N) float64, covariance as stated, east and north.
        range_m: (N,) float64, measured.
        sine: (N,) float64, of the bearing measured.
        cosine: (N,) float64, of the bearing measured.
        covariance_m2: (3, N) float64, as stated, along and across the direction measured.
        relative: (2, N) float64, standard deviations along and across, of the range.
        powers: (2,) float64, of the range, to which the standard deviations along and across
            grow, fitted to what is stated; None where the covariance is the same everywhere.
    """

    en_m: FloatArray
    stated_m2: FloatArray
    range_m: FloatArray
    sine: FloatArray
    cosine: FloatArray
    covariance_m2: FloatArray
    relative: FloatArray
    powers: FloatArray | None

    @classmethod
    def of(cls, measured: Measurements) -> NoiseAtRange:
        """Fit the growth of the noise with range to the stated covariances."""
        en_m = np.ascontiguousarray(measured.en_m.T)
        range_m, sine, cosine = _line_of_sight(*en_m)
        stated = np.stack([measured.covariance_m2[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1))])
        covariance = _turned(stated, sine, cosine)
        sigma = np.sqrt(covariance[::2])
        powers = None
        if not np.allclose(stated.T, stated[:, 0], rtol=1e-6, atol=0.0):
            log_range = np.log(range_m)
            spread = log_range - log_range.mean()
            # Where all ranges are the same the power does not matter: a camera's, weakly held.
            expected, weight = np.array([2.0, 1.0]), 1e-6
            powers = (np.log(sigma) @ spread + weight * expected) / (spread @ spread + weight)
            powers = np.clip(powers, 0.0, _LARGEST_POWER)
        return cls(en_m, stated, range_m, sine, cosine, covariance, sigma / range_m, powers)

    def linearised(self, reference_m: FloatArray) -> Linearised:
        """Linearise the measurements about a path.

        In polar form the bearing is that of the path and not the one measured: in the measured
        direction every measurement across the line of sight would agree with a target that
        stands still at the camera.

        Args:
            reference_m: (N, 2) where the target is taken to have been at their times.
        """
        east, north = reference_m.T
        if self.powers is None:
            _, sine, cosine = _line_of_sight(east, north)
            measured = _along_across(self.en_m[0], self.en_m[1], sine, cosine)
            return Linearised(
                measured_m=np.stack(measured),
                sine=sine,
                cosine=cosine,
                covariance_m2=_turned(self.stated_m2, sine, cosine),
                reference_m=reference_m,
            )
        # Far from a measurement, and more so on the other side of the camera, its equation is
        # nothing like a straight line: go from the measurement towards the path, not all the way.
        reach = _REACH_SIGMAS * self.relative + _REACH
        along, across = _along_across(east, north, self.sine, self.cosine)
        bearing = np.minimum(np.maximum(np.arctan2(across, along), -reach[1]), reach[1])
        ratio = np.log(self.range_m / _range(east, north))
        ratio = np.minimum(np.maximum(ratio, -reach[0]), reach[0])
        nearer = np.exp(-ratio)
        at = self.range_m * nearer
        turn_cosine, turn_sine = np.cos(bearing), np.sin(bearing)
        p, q = self.powers
        # z(range) - z(at), times dr/dz at the reference: metres again, with the noise there.
        shift = at * (np.expm1((1.0 - p) * ratio) / (1.0 - p) if abs(1.0 - p) > 1e-9 else ratio)
        scale_along, scale_across = nearer**p, nearer**q
        covariance = self.covariance_m2 * [
            scale_along * scale_along,
            scale_along * scale_across,
            scale_across * scale_across,
        ]
        return Linearised(
            measured_m=np.stack([at + shift, -at * bearing]),
            sine=turn_cosine * self.sine - turn_sine * self.cosine,
            cosine=turn_cosine * self.cosine + turn_sine * self.sine,
            covariance_m2=covariance,
            reference_m=reference_m,
        )

    def common_covariance(
        self, en_m: FloatArray, share_along: float, share_across: float
    ) -> FloatArray:
        """(M, 2, 2) common covariance, east and north, of a share of the stated one."""
        out = np.zeros((2, 2, en_m.shape[0]))
        if share_along > 0.0 or share_across > 0.0:
            range_m, sine, cosine = _line_of_sight(*en_m.T)
            if self.powers is None:
                along, mixed, across = _turned(self.stated_m2[:, :1], sine, cosine)
            else:
                typical = np.median(self.relative * self.range_m ** (1.0 - self.powers[:, None]), 1)
                along, across = (typical[:, None] * range_m ** self.powers[:, None]) ** 2
                mixed = np.zeros_like(along)
            mixed = mixed * np.sqrt(share_along * share_across)
            common = np.stack([along * share_along, mixed, across * share_across])
            out[0, 0], out[0, 1], out[1, 1] = _turned_back(common, sine, cosine)
            out[1, 0] = out[0, 1]
        return out.transpose(2, 0, 1)


def _range(east_m: FloatArray, north_m: FloatArray) -> FloatArray:
    out: FloatArray = np.maximum(np.sqrt(east_m * east_m + north_m * north_m), _NEAREST_M)
    return out


def _line_of_sight(
    east_m: FloatArray, north_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Ranges, and sines and cosines of the bearings, three (N,), of places."""
    length = np.sqrt(east_m * east_m + north_m * north_m)
    here = length < 1e-150
    if here.any():
        # At the camera itself: as if it were to the north.
        east_m, north_m, length = (
            np.where(here, value, column)
            for value, column in ((0.0, east_m), (1.0, north_m), (1.0, length))
        )
        return np.where(here, _NEAREST_M, length), east_m / length, north_m / length
    return np.maximum(length, _NEAREST_M), east_m / length, north_m / length


def _along_across(
    east: FloatArray, north: FloatArray, sine: FloatArray, cosine: FloatArray
) -> tuple[FloatArray, FloatArray]:
    return sine * east + cosine * north, sine * north - cosine * east


def _turned(matrices: FloatArray, sine: FloatArray, cosine: FloatArray) -> FloatArray:
    """Rotate (3, N) matrices from east and north to along and across."""
    first, mixed, second = matrices
    ss, sc, cc = sine * sine, sine * cosine, cosine * cosine
    twice = 2.0 * sc * mixed
    return np.stack(
        [
            ss * first + twice + cc * second,
            sc * (second - first) + (ss - cc) * mixed,
            cc * first - twice + ss * second,
        ]
    )


def _turned_back(matrices: FloatArray, sine: FloatArray, cosine: FloatArray) -> FloatArray:
    """Rotate (3, N) matrices from along and across to east and north."""
    return _turned(matrices, sine, -cosine)


def _inverse(matrices: FloatArray) -> FloatArray:
    first, mixed, second = matrices
    out = np.stack([second, -mixed, first])
    out /= first * second - mixed * mixed
    return out


def _firsts(cell: FloatArray) -> IntArray:
    """Indices of the first of each run of equal values in a rising array."""
    new = np.empty(cell.size, dtype=np.bool_)
    new[:1] = True
    np.greater(cell[1:], cell[:-1], out=new[1:])
    return np.flatnonzero(new)


@dataclass(frozen=True, eq=False)
class Linearised:
    """Measurements linearised about a path.

    Attributes:
        measured_m: (2, N) float64, along and across.
        sine: (N,) float64, of the bearing of the axes.
        cosine: (N,) float64, of the bearing of the axes.
        covariance_m2: (3, N) float64, in the axes.
        reference_m: (N, 2) float64, the path, east and north.
    """

    measured_m: FloatArray
    sine: FloatArray
    cosine: FloatArray
    covariance_m2: FloatArray
    reference_m: FloatArray

    def residual(self, en_m: FloatArray) -> FloatArray:
        """(2, N) residuals, measurement less position (N, 2), along and across."""
        expected = _along_across(en_m[:, 0], en_m[:, 1], self.sine, self.cosine)
        return self.measured_m - np.stack(expected)

    def start_gate(self, gate: float) -> BoolArray:
        """Gate measurements about the initial path, by the scatter of all of them.

        Args:
            gate: Of the squared distance in units of that scatter, or of the stated covariance
                where that is larger.
        """
        distance2 = self.residual(self.reference_m) ** 2 / self.covariance_m2[::2]
        scatter = np.sqrt(np.median(distance2, axis=1)) / _MEDIAN_ABS_NORMAL
        distance2 /= np.maximum(1.0, scatter[:, None]) ** 2
        near: BoolArray = distance2.sum(axis=0) <= 2.0 * gate
        return near

    def squared_distance(
        self, en_m: FloatArray, fitted_m2: FloatArray, share: FloatArray, used: BoolArray
    ) -> FloatArray:
        """(N,) squared Mahalanobis distances from a fitted path.

        The residual of a generalised least-squares fit has the covariance of the noise less that
        of the fit; a measurement that was left out has their sum.

        Args:
            en_m: (N, 2) the path at the measurements' times.
            fitted_m2: (3, N) its covariance, east and north.
            share: (2,) of the stated standard deviations that the noise has, along and across.
            used: (N,) which measurements the path was fitted to.
        """
        r, s = self.residual(en_m)
        a, b, c = self.covariance_m2 * [[share[0] ** 2], [share[0] * share[1]], [share[1] ** 2]]
        e, f, g = _turned(fitted_m2, self.sine, self.cosine)
        determinant = a * c - b * b
        # The fit of a used measurement is smaller than its noise; for those that share a node that
        # is only nearly so, and they are held to it: by the largest eigenvalue of noise⁻¹ fit.
        half = 0.5 * (c * e - 2.0 * b * f + a * g) / determinant
        lower = (e * g - f * f) / determinant
        largest = half + np.sqrt(np.maximum(half * half - lower, 0.0))
        sign = np.where(used, -np.minimum(1.0, 0.95 / np.maximum(largest, 1e-9)), 1.0)
        a, b, c = a + sign * e, b + sign * f, c + sign * g
        out: FloatArray = (c * r * r - 2.0 * b * r * s + a * s * s) / (a * c - b * b)
        return out

    def nodes(
        self, time_s: FloatArray, used: BoolArray, reference: Reference, resolution_s: float
    ) -> Nodes:
        """Average the used measurements within each time step to nodes, weighted by precision.

        Args:
            time_s: (N,) rising.
            used: (N,) which ones.
            reference: The path that they were linearised about; its motion within a stretch is
                taken out before the mean.
            resolution_s: Length of a stretch.
        """
        chosen = slice(None) if used.all() else used
        t = time_s[chosen]
        first = _firsts(np.floor(t / resolution_s))
        count = np.diff(np.append(first, t.size)).astype(np.float64)

        sine, cosine = self.sine[chosen], self.cosine[chosen]
        along, across = self.residual(self.reference_m)[:, chosen]
        rows = np.empty((8, t.size))
        rows[0] = t
        rows[1:4] = _turned_back(_inverse(self.covariance_m2[:, chosen]), sine, cosine)
        east, north = sine * along - cosine * across, cosine * along + sine * across
        rows[4] = rows[1] * east + rows[2] * north
        rows[5] = rows[2] * east + rows[3] * north
        rows[6], rows[7] = sine, cosine
        sums = np.add.reduceat(rows, first, axis=1)
        node_s = sums[0] / count
        mean = _inverse(sums[1:4])
        _, sine, cosine = _line_of_sight(sums[6], sums[7])
        at = reference.position_at(node_s)
        east = at[:, 0] + mean[0] * sums[4] + mean[1] * sums[5]
        north = at[:, 1] + mean[1] * sums[4] + mean[2] * sums[5]

        first_m2, mixed_m2, second_m2 = _turned(mean, sine, cosine) * count
        root = np.zeros((2, 2, count.size))
        root[0, 0] = np.sqrt(first_m2)
        root[1, 0] = mixed_m2 / root[0, 0]
        root[1, 1] = np.sqrt(second_m2 - root[1, 0] ** 2)
        axes = np.empty((2, 2, count.size))
        axes[0, 0], axes[0, 1], axes[1, 0], axes[1, 1] = sine, cosine, -cosine, sine
        return Nodes(
            time_s=node_s,
            measured_m=np.stack(_along_across(east, north, sine, cosine)).T,
            axes=axes.transpose(2, 0, 1),
            root_m=root.transpose(2, 0, 1),
            count=count,
            process_noise_scale=np.ones(count.size + 1),
        )
