"""What stands out against the background of a recording, and the box around it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.errors import InputError
from sightline.types import FloatArray, Frame, IntArray

_SAMPLES = 40
_FEWEST_SAMPLES = 3
_LEAST_SPREAD = 2.0
"""Grey levels: noise of the sensor and of the codec where nothing moves."""
_FULL, _NOISE = 8.0, 3.0
"""Contrast, in spreads of the background, beyond which a pixel is no surer to be part of a boat,
and at which it is as likely a part of the water."""
_CORRELATED_PX2 = 60.0
"""Pixels of water, and of a boat, that count as one observation."""
GATE = 3.5
"""Standard deviations within which a box must lie from what is expected."""
_RATIOS = np.exp(np.linspace(-0.9, 0.9, 10))
_PERSON = 0.08
"""Rows above a hull belong to it where this share of its width stands out; aerials are thinner."""
_FEWEST_PERSON_PX = 4

Image = NDArray[np.uint8]
Picture = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Background:
    """What a recording's frames have in common.

    Attributes:
        median: (H, W, 3) float32, grey levels.
        spread: (H, W) float32, how far frames lie from it in the median, smoothed.
    """

    median: Picture
    spread: Picture

    @classmethod
    def of(cls, frames: Iterable[Frame], name: str) -> Background:
        """The background of a recording of a camera that stands still.

        The median over up to `_SAMPLES` frames that lie evenly in it.

        Args:
            frames: Of the recording.
            name: Of the recording, for messages.

        Raises:
            InputError: The frames are fewer than three, or differ in size.
        """
        kept: list[Image] = []
        stride = 1
        for i, frame in enumerate(frames):
            if i % stride:
                continue
            if kept and frame.image_bgr.shape != kept[0].shape:
                raise InputError(
                    f"recording {name}: frame {frame.index} is of another size than the first"
                )
            kept.append(frame.image_bgr)
            if len(kept) == 2 * _SAMPLES:
                kept, stride = kept[::2], 2 * stride
        if len(kept) < _FEWEST_SAMPLES:
            raise InputError(
                f"recording {name}: {len(kept)} frames do not show what stands still in them; "
                f"{_FEWEST_SAMPLES} or more are needed"
            )
        kept = kept[:: max(1, len(kept) // _SAMPLES)]
        height, width = kept[0].shape[:2]
        median = np.empty((height, width, 3), np.float32)
        spread = np.empty((height, width), np.float32)
        smooth = [_smooth(image) for image in kept]
        # A band at a time: the whole pile would take hundreds of megabytes.
        for top in range(0, height, 64):
            band = np.stack([image[top : top + 64] for image in smooth])
            middle = np.median(band, axis=0)
            median[top : top + 64] = middle
            spread[top : top + 64] = np.median(np.abs(band - middle), axis=0).max(axis=2)
        spread = np.asarray(cv2.GaussianBlur(spread, (0, 0), 4.0), np.float32) + _LEAST_SPREAD
        return cls(median, spread)

    def contrast(self, image_bgr: Image, window: tuple[int, int, int, int]) -> Picture:
        """How far a part of a frame stands out, (h, w) float32 in spreads of the background.

        Args:
            image_bgr: (H, W, 3) uint8.
            window: Left, top, right and bottom, within the frame.
        """
        left, top, right, bottom = window
        part = (slice(top, bottom), slice(left, right))
        difference = _smooth(np.ascontiguousarray(image_bgr[part])) - self.median[part]
        # Clouds and exposure change the light of all.
        difference -= np.median(difference.reshape(-1, 3), axis=0).astype(np.float32)
        return np.asarray(np.abs(difference).max(axis=2) / self.spread[part], np.float32)


@dataclass(frozen=True, eq=False)
class BoxPrior:
    """Where a box is expected, and how large.

    Attributes:
        xyxy_px: (4,) float64, in the frame.
        place_sigma_px: (2,) float64, of its middle column and its lower edge.
        shape_sigma: Of the logarithms of its width and height.
    """

    xyxy_px: FloatArray
    place_sigma_px: FloatArray
    shape_sigma: float

    def surprise(self, boxes: FloatArray) -> FloatArray:
        """(N,) squared standard deviations by which boxes (N, 4) differ from what is expected."""
        size = self.xyxy_px[2:] - self.xyxy_px[:2]
        column = 0.5 * (boxes[:, 0] + boxes[:, 2] - self.xyxy_px[0] - self.xyxy_px[2])
        row = boxes[:, 3] - self.xyxy_px[3]
        ratio = np.log((boxes[:, 2:] - boxes[:, :2]) / size) / self.shape_sigma
        return np.asarray(
            (column / self.place_sigma_px[0]) ** 2
            + (row / self.place_sigma_px[1]) ** 2
            + np.sum(ratio**2, axis=1)
        )


@dataclass(frozen=True, eq=False)
class Look:
    """The part of a frame around an expected box.

    Attributes:
        contrast: (h, w) float32, as `Background.contrast` has it.
        corner_px: Left and top of it in the frame.
    """

    contrast: Picture
    corner_px: tuple[int, int]

    @classmethod
    def at(cls, background: Background, image_bgr: Image, belief: BoxPrior) -> Look:
        """What a frame shows as far as a box may lie from where it is expected."""
        height, width = image_bgr.shape[:2]
        box, sigma = belief.xyxy_px, belief.place_sigma_px
        size = box[2:] - box[:2]
        reach_x = GATE * sigma[0] + 0.75 * max(size)
        reach_y = GATE * sigma[1] + 0.75 * size[1]
        left, top = int(max(0.0, box[0] - reach_x)), int(max(0.0, box[1] - reach_y))
        right = int(min(width, np.ceil(box[2] + reach_x)))
        bottom = int(min(height, np.ceil(box[3] + reach_y)))
        return cls(background.contrast(image_bgr, (left, top, right, bottom)), (left, top))


def snap(look: Look, belief: BoxPrior) -> tuple[FloatArray, float] | None:
    """The most probable box: what stands out inside it, and what is expected.

    A pixel of contrast ``c`` speaks for being part of the boat by ``min(c, 8) - 3``, and against it
    where that is negative; so a rectangle of largest sum leaves out wakes and aerials, which fill
    little of the columns and rows that they take. The belief weighs in as a normal prior.

    Args:
        look: The part of the frame.
        belief: Where the box is expected.

    Returns:
        The box in the frame (4,), and the mean contrast inside it; None where the sum of no
        rectangle near enough speaks for a boat.
    """
    score = np.clip(look.contrast, 0.0, _FULL) - _NOISE
    sums = np.zeros((score.shape[0] + 1, score.shape[1] + 1))
    sums[1:, 1:] = score.cumsum(axis=0, dtype=float).cumsum(axis=1) / _CORRELATED_PX2
    corner = np.array([*look.corner_px, *look.corner_px], dtype=float)

    def gain(boxes: IntArray) -> FloatArray:
        x1, y1, x2, y2 = boxes.T
        inside = sums[y2, x2] - sums[y1, x2] - sums[y2, x1] + sums[y1, x1]
        surprise = belief.surprise(boxes + corner)
        return np.where(surprise <= GATE**2, inside - 0.5 * surprise, -np.inf)

    boxes = _rectangles(belief, score.shape, look.corner_px)
    if not len(boxes):
        return None
    best = boxes[int(np.argmax(gain(boxes)))]
    if not np.isfinite(gain(best[None])[0]):
        return None
    best = _climb(best, gain, score.shape)
    if gain(best[None])[0] + 0.5 * belief.surprise(best[None] + corner)[0] <= 0.0:
        return None
    x1, y1, x2, y2 = (int(v) for v in best)
    strength = float(look.contrast[y1:y2, x1:x2].mean())
    manned = np.array([x1, _with_persons(look.contrast, x1, y1, x2, y2), x2, y2])
    # What goes on for long above a hull is the sail of another boat.
    if belief.surprise(manned[None] + corner)[0] <= GATE**2:
        best = manned
    return best + corner, strength


def _rectangles(belief: BoxPrior, shape: tuple[int, ...], corner_px: tuple[int, int]) -> IntArray:
    """(N, 4) rectangles within the gate, on a grid that is fine by their size."""
    size = belief.xyxy_px[2:] - belief.xyxy_px[:2]
    middle = 0.5 * (belief.xyxy_px[0] + belief.xyxy_px[2]) - corner_px[0]
    foot = belief.xyxy_px[3] - corner_px[1]
    found = []
    for width in np.unique(np.maximum(2, np.round(_RATIOS * size[0]).astype(int))):
        for height in np.unique(np.maximum(2, np.round(_RATIOS * size[1]).astype(int))):
            step = max(1, round(0.12 * width)), max(1, round(0.2 * height))
            reach = GATE * belief.place_sigma_px
            x1 = np.arange(
                middle - reach[0] - 0.5 * width, middle + reach[0] - 0.5 * width, step[0]
            )
            y2 = np.arange(foot - reach[1], foot + reach[1] + 1, step[1])
            grid = np.stack(np.meshgrid(np.round(x1), np.round(y2)), axis=-1).reshape(-1, 2)
            left, bottom = grid.astype(np.int64).T
            found.append(np.stack([left, bottom - height, left + width, bottom], axis=1))
    boxes = np.concatenate(found)
    within = (boxes[:, 0] >= 0) & (boxes[:, 1] >= 0)
    within &= (boxes[:, 2] <= shape[1]) & (boxes[:, 3] <= shape[0])
    return np.asarray(boxes[within])


def _climb(
    best: IntArray, gain: Callable[[IntArray], FloatArray], shape: tuple[int, ...]
) -> IntArray:
    """Move one edge at a time by a pixel for as long as that helps."""
    moves = np.concatenate([np.eye(4, dtype=np.int64), -np.eye(4, dtype=np.int64)])
    moves = np.concatenate([moves, 2 * moves])
    here = float(gain(best[None])[0])
    for _ in range(200):
        near = best + moves
        good = (near[:, 0] >= 0) & (near[:, 1] >= 0) & (near[:, 2] <= shape[1])
        good &= (near[:, 3] <= shape[0]) & (near[:, 2] - near[:, 0] >= 2)
        near = near[good & (near[:, 3] - near[:, 1] >= 2)]
        value = gain(near)
        if value.max() <= here + 1e-9:
            break
        best, here = near[int(np.argmax(value))], float(value.max())
    return best


def _with_persons(contrast: Picture, x1: int, y1: int, x2: int, y2: int) -> int:
    """The upper edge with what stands on the deck."""
    enough = max(_FEWEST_PERSON_PX, round(_PERSON * (x2 - x1)))
    limit = max(0, y1 - (y2 - y1))
    while y1 > limit and int((contrast[y1 - 1, x1:x2] > _NOISE).sum()) >= enough:
        y1 -= 1
    return y1


def _smooth(image: Image) -> Picture:
    return np.asarray(cv2.GaussianBlur(image, (3, 3), 0), np.float32)
