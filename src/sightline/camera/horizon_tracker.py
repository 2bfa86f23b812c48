"""The horizon of a static camera, found before any calibration."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sightline.camera.horizon_line import find_waterline
from sightline.types import Frame

_EAGER_FRAMES = 16


class HorizonFinder:
    """The median waterline of several frames.

    Frames are observed ever more seldom, at 1, 2, 4, 8 ... of them, so that one with a ship
    before the horizon does not count for long, and none costs much. As long as no waterline was
    found, each of the first frames is observed.
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
        """Observe the next frame.

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


def with_horizons(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Frames with their horizon detected, for a camera that rolls and pitches."""
    for frame in frames:
        line = find_waterline(frame.image_bgr)
        seen = line is not None and bool(np.isfinite(line).all())
        yield replace(frame, horizon_px=line if seen else None)
