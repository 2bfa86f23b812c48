"""Masks of a camera's picture: what is neither looked at nor kept."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.errors import InputError
from sightline.types import BoolArray, Boxes, Frame
from sightline.video.pictures import read_picture

GREY = 114
"""What stands where something is masked: networks take it for padding."""

_DARK = 128
# Between black and white there are the edges of what was painted.
_BLACK, _WHITE, _LEAST_PURE = 64, 192, 0.9
_HIDDEN_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Mask:
    """Which pixels of a camera's pictures are masked.

    Attributes:
        hidden: (H, W) bool.
        where: The file, for messages.
    """

    hidden: BoolArray
    where: str = "the mask"

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.hidden.shape[1], self.hidden.shape[0]

    def check_size(self, size_px: tuple[int, int], what: str) -> None:
        """Raise InputError for pictures of another size.

        Args:
            size_px: Their width and height.
            what: Whose they are, as ``recording 01``.

        Raises:
            InputError: They have another size.
        """
        if size_px != self.size_px:
            raise InputError(
                f"{self.where}: has {self.size_px[0]} x {self.size_px[1]} px, and the pictures of "
                f"{what} {size_px[0]} x {size_px[1]} px; a mask is as large as they are"
            )

    def painted(self, frames: Iterable[Frame], what: str) -> Iterator[Frame]:
        """Frames with grey where they are masked.

        Args:
            frames: Of the camera.
            what: Whose they are, for messages.

        Raises:
            InputError: They have another size.
        """
        for frame in frames:
            height, width = frame.image_bgr.shape[:2]
            self.check_size((width, height), what)
            image = frame.image_bgr.copy()
            image[self.hidden] = GREY
            yield replace(frame, image_bgr=image)

    def hides(self, boxes: Boxes) -> BoolArray:
        """(N,) bool, whether at least half of what a box has in the picture is masked."""
        sums = np.asarray(cv2.integral(self.hidden.astype(np.uint8)), dtype=np.int64)
        size = np.array(self.size_px)
        low = np.clip(np.floor(boxes.xyxy_px[:, :2]), 0, size - 1).astype(int)
        high = np.clip(np.ceil(boxes.xyxy_px[:, 2:]), low + 1, size).astype(int)
        (x1, y1), (x2, y2) = low.T, high.T
        masked = sums[y2, x2] - sums[y1, x2] - sums[y2, x1] + sums[y1, x1]
        return np.asarray(masked >= _HIDDEN_SHARE * (x2 - x1) * (y2 - y1), dtype=bool)


def read_mask(path: str | os.PathLike[str]) -> Mask:
    """A mask from a picture: masked where it is black; white and what is transparent is not.

    Raises:
        InputError: It cannot be read, is no picture in black and white, or masks everything.
    """
    if not os.path.isfile(path):
        raise InputError(f"{path}: there is no such file; expected a picture as a mask")
    shown = read_picture(path, transparent=255)
    grey: NDArray[np.uint8] = np.asarray(cv2.cvtColor(shown, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    pure = float(((grey < _BLACK) | (grey >= _WHITE)).mean())
    if pure < _LEAST_PURE:
        raise InputError(
            f"{path}: is no mask: {100.0 * (1.0 - pure):.0f} % of it is neither black nor white; "
            "paint black what is masked, and white all else"
        )
    hidden = grey < _DARK
    if hidden.all():
        raise InputError(
            f"{path}: masks all of the picture; paint black what is masked, and white all else"
        )
    return Mask(np.asarray(hidden, dtype=bool), str(path))
