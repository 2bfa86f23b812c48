"""The horizon of a camera that stands still, for what is looked at before a camera is fitted."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from sightline.camera.horizon_line import find_waterline
from sightline.types import Frame, Horizons

_EAGER_FRAMES = 16


class HorizonFinder:
    """The median of the waterlines of several frames.

    Frames are looked at ever more seldom, at 1, 2, 4, 8 ... of them, so that one with a ship
    before the horizon does not count for long, and none costs much. As long as no waterline was
    found, each of the first frames is looked at.
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
            rows = find_waterline(image_bgr)
            eager = rows is None and not self._rows and self._seen < _EAGER_FRAMES
            self._next = self._seen + 1 if eager else 2 * self._seen
            if rows is not None:
                self._rows.append(rows)
                left, right = np.median(np.array(self._rows), axis=0)
                self._horizon = (float(left), float(right))
        return self._horizon


class HorizonWatch:
    """Looks for the horizon in frames, one after another.

    Attributes:
        seen: Of the last frame looked at; without a row where none was found in it.
    """

    def __init__(self) -> None:
        """Begin without a frame."""
        self.seen = Horizons(np.empty(0), np.empty(0), np.empty(0))

    def look(self, frame: Frame) -> None:
        """Look at the next frame."""
        line = find_waterline(frame.image_bgr)
        rows = np.array([] if line is None else [[frame.time_utc_s, *line]]).reshape(-1, 3)
        self.seen = Horizons(*rows[np.isfinite(rows).all(axis=1)].T)
