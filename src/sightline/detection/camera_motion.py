"""Whether a camera that ought to stand still has been turned: seen against the far shore.

Strips of the picture along the horizon show what does not move: the far shore, houses, hills. How
far each has moved against a reference is found by phase correlation (Kuglin and Hines 1975), to a
fraction of a pixel. The median over the strips does not see the boats that pass before some.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.errors import InputError
from sightline.types import FloatArray, Frame

_STRIPS = 7
_HALF_HEIGHT_PX = 32
_FEWEST = 5
# By what strips may differ, as a share of what they moved.
_MOST_APART = 0.3


@dataclass(frozen=True)
class CameraTurn:
    """A turn of the camera.

    Attributes:
        time_utc_s: When it was noticed; NaN where the frames have no times.
        frame: In which frame.
        heading_deg: To the right, by the shift of the picture.
        pitch_deg: Downwards.
        roll_deg: The right end of the horizon downwards.
        shift_px: The largest shift of a strip, pixels.
    """

    time_utc_s: float
    frame: int
    heading_deg: float
    pitch_deg: float
    roll_deg: float
    shift_px: float


class CameraMotionWatch:
    """Watches the pictures of a camera that ought to stand still.

    The reference is made from the first pictures. After a turn was reported, the next pictures make
    a new one.

    Args:
        horizon_px: Rows of the horizon at two or more columns, evenly apart from the left edge of
            the image to the right one.
        focal_px: Focal length.
        least_deg: Turns that are smaller are not reported.
        lasts_s: A turn counts once it has lasted so long: a gust is none.
        reference_frames: How many pictures make a reference.
    """

    def __init__(
        self,
        horizon_px: Sequence[float] | FloatArray,
        focal_px: float,
        *,
        least_deg: float = 0.2,
        lasts_s: float = 3.0,
        reference_frames: int = 15,
    ) -> None:
        if not (focal_px > 0.0 and least_deg > 0.0 and lasts_s >= 0.0 and reference_frames >= 1):
            raise InputError(
                "camera motion: focal length, least turn and reference must be positive"
            )
        rows = np.asarray(horizon_px, dtype=np.float64)
        if rows.ndim != 1 or rows.size < 2 or not np.isfinite(rows).all():
            raise InputError(
                "camera motion: the rows of the horizon must be two or more finite numbers"
            )
        at = (np.arange(_STRIPS) + 0.5) / _STRIPS
        self._row_px = np.interp(at, np.linspace(0.0, 1.0, rows.size), rows)
        self._focal_px = focal_px
        self._least_px = focal_px * np.radians(least_deg)
        self._lasts_s, self._count = lasts_s, reference_frames
        self.reset()

    @staticmethod
    def fits(image_size_px: tuple[int, int]) -> bool:
        """Whether pictures of a size hold strips about their horizon."""
        return image_size_px[1] >= 2 * _HALF_HEIGHT_PX and image_size_px[0] // _STRIPS >= 16

    def reset(self) -> None:
        """Forget the reference: the next frame is of another recording."""
        self._waiting: list[NDArray[np.float32]] = []
        self._reference: NDArray[np.float32] | None = None
        self._recent: deque[tuple[float, FloatArray]] = deque()

    def update(self, frame: Frame) -> CameraTurn | None:
        """Look at a frame; frames come in the order of time.

        Returns:
            The turn, where one is noticed in this frame.

        Raises:
            InputError: The picture is too small to hold strips about its horizon.
        """
        strips = self._strips(frame.image_bgr)
        if self._reference is None:
            self._waiting.append(strips)
            if len(self._waiting) == self._count:
                self._reference = np.median(np.stack(self._waiting), axis=0).astype(np.float32)
                self._waiting = []
            return None
        self._recent.append((frame.time_utc_s, self._shifts(strips)))
        while (
            len(self._recent) > _FEWEST and frame.time_utc_s - self._recent[1][0] >= self._lasts_s
        ):
            self._recent.popleft()
        if len(self._recent) < _FEWEST:
            return None
        if frame.time_utc_s - self._recent[0][0] < self._lasts_s:
            return None
        # Over time and over strips: neither a boat before one of them nor a gust counts.
        return self._turn(frame, np.stack([one for _, one in self._recent]))

    def _turn(self, frame: Frame, shifts: FloatArray) -> CameraTurn | None:
        """The turn that (T, S, 2) shifts of the strips in the last pictures tell."""
        shift = np.median(shifts, axis=0)
        across, down = np.median(shift, axis=0)
        at = (np.arange(_STRIPS) + 0.5) / _STRIPS - 0.5
        pairs = [(i, j) for i in range(_STRIPS) for j in range(i + 1, _STRIPS)]
        slope = float(np.median([(shift[j, 1] - shift[i, 1]) / (at[j] - at[i]) for i, j in pairs]))
        largest = float(max(np.hypot(across, down), 0.5 * abs(slope)))
        if largest < self._least_px:
            return None
        # Waves or fog alone move each strip of each picture another way.
        apart = shifts - np.stack([np.full(_STRIPS, across), down + slope * at], axis=1)
        if np.median(np.hypot(apart[..., 0], apart[..., 1])) > _MOST_APART * largest:
            return None
        width = self._width
        self.reset()
        return CameraTurn(
            time_utc_s=frame.time_utc_s,
            frame=frame.index,
            # What lies before the camera goes left when it turns right, up when it turns down.
            heading_deg=float(-np.degrees(across / self._focal_px)),
            pitch_deg=float(-np.degrees(down / self._focal_px)),
            roll_deg=float(np.degrees(slope / width)),
            shift_px=largest,
        )

    def _strips(self, image_bgr: NDArray[np.uint8]) -> NDArray[np.float32]:
        height, self._width = image_bgr.shape[:2]
        size = self._width // _STRIPS
        if not self.fits((self._width, height)):
            raise InputError(
                f"camera motion: pictures of {self._width} x {height} px are too small"
            )
        out = []
        for i in range(_STRIPS):
            top = min(
                max(round(self._row_px[i]) - _HALF_HEIGHT_PX, 0), height - 2 * _HALF_HEIGHT_PX
            )
            part = image_bgr[top : top + 2 * _HALF_HEIGHT_PX, i * size : (i + 1) * size]
            out.append(cv2.cvtColor(part, cv2.COLOR_BGR2GRAY).astype(np.float32))
        return np.stack(out)

    def _shifts(self, strips: NDArray[np.float32]) -> FloatArray:
        """(S, 2) by how many pixels each strip has moved to the right and down."""
        assert self._reference is not None, "there is a reference"
        window = cv2.createHanningWindow(strips.shape[:0:-1], cv2.CV_32F)
        return np.array(
            [
                cv2.phaseCorrelate(one, other, window)[0]
                for one, other in zip(self._reference, strips, strict=True)
            ]
        )
