"""The georeferencer: a fitted model with its plane and its fit report."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sightline.camera.motion import StaticInterval
from sightline.camera.parameters import LOG_FOCAL
from sightline.camera.pinhole import Camera
from sightline.camera.registration import ReferenceView
from sightline.camera.rotation import CameraRotation, compensate_rotation, widen
from sightline.camera.stabilisation import nominal_camera, stabilise
from sightline.camera.state import ObservedBoxes
from sightline.errors import InputError, SightlineError
from sightline.geodesy import LocalPlane
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.fit_report import FitReport
from sightline.georeferencing.model_file import damaged, read_model_file, write_model_file
from sightline.georeferencing.models import BoxModel, ModelType, model_type
from sightline.georeferencing.placement import Placement
from sightline.georeferencing.support import Support
from sightline.platform import Pose, on_earth
from sightline.tracking.static_map import StaticPlaces
from sightline.types import (
    BodyPositions,
    BoolArray,
    FloatArray,
    LocatedBoxes,
    Positions,
    check_boxes,
)

_VIEW = ("strips", "top_px", "left_px")
_OLD_NAMES = {
    "drift_m": "correlated_m",
    "drift_s": "correlation_time_s",
    "focal_log_sigma": "log_focal_sigma",
    "height_log_sigma": "log_height_sigma",
}
"""Settings of release 0.1, and their names now."""
_LARGEST_PX = 1_000_000
_TRIED_OUT = ((0.1, 0.5, 0.2, 0.6), (0.4, 0.6, 0.6, 0.8), (0.7, 0.8, 0.75, 0.9))
"""Corners of boxes, as shares of the picture."""
_DAMAGE = (
    ArithmeticError,
    AttributeError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
)


@dataclass(frozen=True, eq=False)
class Georeferencer:
    """Georeferences boxes with a fitted model.

    Attributes:
        model: Name of the model: one of `MODELS`, or another package's.
        regressor: From boxes to metres in the plane.
        plane: The camera is at its origin, as far as its place is known.
        image_size_px: Width and height of the images that it works on.
        support: Where in the image it has learned.
        report: What is to be known about the fit.
        horizon_px: Rows of the horizon at the left and the right edge of the image when the camera
            lies as it did for the model, None where it was taken never to roll or pitch.
        moving: Whether the camera stands on a platform that moves. Then places are to starboard
            and ahead of that: see `sightline.platform`.
        water_level_m: The level of the water that the height of the camera is over, metres above
            the datum of the scene's water levels; None where the water was taken to stand still.
        view: Reference view of the static scene, against which later frames show whether the camera
            was rotated since; None where there were no frames.
        static_places: Where in the image something stays, as the camera lay for the model; None
            where that was not learned.
    """

    model: str
    regressor: BoxModel
    plane: LocalPlane
    image_size_px: tuple[int, int]
    support: Support
    report: FitReport
    horizon_px: tuple[float, float] | None = None
    moving: bool = False
    view: ReferenceView | None = None
    water_level_m: float | None = None
    static_places: StaticPlaces | None = None

    @property
    def camera(self) -> Camera | None:
        """The fitted camera, where the model has one."""
        return self.regressor.camera

    @property
    def calibrated(self) -> CameraRegressor | None:
        """The camera model with its covariance, where the model is one of ours."""
        return self.regressor if isinstance(self.regressor, CameraRegressor) else None

    @property
    def reference_sigma_m(self) -> float:
        """Standard deviation of the logs' correlated error, metres east and north.

        White noise from fix to fix cannot be told from the boxes' own noise, and is part of each
        position's covariance. 0 where the model does not tell the two apart.
        """
        return self.regressor.reference_sigma_m

    def locate(
        self,
        boxes_xyxy_px: ArrayLike,
        source: ArrayLike | None = None,
        water_level_m: ArrayLike | None = None,
        *,
        pose: Pose | None = None,
    ) -> Positions:
        """Positions of boxes on the earth.

        Args:
            boxes_xyxy_px: (N, 4) pixels, x1, y1, x2, y2.
            source: Who made the boxes, (N,) str or one for all: the annotator's or detector's
                name, as in the fit. Its bias is taken off. The paper's models know no sources.
            water_level_m: How high the water stands, (N,) or one value for all, metres above the
                datum of the water levels of the fit; needed where there were such.
            pose: Where the platform was at the N boxes' times, in the model's plane, and how it
                pointed; needed where the camera stands on one that moves.

        Returns:
            N positions, NaN where there is none: at or above the horizon, or where the range
            would be less certain than half of itself.

        Raises:
            InputError: A box is reversed, or not a number; or the water level or the pose is
                missing, is given to a model that knows of none, or does not fit.

        Examples:
            >>> model = sightline.load("model.safetensors")
            >>> where = model.locate([600.0, 400.0, 640.0, 430.0], source="annotator")
            >>> where.latitude_deg.round(3).tolist(), where.longitude_deg.round(3).tolist()
            ([54.322], [10.139])
            >>> where.extrapolated.tolist()
            [False]
        """
        if pose is None and self.moving:
            raise InputError(
                "the model is of a camera on a platform that moves, so a box alone has no place on "
                "the earth; give the platform's pose (pose=platform.pose(times, model.plane)), or "
                "ask for places relative to the platform (locate_body)"
            )
        if pose is not None:
            return on_earth(self.locate_body(boxes_xyxy_px, source), pose)
        placed, extrapolated = self._place(boxes_xyxy_px, source, water_level_m)
        return Positions(
            east_m=placed.east_north_m[:, 0],
            north_m=placed.east_north_m[:, 1],
            covariance_m2=placed.covariance_m2,
            extrapolated=extrapolated,
            plane=self.plane,
            shared_covariance_m2=placed.shared_covariance_m2,
        )

    def locate_body(
        self, boxes_xyxy_px: ArrayLike, source: ArrayLike | None = None
    ) -> BodyPositions:
        """Positions of boxes in the body frame of the camera's platform.

        Args:
            boxes_xyxy_px: See `locate`.
            source: See `locate`.

        Raises:
            InputError: See `locate`; or the camera stands still.
        """
        if not self.moving:
            raise InputError(
                "the model is of a camera that stands still, so its boxes have places on the earth "
                "and none relative to a platform; ask for those (locate), or fit a model to "
                "recordings with platform logs"
            )
        placed, extrapolated = self._place(boxes_xyxy_px, source, None)
        return BodyPositions(
            starboard_m=placed.east_north_m[:, 0],
            ahead_m=placed.east_north_m[:, 1],
            covariance_m2=placed.covariance_m2,
            extrapolated=extrapolated,
            plane=self.plane,
            shared_covariance_m2=placed.shared_covariance_m2,
        )

    def _place(
        self,
        boxes_xyxy_px: ArrayLike,
        source: ArrayLike | None,
        water_level_m: ArrayLike | None,
    ) -> tuple[Placement, BoolArray]:
        """Places in the model's plane, and (N,) whether they are extrapolated."""
        boxes = np.asarray(boxes_xyxy_px, dtype=np.float64)
        boxes = boxes.reshape(-1, 4) if boxes.size == 0 or boxes.ndim == 1 else boxes
        check_boxes(boxes)
        names = None if source is None else np.asarray(source, dtype=np.str_)
        placed = self.regressor.locate(boxes, names, self.above_m(water_level_m))
        foot = np.empty((len(boxes), 2))
        foot[:, 0], foot[:, 1] = 0.5 * (boxes[:, 0] + boxes[:, 2]), boxes[:, 3]
        known = np.isfinite(placed.east_north_m[:, 0])
        return placed, ~(known & self.support.holds(foot))

    def check_water(self, given: bool, where: str = "") -> None:
        """Raise InputError where a water level is missing, or given to a model without one.

        Args:
            given: Whether a level is given.
            where: Begins the message.

        Raises:
            InputError: It is needed and not given, or given and of no use.
        """
        if self.camera is None or given == (self.water_level_m is not None):
            return
        if given:
            raise InputError(
                f"{where}the model was fitted without water levels, so it can make nothing of one; "
                "give all recordings of its scene water_level_m and fit it again"
            )
        raise InputError(
            f"{where}the model was fitted to water levels; say how high the water stands, above "
            "the same datum (--water-level METRES or FILE; water_level_m in a scene)"
        )

    def above_m(self, water_level_m: ArrayLike | None) -> FloatArray:
        """Water level above the plane that the camera's height is over.

        Args:
            water_level_m: See `locate`.

        Returns:
            (N,) or one number, metres; 0 where the water was taken to stand still.

        Raises:
            InputError: See `locate`.
        """
        self.check_water(water_level_m is not None)
        if water_level_m is None or self.water_level_m is None or self.camera is None:
            return np.zeros(())
        above = np.asarray(water_level_m, dtype=np.float64) - self.water_level_m
        if not (above < self.camera.height_m).all():
            raise InputError(
                f"a water level of {np.max(water_level_m):g} m is not below the camera, which is "
                f"at {self.camera.height_m + self.water_level_m:.2f} m above its datum"
            )
        return above

    def compensated(self, boxes: ObservedBoxes) -> ObservedBoxes:
        """Boxes stabilised and compensated to the camera of the model.

        Args:
            boxes: With the state of the camera in their moments.

        Returns:
            Those of which that is known: in whose frames the horizon was seen, where the model
            knows of one, and of which it is known how the camera had been rotated.
        """
        state = boxes.state
        if self.horizon_px is not None:
            camera = self.camera or nominal_camera(self.image_size_px)
            boxes = _moved(
                boxes, *stabilise(boxes.xyxy_px, state.horizon_px, self.horizon_px, camera)
            )
        if self.camera is not None and boxes.state.rotation_rad.any():
            rotation_rad = boxes.state.rotation_rad
            boxes = _moved(boxes, *compensate_rotation(boxes.xyxy_px, rotation_rad, self.camera))
        return boxes

    def place(self, boxes: ObservedBoxes) -> LocatedBoxes:
        """Locate boxes with the camera state at their times.

        Args:
            boxes: As the camera saw them, with their times.

        Returns:
            Those of which it is known how the camera lay, as `compensated` has them. Positions are
            on the earth, or in the body frame of the platform that the camera stands on.

        Raises:
            InputError: See `locate`.
        """
        return self.place_compensated(self.compensated(boxes))

    def place_compensated(self, boxes: ObservedBoxes) -> LocatedBoxes:
        """As `place`, of boxes that `compensated` has given back.

        Args:
            boxes: As the camera would have seen them if it had lain as it did for the model.

        Raises:
            InputError: See `locate`.
        """
        state, plain = boxes.state, boxes.boxes
        if self.moving:
            return LocatedBoxes.at(plain, self.locate_body(plain.xyxy_px, plain.source))
        told = bool(np.isfinite(state.water_level_m).any())
        if not len(plain):
            told = self.water_level_m is not None
        level_m = state.water_level_m if told else None
        positions = self.locate(plain.xyxy_px, plain.source, level_m)
        if self.camera is not None and state.rotation_covariance_rad2.any():
            covariance = state.rotation_covariance_rad2
            positions = widen(positions, covariance, self.camera, self.above_m(level_m))
        return LocatedBoxes.at(plain, positions)

    def rotation_in(
        self, static_intervals: Sequence[StaticInterval], view: ReferenceView | None = None
    ) -> CameraRotation | None:
        """Camera rotation in the static intervals of a recording, against the model's camera.

        Args:
            static_intervals: Of the recording.
            view: What the camera of the model saw. Absent: the model's own view.

        Returns:
            None where it was not turned, nothing tells, or the model has no camera that stands
            still.
        """
        fit = self.regressor.camera_fit
        if fit is None or self.moving:
            return None
        log_focal_sigma = float(np.sqrt(fit.covariance[LOG_FOCAL, LOG_FOCAL]))
        return CameraRotation.of(
            static_intervals, fit.camera, view or self.view, log_focal_sigma=log_focal_sigma
        )

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the model to a file, atomically; see `sightline.load`.

        Raises:
            InputError: The file cannot be written.
        """
        arrays, settings = self.regressor.state()
        content: dict[str, object] = {
            "model": self.model,
            "plane": [self.plane.latitude_deg, self.plane.longitude_deg],
            "image_size_px": list(self.image_size_px),
            "settings": settings,
            "report": self.report.to_dict(),
        }
        if self.horizon_px is not None:
            content["horizon_px"] = list(self.horizon_px)
        if self.water_level_m is not None:
            content["water_level_m"] = self.water_level_m
        if self.moving:
            content["moving"] = True
        tensors = {f"regressor.{name}": array for name, array in arrays.items()}
        tensors["support"] = self.support.planes
        if self.view is not None:
            tensors |= {f"view.{name}": getattr(self.view, name) for name in _VIEW}
            content["view_landmarks"] = self.view.landmarks
        if self.static_places is not None:
            tensors["static_places"] = self.static_places.to_array()
        return write_model_file(path, content, tensors)


def load_model(path: str | os.PathLike[str], *, model: ModelType | None = None) -> Georeferencer:
    """Read a georeferencer from a model file.

    Args:
        path: Of the file.
        model: Reads the model in it, where that is of a type that is not registered.

    Raises:
        ModelFileError: There is no such file, it is damaged, of another kind, or of a format
            version that this release does not know.

    Examples:
        >>> model = sightline.load("model.safetensors")
        >>> model.model, model.image_size_px
        ('camera+gpr', (1280, 720))
    """
    content, tensors = read_model_file(path)
    try:
        loaded = _build(content, tensors, model)
        # Boxes go through all that was stored; one alone, or four, would fit many a wrong shape.
        boxes = np.tile(loaded.image_size_px, 2) * np.array(_TRIED_OUT)
        with np.errstate(all="ignore"):
            loaded.regressor.locate(boxes, None, np.zeros(len(boxes)))
            loaded.regressor.locate(boxes[:1], None, np.zeros(1))
    except (*_DAMAGE, SightlineError) as error:
        raise damaged(path, error) from error
    return loaded


def _build(
    content: dict[str, Any], tensors: dict[str, Any], model: ModelType | None
) -> Georeferencer:
    kind = model or model_type(content["model"])
    prefix = "regressor."
    arrays = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
    width, height = (int(v) for v in content["image_size_px"])
    if not 1 <= min(width, height) <= max(width, height) <= _LARGEST_PX:
        raise ValueError(f"its pictures are of {width} x {height} px")
    latitude, longitude = (float(v) for v in content["plane"])
    support = np.asarray(tensors["support"], dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(support).all():
        raise ValueError("its support is not a number")
    return Georeferencer(
        model=content["model"],
        regressor=kind.load(arrays, _settings(content)),
        plane=LocalPlane(latitude, longitude),
        image_size_px=(width, height),
        support=Support(support),
        report=FitReport.from_dict(content["report"]),
        horizon_px=_horizon(content.get("horizon_px")),
        moving=bool(content.get("moving", False)),
        water_level_m=_finite(content.get("water_level_m")),
        view=_view(tensors, bool(content.get("view_landmarks", True))),
        static_places=StaticPlaces.of_array(tensors["static_places"])
        if "static_places" in tensors
        else None,
    )


def _settings(content: dict[str, Any]) -> dict[str, Any]:
    """Settings of a model file; release 0.1 kept logarithms, and other names."""
    settings = dict(content["settings"])
    if content["format_version"] == 1:
        for key in {"noise", "prior"} & settings.keys():
            if settings[key] is not None:
                settings[key] = {_OLD_NAMES.get(k, k): v for k, v in settings[key].items()}
        for key in {"range", "bearing"} & settings.keys():
            values = np.exp(np.array(settings[key]["hyperparameters"], dtype=np.float64))
            settings[key] = {**settings[key], "hyperparameters": values.tolist()}
    return settings


def _moved(boxes: ObservedBoxes, xyxy_px: FloatArray, known: BoolArray) -> ObservedBoxes:
    rows = np.flatnonzero(known)
    chosen = boxes[rows]
    return ObservedBoxes.at(chosen.boxes.with_columns(xyxy_px=xyxy_px[rows]), chosen.state)


def _view(tensors: dict[str, Any], landmarks: bool) -> ReferenceView | None:
    if "view.strips" not in tensors:
        return None
    strips, *places = (np.asarray(tensors[f"view.{name}"]) for name in _VIEW)
    if strips.dtype != np.uint8:
        raise ValueError("its view is no picture")
    top_px, left_px = (place.astype(np.int64) for place in places)
    return ReferenceView(strips, top_px, left_px, landmarks)


def _finite(value: float | None) -> float | None:
    if value is None:
        return None
    if not math.isfinite(float(value)):
        raise ValueError("its water level is not a number")
    return float(value)


def _horizon(rows: Any) -> tuple[float, float] | None:
    if rows is None:
        return None
    left, right = (float(row) for row in rows)
    return left, right
