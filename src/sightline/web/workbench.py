"""What the page of drawing shows and changes: boxes of a recording, and control points."""

from __future__ import annotations

import dataclasses
import math
import threading
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sightline.text import encodable_text

if TYPE_CHECKING:
    from sightline.labelling.control_points import ControlPointSheet
    from sightline.labelling.drawing import Drawing


class Workbench:
    """One drawing and one sheet of control points, for any number of pages at once.

    Args:
        drawing: The boxes.
        sheet: The control points.
        annotator: Who draws.
        scene: Its name, as the page shows it.
        shore: GeoJSON that the map shows, or None.
    """

    def __init__(
        self,
        drawing: Drawing,
        sheet: ControlPointSheet,
        *,
        annotator: str = "",
        scene: str = "",
        shore: bytes | None = None,
    ) -> None:
        self.drawing = drawing
        self.sheet = sheet
        self.shore = shore
        self._annotator, self._scene = annotator, scene
        # One change after the other, and none while the state is put together.
        self._lock = threading.RLock()

    def about(self) -> dict[str, object]:
        """What does not change while it is served."""
        return {
            "scene": encodable_text(self._scene),
            "recording": encodable_text(self.drawing.recording.name),
            "annotator": encodable_text(self._annotator),
            "frame_size_px": list(self.drawing.frame_size_px),
            "shore": self.shore is not None,
        }

    def frames(self) -> dict[str, object]:
        """The frames of the recording, a column each."""
        with self._lock:
            every = self.drawing.frames()
        return {
            "frame": [one.frame for one in every],
            "time_utc_s": [plain(one.time_utc_s) for one in every],
            "gap_s": [plain(one.gap_s) for one in every],
        }

    def state(self) -> dict[str, object]:
        """Boxes, what is suggested, and what the fit makes of them."""
        with self._lock:
            told = {
                "boxes": self.drawing.boxes(),
                "suggested": self.drawing.suggested(),
                "advice": self.drawing.advice(),
            }
        cleaned = plain(told)
        assert isinstance(cleaned, dict)
        return cleaned

    def change(self, action: Callable[[], object]) -> dict[str, object]:
        """The state after a change, and what the change gave.

        Raises:
            InputError: It cannot be made.
        """
        with self._lock:
            result = plain(action())
            return {**self.state(), "result": result}

    def picture(self, frame: int) -> NDArray[np.uint8]:
        """A frame's picture, (H, W, 3), blue, green, red.

        Raises:
            InputError: There is no such frame, or it cannot be read.
        """
        return self.drawing.picture(frame)
