"""The fit of a georeferencer from collected inputs. Nothing here reads a file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sightline.camera.motion import StaticInterval
from sightline.camera.observations import Landmarks
from sightline.camera.pinhole import Camera
from sightline.camera.priors import CameraPrior, SourcePrior
from sightline.camera.registration import ReferenceView
from sightline.camera.rotation import CameraRotation, compensate_rotation, reference_view
from sightline.camera.stabilisation import horizons_at, nominal_camera, stabilise
from sightline.camera.stated import StatedCamera
from sightline.clock_offset import RecordingClock
from sightline.errors import FitError
from sightline.geodesy import LocalPlane
from sightline.georeferencing.contradictions import contradictions
from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.fit_report import fit_report
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.georeferencing.models import (
    DEFAULT_MODEL,
    ModelType,
    Observations,
    control_landmarks,
    model_type,
)
from sightline.georeferencing.stages import fit_in_stages
from sightline.georeferencing.support import Support
from sightline.threads import on_one_thread
from sightline.types import BoolArray, Boxes, ControlPoints, FloatArray, Horizons


@dataclass(frozen=True, eq=False)
class FitInputs:
    """Everything that a fit learns from.

    Attributes:
        correspondences: Boxes beside the places of their targets, as the camera saw them.
        image_size_px: Width and height.
        control_points: Pixels whose place on the earth is known.
        position_known: Whether the camera stands at the origin of the correspondences' plane, as
            far as one knows.
        moving: Whether the camera is on a platform that moves; places are then starboard and ahead.
        tidal: Whether every recording tells how high the water stood.
        horizons: By recording, where the horizon lay in its frames; of a camera that rolls.
        static_intervals: By recording, the static intervals of its camera.
        landmarks: Pixels whose place is known roughly.
        statements: Sentences for people on what was left out of the logs.
        stated: What is known of the camera before any data.
        clocks: By recording, what was taken off its times, and what is believed of its clock.
        name: Begins messages: the scene file.
    """

    correspondences: Correspondences
    image_size_px: tuple[int, int]
    control_points: ControlPoints
    position_known: bool = True
    moving: bool = False
    tidal: bool = False
    horizons: Mapping[str, Horizons] = field(default_factory=dict)
    static_intervals: Mapping[str, Sequence[StaticInterval]] = field(default_factory=dict)
    landmarks: Landmarks = field(default_factory=Landmarks.none)
    statements: tuple[str, ...] = ()
    stated: StatedCamera = field(default_factory=StatedCamera)
    clocks: Mapping[str, RecordingClock] = field(default_factory=dict)
    name: str = "the scene"


@dataclass(frozen=True)
class FitSettings:
    """Settings of a fit.

    Attributes:
        model: Name of a model, or a model type.
        seed: Of whatever is random in the fit.
        prior: Of the camera. Absent: that of an ordinary one.
        source_priors: Of the lower edge of single sources of boxes, by name.
        water_level_m: The level that the camera's height is to be over. Absent: the median of the
            boxes' levels, so that it is a height over the water as one sees it.
    """

    model: str | ModelType = DEFAULT_MODEL
    seed: int = 0
    prior: CameraPrior | None = None
    source_priors: Mapping[str, SourcePrior] = field(default_factory=dict)
    water_level_m: float | None = None


@dataclass(frozen=True, eq=False)
class _Knowledge:
    """Estimates of one fit that prepare the data of the next; None where there are none yet.

    Attributes:
        lens: The camera, by whose lens boxes are stabilised; known once one is fitted.
        rotations: By recording, the camera rotation against the model's camera.
        origin: Where on the earth the camera stands.
    """

    lens: Camera | None = None
    rotations: Mapping[str, CameraRotation] | None = None
    origin: LocalPlane | None = None


@on_one_thread
def fit(inputs: FitInputs, settings: FitSettings | None = None) -> Georeferencer:
    """Fit a georeferencer.

    What a fit tells of the camera prepares the data of the next: its lens takes swell off the
    boxes, its focal length turns shifts of the static scene into camera rotations, whose effect is
    compensated, and its place becomes the origin of the plane. A model of a camera that was turned
    is one of the camera as it lay at the end. Models without a camera learn from the boxes as they
    are.

    Args:
        inputs: What there is to learn from.
        settings: How. Absent: `DEFAULT_MODEL`.

    Raises:
        InputError: The model's name is not known.
        FitError: There are too few pairs, all in one place, or no camera explains them.
    """
    settings = settings or FitSettings()
    kind = model_type(settings.model)
    usual = settings.prior or CameraPrior()
    if inputs.stated.keys:
        prior = inputs.stated.prior(usual, inputs.image_size_px)
        settings = replace(settings, prior=prior)
    if not len(inputs.correspondences) and not len(inputs.control_points):
        raise FitError(
            f"{inputs.name}: no pairs of a box and a fix, and no control points; give a "
            "recording boxes and fixes, or [[control_points]]"
        )
    horizon = _typical_horizon(list(inputs.horizons.values()))
    view = reference_view(inputs.static_intervals)
    known = _Knowledge()
    while True:
        observed, level_m = _observed(inputs, _prepared(inputs, known, horizon), settings)
        try:
            fitted, observed = _fit_once(inputs, observed, level_m, kind, settings.seed)
        except FitError as error:
            wrong = contradictions(observed, inputs.stated, usual, seed=settings.seed)
            if not wrong:
                raise
            raise FitError("; ".join((str(error), *wrong))) from error
        fitted = replace(fitted, horizon_px=horizon, moving=inputs.moving)
        told = _told(fitted, inputs, known, horizon, view)
        if told is known:
            break
        known = told
    if fitted.camera is None:
        return fitted
    wrong = contradictions(observed, inputs.stated, usual, seed=settings.seed)
    if inputs.stated.focal_in_pictures and inputs.stated.focal_px is not None and not wrong:
        focal_px, sigma_px = inputs.stated.focal_px
        said = f"The pictures carry a focal length (EXIF): {focal_px:.0f} ± {sigma_px:.0f} px."
        wrong = (said,)
    report = replace(fitted.report, statements=(*wrong, *fitted.report.statements))
    fitted = replace(fitted, report=report)
    if view is None:
        return fitted
    if known.rotations:
        said = (
            f"The camera was rotated: in recordings {', '.join(known.rotations)} it did not always "
            "point as at the end. The rotation is compensated in their boxes."
        )
        report = replace(fitted.report, statements=(*fitted.report.statements, said))
        fitted = replace(fitted, report=report)
    return replace(fitted, view=view)


def _told(
    fitted: Georeferencer,
    inputs: FitInputs,
    known: _Knowledge,
    horizon: tuple[float, float] | None,
    view: ReferenceView | None,
) -> _Knowledge:
    """Estimates after a fit; the same object where it added nothing new."""
    camera = fitted.camera
    if camera is None:
        return known
    told = known
    if known.lens is None and horizon is not None:
        told = replace(told, lens=camera)
    if known.rotations is None and view is not None:
        rotations = {
            name: found
            for name, own in inputs.static_intervals.items()
            if (found := fitted.rotation_in(own, view)) is not None
        }
        if rotations:
            told = replace(told, rotations=rotations)
    if known.origin is None and not inputs.position_known:
        latitude, longitude = fitted.plane.to_geographic([camera.east_m], [camera.north_m])
        told = replace(told, origin=LocalPlane(float(latitude[0]), float(longitude[0])))
    return told


def _prepared(
    inputs: FitInputs, known: _Knowledge, horizon: tuple[float, float] | None
) -> Correspondences:
    """Correspondences, stabilised and compensated to the camera of the model."""
    pairs = inputs.correspondences
    if known.origin is not None:
        pairs = pairs.in_plane(known.origin)
    if horizon is not None:
        lens = known.lens or nominal_camera(inputs.image_size_px)
        pairs = _stabilised(pairs, inputs.horizons, horizon, lens)
    return pairs if known.rotations is None else _compensated(pairs, known.rotations)


def _stabilised(
    pairs: Correspondences,
    horizons: Mapping[str, Horizons],
    horizon_px: tuple[float, float],
    lens: Camera,
) -> Correspondences:
    """Correspondences with roll and pitch compensated; those without a horizon are left out."""

    def moved(name: str, boxes: Boxes) -> tuple[FloatArray, BoolArray]:
        seen_px = horizons_at(horizons[name], boxes.time_utc_s)
        return stabilise(boxes.xyxy_px, seen_px, horizon_px, lens)

    return _moved(pairs, horizons, moved)


def _compensated(
    pairs: Correspondences, rotations: Mapping[str, CameraRotation]
) -> Correspondences:
    """Correspondences with the camera rotations of their recordings compensated."""

    def moved(name: str, boxes: Boxes) -> tuple[FloatArray, BoolArray]:
        rotation_rad, _ = rotations[name].at(boxes.time_utc_s)
        return compensate_rotation(boxes.xyxy_px, rotation_rad, rotations[name].camera)

    return _moved(pairs, rotations, moved)


def _moved(
    pairs: Correspondences,
    recordings: Iterable[str],
    move: Callable[[str, Boxes], tuple[FloatArray, BoolArray]],
) -> Correspondences:
    """Correspondences with the boxes of some recordings moved; those that cannot be are left out.

    Args:
        pairs: Of all recordings.
        recordings: Names of those whose boxes are moved.
        move: From a name and its N boxes to (N, 4) the boxes moved and (N,) whether they could be.
    """
    xyxy_px = pairs.boxes.xyxy_px.copy()
    usable = np.ones(len(pairs), dtype=bool)
    for name in recordings:
        rows = np.flatnonzero(pairs.recording == name)
        moved, known = move(name, pairs.boxes[rows])
        xyxy_px[rows[known]] = moved[known]
        usable[rows] = known
    return replace(pairs, boxes=pairs.boxes.with_columns(xyxy_px=xyxy_px))[usable]


def _typical_horizon(horizons: Sequence[Horizons]) -> tuple[float, float] | None:
    """The median horizon, rows at the left and the right edge; None without any."""
    if not sum(map(len, horizons)):
        return None
    left = np.concatenate([one.left_y_px for one in horizons])
    right = np.concatenate([one.right_y_px for one in horizons])
    return float(np.median(left)), float(np.median(right))


def _observed(
    inputs: FitInputs, pairs: Correspondences, settings: FitSettings
) -> tuple[Observations, float | None]:
    """What a model learns from, and the water level that the camera's height is over."""
    control = inputs.control_points
    east_north_m = np.stack(
        pairs.plane.to_plane(control.latitude_deg, control.longitude_deg), axis=1
    )
    level_m = settings.water_level_m
    if level_m is None and inputs.tidal and len(pairs):
        level_m = float(np.median(pairs.water_level_m))
    observed = Observations(
        correspondences=pairs,
        image_size_px=inputs.image_size_px,
        control_points=control_landmarks(control.pixel_px, east_north_m),
        landmarks=inputs.landmarks,
        above_m=pairs.water_level_m - (level_m or 0.0),
        # That the origin is where a fit put the camera is no knowledge of where it stands.
        position_known=inputs.position_known,
        moving=inputs.moving,
        tidal=level_m is not None,
        prior=settings.prior,
        source_priors=settings.source_priors,
        clocks={
            name: clock.left for name, clock in inputs.clocks.items() if clock.left is not None
        },
    )
    return observed, level_m


