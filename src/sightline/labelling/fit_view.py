"""What a fit says of a picture, to be held against what is seen: the log and the water in it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sightline.errors import InputError
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.overlay import fixes_sigma_of, still_camera
from sightline.overlay.rectified import Rectifier, resolved_m
from sightline.overlay.water_view import WaterView, ellipse_outline, grid_spacing_m
from sightline.reference_trajectory import ReferenceTrajectory
from sightline.scene import Recording
from sightline.scene.correspondences import levels_at
from sightline.types import FloatArray

AROUND_S = 30.0
"""Fixes so long before and after a picture are drawn into it."""

_MOST_FIXES = 60
# Water that rises by less moves nothing by a pixel that matters.
_LEVEL_STEP_M = 0.02


@dataclass(frozen=True, eq=False)
class WaterLines:
    """Lines of the water in a picture, each (N, 2) pixels; NaN where it is not seen.

    Attributes:
        horizon_px: The horizon.
        rings: Circles about the camera: radius in metres, and pixels.
        grid: Lines of equal east and of equal north.
        spacing_m: Between the lines of the grid.
    """

    horizon_px: FloatArray
    rings: tuple[tuple[float, FloatArray], ...]
    grid: tuple[FloatArray, ...]
    spacing_m: float


@dataclass(frozen=True, eq=False)
class LoggedPlace:
    """A place of a log, on the earth and in a picture, with its 95 % ellipse.

    Attributes:
        name: Of the vessel; ``""`` where the log tells none.
        fix: Whether it is a fix of the log; else it lies between two, at the picture's time.
        after_s: Seconds after the picture was taken, by the offset that was asked for.
        place_deg: Latitude and longitude.
        pixel_px: (2,) NaN where it is not seen.
        ellipse_px: (N, 2) outline as it lies on the water in the picture.
        ellipse_deg: (N, 2) the same on the earth, latitude and longitude.
    """

    name: str
    fix: bool
    after_s: float
    place_deg: tuple[float, float]
    pixel_px: FloatArray
    ellipse_px: FloatArray
    ellipse_deg: FloatArray


class FitView:
    """Pictures of a recording beside what a fit and the log say of them.

    Args:
        recording: Whose pictures and log.
        model: With a camera that stands still.

    Raises:
        InputError: The model has none, or the log cannot be used.
    """

    def __init__(self, recording: Recording, model: Georeferencer) -> None:
        self.model = model
        self._recording, self._camera = recording, still_camera(model)
        self._paths: list[ReferenceTrajectory] = []
        if recording.fixes_path is not None:
            self._paths = [
                ReferenceTrajectory.of(one.fixes, model.plane, one.velocity_mps)
                for one in recording.logs()
            ]
        self._rectifiers: dict[tuple[float, float], Rectifier] = {}

    @property
    def logs(self) -> int:
        """How many vessels the log tells of."""
        return len(self._paths)

    @property
    def clock_offset_s(self) -> float:
        """How far the camera's clock is ahead of the log's, as the fit has it, seconds."""
        known = self.model.report.clock_offset_s.get(self._recording.name)
        return self._recording.clock_offset_s if known is None else -known

    def water(self, time_utc_s: float) -> WaterLines:
        """The water in a picture.

        Args:
            time_utc_s: When it was taken, POSIX seconds; NaN where that is not known.

        Raises:
            InputError: The water level is needed and not known.
        """
        view = self._view(time_utc_s)
        rings = tuple(view.rings())
        # Further out the lines of a grid lie on one another.
        reach_m = min(rings[-1][0], resolved_m(view)) if rings else 0.0
        spacing_m = grid_spacing_m(reach_m) if rings else math.nan
        grid = tuple(view.grid(reach_m, spacing_m)) if rings else ()
        return WaterLines(view.horizon_px(), rings, grid, spacing_m)

    def log(self, time_utc_s: float, clock_offset_s: float) -> list[LoggedPlace]:
        """The log about the time of a picture.

        Of one vessel these are its fixes and, first, where it was at that time; of the many of an
        AIS feed only the latter.

        Args:
            time_utc_s: When it was taken by the camera's own clock, POSIX seconds.
            clock_offset_s: How far that is taken to be ahead of the log's.

        Raises:
            InputError: The water level is needed and not known.
        """
        log_s = time_utc_s - clock_offset_s
        if not self._paths or not math.isfinite(log_s):
            return []
        view, own_m = self._view(log_s), fixes_sigma_of(self.model)
        found = []
        for path in self._paths:
            now = path.at(np.array([log_s]))
            if np.isfinite(now.east_north_m).all():
                sigma_m = float(np.hypot(own_m, now.sigma_m[0]))
                found.append(self._logged(view, now.east_north_m[0], sigma_m, path.name))
        if len(self._paths) > 1:
            return found
        (path,) = self._paths
        near = np.flatnonzero(np.abs(path.time_utc_s - log_s) <= AROUND_S)
        near = near[:: max(math.ceil(near.size / _MOST_FIXES), 1)]
        for row in near.tolist():
            place, after_s = path.east_north_m[row], float(path.time_utc_s[row] - log_s)
            found.append(self._logged(view, place, own_m, path.name, after_s))
        return found

    def rmse_m(
        self,
        boxes_xyxy_px: Sequence[tuple[float, float, float, float]],
        sources: Sequence[str],
        time_utc_s: FloatArray,
        clock_offset_s: float,
    ) -> tuple[float, int]:
        """How far boxes lie from the log at an offset: root mean square, and of how many.

        Args:
            boxes_xyxy_px: N boxes.
            sources: N names of who drew them.
            time_utc_s: (N,) by the camera's own clock.
            clock_offset_s: How far that is taken to be ahead of the log's.
        """
        log_s = np.asarray(time_utc_s) - clock_offset_s
        if len(self._paths) != 1 or not len(boxes_xyxy_px):
            return math.nan, 0
        there = self._paths[0].at(log_s).east_north_m
        rows = np.flatnonzero(np.isfinite(there).all(axis=1))
        if not rows.size:
            return math.nan, 0
        levels = self._levels(log_s[rows])
        found = self.model.locate(
            np.array(boxes_xyxy_px, dtype=float)[rows], np.array(sources)[rows], levels
        )
        apart = np.hypot(found.east_m - there[rows, 0], found.north_m - there[rows, 1])
        known = np.isfinite(apart)
        if not known.any():
            return math.nan, 0
        return float(np.sqrt(np.mean(apart[known] ** 2))), int(known.sum())

    def rectifier(self, time_utc_s: float, reach_m: float = math.inf) -> Rectifier:
        """What lays a picture onto the map.

        Args:
            time_utc_s: When it was taken, POSIX seconds; NaN where that is not known.
            reach_m: It reaches no further.

        Raises:
            InputError: The camera sees no water, or the water level is needed and not known.
        """
        key = self._above_m(time_utc_s), reach_m
        known = self._rectifiers.get(key)
        if known is None:
            view = self._view(time_utc_s)
            known = Rectifier.of(view, self.model.plane, reach_m=reach_m)
            self._rectifiers = {key: known}
        return known

    def _logged(
        self,
        view: WaterView,
        place: FloatArray,
        sigma_m: float,
        name: str,
        after_s: float | None = None,
    ) -> LoggedPlace:
        outline = ellipse_outline(place, sigma_m**2 * np.eye(2))
        plane = self.model.plane
        latitude, longitude = plane.to_geographic(*place[:, None])
        return LoggedPlace(
            name=name,
            fix=after_s is not None,
            after_s=after_s or 0.0,
            place_deg=(float(latitude[0]), float(longitude[0])),
            pixel_px=view.pixels(place)[0],
            ellipse_px=view.pixels(outline),
            ellipse_deg=np.stack(plane.to_geographic(*outline.T), axis=1),
        )

    def _view(self, time_utc_s: float) -> WaterView:
        return WaterView.of(self._camera, self._above_m(time_utc_s))

    def _levels(self, time_utc_s: FloatArray) -> FloatArray | None:
        if self.model.water_level_m is None or self._recording.water_levels() is None:
            # Where the model needs one it says so itself.
            return None
        return levels_at(self._recording, time_utc_s)

    def _above_m(self, time_utc_s: float) -> float:
        if self.model.water_level_m is None:
            return 0.0
        if not math.isfinite(time_utc_s):
            raise InputError(
                "nothing tells when this picture was taken, nor how high the water was"
            )
        above = self.model.above_m(self._levels(np.array([time_utc_s])))
        return round(float(np.ravel(above)[0]) / _LEVEL_STEP_M) * _LEVEL_STEP_M
