"""Where water and sky meet, found in the image.

The far shore stands on the horizon, or a little below it, and both are edges that run straight
through the whole image, which waves, clouds and boats do not.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.types import FloatArray

_WIDTH_PX = 640
_BAND_PX = 32
_PEAKS = 4
_STEEPEST = math.tan(math.radians(15.0))
_NEAR_PX = 2.0
"""How far an edge may lie from the line, px of the scaled picture."""
_STRONG = 0.4
"""Weight of the edges that lines are drawn through."""
_BOWS_PX = (0.0, -9.0, -6.0, -3.0, 3.0, 6.0, 9.0)
"""How far below its chord the middle of the horizon may lie, px of the scaled picture."""
_STRAIGHTER = 0.01
"""A line counts less by this share for each pixel of bow."""
_FIRM = 0.7
"""Lines this nearly as good as the best count too; the lowest of them is the waterline."""
_LEAST = 0.45
"""Share of the bands that must have an edge on the line."""


def find_horizon(image_bgr: NDArray[np.uint8]) -> tuple[float, float] | None:
    """Rows at which the horizon meets the left and the right edge of a picture.

    The picture is cut into upright bands. Each gives the rows where its brightness changes most;
    the line that passes the most of these, weighted by how strong they are, is the horizon.
    Shores have an upper edge as well: of lines that are about as good, the lowest is taken, since
    below the waterline there is only water.

    Args:
        image_bgr: (H, W, 3).

    Returns:
        Two rows, px; None where no line stands out.
    """
    height, width = image_bgr.shape[:2]
    if height < 8 or width < 8:
        return None
    scale = min(1.0, _WIDTH_PX / width)
    size = (max(round(width * scale), 8), max(round(height * scale), 8))
    small = np.asarray(cv2.resize(image_bgr, size, interpolation=cv2.INTER_AREA), np.uint8)
    x, y, weight, bands = _edges(small)
    line = _best_line(x, y, weight, bands, size[0])
    if line is None:
        return None
    return line[0] * height / size[1], line[1] * height / size[1]


def _edges(small: NDArray[np.uint8]) -> tuple[FloatArray, FloatArray, FloatArray, int]:
    """Columns, rows and weights, 0 to 1, of the strongest edges of each band; and their number."""
    height, width = small.shape[:2]
    count = max(width // _BAND_PX, 4)
    edges = np.linspace(0, width, count + 1).round().astype(int)
    # Of all colours the one that changes most: sky and water may be equally bright.
    picture = small.astype(np.float64)
    profile = np.stack(
        [picture[:, left:right].mean(axis=1) for left, right in pairwise(edges.tolist())],
        axis=1,
    )
    reach = 2
    above = np.cumsum(np.pad(profile, ((1, 0), (0, 0), (0, 0))), axis=0)
    # Mean of the rows below less the mean of the rows above each boundary between rows.
    boundary = np.arange(reach, height - reach + 1)
    lower = (above[boundary + reach] - above[boundary]) / reach
    upper = (above[boundary] - above[boundary - reach]) / reach
    change = np.abs(lower - upper).max(axis=2)
    xs, ys, weights = [], [], []
    for band in range(count):
        column = change[:, band]
        peak = np.flatnonzero(
            (column >= np.r_[-np.inf, column[:-1]]) & (column > np.r_[column[1:], -np.inf])
        )
        peak = peak[np.argsort(-column[peak], kind="stable")[:_PEAKS]]
        strongest = column[peak].max(initial=0.0)
        if strongest <= 0.0:
            continue
        xs.append(np.full(peak.size, 0.5 * (edges[band] + edges[band + 1])))
        ys.append(boundary[peak].astype(np.float64))
        weights.append(column[peak] / strongest)
    if not xs:
        return np.empty(0), np.empty(0), np.empty(0), count
    return np.concatenate(xs), np.concatenate(ys), np.concatenate(weights), count


def _best_line(
    x: FloatArray, y: FloatArray, weight: FloatArray, bands: int, width: int
) -> tuple[float, float] | None:
    """Rows at the left and the right edge of the line that most edges vote for.

    Each pair of strong edges far apart gives a line, straight or bowed by so much, since lenses
    bend what does not pass through the middle of the image.
    """
    strong = np.flatnonzero(weight >= _STRONG)
    i, j = np.triu_indices(len(strong), 1)
    first, second = strong[i], strong[j]
    far = np.abs(x[second] - x[first]) > 0.3 * width
    first, second = first[far], second[far]
    if not first.size:
        return None
    part = x / width
    arc = 4.0 * part * (1.0 - part)
    lines = []
    for bow in _BOWS_PX:
        chord = y - bow * arc
        slope = (chord[second] - chord[first]) / (part[second] - part[first])
        flat = np.abs(slope) < _STEEPEST * width
        left = chord[first][flat] - slope[flat] * part[first][flat]
        ends = np.column_stack([left, left + slope[flat], np.full(left.size, bow)])
        # Those that agree to about a pixel are one.
        lines.append(np.unique(np.round(ends / _NEAR_PX), axis=0) * _NEAR_PX)
    ends = np.concatenate(lines)
    if not ends.size:
        return None
    votes = _votes(ends, x, y, weight, part, arc) * (1.0 - _STRAIGHTER * np.abs(ends[:, 2]))
    if votes.max() < _LEAST * bands:
        return None
    good = np.flatnonzero(votes >= _FIRM * votes.max())
    middle = ends[good, :2].mean(axis=1) + ends[good, 2]
    group = good[middle >= middle.max() - 2.0 * _NEAR_PX]
    left, right, bow = ends[group[np.argmax(votes[group])]]
    at = left + (right - left) * part + bow * arc
    own = np.abs(at - y) <= _NEAR_PX
    # Theil and Sen: the median of all slopes does not mind a fifth of them being wrong.
    chord, there = (y - bow * arc)[own], part[own]
    i, j = np.triu_indices(chord.size, 1)
    usable = there[i] != there[j]
    if not usable.any():
        return None
    slopes = (chord[j] - chord[i])[usable] / (there[j] - there[i])[usable]
    rise = float(np.median(slopes))
    start = float(np.median(chord - rise * there))
    return start, start + rise


def _votes(
    ends: FloatArray,
    x: FloatArray,
    y: FloatArray,
    weight: FloatArray,
    part: FloatArray,
    arc: FloatArray,
) -> FloatArray:
    """(L,) over all bands, the weight of the strongest edge that lies on each line."""
    votes = np.zeros(len(ends))
    for column in np.unique(x):
        own = np.flatnonzero(x == column)
        u, v = part[own[0]], arc[own[0]]
        at = ends[:, 0] * (1.0 - u) + ends[:, 1] * u + ends[:, 2] * v
        near = np.abs(at[:, None] - y[own][None, :]) <= _NEAR_PX
        votes += np.where(near, weight[own][None, :], 0.0).max(axis=1)
    return votes


class HorizonFinder:
    """The horizon of a camera that stands still, from several of its frames.

    Frames are looked at ever more seldom, at 1, 2, 4, 8 ... of them, so that one with a ship
    before the horizon does not count for long, and none costs much.
    """

    def __init__(self, most: int = 15) -> None:
        """Begin without a frame.

        Args:
            most: Of how many frames the median is taken, the last ones.
        """
        self._rows: deque[tuple[float, float]] = deque(maxlen=most)
        self._seen = 0
        self._next = 1
        self._horizon: tuple[float, float] | None = None

    def look(self, image_bgr: NDArray[np.uint8]) -> tuple[float, float] | None:
        """Take the next frame.

        Args:
            image_bgr: (H, W, 3).

        Returns:
            Rows of the horizon at the left and the right edge, px; None as long as none is found.
        """
        self._seen += 1
        if self._seen >= self._next:
            self._next = 2 * self._seen
            rows = find_horizon(image_bgr)
            if rows is not None:
                self._rows.append(rows)
                left, right = np.median(np.array(self._rows), axis=0)
                self._horizon = (float(left), float(right))
        return self._horizon
