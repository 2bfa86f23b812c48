"""The seam of stage 2: the protocol of a tracker."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from sightline.types import Boxes


@runtime_checkable
class Tracker(Protocol):
    """Assigns track ids: which boxes are of the same target."""

    def update(self, boxes: Boxes) -> Boxes:
        """Assign track ids to the boxes of one moment.

        Args:
            boxes: All of one time, later than the boxes before. No boxes tell no time and change
                nothing. In the pipeline they are `LocatedBoxes`, with their positions.

        Returns:
            Those boxes that belong to a confirmed track, with its id, in the order given.

        Raises:
            InputError: Times are not known, differ, or are not later than those before.
        """
        ...

    def reset(self) -> None:
        """Forget all targets, as between recordings; ids go on from where they were."""
        ...
