"""Lines and zones in metres: on which side of them places are, and how far."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from sightline.area import Area, Line
from sightline.geodesy import LocalPlane
from sightline.types import BoolArray, FloatArray

_CHUNK = 1_000_000
_LEAST_STEP_M = 0.1


@dataclass(frozen=True, eq=False)
class Sides:
    """Where places lie beside a boundary.

    Attributes:
        distance_m: (N,) metres; positive on its right side, or inside.
        normal: (N, 2) unit vectors east and north, along which the distance is measured.
        along_m: (N,) metres along a line from its first corner; beyond its ends outside of
            0 to its length. 0 for zones.
    """

    distance_m: FloatArray
    normal: FloatArray
    along_m: FloatArray


class Boundary(Protocol):
    """What a track can cross."""

    @property
    def name(self) -> str:
        """As its file names it."""
        ...

    @property
    def step_m(self) -> float:
        """The longest step of a path that cannot jump over a part of it."""
        ...

    @property
    def length_m(self) -> float:
        """Between its ends; infinite where it has none."""
        ...

    def sides(self, place_m: FloatArray) -> Sides:
        """Where (N, 2) places lie."""
        ...


@dataclass(frozen=True, eq=False)
class LineBoundary:
    """A line that tracks cross; it goes on straight beyond its ends, where nothing counts.

    Attributes:
        name: As its file names it.
        corners_m: (K, 2) metres east and north.
    """

    name: str
    corners_m: FloatArray

    @classmethod
    def of(cls, name: str, line: Line, plane: LocalPlane) -> LineBoundary:
        """A line on the earth, in a plane."""
        return cls(name, _in_plane(line.corners, plane))

    @cached_property
    def _lengths(self) -> FloatArray:
        return np.asarray(np.hypot(*np.diff(self.corners_m, axis=0).T))

    @property
    def length_m(self) -> float:
        """From its first corner to its last."""
        return float(self._lengths.sum())

    @property
    def step_m(self) -> float:
        """Infinite for a straight line, from which distances change evenly."""
        if len(self._lengths) == 1:
            return float("inf")
        return max(0.25 * float(self._lengths.min()), _LEAST_STEP_M)

    @property
    def right_deg(self) -> float:
        """Bearing across it from left to right, seen from its first corner to its last."""
        east, north = self.corners_m[-1] - self.corners_m[0]
        return float((np.degrees(np.arctan2(east, north)) + 90.0) % 360.0)

    def sides(self, place_m: FloatArray) -> Sides:
        """Where (N, 2) places lie; the right side is positive."""
        starts, steps, lengths = self.corners_m[:-1], np.diff(self.corners_m, axis=0), self._lengths
        before = np.r_[0.0, np.cumsum(lengths)[:-1]]
        least, most = np.zeros(len(lengths)), np.ones(len(lengths))
        least[0], most[-1] = -np.inf, np.inf
        tangent = steps / lengths[:, None]
        nearest, k, share = _nearest(place_m, starts, steps, least, most)
        # At a corner both pieces decide: the side of the nearer alone may be the wrong one.
        last = len(lengths) - 1
        other = np.where((share <= 0.0) & (k > 0), k - 1, np.where(share >= 1.0, k + 1, k))
        ahead = tangent[k] + tangent[np.minimum(other, last)]
        off = place_m - nearest
        distance = np.hypot(*off.T)
        side = np.where(ahead[:, 1] * off[:, 0] - ahead[:, 0] * off[:, 1] < 0.0, -1.0, 1.0)
        right = np.column_stack([tangent[k, 1], -tangent[k, 0]])
        apart = distance > 1e-9
        normal = np.where(apart[:, None], off / np.where(apart, distance, 1.0)[:, None], right)
        return Sides(side * distance, normal, before[k] + share * lengths[k])


@dataclass(frozen=True, eq=False)
class ZoneBoundary:
    """A zone that tracks enter and leave.

    Attributes:
        name: As its file names it.
        polygons_m: Of each polygon its rings, each (K, 2) metres east and north, not closed.
    """

    name: str
    polygons_m: tuple[tuple[FloatArray, ...], ...]

    @classmethod
    def of(cls, name: str, area: Area, plane: LocalPlane) -> ZoneBoundary:
        """A zone on the earth, in a plane."""
        return cls(
            name,
            tuple(
                tuple(_in_plane(ring, plane) for ring in polygon.rings) for polygon in area.polygons
            ),
        )

    @property
    def length_m(self) -> float:
        """Infinite: it has no ends."""
        return float("inf")

    @cached_property
    def step_m(self) -> float:
        """A sixteenth of the smallest polygon's width."""
        sizes = [np.ptp(polygon[0], axis=0).min() for polygon in self.polygons_m]
        return max(float(min(sizes)) / 16.0, _LEAST_STEP_M)

    def sides(self, place_m: FloatArray) -> Sides:
        """Where (N, 2) places lie; the inside is positive."""
        rings = [ring for polygon in self.polygons_m for ring in polygon]
        starts = np.concatenate(rings)
        steps = np.concatenate([np.roll(ring, -1, axis=0) - ring for ring in rings])
        kept = np.hypot(*steps.T) > 0.0
        starts, steps = starts[kept], steps[kept]
        zeros, ones = np.zeros(len(steps)), np.ones(len(steps))
        nearest, k, _ = _nearest(place_m, starts, steps, zeros, ones)
        off = place_m - nearest
        distance = np.hypot(*off.T)
        inside: BoolArray = np.zeros(len(place_m), dtype=bool)
        for polygon in self.polygons_m:
            within: BoolArray = np.zeros(len(place_m), dtype=bool)
            for ring in polygon:
                within ^= _within(place_m, ring)
            inside |= within
        apart = distance > 1e-9
        across = np.column_stack([steps[k, 1], -steps[k, 0]]) / np.hypot(*steps[k].T)[:, None]
        normal = np.where(apart[:, None], off / np.where(apart, distance, 1.0)[:, None], across)
        return Sides(np.where(inside, distance, -distance), normal, np.zeros(len(place_m)))


