"""The seam of stage 1: the protocol of a detector."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from sightline.types import Boxes, Frame


class Detector(Protocol):
    """Detects vessels or vehicles in frames.

    A detector may remember the frames that it has seen; they come in the order of time.
    """

    def detect(self, frame: Frame) -> Boxes:
        """Detect boxes in a frame.

        Args:
            frame: The next picture.

        Returns:
            Boxes with the frame's number and time, and the detector's name as their source.
        """
        ...

    def reset(self) -> None:
        """Forget the frames seen so far: the next one is of another recording."""
        ...


@runtime_checkable
class BatchDetector(Detector, Protocol):
    """A detector that takes several frames at once.

    Attributes:
        batch_size: How many frames it wants, at least 1; the last batch may have fewer.
    """

    batch_size: int

    def detect_batch(self, frames: Sequence[Frame]) -> Sequence[Boxes]:
        """Detect boxes in each of the frames, in their order; see `Detector.detect`."""
        ...
