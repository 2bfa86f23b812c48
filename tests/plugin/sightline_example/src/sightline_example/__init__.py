"""One of each: a detector, a tracker, a trajectory method and a model of another package."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sightline.georeferencing.models import Observations
from sightline.georeferencing.placement import Placement
from sightline.types import Boxes, EastNorthPositions, Frame, PointKind, Track


class Squares:
    """Finds the brightest square of 20 px in each picture."""

    def detect(self, frame: Frame) -> Boxes:
        rows, columns = np.nonzero(frame.image_bgr.max(axis=2) > 200)
        if not rows.size:
            return Boxes.of([])
        x, y = float(columns.min()), float(rows.min())
        return Boxes.of(
            [[x, y, x + 20.0, y + 20.0]],
            frame=frame.index,
            time_utc_s=frame.time_utc_s,
            source="example-squares",
        )

    def reset(self) -> None:
        """Nothing is remembered."""


class Nearest:
    """Follows the one target of this world as long as it is left of column 100."""

    def update(self, boxes: Boxes) -> Boxes:
        boxes = boxes[boxes.xyxy_px[:, 0] < 99.5]
        return Boxes.of(
            boxes.xyxy_px,
            frame=boxes.frame,
            time_utc_s=boxes.time_utc_s,
            source=boxes.source,
            track_id=np.full(len(boxes), 7),
        )

    def reset(self) -> None:
        """Nothing is remembered."""


@dataclass(frozen=True)
class Straight:
    """A straight line through all positions, by least squares."""

    sigma_m: float = 1.0

    def apply(
        self,
        time_utc_s: Any,
        positions: EastNorthPositions,
        *,
        confidence: Any = None,
        at_utc_s: Any = None,
        track_id: int = 0,
        label: str = "",
    ) -> Track:
        known = positions.known
        time_s = time_utc_s[known]
        at = np.unique(time_s) if at_utc_s is None else np.asarray(at_utc_s)
        lines = [
            np.polynomial.Polynomial.fit(time_s - time_s[0], column[known], 1)
            for column in (positions.east_m, positions.north_m)
        ]
        n = at.size
        covariance = np.tile(self.sigma_m**2 * np.eye(2), (n, 1, 1))
        east, north = (line(at - time_s[0]) for line in lines)
        velocity_east, velocity_north = (line.deriv()(at - time_s[0]) for line in lines)
        return Track(
            track_id=track_id,
            time_utc_s=at,
            east_m=east,
            north_m=north,
            covariance_m2=covariance,
            velocity_east_mps=velocity_east,
            velocity_north_mps=velocity_north,
            velocity_covariance_m2ps2=covariance,
            kind=np.full(n, PointKind.MEASURED, dtype=np.int8),
            plane=positions.plane,
            label=label,
        )


@dataclass
class Affine:
    """Metres as an affine function of the foot of a box."""

    coefficients: np.ndarray
    variance_m2: float

    camera = None
    camera_fit = None
    reference_sigma_m = 0.0

    def locate(self, boxes_xyxy_px: Any, source: Any, above_m: Any) -> Placement:
        return Placement(
            _design(boxes_xyxy_px) @ self.coefficients,
            np.tile(self.variance_m2 * np.eye(2), (len(boxes_xyxy_px), 1, 1)),
        )

    def state(self) -> tuple[dict[str, Any], dict[str, Any]]:
        return {"coefficients": self.coefficients}, {"variance_m2": self.variance_m2}


def _design(boxes_xyxy_px: Any) -> np.ndarray:
    foot = 0.5 * (boxes_xyxy_px[:, 0] + boxes_xyxy_px[:, 2])
    return np.stack([foot, boxes_xyxy_px[:, 3], np.ones(len(boxes_xyxy_px))], axis=1)


class AffineType:
    name = "example-affine"

    def fit(self, observations: Observations, *, seed: int = 0) -> Affine:
        pairs = observations.correspondences
        design = _design(pairs.boxes.xyxy_px)
        found, *_ = np.linalg.lstsq(design, pairs.east_north_m, rcond=None)
        left = pairs.east_north_m - design @ found
        return Affine(found, float(np.mean(left**2)))

    def load(self, arrays: dict[str, Any], settings: dict[str, Any]) -> Affine:
        return Affine(np.array(arrays["coefficients"]), float(settings["variance_m2"]))


AFFINE = AffineType()
