"""Tracks on a common time base: states at whole multiples of an interval."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sightline.types import BoolArray, FloatArray, IntArray, PointKind, Track

LARGEST_GAP_S = 5.0
"""Between points that are further apart a camera has not seen its target."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A track, or a part of one, of one camera on the common time base.

    Attributes:
        camera: Index of the camera.
        track: Index of its track among all of all cameras.
        first: Index of its first moment on the time base.
        place_m: (N, 2) float64, east and north, one row a moment; NaN where the camera has not
            seen the target.
        velocity_mps: (N, 2) float64.
        covariance_m2: (N, 2, 2) float64, of the place.
        velocity_covariance: (N, 2, 2) float64, m²/s².
        kind: (N,) int8, a `PointKind` a row.
        moored: (N,) bool.
        mmsi: Of the vessel, where the track has one.
        name: Of the vessel, or ``""``.
        label: Its class, or ``""``.
        untold: As of `Track`.
    """

    camera: int
    track: int
    first: int
    place_m: FloatArray
    velocity_mps: FloatArray
    covariance_m2: FloatArray
    velocity_covariance: FloatArray
    kind: np.ndarray
    moored: BoolArray
    mmsi: int | None = None
    name: str = ""
    label: str = ""
    untold: bool = False

    def __len__(self) -> int:
        return len(self.place_m)

    @property
    def last(self) -> int:
        """Index of its last moment."""
        return self.first + len(self) - 1

    @property
    def known(self) -> BoolArray:
        """(N,) whether the camera sees the target."""
        return np.asarray(np.isfinite(self.place_m[:, 0]))

    def part(self, first: int, last: int) -> Piece:
        """From one moment of the time base to another, both included."""
        rows = slice(first - self.first, last - self.first + 1)
        columns = ("place_m", "velocity_mps", "covariance_m2", "velocity_covariance")
        return replace(
            self,
            first=first,
            **{name: getattr(self, name)[rows] for name in (*columns, "kind", "moored")},
        )


def resampled(
    track: Track, camera: int, number: int, start_utc_s: float, interval_s: float
) -> Piece | None:
    """A track on the time base; None where it is too short for a single moment.

    Places between two points are those of the cubic that has their velocities (Hermite), and
    covariances change linearly from one to the other.

    Args:
        track: With covariances.
        camera: Index of its camera.
        number: Index of the track.
        start_utc_s: Moment 0 of the time base.
        interval_s: Between two moments.
    """
    known = np.isfinite(track.covariance_m2).all(axis=(1, 2))
    rows = np.flatnonzero(known)
    if not rows.size:
        return None
    times = track.time_utc_s[rows]
    first = int(np.ceil((times[0] - start_utc_s) / interval_s - 1e-6))
    last = int(np.floor((times[-1] - start_utc_s) / interval_s + 1e-6))
    if last < first:
        return None
    at = start_utc_s + interval_s * np.arange(first, last + 1)
    right = np.clip(np.searchsorted(times, at), min(1, times.size - 1), times.size - 1)
    left = np.maximum(right - 1, 0)
    span = np.maximum(times[right] - times[left], 1e-9)
    u = np.clip((at - times[left]) / span, 0.0, 1.0)
    near = np.where(u < 0.5, left, right)
    place = np.stack([track.east_m, track.north_m], axis=1)[rows]
    velocity = np.stack([track.velocity_east_mps, track.velocity_north_mps], axis=1)[rows]
    v = u[:, None]
    chord = place[right] - place[left]
    bend = velocity[left] * span[:, None] - chord
    twist = chord - velocity[right] * span[:, None]
    between = place[left] + v * chord + v * (1.0 - v) * ((1.0 - v) * bend + v * twist)
    between[span > LARGEST_GAP_S] = np.nan
    on_a_point = (np.abs(u) < 1e-6) | (np.abs(u - 1.0) < 1e-6)
    between[on_a_point] = place[near[on_a_point]]
    if not np.isfinite(between).any():
        return None
    return Piece(
        camera=camera,
        track=number,
        first=first,
        place_m=between,
        velocity_mps=(1.0 - v) * velocity[left] + v * velocity[right],
        covariance_m2=_mixed(track.covariance_m2[rows], left, right, u),
        velocity_covariance=_mixed(track.velocity_covariance_m2ps2[rows], left, right, u),
        kind=track.kind[rows][near],
        moored=np.asarray(track.moored)[rows][near],
        mmsi=track.mmsi,
        name=track.name,
        label=track.label,
        untold=track.untold,
    )


def _mixed(
    covariance: FloatArray, left: IntArray, right: IntArray, share: FloatArray
) -> FloatArray:
    part = share[:, None, None]
    return np.asarray((1.0 - part) * covariance[left] + part * covariance[right])


def kinds_of(stack: np.ndarray, known: BoolArray) -> np.ndarray:
    """(N,) the best kind of (N, K) points: measured before interpolated before extrapolated."""
    best = np.where(known, stack, int(PointKind.EXTRAPOLATED)).min(axis=1)
    return np.asarray(best, dtype=np.int8)
