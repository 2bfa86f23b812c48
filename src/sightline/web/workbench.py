"""What the page of drawing shows and changes: boxes of a recording, and control points."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sightline.detection import DEFAULT_DETECTOR, Detector
from sightline.errors import InputError, SightlineError
from sightline.labelling.control_points import (
    ControlPointReport,
    ControlPointSheet,
    SheetPoint,
    fit_points,
    parse_position,
)
from sightline.labelling.expected import TargetSize, expect, place_of
from sightline.scene import Recording, Scene
from sightline.text import encodable_text
from sightline.web.fit_bench import FitBench
from sightline.web.pages import about_tiles
from sightline.web.whose_bench import WhoseBench

if TYPE_CHECKING:
    from sightline.formats.tiles import Tiles
    from sightline.georeferencing.georeferencer import Georeferencer
    from sightline.labelling.advice import Advice
    from sightline.labelling.drawing import Drawing, DrawnBox

_SUGGESTED = 30


class Workbench:
    """The boxes of one recording and the control points of its scene, for any number of pages.

    Args:
        scene: The scene file.
        drawing: The boxes of one of its recordings.
        shore: GeoJSON that the map shows, or None.
        tiles: A basemap that the map shows, or None.
        model: A model that is held against the pictures, instead of the newest fit.
        model_name: What it is called.
        detector: Finds the boxes among which logged vessels are recognised, where the scene has
            none of them.

    Raises:
        InputError: The scene cannot be used.
    """

    def __init__(
        self,
        scene: Path,
        drawing: Drawing,
        *,
        shore: bytes | None = None,
        tiles: Tiles | None = None,
        model: Georeferencer | None = None,
        model_name: str = "",
        detector: str | Detector = DEFAULT_DETECTOR,
    ) -> None:
        loaded = Scene.load(scene)
        self.drawing = drawing
        self.points = PointBench(scene)
        self.shore, self.tiles = shore, tiles
        self._name = loaded.camera.name or scene.stem
        self.whose = WhoseBench(scene, drawing, detector)
        self.fit = FitBench(drawing, model, model_name, self.points.newest)
        self._places_deg = _places(loaded, loaded[drawing.recording])

    def about(self) -> dict[str, object]:
        """What does not change while it is served."""
        return {
            "scene": encodable_text(self._name),
            "recording": encodable_text(self.drawing.recording),
            "annotator": encodable_text(self.drawing.annotator),
            "frame_size_px": list(self.drawing.frame_size_px),
            "shore": self.shore is not None,
            "basemap": about_tiles(self.tiles),
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
        model, recording = self.drawing.advice().georeferencer, self.drawing.logged
        try:
            times = np.array([self.drawing.time_utc_s(frame)])
            if model is None or not np.isfinite(times).all():
                return nothing
            levels = recording.water_levels()
            place = place_of(recording, model, times)
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


class PointBench:
    """The control points of a scene, as the page shows and changes them.

    Args:
        scene: The scene file.
    """

    def __init__(self, scene: Path) -> None:
        self._sheet: ControlPointSheet | None = None
        self._refused = ""
        # One fit at a time is enough for two cores.
        self._fitting = threading.Lock()
        self._asked = 0
        self._scene, self._tried = scene, False
        self._fitted: Georeferencer | None = None
        try:
            self._sheet = ControlPointSheet(scene)
        except InputError as error:
            # Boxes can be drawn nevertheless.
            self._refused = str(error)

    def shown(self) -> dict[str, object]:
        """All points, and why there can be none."""
        points = [] if self._sheet is None else self._sheet.points()
        return {"points": [_point(one) for one in points], "error": encodable_text(self._refused)}

    def newest(self) -> Georeferencer | None:
        """The newest fit to the points; None where none is possible."""
        with self._fitting:
            if self._fitted is None and not self._tried:
                # Points that the page cannot change are there to be looked at as well.
                self._tried = True
                with suppress(SightlineError):
                    if len(Scene.load(self._scene).control_points):
                        self._fitted = fit_points(self._scene)[1]
            return self._fitted

    def fit(self, *, left_out: bool) -> dict[str, object]:
        """What a fit makes of each point; ``stale`` where a newer one was asked for meanwhile.

        Args:
            left_out: Whether each is held against a fit without it, too, which takes longer.

        Raises:
            InputError: The points cannot be read.
        """
        if self._sheet is None or not self._sheet.points():
            return {"points": [], "error": "", "stale": False}
        self._asked += 1
        number = self._asked
        with self._fitting:
            if number != self._asked:
                return {"points": [], "error": "", "stale": True}
            report = self._sheet.residuals(left_out=left_out)
            points = self._sheet.points()
            self._fitted = report.georeferencer
        places = _fitted_places(report, points)
        return {
            "points": [
                {
                    "number": one.number,
                    "error_m": _number(one.error_m),
                    "left_out_m": _number(one.left_out_m),
                    "residual_px": _number(one.residual_px),
                    "outlier": one.outlier,
                    "place_deg": places.get(one.number),
                }
                for one in report.points
            ],
            "error": encodable_text(report.error),
            "stale": False,
            "rmse_m": _number(report.rmse_m),
            "left_out_m": _number(report.left_out_m),
        }

    def add(self, pixel_px: tuple[float, float], place: str, name: str) -> None:
        """Add a point; its place as people paste it.

        Raises:
            InputError: It cannot be read or kept.
        """
        latitude, longitude = parse_position(place)
        self._own().add(pixel_px, latitude, longitude, name)

    def move(self, number: int, pixel_px: tuple[float, float], place: str) -> None:
        """Move a point.

        Raises:
            InputError: As `add`, or there is no such point.
        """
        self._own().move(number, pixel_px=pixel_px, place_deg=parse_position(place))

    def remove(self, number: int) -> None:
        """Take a point away.

        Raises:
            InputError: There is no such point, or it cannot be written.
        """
        self._own().remove(number)

    def undo(self) -> bool:
        """Take the last change back; whether there was one.

        Raises:
            InputError: Somebody else has changed it since.
        """
        return self._own().undo()

    def redo(self) -> bool:
        """Make what was taken back again; whether there was something.

        Raises:
            InputError: Somebody else has changed it since.
        """
        return self._own().redo()

    def _own(self) -> ControlPointSheet:
        if self._sheet is None:
            raise InputError(self._refused)
        return self._sheet


def _fitted_places(
    report: ControlPointReport, points: list[SheetPoint]
) -> dict[int, list[float] | None]:
    """Latitude and longitude of where the fit has the pixel of each point, where it has one."""
    model = report.georeferencer
    if model is None or model.camera is None or not points:
        return {}
    east, north = model.camera.locate(np.array([(one.x_px, one.y_px) for one in points]))
    latitude, longitude = model.plane.to_geographic(east, north)
    places = np.stack([latitude, longitude], axis=1)
    return {
        one.number: place.tolist() if np.isfinite(place).all() else None
        for one, place in zip(points, places, strict=True)
    }


def _point(point: SheetPoint) -> dict[str, object]:
    return {
        "number": point.number,
        "pixel_px": [point.x_px, point.y_px],
        "latitude_deg": point.latitude_deg,
        "longitude_deg": point.longitude_deg,
        "name": encodable_text(point.name),
    }


def _places(scene: Scene, recording: Recording) -> list[tuple[float, float]]:
    """Latitude and longitude of the camera, where it is known, and of where the log goes."""
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