def _fit_once(
    inputs: FitInputs,
    observed: Observations,
    level_m: float | None,
    kind: ModelType,
    seed: int,
) -> tuple[Georeferencer, Observations]:
    """A georeferencer, and what it learned from in the end."""
    control = inputs.control_points
    staged = fit_in_stages(kind, observed, seed=seed)
    observed = replace(
        observed,
        correspondences=observed.correspondences[staged.rows],
        above_m=observed.above_m[staged.rows],
    )
    model, pairs, above_m = staged.model, observed.correspondences, observed.above_m
    has_camera = model.camera is not None
    boxes = pairs.boxes.xyxy_px
    placed = model.locate(boxes, pairs.boxes.source, above_m)
    report = fit_report(
        kind.name,
        model,
        pairs,
        placed.east_north_m,
        observed.control_points,
        clocks=inputs.clocks,
        stated=inputs.stated,
    )
    report = replace(
        report, statements=(*inputs.statements, *staged.statements, *report.statements)
    )
    if level_m is not None and has_camera:
        said = f"The height of the camera is that over a water level of {level_m:.2f} m."
        report = replace(report, statements=(*report.statements, said))
    foot: FloatArray = np.stack([0.5 * (boxes[:, 0] + boxes[:, 2]), boxes[:, 3]], axis=1)
    fitted = Georeferencer(
        model=kind.name,
        regressor=model,
        plane=pairs.plane,
        image_size_px=inputs.image_size_px,
        support=Support.of(
            np.concatenate([foot, control.pixel_px]) if has_camera else foot, inputs.image_size_px
        ),
        report=report,
        water_level_m=level_m if has_camera else None,
    )
    return fitted, observed