def _in_plane(corners: FloatArray, plane: LocalPlane) -> FloatArray:
    return np.column_stack(plane.to_plane(corners[:, 1], corners[:, 0]))


def _nearest(
    place_m: FloatArray, starts: FloatArray, steps: FloatArray, least: FloatArray, most: FloatArray
) -> tuple[FloatArray, np.ndarray[tuple[int, ...], np.dtype[np.intp]], FloatArray]:
    """The nearest point of any piece, which piece that is, and the share of it gone by."""
    squared = (steps**2).sum(axis=1)
    nearest = np.empty_like(place_m)
    piece = np.empty(len(place_m), dtype=np.intp)
    share = np.empty(len(place_m))
    size = max(_CHUNK // len(steps), 1)
    for begin in range(0, len(place_m), size):
        some = slice(begin, begin + size)
        off = place_m[some, None] - starts
        along = np.clip((off * steps).sum(axis=2) / squared, least, most)
        k = ((off - along[..., None] * steps) ** 2).sum(axis=2).argmin(axis=1)
        piece[some], share[some] = k, along[np.arange(len(k)), k]
        nearest[some] = starts[k] + share[some, None] * steps[k]
    return nearest, piece, share


def _within(place_m: FloatArray, ring: FloatArray) -> BoolArray:
    """Whether a ray to the east crosses a ring an odd number of times."""
    within: BoolArray = np.zeros(len(place_m), dtype=bool)
    x, y = place_m.T
    for (x1, y1), (x2, y2) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        if y1 != y2:
            across = (y1 > y) != (y2 > y)
            within ^= across & (x < x1 + (y - y1) * (x2 - x1) / (y2 - y1))
    return within
