"""What a fit would learn of a camera from a drive, by the covariance of that fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sightline.camera.calibration import CameraFit
from sightline.camera.parameters import CAMERA, PARAMETERS, TARGET, ParameterLayout
from sightline.camera.pinhole import Camera
from sightline.camera.priors import NOISE_PRIORS, CameraPrior, PixelNoise
from sightline.camera.stated import SLOTS, StatedCamera, stated_camera
from sightline.camera.target_sizes import TargetSizes
from sightline.errors import FitError, unknown_name
from sightline.geodesy import LocalPlane
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.fit_report import Parameter, fitted_parameters, on_undetermined
from sightline.georeferencing.observations import CameraObservations
from sightline.planning.drive import SOURCE, Drive, DriveNoise
from sightline.planning.mounting import Hull
from sightline.types import BoolArray, FloatArray

DRAWS = 3
"""So often noise is drawn; the plan is the one in the middle."""


@dataclass(frozen=True, eq=False)
class Learning:
    """What a fit would know of a camera after a drive.

    Attributes:
        model: The model that it would lead to.
        parameters: Of the camera, with their standard deviations; whether the drive determines
            them is decided as by a fit.
        boxes: How many there are of the boat.
        places_m: (N, 2) where it was in them, metres.
        duration_s: Of the drive.
        statements: On what stays undetermined.
        seldom: Names of parameters that other noise of the same size determines, or leaves.
    """

    model: CameraRegressor
    parameters: tuple[Parameter, ...]
    boxes: int
    places_m: FloatArray
    duration_s: float
    statements: tuple[str, ...]
    seldom: tuple[str, ...] = ()

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Names of parameters of the camera that the drive does not determine."""
        return tuple(p.name for p in self.parameters if p.name in PARAMETERS and not p.determined)


@dataclass(frozen=True)
class LearnSettings:
    """How a camera is to be learned from a drive.

    Attributes:
        interval_s: Between two boxes of the boat.
        least_px: Boxes that are narrower are not found.
        noise: Of boxes and log.
        stated: Keys of `StatedCamera` whose planned values the scene will state.
        seed: Of the noise that is drawn.
    """

    interval_s: float = 2.0
    least_px: float = 8.0
    noise: DriveNoise = field(default_factory=DriveNoise)
    stated: tuple[str, ...] = ()
    seed: int = 0


def learn(
    camera: Camera,
    plane: LocalPlane,
    drive: Drive,
    hull: Hull,
    settings: LearnSettings | None = None,
) -> Learning:
    """What a fit would know of a camera after a drive.

    Noise is drawn, and estimated as the fit would: how large it seems to be decides how much the
    boxes teach, and a handful of them does not tell an offset of the log from none.

    Args:
        camera: As it is to be mounted.
        plane: Of its place.
        drive: Of a boat that keeps a log.
        hull: Of that boat.
        settings: How it is learned.

    Raises:
        InputError: The boat is never in the picture, or a stated key is not known.
        FitError: Its boxes are too few, or all in one place.
    """
    settings = settings or LearnSettings()
    stated = stated_by(camera, settings.stated)
    prior = stated.prior(CameraPrior(), camera.image_size_px)
    models: list[CameraRegressor] = []
    pairs: Correspondences | None = None
    for draw in range(DRAWS):
        pairs = drive.correspondences(
            camera,
            plane,
            hull,
            interval_s=settings.interval_s,
            least_px=settings.least_px,
            noise=settings.noise,
            rng=np.random.default_rng([settings.seed, draw]),
        )
        model = CameraRegressor(camera.image_size_px, residual=False, prior=prior)
        try:
            models.append(model.expect_observations(CameraObservations.of(pairs), camera))
        except FitError as error:
            raise FitError(f"drive {drive.name}: {error}") from error
    assert pairs is not None, "noise is drawn at least once"
    chosen = _middle(models)
    # What it is about is the planned camera, and not one that noise has drawn off it.
    vector = chosen.fit_.vector.copy()
    vector[CAMERA] = camera.to_vector()
    parameters = fitted_parameters(replace(chosen.fit_, vector=vector), of_target=True)
    told = [PARAMETERS[slot] for slot in stated.parameters]
    determined = np.stack([model.fit_.determined() for model in models])
    mostly = dict(zip(PARAMETERS, np.median(determined, axis=0).astype(bool).tolist(), strict=True))
    parameters = tuple(
        replace(one, determined=mostly.get(one.name, one.determined)) for one in parameters
    )
    unsure: BoolArray = np.ptp(determined.astype(np.int64), axis=0) > 0
    return Learning(
        model=chosen,
        parameters=parameters,
        boxes=len(pairs),
        places_m=pairs.east_north_m,
        duration_s=drive.duration_s,
        statements=tuple(on_undetermined(parameters, told)),
        seldom=tuple(name for name, one in zip(PARAMETERS, unsure.tolist(), strict=True) if one),
    )


