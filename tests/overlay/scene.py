"""A level camera, a boat that goes straight, and what is drawn of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import cast

import numpy as np

from sightline import Georeferencer
from sightline.camera.motion import StaticInterval
from sightline.camera.pinhole import Camera
from sightline.geodesy import LocalPlane
from sightline.types import Boxes, PointKind, Track

SIZE_PX = (640, 360)
FOCAL_PX, HEIGHT_M = 900.0, 5.0
START_S = 1_700_000_000.0
LEVEL = Camera(HEIGHT_M, 0.0, 0.0, 0.0, FOCAL_PX, 0.0, 0.0, 0.0, 0.0, SIZE_PX)
SIGMA_M = (2.0, 6.0)
SEA = 128


@dataclass(frozen=True)
class Fitted:
    """What drawing asks of a model."""

    camera: Camera | None = LEVEL
    moving: bool = False
    model: str = "camera"
    image_size_px: tuple[int, int] = SIZE_PX
    horizon_px: None = None
    view: None = None
    reference_sigma_m: float = 3.0
    plane: LocalPlane = field(default_factory=lambda: LocalPlane(54.3, 10.1))

    def check_water(self, given: bool, _where: str = "") -> None:
        assert not given

    def rotation_in(self, _static_intervals: Sequence[StaticInterval]) -> None:
        return None


def model(**changes: object) -> Georeferencer:
    return cast(Georeferencer, Fitted(**changes))  # type: ignore[arg-type]


def pixel(east_m: float, north_m: float) -> np.ndarray:
    """Of a place on the water, by similar triangles."""
    return np.array([320.0 + FOCAL_PX * east_m / north_m, 180.0 + FOCAL_PX * HEIGHT_M / north_m])


def track(
    number: int = 3,
    *,
    start: tuple[float, float] = (-10.0, 100.0),
    velocity: tuple[float, float] = (2.0, 1.0),
    label: str = "sailboat",
    apart_s: float = 1.0,
    moored: bool = False,
) -> Track:
    """A point each ``apart_s`` for ten seconds."""
    lags = np.arange(0.0, 10.0 + 1e-9, apart_s)
    n = lags.size
    return Track(
        track_id=number,
        time_utc_s=START_S + lags,
        east_m=start[0] + velocity[0] * lags,
        north_m=start[1] + velocity[1] * lags,
        velocity_east_mps=np.full(n, velocity[0]),
        velocity_north_mps=np.full(n, velocity[1]),
        covariance_m2=np.tile(np.diag(np.square(SIGMA_M)), (n, 1, 1)),
        velocity_covariance_m2ps2=np.tile(np.eye(2), (n, 1, 1)),
        kind=np.full(n, PointKind.MEASURED),
        plane=LocalPlane(54.3, 10.1),
        label=label,
        moored=np.full(n, moored),
    )


def sea() -> np.ndarray:
    return np.full((SIZE_PX[1], SIZE_PX[0], 3), SEA, dtype=np.uint8)


def box_at(foot: np.ndarray, size: tuple[float, float] = (40.0, 24.0), frame: int = 0) -> Boxes:
    x, y = foot
    box = [[x - size[0] / 2, y - size[1], x + size[0] / 2, y]]
    return Boxes.of(np.array(box), frame=np.array([frame]), confidence=np.array([0.9]))
