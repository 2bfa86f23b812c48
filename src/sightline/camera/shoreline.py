"""Shoreline detection: the far shore or the horizon, where the water ends in the image.

In the median of some frames of a static camera the waves average out, and the static scene
stays sharp. So above the edge of the water the picture is much sharper than below it. The
edge runs along the curve that the horizon would have, higher or lower and somewhat tilted; boats,
posts and quays hide it in some columns, and the median over the columns does not see them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.types import FloatArray, Frame

_COLUMN_PX = 8
_BLUR_PX = 0.5
# The land's height in the picture that is compared with as much water below it.
_ABOVE_PX = 8
_BELOW_PX = 16
_LEAST_RATIO = 2.5
_LEAST_RATIO_OF_COLUMN = 1.5
_LEAST_SHARE = 0.6


@dataclass(frozen=True, eq=False)
class WaterEdge:
    """The far edge of the water in the image: shoreline or horizon.

    Attributes:
        column_px: (N,) float64.
        row_px: (N,) float64.
        share: Share of the columns examined that agree, 0 to 1.
    """

    column_px: FloatArray
    row_px: FloatArray
    share: float


class StillPicture:
    """The median of several frames: waves average out, the static scene stays sharp."""

    def __init__(self, every: int = 1, most: int = 25) -> None:
        """Begin without a frame.

        Args:
            every: One in so many frames is taken, from the first one on.
            most: So many are taken.
        """
        self._every, self._most = every, most
        self._passed = 0
        self._grey: list[NDArray[np.uint8]] = []

    @property
    def seen_enough(self) -> bool:
        """Whether further frames change nothing."""
        return len(self._grey) == self._most

    def observe(self, frame: Frame) -> None:
        """Add the next frame, where it is its turn; not one of another size than the first."""
        due = self._passed % self._every == 0
        self._passed += 1
        if self.seen_enough or not due:
            return
        grey = np.asarray(cv2.cvtColor(frame.image_bgr, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        if not self._grey or grey.shape == self._grey[0].shape:
            self._grey.append(grey)

    def picture(self) -> NDArray[np.uint8]:
        """(H, W) grey: the median frame."""
        # Row by row: the whole stack would be copied to be put in order.
        rows = zip(*self._grey, strict=True)
        return np.stack([np.median(np.stack(row), axis=0).astype(np.uint8) for row in rows])


def find_water_edge(
    still: NDArray[np.uint8], near_row_px: FloatArray, *, reach_px: float = 45.0
) -> WaterEdge | None:
    """Find the shoreline near where it is expected.

    Args:
        still: (H, W) grey, as `StillPicture` makes it.
        near_row_px: (W,) where the horizon is expected in each column; NaN where it is not.
        reach_px: How far off it may be.

    Returns:
        The edge; None where the columns do not agree on one.
    """
    height, width = still.shape
    expected = np.array(
        [
            near_row_px[x : x + _COLUMN_PX].mean()
            for x in range(0, width - _COLUMN_PX + 1, _COLUMN_PX)
        ]
    )
    lowest = int(reach_px) + _BELOW_PX + 22
    inside = np.flatnonzero(
        np.isfinite(expected) & (expected > lowest) & (expected < height - lowest - 1)
    )
    if inside.size < 20:
        return None
    offsets = np.arange(-lowest, lowest + 1)
    texture = _texture(still)
    # (offsets, columns) how sharp the picture is about where the horizon is expected.
    rows = np.round(expected[inside]).astype(np.int64)[None, :] + offsets[:, None]
    sharp = np.log(texture[rows, inside[None, :]] + 0.3)
    x = (inside + 0.5) * _COLUMN_PX / width - 0.5
    best = (-np.inf, 0, 0.0)
    reach = np.arange(-int(reach_px), int(reach_px) + 1)
    for slope in np.linspace(-20.0, 20.0, 41):
        shift = np.round(slope * x).astype(np.int64)
        level = np.take_along_axis(
            sharp,
            np.clip(np.arange(offsets.size)[:, None] + shift[None, :], 0, offsets.size - 1),
            0,
        )
        profile = np.median(level, axis=1)
        total = np.concatenate([[0.0], np.cumsum(profile)])
        at = reach + lowest
        above = (total[at + 1] - total[at + 1 - _ABOVE_PX]) / _ABOVE_PX
        below = (total[at + 2 + _BELOW_PX] - total[at + 2]) / _BELOW_PX
        step = above - below
        k = int(np.argmax(step))
        if step[k] > best[0]:
            best = (float(step[k]), int(reach[k]), float(slope))
    if best[0] < np.log(_LEAST_RATIO):
        return None
    line = best[1] + 0.5 + best[2] * x
    columns = np.arange(x.size)
    total = np.concatenate([np.zeros((1, x.size)), np.cumsum(sharp, axis=0)])
    at = np.round(line).astype(np.int64) + lowest
    above = (total[at, columns] - total[at - _ABOVE_PX, columns]) / _ABOVE_PX
    below = (total[at + 1 + _BELOW_PX, columns] - total[at + 1, columns]) / _BELOW_PX
    agreeing = above - below > np.log(_LEAST_RATIO_OF_COLUMN)
    share = float(agreeing.mean())
    if share < _LEAST_SHARE:
        return None
    return WaterEdge(
        (inside[agreeing] + 0.5) * _COLUMN_PX, expected[inside][agreeing] + line[agreeing], share
    )


def _texture(still: NDArray[np.uint8]) -> FloatArray:
    """(H, W / 8) gradient magnitude, grey values a pixel, mean over eight columns."""
    image = cv2.GaussianBlur(still.astype(np.float32), (0, 0), _BLUR_PX)
    steep = np.abs(cv2.Sobel(image, cv2.CV_32F, 0, 1)) + np.abs(cv2.Sobel(image, cv2.CV_32F, 1, 0))
    columns = steep.shape[1] // _COLUMN_PX
    blocks = steep[:, : columns * _COLUMN_PX].reshape(len(steep), columns, _COLUMN_PX)
    return np.asarray(blocks.mean(axis=2) / 8.0, dtype=np.float64)
