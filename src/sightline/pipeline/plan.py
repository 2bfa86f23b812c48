"""`sightline plan`: what a camera would know of places, before it is mounted or as it is."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from sightline import formats
from sightline.camera.pinhole import Camera
from sightline.errors import InputError
from sightline.formats.contours_geojson import Line, write_contours
from sightline.geodesy import LocalPlane
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.fit_report import Parameter, fitted_parameters
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.planning import (
    PATTERNS,
    Contour,
    Curvature,
    Drive,
    DriveNoise,
    Hull,
    Mounting,
    Row,
    WaterMap,
    curvature,
    known_camera,
    learn,
    logged_drive,
    pattern_drive,
    rows_along,
    water_map,
)
from sightline.planning.drive import SOURCE
from sightline.planning.learning import LearnSettings, without_doubt
from sightline.planning.mounting import seen_ahead_m
from sightline.planning.water_map import width_reach_m
from sightline.progress import Progress
from sightline.threads import on_one_thread
from sightline.types import FloatArray

NO_DRIVE = "none"
"""The drive of a camera that is taken to be known exactly."""


@dataclass(frozen=True)
class PlanSettings:
    """What a plan asks of a camera.

    Attributes:
        boats: Of interest; ellipses are those of the first, which is also the one that drives.
        least_px: Width at which a boat is just found.
        tide_m: How low and how high the water stands about the level that the camera's height is
            over. Absent: it stands still.
        reach_m: How far the map reaches. Absent: as far as there is something to see.
        speed_mps: Of a boat that drives a pattern.
        interval_s: Between two boxes of the drive.
        noise: Of boxes and log.
        stated: Keys of ``[camera]`` whose planned values the scene will state.
        seed: Of the noise that is drawn.
    """

    boats: tuple[Hull, ...] = field(default_factory=lambda: (Hull.of_length(5.0),))
    least_px: float = 8.0
    tide_m: tuple[float, float] | None = None
    reach_m: float | None = None
    speed_mps: float = 4.0
    interval_s: float = 2.0
    noise: DriveNoise = field(default_factory=DriveNoise)
    stated: tuple[str, ...] = ()
    seed: int = 0

    @property
    def levels_m(self) -> tuple[float, ...]:
        """Levels of the water that are mapped: that of the height, low and high water."""
        return (0.0, *sorted(set(self.tide_m or ()) - {0.0}))


@dataclass(frozen=True, eq=False)
class Plan:
    """What a camera would know of places on the water.

    Attributes:
        camera: As planned, or as fitted.
        plane: Of its places.
        settings: What was asked.
        drive: What the camera is learned from; ``"none"``, a pattern, a file, or a model.
        maps: By the level of the water, metres about that of the height.
        rows: By level, places along the heading.
        curvature: Of the water.
        parameters: Of the camera, after the drive; none where it is taken as known.
        boxes: How many boxes of the boat there are; 0 without a drive.
        duration_s: Of the drive.
        places_m: (N, 2) of the boat in its boxes, metres in the plane.
        statements: Sentences for people.
        seldom: Names of parameters that are determined or not by chance.
    """

    camera: Camera
    plane: LocalPlane
    settings: PlanSettings
    drive: str
    maps: dict[float, WaterMap]
    rows: dict[float, tuple[Row, ...]]
    curvature: Curvature
    parameters: tuple[Parameter, ...] = ()
    boxes: int = 0
    duration_s: float = 0.0
    places_m: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    statements: tuple[str, ...] = ()
    seldom: tuple[str, ...] = ()

    @property
    def place_deg(self) -> tuple[float, float]:
        """Latitude and longitude of the camera."""
        latitude, longitude = self.plane.to_geographic(self.camera.east_m, self.camera.north_m)
        return float(latitude), float(longitude)

    @property
    def sizes_m(self) -> dict[float, float | None]:
        """By the length of a boat, from which range ahead it is narrower than is found."""
        nearest, farthest = seen_ahead_m(self.camera)
        out: dict[float, float | None] = {}
        for boat in self.settings.boats:
            range_m = width_reach_m(self.camera, boat.length_m, self.settings.least_px)
            out[boat.length_m] = range_m if nearest <= range_m <= farthest else None
        return out

    def to_dict(self) -> dict[str, object]:
        """The plan as JSON can hold it; what is infinite or not known is None."""
        camera, (latitude, longitude) = self.camera, self.place_deg
        planned = {
            "height_m": camera.height_m,
            "focal_px": camera.focal_px,
            "image_size_px": list(camera.image_size_px),
            "latitude_deg": latitude,
            "longitude_deg": longitude,
            "heading_deg": camera.heading_deg,
            "pitch_deg": camera.pitch_deg,
            "roll_deg": camera.roll_deg,
        }
        lengths = [boat.length_m for boat in self.settings.boats]
        return {
            "plan": planned,
            "drive": {"name": self.drive, "boxes": self.boxes, "duration_s": self.duration_s},
            "parameters": [_finite(asdict(one)) for one in self.parameters],
            "undetermined": [one.name for one in self.parameters if not one.determined],
            "by_chance": list(self.seldom),
            "ahead": [
                {"above_m": level, "range_m": row.range_m, **_row(row, lengths)}
                for level, rows in self.rows.items()
                for row in rows
            ],
            "boats": [
                {"length_m": length, "least_px": self.settings.least_px, "range_m": range_m}
                for length, range_m in self.sizes_m.items()
            ],
            "curvature": _finite(asdict(self.curvature)),
            "statements": list(self.statements),
        }

    def lines(self) -> list[Line]:
        """Contours on the earth, with their properties."""
        out: list[Line] = []
        for level, one in self.maps.items():
            for contour in one.contours:
                places = self.plane.to_geographic(*contour.east_north_m.T)
                out.append((_properties(contour, self.settings, level), np.stack(places, axis=1)))
        return out

    def write_contours(self, path: str | os.PathLike[str]) -> None:
        """Write the contours as GeoJSON.

        Raises:
            InputError: The file cannot be written.
        """
        write_contours(self.lines(), path)


@on_one_thread
def plan(
    mounting: Mounting,
    plane: LocalPlane,
    *,
    drive: str = "zigzag",
    settings: PlanSettings | None = None,
    mmsi: int | None = None,
    progress: Progress | None = None,
) -> Plan:
    """Plan a camera that is not there yet.

    Args:
        mounting: How it is to be mounted.
        plane: At its place.
        drive: One of `PATTERNS`, ``"none"``, or the file of a log.
        settings: What is asked.
        mmsi: Which vessel of an AIS log drives.
        progress: Told what is being done.

    Raises:
        InputError: No water is in the picture, the boat is never, or the log cannot be used.
        FitError: The boat's boxes are too few, or all in one place.
    """
    settings = settings or PlanSettings()
    camera, boat = mounting.camera, settings.boats[0]
    _check_tide(camera, settings)
    seen_ahead_m(camera)
    if drive == NO_DRIVE:
        noise = settings.noise
        model = known_camera(camera, boat, noise.box_px)
        said = ("The camera is taken to be known exactly: what is left is the noise of boxes.",)
        return _plan(model, model, plane, settings, drive, said)
    way = _drive(drive, camera, plane, settings, mmsi)
    if progress is not None:
        progress("estimating what the drive teaches", math.nan)
    learned = learn(
        camera,
        plane,
        way,
        boat,
        LearnSettings(
            settings.interval_s, settings.least_px, settings.noise, settings.stated, settings.seed
        ),
    )
    made = _plan(
        learned.model,
        without_doubt(learned.model, camera),
        plane,
        settings,
        drive,
        learned.statements,
        camera=camera,
    )
    return replace(
        made,
        parameters=learned.parameters,
        boxes=learned.boxes,
        duration_s=learned.duration_s,
        places_m=learned.places_m,
        seldom=learned.seldom,
    )


@on_one_thread
def plan_of_model(
    fitted: Georeferencer,
    *,
    name: str = "the model",
    source: str | None = None,
    settings: PlanSettings | None = None,
) -> Plan:
    """Map what a fitted camera knows of places, as it is.

    Args:
        fitted: The model.
        name: What messages call it.
        source: Who makes the boxes. Absent: whose boxes the model has seen most of.
        settings: What is asked.

    Raises:
        InputError: It has no camera, one on a platform that moves, or does not know the source.
    """
    settings = settings or PlanSettings()
    model = fitted.calibrated
    if fitted.moving:
        raise InputError(
            f"{name}: is of a camera on a platform that moves, so there is no map of its water; "
            "plan one that stands still"
        )
    if model is None:
        raise InputError(
            f"{name}: is of the kind {fitted.model}, which knows no camera and its covariance; fit "
            "one of camera or camera+gpr"
        )
    _check_tide(model.camera, settings)
    seen = {one.name: one.n for one in fitted.report.sources}
    if source is not None and source not in seen:
        known = ", ".join(seen) or "none"
        raise InputError(f"{name}: has learned from no boxes of {source!r}; known are {known}")
    chosen = source if source is not None else max(seen, key=lambda one: seen[one], default="")
    undetermined = [s for s in fitted.report.statements if "does not determine" in s]
    whose = f"Boxes are those of {chosen!r}." if chosen else "Boxes are those of nobody it knows."
    made = _plan(
        model,
        without_doubt(model),
        fitted.plane,
        settings,
        name,
        (whose, *undetermined),
        chosen,
    )
    return replace(
        made,
        parameters=fitted_parameters(model.fit_, of_target=fitted.report.n > 0),
        boxes=fitted.report.n,
    )


def _plan(
    model: CameraRegressor,
    known: CameraRegressor,
    plane: LocalPlane,
    settings: PlanSettings,
    drive: str,
    said: Sequence[str],
    source: str = SOURCE,
    camera: Camera | None = None,
) -> Plan:
    boats, camera = settings.boats, camera or model.camera
    maps: dict[float, WaterMap] = {}
    rows: dict[float, tuple[Row, ...]] = {}
    reach_m = settings.reach_m
    for level in settings.levels_m:
        maps[level] = water_map(
            model,
            boats,
            camera=camera,
            source=source,
            least_px=settings.least_px,
            above_m=level,
            reach_m=reach_m,
        )
        # Maps of one camera reach equally far, to be laid over one another.
        reach_m = maps[level].reach_m
        rows[level] = rows_along(
            model, known, boats, camera=camera, source=source, above_m=level, reach_m=reach_m
        )
    bent = curvature(camera)
    return Plan(
        camera=camera,
        plane=plane,
        settings=settings,
        drive=drive,
        maps=maps,
        rows=rows,
        curvature=bent,
        statements=(*said, *_on_curvature(bent), *_on_tide(camera, settings)),
    )


def _drive(
    name: str, camera: Camera, plane: LocalPlane, settings: PlanSettings, mmsi: int | None
) -> Drive:
    if name in PATTERNS:
        return pattern_drive(
            name,
            camera,
            settings.boats[0],
            speed_mps=settings.speed_mps,
            least_px=settings.least_px,
        )
    if not os.path.exists(name):
        raise InputError(
            f"--drive {name}: there is no such log, and no such pattern; known are "
            f"{', '.join((*PATTERNS, NO_DRIVE))}"
        )
    return logged_drive(formats.read_fixes(name, mmsi=mmsi), plane, name)


def _check_tide(camera: Camera, settings: PlanSettings) -> None:
    high = max(settings.levels_m)
    if not high < camera.height_m:
        raise InputError(
            f"a tide that rises by {high:g} m drowns a camera {camera.height_m:g} m above the "
            "water; give --tide as metres about the level that the height is over"
        )


def _on_curvature(bent: Curvature) -> tuple[str, ...]:
    if not math.isfinite(bent.horizon_m):
        return ("The water counts as flat: the model has not seen it fall away.",)
    pixel = (
        f"from {_length(bent.pixel_from_m)} on by more than a pixel"
        if math.isfinite(bent.pixel_from_m)
        else "nowhere by a whole pixel"
    )
    matters = (
        f"were it taken for flat, places would lie 5 % too near from {_length(bent.matters_from_m)}"
        if math.isfinite(bent.matters_from_m)
        else "were it taken for flat, places would nowhere lie 5 % too near"
    )
    horizon = f"{_length(bent.horizon_m)} away ({_length(bent.geometric_horizon_m)}"
    return (
        f"The horizon is {horizon} without refraction).",
        f"The water falls away, in the picture {pixel}; {matters}.",
    )


def _on_tide(camera: Camera, settings: PlanSettings) -> tuple[str, ...]:
    said = []
    for level in settings.levels_m:
        if level:
            share = abs(camera.height_m / (camera.height_m - level) - 1.0)
            where = "far" if level > 0.0 else "near"
            said.append(
                f"With the water {abs(level):g} m {'higher' if level > 0.0 else 'lower'}, all "
                f"ranges come out {100.0 * share:.0f} % too {where} unless its level is told."
            )
    return tuple(said)


def _length(metres: float) -> str:
    return f"{metres / 1000.0:.1f} km" if metres >= 1000.0 else f"{metres:.0f} m"


def _row(row: Row, lengths: Sequence[float]) -> dict[str, object]:
    own = _finite(asdict(row))
    names = [f"{length:g}" for length in lengths]
    own["widths_px"] = dict(zip(names, row.widths_px, strict=True))
    return own


def _finite(values: dict[str, object]) -> dict[str, object]:
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in values.items()
    }


def _properties(contour: Contour, settings: PlanSettings, level: float) -> dict[str, str | float]:
    out: dict[str, str | float] = {"kind": contour.kind, "above_m": level}
    if contour.kind == "axis":
        out["axis_95_m"] = contour.value
        out["name"] = f"95 % within {contour.value:g} m"
    elif contour.kind == "size":
        out["boat_m"], out["width_px"] = contour.value, settings.least_px
        out["name"] = f"a boat of {contour.value:g} m is {settings.least_px:g} px wide"
    else:
        out["name"] = "less certain than half the range beyond"
    return out
