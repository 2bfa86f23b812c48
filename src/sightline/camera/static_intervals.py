"""Static intervals of a recording, from its frames alone, before any calibration."""

from __future__ import annotations

import numpy as np

from sightline.camera.motion import CameraMotionDetector, StaticInterval
from sightline.types import Frame

LOOKS_APART_S = 1.0
"""Interval between the frames that are observed."""
LOOKS_OF_REFERENCE = 5
"""Number of frames of a reference view."""

LEAST_DEG = 0.05
LEAST_PX = 0.8
"""Phase correlation is good to a tenth of a pixel; smaller rotations are not reported."""

_NOMINAL_FOCAL_WIDTHS = 0.8


def least_turn_deg(focal_px: float) -> float:
    """The least detectable rotation for a focal length, degrees."""
    return max(LEAST_DEG, float(np.degrees(LEAST_PX / focal_px)))


class StaticIntervalMonitor:
    """Observes a recording, one frame a second, for its static intervals.

    Where the horizon lies it sees for itself, and an ordinary lens is assumed: neither a model nor
    a fit is needed before.
    """

    def __init__(self) -> None:
        """Begin without a frame."""
        self._watch: CameraMotionDetector | None = None
        self._size: tuple[int, ...] | None = None
        self._next_s = -np.inf

    @property
    def static_intervals(self) -> tuple[StaticInterval, ...]:
        """Static intervals; none without a shoreline or with too few frames."""
        return () if self._watch is None else self._watch.static_intervals

    def observe(self, frame: Frame) -> None:
        """Observe the next frame; those of another size than the first are left out."""
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
