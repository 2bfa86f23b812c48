"""Whether a camera that ought to stand still has been turned: seen against the far shore.

Strips of the picture along the horizon show what does not move: the far shore, houses, hills. How
far each has moved against a reference is found by phase correlation (Kuglin and Hines 1975), to a
fraction of a pixel. The median over the strips does not see the boats that pass before some. Where
there is only a horizon between water and sky, the strips still tell by how much it rose or fell,
and nothing tells what was turned about the vertical.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from sightline.camera.horizon_line import find_waterline
from sightline.errors import InputError
from sightline.types import FloatArray, Frame, IntArray

_STRIPS = 7
_HALF_HEIGHT_PX = 32
_HALF_STORED_PX = 64
"""Views keep more rows than are compared at once, so that they are still there after a turn."""
_SHRINK = 4
_FEWEST = 5
# By what strips may differ, as a share of what they moved.
_MOST_APART = 0.3
# And by what they may differ where they moved little, px.
_NOISE_PX = 0.3
# Where strips disagree more than this about the way across, they show nothing that stands still.
_LANDMARKS_APART_PX = 1.5
# Waves lift a horizon without landmarks more easily than a shore.
_HORIZON_FACTOR = 2.0
_ROWS_SMOOTH_PX = 1.5
_FEWEST_HORIZONS = 3
_EAGER = 16
_NOWHERE = np.zeros(2, dtype=np.int64)


@dataclass(frozen=True)
class CameraTurn:
    """A turn of the camera.

    Attributes:
        time_utc_s: When it was noticed; NaN where the frames have no times.
        frame: In which frame.
        heading_deg: To the right, by the shift of the picture; NaN where only the horizon is seen.
        pitch_deg: Downwards.
        roll_deg: The right end of the horizon downwards.
        shift_px: The largest shift of a strip, pixels.
        before_utc_s: Time of the last picture looked at before it.
        since_utc_s: Time of the first picture looked at after it.
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
class View:
    """What stands still before a camera, in strips along the horizon.

    Attributes:
        strips: (S, H, W) uint8, grey, from left to right.
        top_px: (S,) int64, rows of their upper edges in the picture.
        left_px: (S,) int64, columns of their left edges.
        landmarks: Whether anything in them stands still but the horizon.

    Raises:
        InputError: The columns do not fit together.
    """

    strips: NDArray[np.uint8]
    top_px: IntArray
    left_px: IntArray
    landmarks: bool = True

    def __post_init__(self) -> None:
        n = len(self.strips)
        if self.strips.ndim != 3 or n < 2 or {self.top_px.shape, self.left_px.shape} != {(n,)}:
            raise InputError("a view needs two strips or more, each with its row and column")

    @property
    def middle_px(self) -> FloatArray:
        """(S, 2) the middle of each strip, x and y."""
        height, width = self.strips.shape[1:]
        return np.stack([self.left_px + 0.5 * width, self.top_px + 0.5 * height], axis=1)


@dataclass(frozen=True, eq=False)
class Displacement:
    """By how much what stands still lies elsewhere in one view than in another.

    Attributes:
        at_px: (S, 2) places in the first, x and y.
        moved_px: (S, 2) by how much each lies further right and down in the second.
        landmarks: Whether the way across means anything: not where only a horizon is seen.
    """

    at_px: FloatArray
    moved_px: FloatArray
    landmarks: bool


@dataclass(frozen=True, eq=False)
class Stance:
    """A time in which the camera stood still, and what it saw.

    Attributes:
        before_utc_s: Time of the last picture looked at in which it did not stand so yet; minus
            infinity for the first stance.
        since_utc_s: Time of the first picture in which it did; minus infinity for the first.
        view: What it saw.
    """

    before_utc_s: float
    since_utc_s: float
    view: View


def displacement(reference: View, other: View) -> Displacement | None:
    """How the camera of one view lies against that of another; None where that cannot be told.

    Args:
        reference: Of one time.
        other: Of another, of the same camera with the same lens.
    """
    if reference.strips.shape != other.strips.shape:
        return None
    base = np.stack([other.left_px - reference.left_px, other.top_px - reference.top_px], axis=1)
    if not (reference.landmarks and other.landmarks):
        measured = _measured(reference.strips, other.strips, -base)
        moved = np.stack([np.zeros(len(base)), measured[:, 2] + base[:, 1]], axis=1)
        told = _agree(moved[None], *_consensus(moved))
        return Displacement(reference.middle_px, moved, False) if told else None
    for coarse in ((0, 0), _coarse(reference.strips, other.strips)):
        rough = _measured(reference.strips, other.strips, np.array(coarse) - base)[:, :2] + base
        # Once more where each strip ought to be: what lies in both is then as much as can be.
        there = np.round(_rigid(*_consensus(rough), len(rough))).astype(np.int64)
        moved = _measured(reference.strips, other.strips, there - base)[:, :2] + base
        if _agree(moved[None], *_consensus(moved)):
            return Displacement(reference.middle_px, moved, True)
    return None


