"""Run a detector on the frames of a source, with observers of the same frames."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from typing import Protocol

import numpy as np

from sightline.camera.state import ObservedBoxes
from sightline.detection.detector import BatchDetector, Detector
from sightline.errors import InputError
from sightline.progress import Progress
from sightline.types import Frame


class FrameObserver(Protocol):
    """Observes frames one after another, and keeps what it needs of them.

    What it has found out it tells by attributes or methods of its own.
    """

    def observe(self, frame: Frame) -> object:
        """Observe the next frame; they come in the order of time."""
        ...


def observe(frames: Iterable[Frame], observers: Iterable[FrameObserver]) -> Iterator[Frame]:
    """Yield frames after all observers have observed them, so that one pass serves all (tee).

    Args:
        frames: In the order of time.
        observers: Observe each picture.
    """
    observers = tuple(observers)
    for frame in frames:
        for observer in observers:
            observer.observe(frame)
        yield frame


def detect(
    frames: Iterable[Frame],
    detector: Detector,
    count: int | None = None,
    progress: Progress | None = None,
) -> Iterator[ObservedBoxes]:
    """Detect the boxes of each frame, with the camera state.

    Args:
        frames: In the order of time.
        detector: Finds boxes, in one frame at a time, or in batches of frames (`BatchDetector`).
        count: How many frames there are, where that is known.
        progress: Told how far it is.
    """
    done = 0
    for batch in _batches(frames, getattr(detector, "batch_size", 1)):
        if isinstance(detector, BatchDetector):
            found = detector.detect_batch(batch)
        else:
            found = [detector.detect(frame) for frame in batch]
        for frame, boxes in zip(batch, found, strict=True):
            done += 1
            if progress:
                progress("detecting", done / count if count else float("nan"))
            yield ObservedBoxes.of_frame(boxes, frame)


def _batches(frames: Iterable[Frame], size: int) -> Iterator[list[Frame]]:
    waiting = iter(frames)
    while batch := list(itertools.islice(waiting, size)):
        yield batch


def same_size(frames: Iterable[Frame], size_px: tuple[int, int], where: str) -> Iterator[Frame]:
    """Pass frames on; raise InputError for those of another size than the model's.

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
    """Pass frames on; raise InputError for those of another size or without a time.

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
