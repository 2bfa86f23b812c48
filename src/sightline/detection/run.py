"""A detector at work on the frames of a source, or of all recordings of a scene."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Protocol

import numpy as np

from sightline.detection.detector import Detector
from sightline.errors import InputError
from sightline.progress import Progress
from sightline.types import Boxes, Frame


class Looker(Protocol):
    """Whatever is shown pictures one after another, and remembers of them what it is for.

    What it has found out it tells by attributes or methods of its own.
    """

    def look(self, frame: Frame) -> object:
        """Look at the next picture; they come in the order of time."""
        ...


def shown(frames: Iterable[Frame], lookers: Iterable[Looker]) -> Iterator[Frame]:
    """Hand pictures on, each when all have looked at it: one pass serves them all.

    Args:
        frames: In the order of time.
        lookers: Are shown each picture.
    """
    lookers = tuple(lookers)
    for frame in frames:
        for looker in lookers:
            looker.look(frame)
        yield frame


def detect(
    frames: Iterable[Frame],
    detector: Detector,
    count: int | None = None,
    progress: Progress | None = None,
) -> Iterator[Boxes]:
    """The boxes of each frame, as the detector finds them.

    Args:
        frames: In the order of time.
        detector: Finds boxes.
        count: How many frames there are, where that is known.
        progress: Told how far it is.
    """
    for i, frame in enumerate(frames):
        if progress:
            progress("detecting", (i + 1) / count if count else float("nan"))
        yield detector.detect(frame)


def same_size(frames: Iterable[Frame], size_px: tuple[int, int], where: str) -> Iterator[Frame]:
    """Pass pictures on, and refuse those of another size than those that the model learned from.

    Raises:
        InputError: A picture has another size.
    """
    for frame in frames:
        own_px = (frame.image_bgr.shape[1], frame.image_bgr.shape[0])
        if own_px != size_px:
            raise InputError(
                f"{where}: its pictures have {own_px[0]} x {own_px[1]} px, the model learned "
                f"from {size_px[0]} x {size_px[1]} px; fit one to pictures of this size"
            )
        yield frame


def usable(frames: Iterable[Frame], size_px: tuple[int, int], where: str) -> Iterator[Frame]:
    """Pass pictures on, and refuse those that no target can be found and placed in.

    Raises:
        InputError: A picture has no time, or another size than those that the model learned from.
    """
    for frame in same_size(frames, size_px, where):
        if not np.isfinite(frame.time_utc_s):
            raise InputError(
                f"{where}: nothing tells the time of frame {frame.index}; give the start of the "
                "video (--start-utc), or a clock (--clock)"
            )
        yield frame
