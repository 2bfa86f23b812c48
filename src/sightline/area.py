"""Areas and lines on the earth, in latitude and longitude, also across 180 degrees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sightline.errors import InputError
from sightline.types import BoolArray, FloatArray

MOST_CORNERS = 200_000
"""Of all polygons together; what a coast has more can be left out of it unseen."""

_TURN_DEG = 360.0
_MOST_LINE_CORNERS = 10_000
_CHUNK = 2_000_000


@dataclass(frozen=True, eq=False)
class Polygon:
    """A polygon and its holes, its edges straight in longitude and latitude (RFC 7946).

    Attributes:
        rings: Each (N, 2) longitude and latitude, degrees: the outline, then the holes. The last
            corner is joined to the first; it may be the same. Where two neighbours are more than
            180 degrees apart, the edge goes the other way around the earth.

    Raises:
        InputError: A coordinate is none of the earth's, a ring has no area or goes around a pole,
            or edges cross.
    """

    rings: tuple[FloatArray, ...]

    def __post_init__(self) -> None:
        if not self.rings:
            raise InputError("a polygon has no outline")
        outline = _ring(self.rings[0], "its outline")
        rings = [outline]
        for number, given in enumerate(self.rings[1:], start=1):
            hole = _ring(given, f"its hole {number}")
            # On the same side of 180 degrees as what it is cut out of.
            turns = np.round((outline[:, 0].mean() - hole[:, 0].mean()) / _TURN_DEG)
            rings.append(hole + np.array([turns * _TURN_DEG, 0.0]))
        crossing = _crossing(rings)
        if crossing is not None:
            longitude, latitude = crossing
            longitude = (longitude + 180.0) % _TURN_DEG - 180.0
            raise InputError(
                f"its edges cross at longitude {longitude:.6f}, latitude {latitude:.6f}; draw it "
                "without a crossing"
            )
        for number, ring in enumerate(rings):
            if not _has_area(ring):
                raise InputError(f"its {f'hole {number}' if number else 'outline'} has no area")
        object.__setattr__(self, "rings", tuple(rings))

    def contains(self, latitude_deg: FloatArray, longitude_deg: FloatArray) -> BoolArray:
        """(N,) bool, whether places lie in it and in none of its holes."""
        low = min(float(ring[:, 0].min()) for ring in self.rings)
        x = (longitude_deg - low) % _TURN_DEG + low
        inside: BoolArray = np.zeros(x.shape, dtype=bool)
        for ring in self.rings:
            inside ^= _inside(ring, x, latitude_deg)
        return inside


@dataclass(frozen=True, eq=False)
class Area:
    """Where targets can be: in any of some polygons.

    Attributes:
        polygons: At least one.
        where: The files that it comes from, for messages.
    """

    polygons: tuple[Polygon, ...]
    where: str = "the area"

    def contains(self, latitude_deg: ArrayLike, longitude_deg: ArrayLike) -> BoolArray:
        """(N,) bool, whether places lie in the area; those that are not known (NaN) do not.

        Args:
            latitude_deg: (N,) degrees north.
            longitude_deg: (N,) degrees east.
        """
        latitude = np.asarray(latitude_deg, dtype=np.float64)
        longitude = np.asarray(longitude_deg, dtype=np.float64)
        inside: BoolArray = np.zeros(latitude.shape, dtype=bool)
        known = np.isfinite(latitude) & np.isfinite(longitude)
        for polygon in self.polygons:
            inside[known] |= polygon.contains(latitude[known], longitude[known])
        return inside


@dataclass(frozen=True, eq=False)
class Line:
    """A line of straight pieces that neither crosses nor touches itself.

    Attributes:
        corners: (N, 2) longitude and latitude, degrees, from its first corner to its last. Where
            two neighbours are more than 180 degrees apart, it goes the other way around the earth.

    Raises:
        InputError: A coordinate is none of the earth's, there are fewer than two corners, the line
            is closed, or it crosses or touches itself.
    """

    corners: FloatArray

    def __post_init__(self) -> None:
        given = np.asarray(self.corners, dtype=np.float64)
        _check_corners(given, "it")
        if len(given) > _MOST_LINE_CORNERS:
            raise InputError(f"it has more than {_MOST_LINE_CORNERS} corners; simplify it")
        moved = np.r_[True, (np.diff(given, axis=0) != 0.0).any(axis=1)]
        corners = given[moved]
        if len(corners) < 2:
            raise InputError("it has fewer than two corners that differ")
        step = np.diff(corners[:, 0])
        turns = np.where(np.abs(step) > 0.5 * _TURN_DEG, np.sign(step) * _TURN_DEG, 0.0)
        corners = np.column_stack([corners[:, 0] - np.r_[0.0, np.cumsum(turns)], corners[:, 1]])
        if (corners[0] == corners[-1]).all():
            raise InputError("it is closed; draw a zone, or leave it open")
        at = _touching(corners)
        if at is not None:
            longitude = (corners[at, 0] + 180.0) % _TURN_DEG - 180.0
            raise InputError(
                f"it crosses or touches itself after the corner at longitude {longitude:.6f}, "
                f"latitude {corners[at, 1]:.6f}; draw it without that"
            )
        object.__setattr__(self, "corners", corners)


def _touching(corners: FloatArray) -> int | None:
    """Number of the first piece that meets another one elsewhere than at their common corner."""
    first, second = corners[:-1], corners[1:]
    ahead = second - first
    back = (ahead[:-1] * ahead[1:]).sum(axis=1) < 0.0
    back &= ahead[:-1, 0] * ahead[1:, 1] == ahead[:-1, 1] * ahead[1:, 0]
    low, high = np.minimum(first, second), np.maximum(first, second)
    for i in range(len(first)):
        if i < len(back) and back[i]:
            return i
        rest = slice(i + 2, None)
        near = (low[rest] <= high[i]).all(axis=1) & (high[rest] >= low[i]).all(axis=1)
        a, b, c, d = first[i], second[i], first[rest][near], second[rest][near]
        meets = np.sign(_side(a, b, c)) * np.sign(_side(a, b, d)) <= 0.0
        meets &= np.sign(_side(c, d, a)) * np.sign(_side(c, d, b)) <= 0.0
        if meets.any():
            return i
    return None


def _check_corners(given: FloatArray, what: str) -> None:
    """Raise InputError for corners that are no places on the earth."""
    if given.ndim != 2 or given.shape[1] != 2 or not np.isfinite(given).all():
        raise InputError(f"{what} has a corner that is no longitude and latitude")
    outside = (np.abs(given) > [180.0, 90.0]).any(axis=1)
    if outside.any():
        longitude, latitude = given[np.argmax(outside)]
        raise InputError(
            f"{what} has a corner at longitude {longitude:g}, latitude {latitude:g}, which is not "
            "on the earth; give degrees, WGS 84, longitude first"
        )


def _ring(given: FloatArray, what: str) -> FloatArray:
    """(N, 2) a closed ring whose longitudes do not jump, without its last corner."""
    ring = np.asarray(given, dtype=np.float64)
    _check_corners(ring, what)
    if len(ring) > 1 and (ring[0] == ring[-1]).all():
        ring = ring[:-1]
    if len(np.unique(ring, axis=0)) < 3:
        raise InputError(f"{what} has fewer than three corners")
    longitude = np.r_[ring[:, 0], ring[0, 0]]
    step = np.diff(longitude)
    # From -180 to 180 it is all the way around, in a box of all the earth.
    other_way = (np.abs(step) > 0.5 * _TURN_DEG) & (np.abs(step) < _TURN_DEG)
    longitude[1:] -= np.cumsum(np.where(other_way, np.sign(step) * _TURN_DEG, 0.0))
    if abs(longitude[-1] - longitude[0]) > 1.0:
        raise InputError(f"{what} goes around a pole; cut it in two")
    return np.column_stack([longitude[:-1], ring[:, 1]])


def _has_area(ring: FloatArray) -> bool:
    x, y = (ring - ring[0]).T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) != 0.0


def _inside(ring: FloatArray, x: FloatArray, y: FloatArray) -> BoolArray:
    """(N,) bool, whether a ray to the east crosses a ring an odd number of times."""
    (x1, y1), (x2, y2) = ring.T, np.roll(ring, -1, axis=0).T
    inside: BoolArray = np.zeros(x.shape, dtype=bool)
    step = max(_CHUNK // len(ring), 1)
    # A level edge is crossed by no ray, and its quotient is not looked at.
    rise = np.where(y1 == y2, 1.0, y2 - y1)
    for start in range(0, len(x), step):
        some = slice(start, start + step)
        across = (y1 > y[some, None]) != (y2 > y[some, None])
        at = x1 + (y[some, None] - y1) * (x2 - x1) / rise
        inside[some] = (across & (x[some, None] < at)).sum(axis=1) % 2 == 1
    return inside


def _crossing(rings: Sequence[FloatArray]) -> tuple[float, float] | None:
    """Where two edges of rings cross, x and y; None where none do. To touch is not to cross."""
    first = np.concatenate(rings)
    second = np.concatenate([np.roll(ring, -1, axis=0) for ring in rings])
    low, high = np.minimum(first, second), np.maximum(first, second)
    order = np.argsort(low[:, 0], kind="stable")
    first, second, low, high = first[order], second[order], low[order], high[order]
    # Those that begin before an edge ends, from west to east.
    until = np.searchsorted(low[:, 0], high[:, 0], side="right")
    for i in range(len(first) - 1):
        others = np.arange(i + 1, until[i])
        others = others[(low[others, 1] <= high[i, 1]) & (high[others, 1] >= low[i, 1])]
        if not others.size:
            continue
        a, b, c, d = first[i], second[i], first[others], second[others]
        ends = np.sign(_side(a, b, c)) * np.sign(_side(a, b, d)) < 0.0
        ends &= np.sign(_side(c, d, a)) * np.sign(_side(c, d, b)) < 0.0
        if ends.any():
            k = int(np.argmax(ends))
            along = _side(c[k], d[k], a)
            share = along / (along - _side(c[k], d[k], b))
            x, y = a + share * (b - a)
            return float(x), float(y)
    return None


def _side(a: FloatArray, b: FloatArray, point: FloatArray) -> FloatArray:
    """Positive or negative by the side of a line on which points lie; 0 on it."""
    u, v = b - a, point - a
    return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0], dtype=np.float64)
