"""The seam of stage 1."""

from __future__ import annotations

from typing import Protocol

from sightline.types import Boxes, Frame


class Detector(Protocol):
    """What finds vessels or vehicles in pictures.

    A detector may remember the frames that it has seen; they come in the order of time.
    """

    def detect(self, frame: Frame) -> Boxes:
        """The boxes in a frame.

        Args:
            frame: The next picture.

        Returns:
            Boxes with the frame's number and time, and the detector's name as their source.
        """
        ...

    def reset(self) -> None:
        """Forget the frames seen so far: the next one is of another recording."""
        ...
