"""What the page of drawing shows and changes: boxes of a recording, and control points."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sightline.errors import InputError
from sightline.labelling.expected import TargetSize, expect, place_of
from sightline.scene import Recording, Scene
from sightline.text import encodable_text

if TYPE_CHECKING:
    from sightline.labelling.advice import Advice
    from sightline.labelling.control_points import ControlPointSheet
    from sightline.labelling.drawing import Drawing, DrawnBox

_SUGGESTED = 30


class Workbench:
    """One drawing and one sheet of control points, for any number of pages at once.

    Args:
        scene: The scene file.
        drawing: The boxes of one of its recordings.
        sheet: Its control points.
        shore: GeoJSON that the map shows, or None.

    Raises:
        InputError: The scene cannot be used.
    """

    def __init__(
        self,
        scene: Path,
        drawing: Drawing,
        sheet: ControlPointSheet,
        *,
        shore: bytes | None = None,
    ) -> None:
        loaded = Scene.load(scene)
        self.drawing = drawing
        self.sheet = sheet
        self.shore = shore
        self._name = loaded.camera.name or scene.stem
        self._recording = loaded[drawing.recording]
        self._places_deg = _places(loaded, self._recording)
        self._time_utc_s = {one.frame: one.time_utc_s for one in drawing.frames()}

    def about(self) -> dict[str, object]:
        """What does not change while it is served."""
        return {
            "scene": encodable_text(self._name),
            "recording": encodable_text(self.drawing.recording),
            "annotator": encodable_text(self.drawing.annotator),
            "frame_size_px": list(self.drawing.frame_size_px),
            "shore": self.shore is not None,
            "places_deg": [list(place) for place in self._places_deg],
        }

    def frames(self) -> dict[str, object]:
        """The frames of the recording, a column each."""
        every = self.drawing.frames()
        return {
            "frame": [one.frame for one in every],
            "time_utc_s": [_number(one.time_utc_s) for one in every],
            "gap_s": [_number(one.gap_s) for one in every],
        }

    def state(self) -> dict[str, object]:
        """Boxes, what is suggested, and what the fit makes of them."""
        return {
            "boxes": [_box(one) for one in self.drawing.boxes()],
            "suggested": self.drawing.suggested(_SUGGESTED),
            "advice": _advice(self.drawing.advice()),
        }

    def change(self, action: Callable[[], object]) -> dict[str, object]:
        """The state after a change, and how much the change gave.

        Raises:
            InputError: It cannot be made.
        """
        result = action()
        count = len(result) if isinstance(result, list) else int(result is not False)
        return {**self.state(), "count": count}

    def expected(self, frame: int) -> dict[str, object]:
        """Where the newest fit has the logged target in a frame, if it knows.

        Args:
            frame: Its number.
        """
        nothing: dict[str, object] = {"box_px": None}
        model = self.drawing.advice().georeferencer
        time_utc_s = self._time_utc_s.get(frame, math.nan)
        if model is None or not math.isfinite(time_utc_s):
            return nothing
        times = np.array([time_utc_s])
        try:
            levels = self._recording.water_levels()
            place = place_of(self._recording, model, times)
            found = expect(place, model, TargetSize(), None if levels is None else levels.at(times))
        except InputError:
            # It is a hint: what there is to be said of log and fit, the advice says.
            return nothing
        box = found.xyxy_px[0]
        return {"box_px": box.tolist()} if np.isfinite(box).all() else nothing

    def picture(self, frame: int) -> NDArray[np.uint8]:
        """A frame's picture, (H, W, 3), blue, green, red.

        Raises:
            InputError: There is no such frame, or it cannot be read.
        """
        return self.drawing.picture(frame)


def _places(scene: Scene, recording: Recording) -> list[tuple[float, float]]:
    """Latitude and longitude of the camera, where it is known, and corners of where the log goes."""
    camera = scene.camera.place_deg
    places = [] if camera is None else [camera]
    try:
        fixes = recording.fixes()
    except InputError:
        # Control points are wanted just where there is no log.
        return places
    if len(fixes):
        north, east = fixes.latitude_deg, fixes.longitude_deg
        places += [(float(north.min()), float(east.min())), (float(north.max()), float(east.max()))]
    return places


def _number(value: float) -> float | None:
    """A number as JSON can hold it."""
    return float(value) if math.isfinite(value) else None


def _box(box: DrawnBox) -> dict[str, object]:
    return {
        "frame": box.frame,
        "box_px": list(box.xyxy_px),
        "annotator": encodable_text(box.annotator),
        "accepted": box.accepted,
        "confidence": _number(box.confidence),
    }


def _advice(advice: Advice) -> dict[str, object]:
    return {
        "running": advice.running,
        "boxes": advice.boxes,
        "rmse_m": _number(advice.rmse_m),
        "left_out": advice.left_out,
        "parameters": [
            {
                "name": one.name,
                "value": _number(one.value),
                "sigma": _number(one.sigma),
                "unit": one.unit,
                "determined": one.determined,
            }
            for one in advice.parameters
        ],
        "odd": [
            {
                "recording": encodable_text(one.recording),
                "frame": one.frame,
                "annotator": encodable_text(one.annotator),
                "sigmas": _number(one.sigmas),
                "error_m": _number(one.error_m),
                "why": encodable_text(one.why),
            }
            for one in advice.odd
        ],
        "thin": [
            {
                "cell_px": [one.x1, one.y1, one.x2, one.y2],
                "boxes": one.boxes,
                "passes": one.passes,
                "frames": list(one.frames),
            }
            for one in advice.thin
        ],
        "enough": advice.enough,
        "reason": encodable_text(advice.reason),
        "axis_m": _number(advice.axis_m),
        "gain": _number(advice.gain),
        "statements": [encodable_text(one) for one in advice.statements],
        "error": encodable_text(advice.error),
    }
