"""Letterboxing: pictures scaled to the network's input size, and boxes back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.types import FloatArray


@dataclass(frozen=True)
class Letterbox:
    """Position and scale of a picture on a padded canvas.

    A pixel's left edge at x of the picture lies at ``left_px + x * inner / size`` of the canvas.
    Width and height are rounded to whole pixels each, so each has its own scale; with them the way
    back is exact.

    Attributes:
        size_px: Width and height of the picture.
        inner_px: Width and height of the scaled picture.
        canvas_px: Width and height of the canvas.
        left_px: Padding on the left.
        top_px: Padding above.
    """

    size_px: tuple[int, int]
    inner_px: tuple[int, int]
    canvas_px: tuple[int, int]
    left_px: int = 0
    top_px: int = 0

    @classmethod
    def fit(
        cls,
        size_px: tuple[int, int],
        *,
        scale: float | None = None,
        canvas_px: tuple[int, int] | None = None,
        stride_px: int = 32,
        centred: bool = False,
    ) -> Self:
        """The largest letterbox of a picture at its aspect ratio.

        Args:
            size_px: Width and height of the picture.
            scale: Wanted; smaller where the canvas is too small. Absent: what the canvas allows.
            canvas_px: Width and height. Absent: the scaled picture's, rounded up to strides.
            stride_px: Of which width and height of the canvas are multiples, where it is free.
            centred: Whether the padding goes to both sides, or to the right and below.
        """
        width, height = size_px
        if canvas_px is not None:
            largest = min(canvas_px[0] / width, canvas_px[1] / height)
            scale = largest if scale is None else min(scale, largest)
        elif scale is None:
            scale = 1.0
        inner = (max(round(width * scale), 1), max(round(height * scale), 1))
        if canvas_px is None:
            canvas_px = (_up(inner[0], stride_px), _up(inner[1], stride_px))
        left = (canvas_px[0] - inner[0]) // 2 if centred else 0
        top = (canvas_px[1] - inner[1]) // 2 if centred else 0
        return cls(size_px, inner, canvas_px, left, top)

    @property
    def scale(self) -> tuple[float, float]:
        """Pixels of the canvas for a pixel of the picture, along x and y."""
        return self.inner_px[0] / self.size_px[0], self.inner_px[1] / self.size_px[1]

    def apply(self, image: NDArray[np.uint8], pad: int = 114) -> NDArray[np.uint8]:
        """Scale a picture onto the canvas.

        Args:
            image: (H, W, 3), of ``size_px``.
            pad: Grey value of the padding.

        Returns:
            (H, W, 3) of ``canvas_px``; the picture itself where nothing has to be done.
        """
        if self.inner_px != self.size_px:
            smaller = self.inner_px[0] < self.size_px[0]
            # Areas are averaged, or what is smaller than the step between samples is lost.
            method = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
            image = np.asarray(cv2.resize(image, self.inner_px, interpolation=method), np.uint8)
        if self.inner_px == self.canvas_px:
            return image
        (width, height), (inner_width, inner_height) = self.canvas_px, self.inner_px
        canvas = np.full((height, width, 3), pad, dtype=np.uint8)
        bottom, right = self.top_px + inner_height, self.left_px + inner_width
        canvas[self.top_px : bottom, self.left_px : right] = image
        return canvas

    def to_picture(self, xyxy_px: FloatArray) -> FloatArray:
        """Map boxes (N, 4) px from the canvas to the picture; those in the padding lie outside."""
        moved: FloatArray = xyxy_px - np.tile([self.left_px, self.top_px], 2).astype(np.float64)
        back: FloatArray = moved / np.tile(self.scale, 2)
        return back


def _up(length: int, stride: int) -> int:
    return -(-length // stride) * stride
