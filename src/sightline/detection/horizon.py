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
_BAND_PX = 16
_PEAKS = 6
_STEEPEST = math.tan(math.radians(15.0))
_NEAR_PX = 2.0
"""How far an edge may lie from the line, px of the scaled picture."""
_FIRM = 0.8
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
    rows = np.array([line[0], line[0] + line[1] * size[0]]) * height / size[1]
    return float(rows[0]), float(rows[1])


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
    """Row at the left edge and slope of the line; all lines through two edges far apart vote."""
    first, second = np.triu_indices(len(x), 1)
    apart = x[second] - x[first]
    far = np.abs(apart) > 0.3 * width
    first, second, apart = first[far], second[far], apart[far]
    slope = (y[second] - y[first]) / apart
    flat = np.abs(slope) < _STEEPEST
    first, slope = first[flat], slope[flat]
    if not first.size:
        return None
    start = y[first] - slope * x[first]
    # Those that agree to the pixel are one.
    keys = np.unique(np.round(np.column_stack([start, start + slope * width])), axis=0)
    columns = np.unique(x)
    votes = np.zeros(len(keys))
    for column in columns:
        own = x == column
        at = keys[:, 0] + (keys[:, 1] - keys[:, 0]) * column / width
        near = np.abs(at[:, None] - y[own][None, :]) <= _NEAR_PX
        votes += np.where(near, weight[own][None, :], 0.0).max(axis=1)
    if votes.max() < _LEAST * bands:
        return None
    good = np.flatnonzero(votes >= _FIRM * votes.max())
    lowest = keys[good].mean(axis=1).max()
    group = good[keys[good].mean(axis=1) >= lowest - 2.0 * _NEAR_PX]
    chosen = keys[group[np.argmax(votes[group])]]
    at = chosen[0] + (chosen[1] - chosen[0]) * x / width
    own = np.abs(at - y) <= _NEAR_PX
    # Theil and Sen: the median of all slopes does not mind a fifth of them being wrong.
    i, j = np.triu_indices(int(own.sum()), 1)
    run = x[own][j] - x[own][i]
    rise = y[own][j] - y[own][i]
    usable = run != 0.0
    if not usable.any():
        return None
    slope_px = float(np.median(rise[usable] / run[usable]))
    return float(np.median(y[own] - slope_px * x[own])), slope_px


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
