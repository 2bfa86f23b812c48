"""What the page shows of a fit, to be held against the picture: the log and the water in it."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from sightline.errors import InputError
from sightline.labelling.fit_view import FitView, LoggedPlace
from sightline.overlay.rectified import Rectifier, webp
from sightline.text import encodable_text
from sightline.types import FloatArray

if TYPE_CHECKING:
    from sightline.georeferencing.georeferencer import Georeferencer
    from sightline.labelling.drawing import Drawing
    from sightline.scene import Recording

_NO_FIT = (
    "there is no fit yet to be looked at: draw boxes, give control points, or name a model "
    "(--model FILE)"
)


class FitBench:
    """Looks at pictures of a recording with the model that is given, or the newest fit.

    Args:
        drawing: The recording.
        model: What is looked at; None: the newest fit to the boxes, else that to control points.
        name: Of the model, as people know it.
        points_fit: Gives the newest fit to control points, or None.
    """

    def __init__(
        self,
        drawing: Drawing,
        model: Georeferencer | None = None,
        name: str = "",
        points_fit: Callable[[], Georeferencer | None] = lambda: None,
    ) -> None:
        self._drawing, self._model, self._name = drawing, model, name
        self._points_fit = points_fit
        self._view: tuple[Georeferencer, Recording, FitView] | None = None
        self._lock = threading.Lock()

    def about(self) -> dict[str, object]:
        """What is looked at, and what is known of the clock; with a reason where there is none."""
        recording = self._drawing.logged
        prior = recording.clock_prior
        stated_s = prior.mean_s if prior.stated else None
        try:
            view, words = self._current()
        except InputError as error:
            return {"reason": encodable_text(str(error)), "stated_s": stated_s}
        found = view.model.report.clocks.get(recording.name)
        camera = view.model.camera
        assert camera is not None, "a view has one"
        latitude, longitude = view.model.plane.to_geographic([camera.east_m], [camera.north_m])
        return {
            "reason": "",
            "model": words,
            "logs": view.logs,
            "camera_deg": [float(latitude[0]), float(longitude[0])],
            "clock_offset_s": view.clock_offset_s,
            "clock_sigma_s": None if found is None else _number(found.sigma_s),
            "stated_s": stated_s,
        }

    def water(self, frame: int) -> dict[str, object]:
        """Lines of the water in a picture.

        Raises:
            InputError: There is no such frame or no fit, or the water level is not known.
        """
        view, _ = self._current()
        lines = view.water(self._log_time_s(frame, view))
        size = self._drawing.frame_size_px
        return {
            "horizon_px": segments(lines.horizon_px, size),
            "rings": [
                {"radius_m": radius_m, "lines_px": segments(ring, size)}
                for radius_m, ring in lines.rings
            ],
            "grid_px": [part for one in lines.grid for part in segments(one, size)],
            "spacing_m": _number(lines.spacing_m),
        }

    def log(self, frame: int, clock_offset_s: float | None) -> dict[str, object]:
        """The log in a picture, if the camera's clock is ahead by so much.

        Args:
            frame: Its number.
            clock_offset_s: Seconds; None: as the fit has it.

        Raises:
            InputError: As `water`.
        """
        view, _ = self._current()
        offset_s = view.clock_offset_s if clock_offset_s is None else clock_offset_s
        places = view.log(self._camera_time_s(frame), offset_s)
        drawn = [box for box in self._drawing.boxes() if box.accepted]
        times = np.array([self._camera_time_s(box.frame) for box in drawn])
        rmse_m, count = view.rmse_m(
            [box.xyxy_px for box in drawn], [box.annotator for box in drawn], times, offset_s
        )
        size = self._drawing.frame_size_px
        return {
            "clock_offset_s": offset_s,
            "places": [_place(one, size) for one in places],
            "rmse_m": _number(rmse_m),
            "boxes": count,
        }

    def on_the_map(self, frame: int, reach_m: float | None = None) -> dict[str, object]:
        """Where a picture lies on the map.

        Args:
            frame: Its number.
            reach_m: It reaches no further; None: as far as its rows tell ranges apart.

        Raises:
            InputError: As `water`; or the camera sees no water near enough.
        """
        return self._rectifier(frame, reach_m).about()

    def rectified(self, frame: int, reach_m: float | None = None) -> bytes:
        """A picture as it lies on the map, WebP with transparent parts.

        Args:
            frame: Its number.
            reach_m: As for `on_the_map`.

        Raises:
            InputError: As `on_the_map`.
        """
        rectifier = self._rectifier(frame, reach_m)
        return webp(rectifier.rectified(self._drawing.picture(frame)))

    def state_clock(self, offset_s: float | None) -> dict[str, object]:
        """Write the clock offset into the scene file; None takes it out.

        Raises:
            InputError: It cannot be written.
        """
        before_s = self._drawing.state_clock(offset_s)
        return {**self.about(), "before_s": before_s}

    def _rectifier(self, frame: int, reach_m: float | None) -> Rectifier:
        view, _ = self._current()
        return view.rectifier(self._log_time_s(frame, view), reach_m or math.inf)

    def _current(self) -> tuple[FitView, str]:
        """The view of the model that is looked at, and what that is."""
        advice = self._drawing.advice()
        model, words = self._model, encodable_text(self._name)
        if model is None and advice.georeferencer is not None:
            model, words = advice.georeferencer, f"the fit to {advice.boxes} boxes"
        if model is None:
            model, words = self._points_fit(), "the fit to control points"
        if model is None:
            raise InputError(advice.error or _NO_FIT)
        if model.image_size_px != self._drawing.frame_size_px:
            raise InputError(
                f"{words}: learned from pictures of {model.image_size_px} px, and these have "
                f"{self._drawing.frame_size_px} px"
            )
        recording = self._drawing.logged
        with self._lock:
            known = self._view
            if known is None or known[0] is not model or known[1] is not recording:
                known = (model, recording, FitView(recording, model))
                self._view = known
        return known[2], words

    def _camera_time_s(self, frame: int) -> float:
        """When a frame was taken by the camera's own clock; NaN where nothing tells it."""
        return self._drawing.time_utc_s(frame) + self._drawing.logged.clock_offset_s

    def _log_time_s(self, frame: int, view: FitView) -> float:
        return self._camera_time_s(frame) - view.clock_offset_s


def segments(points_px: FloatArray, size_px: tuple[int, int]) -> list[list[list[float]]]:
    """The parts of a line that are in or near a picture, each two points or more.

    Args:
        points_px: (N, 2) pixels; NaN where it is not seen.
        size_px: Width and height.
    """
    width, height = size_px
    x, y = points_px.T
    with np.errstate(invalid="ignore"):
        near = (np.abs(x - 0.5 * width) <= width) & (np.abs(y - 0.5 * height) <= height)
    rows = np.flatnonzero(near)
    parts = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    return [np.round(points_px[part], 1).tolist() for part in parts if part.size > 1]


def _place(place: LoggedPlace, size_px: tuple[int, int]) -> dict[str, object]:
    seen = np.isfinite(place.pixel_px).all()
    return {
        "name": encodable_text(place.name),
        "fix": place.fix,
        "after_s": round(place.after_s, 3),
        "place_deg": list(place.place_deg),
        "pixel_px": np.round(place.pixel_px, 2).tolist() if seen else None,
        "ellipse_px": segments(place.ellipse_px, size_px),
        "ellipse_deg": place.ellipse_deg[::3].round(8).tolist(),
    }


def _number(value: float) -> float | None:
    """A number as JSON can hold it."""
    return float(value) if math.isfinite(value) else None
