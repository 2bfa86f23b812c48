"""How a camera stood in a recording, from a look at its pictures in which nothing else is known."""

from __future__ import annotations

import numpy as np

from sightline.camera.motion import CameraMotionDetector, StaticInterval
from sightline.types import Frame

LOOKS_APART_S = 1.0
"""One picture in so long is looked at."""
LOOKS_OF_REFERENCE = 5
"""Of so many pictures a view is made."""

LEAST_DEG = 0.05
LEAST_PX = 0.8
"""Phase correlation is sure to a tenth of a pixel; turns that move less than this are none."""

_NOMINAL_FOCAL_WIDTHS = 0.8


def least_turn_deg(focal_px: float) -> float:
    """The least turn that is one, for a focal length."""
    return max(LEAST_DEG, float(np.degrees(LEAST_PX / focal_px)))


class StaticIntervalMonitor:
    """Is shown the pictures of a recording, and looks at one in a second of them.

    Where the horizon lies it sees for itself, and an ordinary lens is assumed: neither a model nor
    a fit is needed before.
    """

    def __init__(self) -> None:
        """Begin without a picture."""
        self._watch: CameraMotionDetector | None = None
        self._size: tuple[int, ...] | None = None
        self._next_s = -np.inf

    @property
    def static_intervals(self) -> tuple[StaticInterval, ...]:
        """How the camera stood; none where there is no edge of the water, or too few pictures."""
        return () if self._watch is None else self._watch.static_intervals

    def observe(self, frame: Frame) -> None:
        """Look at the next picture; those of another size than the first are left out."""
        size = frame.image_bgr.shape[1::-1]
        if self._size is None:
            self._size = size
            if CameraMotionDetector.fits((size[0], size[1])):
                focal_px = _NOMINAL_FOCAL_WIDTHS * size[0]
                self._watch = CameraMotionDetector(
                    None,
                    focal_px,
                    least_deg=least_turn_deg(focal_px),
                    reference_frames=LOOKS_OF_REFERENCE,
                )
        if self._watch is None or size != self._size or not frame.time_utc_s >= self._next_s:
            return
        self._next_s = frame.time_utc_s + LOOKS_APART_S
        self._watch.update(frame)
