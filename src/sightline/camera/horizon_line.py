"""Waterline detection with sub-pixel precision, for a camera that rolls between frames."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.types import FloatArray

_LEAST_SIDE_PX = 64
_ROWS, _COARSE_BANDS = 180, 20
_BESIDE = (0.012, 0.06)
"""From how near to how far above and below a line colours are compared, of the height."""
_STEEPEST, _SLOPES = 0.2, 81
_BANDS = 40
_SEARCH_PX = 24
_SMOOTH_PX = 3
_STRONG = 0.3
"""Of the strongest edge of a band; the lowest edge that is as strong is the water's."""
_OVER_WAVES = 4.0
"""And so many times as strong as what waves show further down."""
_NEAR_PX = 4.0
_LEAST_BANDS = 12


def find_waterline(image_bgr: NDArray[np.uint8]) -> tuple[float, float] | None:
    """Rows of the waterline at the left and the right edge of the image.

    Roughly it is the line above which everything is of another colour than below it, and in the
    same way over the whole width: wakes, glitter and boats are not. A far shore has an edge at its
    top, and one at its foot; the foot is straight and the top is not. So in each band of columns
    the lowest strong edge near that line is taken, since the water below it is smooth so far out,
    and a line goes through the medians.

    Args:
        image_bgr: (H, W, 3).

    Returns:
        Two rows, px; None where no line stands out.
    """
    if min(image_bgr.shape[:2]) < _LEAST_SIDE_PX:
        return None
    rough = _rough(image_bgr)
    width = image_bgr.shape[1]
    bands, x = _along(image_bgr, rough)
    change = np.abs(bands[_SMOOTH_PX:] - bands[:-_SMOOTH_PX]).max(axis=2)
    offset = np.arange(change.shape[0]) + 0.5 * _SMOOTH_PX - _SEARCH_PX
    waves = np.median(change[-_SEARCH_PX // 2 :], axis=0)
    least = np.maximum(_STRONG * change.max(axis=0), _OVER_WAVES * waves)
    inner = change[1:-1]
    peak = (inner >= change[:-2]) & (inner > change[2:]) & (inner >= least)
    if (peak.any(axis=0)).sum() < _LEAST_BANDS:
        return None
    slope, start = 0.0, 0.0
    for within in (np.inf, 2.0 * _NEAR_PX, _NEAR_PX):
        near = np.abs(offset[1:-1, None] - slope * x - start) <= within
        found = peak & near
        columns = np.flatnonzero(found.any(axis=0))
        if columns.size < _LEAST_BANDS:
            return None
        row = inner.shape[0] - np.argmax(found[::-1, columns], axis=0)
        at = offset[row] + _vertex(change, row, columns)
        slope, start = _median_line(x[columns], at)
    return rough[0] + start, rough[1] + start + slope * width


def _rough(image_bgr: NDArray[np.uint8]) -> tuple[float, float]:
    """Rough rows at the left and right edge of the line that best separates two colours."""
    height, width = image_bgr.shape[:2]
    step = height / _ROWS
    bands = np.asarray(
        cv2.resize(image_bgr, (_COARSE_BANDS, _ROWS), interpolation=cv2.INTER_AREA), np.float64
    )
    near, far = (round(share * _ROWS) for share in _BESIDE)
    above = np.concatenate([np.zeros((1, *bands.shape[1:])), np.cumsum(bands, axis=0)])
    rows = np.arange(far, _ROWS - far + 1)
    across = (np.arange(_COARSE_BANDS) + 0.5) / _COARSE_BANDS - 0.5
    best, line = -1.0, (0.0, 0.0)
    for slope in np.linspace(-_STEEPEST, _STEEPEST, _SLOPES):
        at = rows[:, None] + np.round(slope * width / step * across).astype(int)
        inside = (at >= far) & (at <= _ROWS - far)
        at = np.clip(at, far, _ROWS - far)
        band = np.arange(_COARSE_BANDS)
        upper = above[at - near, band] - above[at - far, band]
        lower = above[at + far, band] - above[at + near, band]
        unlike = np.median(lower - upper, axis=1)
        score = np.where(inside.mean(axis=1) > 0.5, np.abs(unlike).sum(axis=1), -1.0)
        i = int(np.argmax(score))
        if score[i] > best:
            middle, rise = rows[i] * step, slope * width
            best, line = float(score[i]), (middle - 0.5 * rise, middle + 0.5 * rise)
    return line


def _along(
    image_bgr: NDArray[np.uint8], line: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Colour profile (rows about a line, bands of columns, 3), and the centres of the bands, px."""
    width = image_bgr.shape[1]
    turn = np.array(
        [[1.0, 0.0, 0.0], [(line[1] - line[0]) / width, 1.0, line[0] - _SEARCH_PX]],
        dtype=np.float64,
    )
    strip = cv2.warpAffine(
        image_bgr,
        turn,
        (width, 2 * _SEARCH_PX + 1),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    bands = np.asarray(
        cv2.resize(strip, (_BANDS, 2 * _SEARCH_PX + 1), interpolation=cv2.INTER_AREA), np.float64
    )
    return bands, (np.arange(_BANDS) + 0.5) * width / _BANDS


def _vertex(values: FloatArray, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> FloatArray:
    """Offset of the vertex of a parabola through three neighbours from the middle one."""
    before, at, after = (values[rows + step, columns] for step in (-1, 0, 1))
    bend = before - 2.0 * at + after
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = np.where(bend < 0.0, 0.5 * (before - after) / bend, 0.0)
    return np.clip(shift, -0.5, 0.5)


def _median_line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Slope and intercept of the Theil-Sen line through points."""
    i, j = np.triu_indices(x.size, 1)
    slope = float(np.median((y[j] - y[i]) / (x[j] - x[i])))
    return slope, float(np.median(y - slope * x))