class CameraMotionWatch:
    """Watches the pictures of a camera that ought to stand still.

    The reference is made from the first pictures, and after a turn anew from those that show it.

    Args:
        horizon_px: Rows of the horizon at two or more columns, evenly apart from the left edge of
            the image to the right one; None: the edge of the water is looked for in the first
            pictures, and nothing is watched where there is none.
        focal_px: Focal length.
        least_deg: Turns that are smaller are not reported.
        lasts_s: A turn counts once it has lasted so long: a gust is none.
        reference_frames: How many pictures make a reference.
        like: A view whose strips are to be looked at, instead of ``horizon_px``.
    """

    def __init__(
        self,
        horizon_px: Sequence[float] | FloatArray | None,
        focal_px: float,
        *,
        least_deg: float = 0.2,
        lasts_s: float = 3.0,
        reference_frames: int = 15,
        like: View | None = None,
    ) -> None:
        if not (focal_px > 0.0 and least_deg > 0.0 and lasts_s >= 0.0 and reference_frames >= 1):
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
        self._lasts_s, self._count = lasts_s, reference_frames
        self.reset()

    @staticmethod
    def fits(image_size_px: tuple[int, int]) -> bool:
        """Whether pictures of a size hold strips about their horizon."""
        return image_size_px[1] >= 2 * _HALF_HEIGHT_PX and image_size_px[0] // _STRIPS >= 16

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
        self._past: list[Stance] = []

    @property
    def stances(self) -> tuple[Stance, ...]:
        """How the camera stood so far, in the order of time; none before the first reference."""
        if self._reference is None:
            return ()
        return (*self._past, self._stance(self._reference))

    @property
    def settled_utc_s(self) -> float:
        """Up to this time no other turn will be told of."""
        return np.inf if self._blind else self._settled_s

    def update(self, frame: Frame) -> CameraTurn | None:
        """Look at a frame; frames come in the order of time.

        Returns:
            The turn, where one is noticed in this frame.

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
                steps = [_measured(one, other, _NOWHERE) for one, other in pairs]
                self._landmarks = not steps or not _scattered(np.stack(steps))
                self._before_s = self._settled_s = frame.time_utc_s
            return None
        moved = _measured(self._reference, strips, _NOWHERE)
        self._recent.append((frame.time_utc_s, self._nearer(moved, strips), strips))
        while (
            len(self._recent) > _FEWEST and frame.time_utc_s - self._recent[1][0] >= self._lasts_s
        ):
            self._before_s = self._settled_s = self._recent[0][0]
            self._learn(self._recent.popleft())
        if len(self._recent) < _FEWEST:
            return None
        if frame.time_utc_s - self._recent[0][0] < self._lasts_s:
            return None
        # Over time and over strips: neither a boat before one of them nor a gust counts.
        return self._turn(frame, np.stack([one for _, one, _ in self._recent]))

    def _placed(self, size: tuple[int, int], frame: Frame) -> bool:
        """Whether it is known where the strips lie; the first frames may have to wait for it."""
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
            if len(self._first) < _FEWEST or len(self._lines) < _FEWEST_HORIZONS:
                if len(self._first) >= _EAGER:
                    self._blind, self._first = True, []
                return False
            self._first.pop()
            left, right = np.median(self._lines, axis=0)
            rows = left + (right - left) * (np.arange(_STRIPS) + 0.5) / _STRIPS
        self._size = size
        self._width = size[0] // _STRIPS
        self._height = min(2 * _HALF_STORED_PX, size[1])
        top = np.clip(np.round(rows) - self._height // 2, 0, size[1] - self._height)
        self._top = top.astype(np.int64)
        self._left = np.arange(_STRIPS, dtype=np.int64) * self._width
        return True

    def _nearer(self, moved: FloatArray, strips: NDArray[np.uint8]) -> FloatArray:
        """What was measured, or what is after a coarse look where the strips disagree."""
        assert self._reference is not None, "the caller has looked"
        if _agree(moved[None, :, :2], *_consensus(moved[:, :2])):
            return moved
        coarse = np.array(_coarse(self._reference, strips))
        again = _measured(self._reference, strips, coarse)
        return again if _agree(again[None, :, :2], *_consensus(again[:, :2])) else moved

    def _learn(self, look: tuple[float, FloatArray, NDArray[np.uint8]]) -> None:
        """Make the reference of a stance that has just begun better by one more picture."""
        _, moved, strips = look
        if len(self._sample) >= self._count or _largest(*_consensus(moved[:, :2])) > self._least_px:
            return
        self._sample.append(strips)
        self._reference = _median(self._sample)

    def _turn(self, frame: Frame, moved: FloatArray) -> CameraTurn | None:
        """The turn that (T, S, 3) shifts of the strips in the last pictures tell."""
        rows = np.stack([np.zeros(moved.shape[:2]), moved[..., 2]], axis=-1)
        for landmarks, shifts in ((True, moved[..., :2]), (False, rows)):
            across, down, slope = _consensus(np.median(shifts, axis=0))
            largest = _largest(across, down, slope)
            least_px = self._least_px if landmarks else _HORIZON_FACTOR * self._least_px
            if largest < least_px or not _agree(shifts, across, down, slope, noise_px=0.0):
                continue
            first = _change(shifts, _rigid(across, down, slope, shifts.shape[1]))
            # Waves or fog move each strip of each picture another way, and a horizon stays.
            if _scattered(moved[first:]) != landmarks:
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

    def _stance(self, reference: NDArray[np.uint8]) -> Stance:
        return Stance(*self._since, View(reference, self._top, self._left, self._landmarks))

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


def _measured(
    reference: NDArray[np.uint8], strips: NDArray[np.uint8], coarse_px: IntArray
) -> FloatArray:
    """By how many pixels strips have moved.

    Args:
        reference: (S, H, W).
        strips: (S, H, W).
        coarse_px: (S, 2) or (2,), by how much further right and down they are to be looked for.

    Returns:
        (S, 3): to the right and down, and down by the rows alone.
    """
    height, width = reference.shape[1:]
    rows = min(2 * _HALF_HEIGHT_PX, height)
    top = (height - rows) // 2
    limit = np.array([width // 2, top])
    coarse = np.broadcast_to(np.clip(coarse_px, -limit, limit), (len(reference), 2))
    out = np.empty((len(reference), 3))
    for i, (x, y) in enumerate(coarse.tolist()):
        left, right = max(0, -x), min(width, width - x)
        here = reference[i, top : top + rows, left:right].astype(np.float32)
        there = strips[i, top + y : top + y + rows, left + x : right + x].astype(np.float32)
        window = cv2.createHanningWindow((right - left, rows), cv2.CV_32F)
        out[i, :2] = cv2.phaseCorrelate(here, there, window)[0]
        out[i, 2] = _rows_moved(here, there)
    return out + np.stack([coarse[:, 0], coarse[:, 1], coarse[:, 1]], axis=1)


def _rows_moved(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    """By how many rows the edges that run across have gone down."""
    edges = [
        np.diff(gaussian_filter1d(strip.mean(axis=1, dtype=np.float64), _ROWS_SMOOTH_PX))
        for strip in (one, other)
    ]
    taper = np.hanning(edges[0].size)
    alike = np.correlate(edges[1] * taper, edges[0] * taper, mode="full")
    at = int(np.argmax(alike))
    shift = float(at - (edges[0].size - 1))
    if 0 < at < alike.size - 1:
        before, here, after = alike[at - 1 : at + 2]
        bend = before - 2.0 * here + after
        if bend < 0.0:
            shift += 0.5 * (before - after) / bend
    return shift


def _coarse(reference: NDArray[np.uint8], strips: NDArray[np.uint8]) -> tuple[int, int]:
    """Whole pixels to the right and down, from all strips side by side, seen from afar."""
    small = []
    for part in (reference, strips):
        wide = np.concatenate(list(part), axis=1)
        size = (wide.shape[1] // _SHRINK, wide.shape[0] // _SHRINK)
        small.append(cv2.resize(wide, size, interpolation=cv2.INTER_AREA).astype(np.float32))
    window = cv2.createHanningWindow(small[0].shape[::-1], cv2.CV_32F)
    x, y = cv2.phaseCorrelate(small[0], small[1], window)[0]
    return round(_SHRINK * x), round(_SHRINK * y)


def _consensus(moved: FloatArray) -> tuple[float, float, float]:
    """Shift across and down, and how much further down over the width, of strips (S, 2)."""
    across, down = np.median(moved, axis=0)
    at = (np.arange(len(moved)) + 0.5) / len(moved)
    i, j = np.triu_indices(len(moved), 1)
    slope = float(np.median((moved[j, 1] - moved[i, 1]) / (at[j] - at[i])))
    return float(across), float(down), slope


def _rigid(across: float, down: float, slope: float, count: int) -> FloatArray:
    """(S, 2) the shifts of strips of which all tell the same turn."""
    at = (np.arange(count) + 0.5) / count - 0.5
    return np.stack([np.full(count, across), down + slope * at], axis=1)


def _largest(across: float, down: float, slope: float) -> float:
    return float(max(np.hypot(across, down), 0.5 * abs(slope)))


def _agree(
    moved: FloatArray, across: float, down: float, slope: float, noise_px: float = _NOISE_PX
) -> bool:
    """Whether shifts (T, S, 2) of strips are those of one turn."""
    apart = moved - _rigid(across, down, slope, moved.shape[1])
    most = max(noise_px, _MOST_APART * _largest(across, down, slope))
    return bool(np.median(np.hypot(apart[..., 0], apart[..., 1])) <= most)


def _scattered(moved: FloatArray) -> bool:
    """Whether strips (T, S, 2 or more) tell nothing of the way across."""
    across = moved[..., 0]
    return bool(np.median(np.abs(across - np.median(across))) > _LANDMARKS_APART_PX)


def _change(moved: FloatArray, turn: FloatArray) -> int:
    """The first of T looks after a turn: at which step looks (T, S, 2) are best explained."""
    before = np.abs(moved).sum(axis=2)
    after = np.abs(moved - turn).sum(axis=2)
    # Over the strips the median: a boat before one of them says nothing.
    gain = np.median(before - after, axis=1)
    return int(np.argmax(np.cumsum(gain[::-1])[::-1]))