def stated_by(camera: Camera, keys: Sequence[str]) -> StatedCamera:
    """What a scene states of a camera that has been mounted as planned.

    Args:
        camera: As planned.
        keys: Of `StatedCamera`.

    Raises:
        InputError: A key is not known.
    """
    width, height = camera.image_size_px
    known: dict[str, float | list[float] | None] = {
        "height_m": camera.height_m,
        "horizontal_fov_deg": 2.0 * float(np.degrees(np.arctan(0.5 * width / camera.focal_px))),
        "focal_px": camera.focal_px,
        "heading_deg": camera.heading_deg,
        "pitch_deg": camera.pitch_deg,
        "roll_deg": camera.roll_deg,
        "principal_point_px": [0.5 * width, 0.5 * height, 1.0],
    }
    for key in keys:
        if key not in known or key not in SLOTS:
            raise unknown_name("key of [camera]", key, tuple(known))
    return stated_camera({key: known[key] for key in keys})


def known_camera(camera: Camera, hull: Hull, box_px: float = 1.0) -> CameraRegressor:
    """The model of a camera that is known exactly: what is left is the noise of boxes.

    Args:
        camera: The camera.
        hull: Of the boats that it places.
        box_px: Standard deviation of every edge of a box.
    """
    layout = ParameterLayout(n_sources=1, n_clocks=0)
    vector = np.zeros(layout.size)
    vector[CAMERA], vector[TARGET] = camera.to_vector(), (0.5 * hull.length_m, 0.5 * hull.beam_m)
    nothing = np.empty(0)
    exact = np.full(layout.size, 1e-9)
    # The middle of two edges.
    noise = PixelNoise(box_px, NOISE_PRIORS["row_m"].typical, box_px / math.sqrt(2.0), place_m=0.0)
    model = CameraRegressor(camera.image_size_px, residual=False)
    model.sources_ = (SOURCE,)
    model.typical_speed_mps_ = 0.0
    model.range_process_ = model.bearing_process_ = None
    return model.with_fit(
        CameraFit(
            vector=vector,
            covariance=np.zeros((layout.size, layout.size)),
            prior_sigma=exact,
            clock_groups=np.empty(0, dtype=np.int64),
            noise=noise,
            image_size_px=camera.image_size_px,
            residual_px=np.empty((0, 2)),
            standard_residual=nothing,
            leverage=nothing,
            outlier=np.empty(0, dtype=np.bool_),
            starts_agreeing=1,
            starts=1,
            typical_range_m=1.0,
            sizes=TargetSizes.of(np.array([0.5 * hull.length_m])),
        )
    )


def without_doubt(model: CameraRegressor, camera: Camera | None = None) -> CameraRegressor:
    """The model were its camera known exactly, with the same noise of boxes.

    Args:
        model: It.
        camera: The true one. Absent: the model's.
    """
    fit = model.fit_
    vector = fit.vector[: fit.layout.clocks.start].copy()
    vector[CAMERA] = (camera or model.camera).to_vector()
    known = model.with_fit(
        replace(
            fit,
            vector=vector,
            covariance=np.zeros((fit.layout.clocks.start,) * 2),
            prior_sigma=fit.prior_sigma[: fit.layout.clocks.start],
            clock_groups=np.empty(0, dtype=np.int64),
        )
    )
    known.range_process_ = known.bearing_process_ = None
    return known


def _middle(models: Sequence[CameraRegressor]) -> CameraRegressor:
    """The one of some models that knows its camera neither best nor worst."""
    sizes = [float(np.linalg.slogdet(model.fit_.covariance[CAMERA, CAMERA])[1]) for model in models]
    return models[int(np.argsort(sizes, kind="stable")[len(models) // 2])]
