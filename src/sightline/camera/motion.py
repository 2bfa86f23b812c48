"""Detection of camera rotation against the static scene along the horizon.

Strips of the picture along the horizon show what does not move: the far shore, houses, hills. How
far each has moved against a reference is found by phase correlation (Kuglin and Hines 1975), to a
fraction of a pixel. The median over the strips does not see the boats that pass before some. Where
there is only a horizon between water and sky, the strips still tell by how much it rose or fell,
and nothing tells the rotation about the vertical.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.camera.horizon_line import find_waterline
from sightline.camera.registration import (
    FEWEST_STRIPS,
    HALF_HEIGHT_PX,
    HALF_STORED_PX,
    NOWHERE,
    ReferenceView,
    agree,
    coarse_shift,
    consensus,
    largest_shift,
    measure_strips,
    rigid_shifts,
    scattered,
)
from sightline.errors import InputError
from sightline.types import FloatArray, Frame

_STRIPS = 7
# Waves lift a horizon without landmarks more easily than a shore.
_HORIZON_FACTOR = 2.0
_FEWEST_HORIZONS = 3
_EAGER = 16


@dataclass(frozen=True)
class CameraTurn:
    """One camera rotation.

    Attributes:
        time_utc_s: When it was detected; NaN where the frames have no times.
        frame: In which frame.
        heading_deg: To the right, by the shift of the picture; NaN where only the horizon is seen.
        pitch_deg: Downwards.
        roll_deg: The right end of the horizon downwards.
        shift_px: The largest shift of a strip, pixels.
        before_utc_s: Time of the last frame observed before it.
        since_utc_s: Time of the first frame observed after it.
    """

    time_utc_s: float
    frame: int
    heading_deg: float
    pitch_deg: float
    roll_deg: float
    shift_px: float
    before_utc_s: float
    since_utc_s: float


@dataclass(frozen=True, eq=False)
class StaticInterval:
    """A time in which the camera did not rotate, with its reference view.

    Attributes:
        before_utc_s: Time of the last observed frame of the static interval before; minus
            infinity for the first one.
        since_utc_s: Time of the first frame of this one; minus infinity for the first.
        view: The reference view of the static scene.
    """

    before_utc_s: float
    since_utc_s: float
    view: ReferenceView


class CameraMotionDetector:
    """Detects rotations of a camera that should be static.

    The reference is made from the first frames, and after a rotation anew from those that show it.

    Args:
        horizon_px: Rows of the horizon at two or more columns, evenly apart from the left edge of
            the image to the right one; None: the edge of the water is looked for in the first
            pictures, and nothing is watched where there is none.
        focal_px: Focal length.
        least_deg: Rotations that are smaller are not reported.
        duration_s: A rotation counts once it has lasted so long: a gust is none.
        reference_frames: Number of frames of a reference.
        like: A view whose strips are to be looked at, instead of ``horizon_px``.
    """

    def __init__(
        self,
        horizon_px: Sequence[float] | FloatArray | None,
        focal_px: float,
        *,
        least_deg: float = 0.2,
        duration_s: float = 3.0,
        reference_frames: int = 15,
        like: ReferenceView | None = None,
    ) -> None:
        if not (focal_px > 0.0 and least_deg > 0.0 and duration_s >= 0.0 and reference_frames >= 1):
            raise InputError(
                "camera motion: focal length, least turn and reference must be positive"
            )
        self._given: FloatArray | None = None
        if horizon_px is not None:
            rows = np.asarray(horizon_px, dtype=np.float64)
            if rows.ndim != 1 or rows.size < 2 or not np.isfinite(rows).all():
                raise InputError(
                    "camera motion: the rows of the horizon must be two or more finite numbers"
                )
            at = (np.arange(_STRIPS) + 0.5) / _STRIPS
            self._given = np.interp(at, np.linspace(0.0, 1.0, rows.size), rows)
        self._like = like
        self._focal_px = focal_px
        self._least_px = focal_px * np.radians(least_deg)
        self._lasts_s, self._count = duration_s, reference_frames
        self.reset()

    @staticmethod
    def fits(image_size_px: tuple[int, int]) -> bool:
        """Whether frames of a size hold patches along their horizon."""
        return image_size_px[1] >= 2 * HALF_HEIGHT_PX and image_size_px[0] // _STRIPS >= 16

    def reset(self) -> None:
        """Forget the reference: the next frame is of another recording."""
        self._size: tuple[int, int] | None = None
        self._blind = False
        self._first: list[Frame] = []
        self._lines: list[tuple[float, float]] = []
        self._sample: list[NDArray[np.uint8]] = []
        self._reference: NDArray[np.uint8] | None = None
        self._recent: deque[tuple[float, FloatArray, NDArray[np.uint8]]] = deque()
        self._before_s, self._settled_s = -np.inf, -np.inf
        self._since, self._landmarks = (-np.inf, -np.inf), True
        self._past: list[StaticInterval] = []

    @property
    def static_intervals(self) -> tuple[StaticInterval, ...]:
        """Static intervals so far, in the order of time; none before the first reference."""
        if self._reference is None:
            return ()
        return (*self._past, self._stance(self._reference))

    @property
    def settled_utc_s(self) -> float:
        """Time up to which no further rotation can be detected."""
        return np.inf if self._blind else self._settled_s

    def update(self, frame: Frame) -> CameraTurn | None:
        """Register the next frame; frames come in the order of time.

        Returns:
            The rotation, where one is detected in this frame.

        Raises:
            InputError: The picture is too small to hold strips about its horizon.
        """
        size = (frame.image_bgr.shape[1], frame.image_bgr.shape[0])
        if not self.fits(size):
            raise InputError(f"camera motion: pictures of {size[0]} x {size[1]} px are too small")
        if self._blind or not self._placed(size, frame):
            return None
        if self._first:
            waiting, self._first = self._first, []
            for one in waiting:
                self.update(one)
        strips = self._strips(frame.image_bgr)
        if self._reference is None:
            self._sample.append(strips)
            if len(self._sample) == self._count:
                self._reference = _median(self._sample)
                pairs = zip(self._sample, self._sample[1:], strict=False)
                steps = [measure_strips(one, other, NOWHERE) for one, other in pairs]
                self._landmarks = not steps or not scattered(np.stack(steps))
                self._before_s = self._settled_s = frame.time_utc_s
            return None
        moved = measure_strips(self._reference, strips, NOWHERE)
        self._recent.append((frame.time_utc_s, self._nearer(moved, strips), strips))
        while (
            len(self._recent) > FEWEST_STRIPS
            and frame.time_utc_s - self._recent[1][0] >= self._lasts_s
        ):
            self._before_s = self._settled_s = self._recent[0][0]
            self._learn(self._recent.popleft())
        if len(self._recent) < FEWEST_STRIPS:
            return None
        if frame.time_utc_s - self._recent[0][0] < self._lasts_s:
            return None
        # Over time and over strips: neither a boat before one of them nor a gust counts.
        return self._turn(frame, np.stack([one for _, one, _ in self._recent]))

    def _placed(self, size: tuple[int, int], frame: Frame) -> bool:
        """Whether the patches are placed along the horizon; early frames may wait for it."""
        if self._size is not None:
            return True
        rows = self._given
        if self._like is not None:
            self._top, self._left = self._like.top_px, self._like.left_px
            self._height, self._width = self._like.strips.shape[1:]
            inside = (self._top >= 0).all() and (self._top + self._height <= size[1]).all()
            self._blind = not (inside and (self._left + self._width <= size[0]).all())
            self._size = size
            return not self._blind
        if rows is None:
            self._first.append(frame)
            line = find_waterline(frame.image_bgr)
            if line is not None:
                self._lines.append(line)
            if len(self._first) < FEWEST_STRIPS or len(self._lines) < _FEWEST_HORIZONS:
                if len(self._first) >= _EAGER:
                    self._blind, self._first = True, []
                return False
            self._first.pop()
            left, right = np.median(self._lines, axis=0)
            rows = left + (right - left) * (np.arange(_STRIPS) + 0.5) / _STRIPS
        self._size = size
        self._width = size[0] // _STRIPS
        self._height = min(2 * HALF_STORED_PX, size[1])
        top = np.clip(np.round(rows) - self._height // 2, 0, size[1] - self._height)
        self._top = top.astype(np.int64)
        self._left = np.arange(_STRIPS, dtype=np.int64) * self._width
        return True

    def _nearer(self, moved: FloatArray, strips: NDArray[np.uint8]) -> FloatArray:
        """The measured displacements, refined from a coarse shift where patches disagree."""
        assert self._reference is not None, "the caller has looked"
        if agree(moved[None, :, :2], *consensus(moved[:, :2])):
            return moved
        coarse = np.array(coarse_shift(self._reference, strips))
        again = measure_strips(self._reference, strips, coarse)
        return again if agree(again[None, :, :2], *consensus(again[:, :2])) else moved

    def _learn(self, look: tuple[float, FloatArray, NDArray[np.uint8]]) -> None:
        """Add a frame to the reference of a static interval that has just begun."""
        _, moved, strips = look
        if (
            len(self._sample) >= self._count
            or largest_shift(*consensus(moved[:, :2])) > self._least_px
        ):
            return
        self._sample.append(strips)
        self._reference = _median(self._sample)

    def _turn(self, frame: Frame, moved: FloatArray) -> CameraTurn | None:
        """The rotation in (T, S, 3) displacements of the last frames; None where there is none."""
        rows = np.stack([np.zeros(moved.shape[:2]), moved[..., 2]], axis=-1)
        for landmarks, shifts in ((True, moved[..., :2]), (False, rows)):
            across, down, slope = consensus(np.median(shifts, axis=0))
            largest = largest_shift(across, down, slope)
            least_px = self._least_px if landmarks else _HORIZON_FACTOR * self._least_px
            if largest < least_px or not agree(shifts, across, down, slope, noise_px=0.0):
                continue
            first = _change(shifts, rigid_shifts(across, down, slope, shifts.shape[1]))
            # Waves or fog move each strip of each picture another way, and a horizon stays.
            if scattered(moved[first:]) != landmarks:
                break
        else:
            return None
        looks = list(self._recent)
        before_s = looks[first - 1][0] if first else self._before_s
        since_s = looks[first][0]
        assert self._reference is not None, "the caller has looked"
        self._past.append(self._stance(self._reference))
        self._since, self._landmarks = (before_s, since_s), landmarks
        self._sample = [strips for _, _, strips in looks[first:]]
        self._reference = _median(self._sample)
        self._recent.clear()
        self._before_s = self._settled_s = frame.time_utc_s
        width = _STRIPS * self._width
        return CameraTurn(
            time_utc_s=frame.time_utc_s,
            frame=frame.index,
            # What lies before the camera goes left when it turns right, up when it turns down.
            heading_deg=float(-np.degrees(across / self._focal_px)) if landmarks else np.nan,
            pitch_deg=float(-np.degrees(down / self._focal_px)),
            roll_deg=float(np.degrees(slope / width)),
            shift_px=largest,
            before_utc_s=before_s,
            since_utc_s=since_s,
        )

    def _stance(self, reference: NDArray[np.uint8]) -> StaticInterval:
        return StaticInterval(
            *self._since, ReferenceView(reference, self._top, self._left, self._landmarks)
        )

    def _strips(self, image_bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
        parts = [
            cv2.cvtColor(
                image_bgr[top : top + self._height, left : left + self._width], cv2.COLOR_BGR2GRAY
            )
            for top, left in zip(self._top.tolist(), self._left.tolist(), strict=True)
        ]
        return np.stack(parts).astype(np.uint8)


def _median(strips: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    middle: FloatArray = np.median(np.stack(strips), axis=0)
    return np.round(middle).astype(np.uint8)


def _change(moved: FloatArray, turn: FloatArray) -> int:
    """Index of the first of T frames after a rotation, from displacements (T, S, 2)."""
    before = np.abs(moved).sum(axis=2)
    after = np.abs(moved - turn).sum(axis=2)
    # Over the strips the median: a boat before one of them says nothing.
    gain = np.median(before - after, axis=1)
    return int(np.argmax(np.cumsum(gain[::-1])[::-1]))
