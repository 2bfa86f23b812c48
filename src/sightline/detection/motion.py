"""Motion detector by background subtraction, without weights."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sightline.errors import InputError
from sightline.types import BoolArray, Boxes, FloatArray, Frame

Mask = NDArray[np.uint8]

_SKY_SHARE = 0.35
_DOUBTFUL_AREA_PX2 = 40.0
_FLICKER_MEMORY_S = 10.0
_SOLID = 0.3
"""Contrast with the water, by that of the strongest tenth of a region, of what is no reflection."""
_TALL, _FULL = 0.2, 0.1
"""Columns and rows that reach less far than this share of the longest are tails."""
_UNKNOWN_INTERVAL_S = 1.0 / 15.0


@dataclass(frozen=True)
class MotionSettings:
    """Settings of a `MotionDetector`.

    Attributes:
        memory_s: How long the background remembers; what lies still for as long becomes part of it.
        threshold: Squared distance from the background, in variances of the pixel, that counts as
            motion. Waves and glitter raise the variance where they are.
        persistence_s: How far back a box must have been seen; waves break and are gone.
        persistent_share: In how many of those frames, 0 to 1.
        smallest_px: Least width and height of a box.
        gap_px: Parts of a boat this far apart, and three times as far side by side, are joined.
        widest: Largest width of a box by its height; longer ones are wakes and crests.
        flicker_hz: Where pixels begin or end to move more often than this there is glitter.
        absorbed_share: What shows at a pixel for this share of the memory is background.
    """

    memory_s: float = 60.0
    threshold: float = 30.0
    persistence_s: float = 0.6
    persistent_share: float = 0.6
    smallest_px: tuple[float, float] = (6.0, 5.0)
    gap_px: int = 2
    widest: float = 6.0
    flicker_hz: float = 0.6
    absorbed_share: float = 0.4

    def __post_init__(self) -> None:
        if not (self.memory_s > 0.0 and self.threshold > 0.0 and self.persistence_s >= 0.0):
            raise InputError(
                "motion detector: memory and threshold must be positive, and persistence not "
                f"negative; got {self.memory_s:g} s, {self.threshold:g}, {self.persistence_s:g} s"
            )


class MotionDetector:
    """Detects what moves below the horizon, by background subtraction.

    Every pixel keeps a mixture of normal distributions (Zivkovic 2004, OpenCV's MOG2), so waves
    belong to the background where they are common; where pixels flicker there is glitter, and
    nothing is looked for. What stands out is cleaned, joined to regions and boxed, and a box counts
    once it has been there for a while.

    Boats that lie at anchor are not found, and slow ones grow faint; boats that touch in the image
    are one.
    """

    name = "motion"

    def __init__(
        self,
        settings: MotionSettings | None = None,
        *,
        horizon_px: tuple[float, float] | None = None,
        above_horizon_px: float = 30.0,
    ) -> None:
        """Begin with an empty background.

        Args:
            settings: Absent: those for boats at 50 to 300 m before a small camera.
            horizon_px: Rows of the horizon at the left and the right edge of the image. Absent:
                the upper 35 % of the image are taken for sky.
            above_horizon_px: How far above that line masts and cabins are still looked for.
        """
        self._settings = settings if settings is not None else MotionSettings()
        self._horizon_px = horizon_px
        self._above_horizon_px = above_horizon_px
        self.reset()

    def reset(self) -> None:
        """Forget the background; see `Detector`."""
        self._background: _Background | None = None
        self._last_s = float("nan")
        self._shown_s = 0.0
        self._recent: deque[tuple[float, FloatArray]] = deque()

    def detect(self, frame: Frame) -> Boxes:
        """Detect boxes of what moves; see `Detector`.

        Frames without a time are taken to follow each other 15 times a second.
        """
        elapsed_s = frame.time_utc_s - self._last_s
        if not elapsed_s > 0.0:
            elapsed_s = _UNKNOWN_INTERVAL_S
        self._last_s = frame.time_utc_s
        self._shown_s += elapsed_s
        if self._background is None:
            mask = self._searched(*frame.image_bgr.shape[1::-1])
            self._background = _Background(self._settings, mask, frame.image_bgr)
        regions, strength = self._background.regions(frame.image_bgr, elapsed_s)
        lasting = self._lasting(regions)
        return Boxes.of(
            regions[lasting],
            frame=frame.index,
            time_utc_s=frame.time_utc_s,
            confidence=strength[lasting],
            source=self.name,
        )

    def _searched(self, width: int, height: int) -> Mask:
        """(H, W) mask, 255 in the region of interest."""
        if self._horizon_px is None:
            line = np.full(width, _SKY_SHARE * height)
        else:
            line = np.linspace(*self._horizon_px, width) - self._above_horizon_px
        # At least the last row, so that there is something to look at.
        line = np.minimum(line, height - 1.0)
        return _u8(np.where(np.arange(height)[:, None] >= line[None, :], 255, 0))

    def _lasting(self, regions: FloatArray) -> BoolArray:
        """(N,) whether a region persists: overlaps one in most of the recent frames."""
        settings = self._settings
        while self._recent and self._recent[0][0] < self._shown_s - settings.persistence_s:
            self._recent.popleft()
        votes = np.zeros(len(regions))
        for _, earlier in self._recent:
            low = np.maximum(regions[:, None, :2], earlier[None, :, :2])
            high = np.minimum(regions[:, None, 2:], earlier[None, :, 2:])
            votes += np.any(np.all(high > low, axis=2), axis=1)
        # Where frames are further apart than that, there is nothing to wait for.
        enough = settings.persistent_share * len(self._recent)
        self._recent.append((self._shown_s, regions))
        return votes >= enough


class _Background:
    """Background model of the pixels of one camera."""

    def __init__(
        self, settings: MotionSettings, searched: Mask, image_bgr: NDArray[np.uint8]
    ) -> None:
        self._settings = settings
        self._top = int(np.argmax(searched.any(axis=1)))
        self._searched = searched[self._top :]
        self._mixture = cv2.createBackgroundSubtractorMOG2(
            varThreshold=settings.threshold, detectShadows=False
        )
        self._mixture.setBackgroundRatio(1.0 - settings.absorbed_share)
        first = self._crop(image_bgr)
        # To an empty mixture everything is new; the first picture is all background.
        self._mixture.apply(first, learningRate=1.0)
        self._mean = first.astype(np.float32)
        self._moved = np.zeros_like(self._searched)
        self._flicker_hz = np.zeros(self._searched.shape, np.float32)
        self._frames = 1

    def regions(
        self, image_bgr: NDArray[np.uint8], elapsed_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """Foreground regions of the next picture.

        Args:
            image_bgr: (H, W, 3).
            elapsed_s: Since the picture before.

        Returns:
            (N, 4) boxes, px of the full image, and (N,) how well each is filled, 0 to 1.
        """
        self._frames += 1
        picture = self._crop(image_bgr)
        # At first the background is the mean of what was seen; then it forgets at its own pace.
        rate = max(1.0 - float(np.exp(-elapsed_s / self._settings.memory_s)), 1.0 / self._frames)
        moving = _u8(self._mixture.apply(picture, learningRate=rate)) & self._searched
        self._learn_flicker(moving, elapsed_s)
        boxes, strength = self._boxes(moving, picture)
        # What moves is not learned, or a slow boat would fade.
        still = _u8(cv2.bitwise_not(moving))
        cv2.accumulateWeighted(picture, self._mean, rate, mask=still)
        boxes[:, [1, 3]] += self._top
        return boxes, strength

    def _crop(self, image_bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return _u8(cv2.GaussianBlur(image_bgr[self._top :], (3, 3), 0))

    def _learn_flicker(self, moving: Mask, elapsed_s: float) -> None:
        """Update the flicker rate of pixels: for a boat they change once, for glitter always."""
        changed = cv2.boxFilter(cv2.bitwise_xor(moving, self._moved), cv2.CV_32F, (9, 9))
        changes_hz = np.asarray(changed, dtype=np.float32) / np.float32(255.0 * elapsed_s)
        rate = 1.0 - float(np.exp(-elapsed_s / _FLICKER_MEMORY_S))
        cv2.accumulateWeighted(changes_hz, self._flicker_hz, rate)
        self._moved = moving

    def _boxes(self, moving: Mask, picture: NDArray[np.uint8]) -> tuple[FloatArray, FloatArray]:
        settings = self._settings
        # An even kernel opens without a shift only if its anchor changes corners on the way back.
        speck = np.ones((2, 2), np.uint8)
        cleaned = _u8(cv2.dilate(cv2.erode(moving, speck, anchor=(1, 1)), speck, anchor=(0, 0)))
        reach = np.ones((_odd(settings.gap_px), _odd(3 * settings.gap_px)), np.uint8)
        joined = cv2.morphologyEx(cleaned, cv2.MORPH_CLOSE, reach)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(_u8(joined), connectivity=8)
        least_width, least_height = settings.smallest_px
        boxes: list[list[int]] = []
        strength: list[float] = []
        for label, (x, y, width, height, area) in enumerate(np.asarray(stats).tolist()):
            if label == 0 or width < least_width or height < least_height:
                continue
            window = (slice(y, y + height), slice(x, x + width))
            inside = (labels[window] == label) & (cleaned[window] > 0)
            if self._flicker_hz[window][inside].mean() > settings.flicker_hz:
                continue
            contrast = np.abs(picture[window] - self._mean[window]).max(axis=2)
            left, right, top, bottom = _trim(inside, contrast)
            width, height = right - left, bottom - top
            if width < least_width or height < least_height or width > settings.widest * height:
                continue
            boxes.append([x + left, y + top, x + right, y + bottom])
            # Small regions are clutter more often than large ones.
            filled = float(inside[top:bottom, left:right].mean())
            strength.append(filled * area / (area + _DOUBTFUL_AREA_PX2))
        return np.array(boxes, dtype=float).reshape(-1, 4), np.array(strength, dtype=float)


def _trim(inside: BoolArray, contrast: NDArray[np.float32]) -> tuple[int, int, int, int]:
    """Left, right, top and bottom of a region without its faint wake and reflection."""
    solid = inside & (contrast >= _SOLID * np.percentile(contrast[inside], 90))
    columns = solid.sum(axis=0)
    tall = np.flatnonzero(columns >= _TALL * columns.max())
    left, right = int(tall[0]), int(tall[-1]) + 1
    rows = solid[:, left:right].sum(axis=1)
    full = np.flatnonzero(rows >= _FULL * rows.max())
    return left, right, int(full[0]), int(full[-1]) + 1


def _odd(gap_px: int) -> int:
    """Side of a kernel that closes a gap, odd so that it has a middle."""
    return 2 * (gap_px // 2) + 1


def _u8(image: ArrayLike) -> NDArray[np.uint8]:
    return np.asarray(image, dtype=np.uint8)
