"""The seam of stage 3: protocols of a model that locates boxes, and models by name.

A model type is looked up by name, among ours, the paper's, and those that other packages register
as entry points of the group ``sightline.models``; or it is handed in as an object.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from sightline._plugins import loaded, registered
from sightline.camera.calibration import CameraFit
from sightline.camera.observations import Landmarks
from sightline.camera.pinhole import Camera
from sightline.camera.priors import HEAVE_M, CameraPrior, PixelNoise, SourcePrior
from sightline.errors import InputError, unknown_name
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.observations import CONTROL_POINT_SIGMA_M, CameraObservations
from sightline.georeferencing.paper.estimator import Arrays, Settings
from sightline.georeferencing.paper.model import PAPER_MODELS, PaperModel, paper_model
from sightline.georeferencing.placement import Placement
from sightline.types import FloatArray, StrArray
from sightline.water import LEVEL_SIGMA_M

MODELS = (*PAPER_MODELS, "camera", "camera+gpr")
"""The names of the models that ship: the paper's five, and ours."""

DEFAULT_MODEL = "camera+gpr"

ENTRY_POINT_GROUP = "sightline.models"


@dataclass(frozen=True, eq=False)
class Observations:
    """Everything a model learns from: correspondences, control points and landmarks.

    Attributes:
        correspondences: Boxes with places, one row a box; boxes as a camera sees them that lies as
            it did for the model.
        image_size_px: Width and height.
        control_points: Pixels whose place is known well.
        landmarks: Pixels whose place is known roughly.
        above_m: (N,) how high the water stood at each box above the plane that the camera's height
            is over.
        position_known: Whether the camera stands at the origin of the plane, as far as one knows.
        moving: Whether the camera is on a platform that moves; places are then starboard and ahead.
        tidal: Whether water levels were told.
        prior: Of the camera. Absent: that of an ordinary one.
        source_priors: Of the lower edge of single sources of boxes, by name.
        clocks: By recording, mean and standard deviation of the seconds to be added to its clock;
            where they are others than the camera's prior says.
    """

    correspondences: Correspondences
    image_size_px: tuple[int, int]
    control_points: Landmarks
    landmarks: Landmarks
    above_m: FloatArray
    position_known: bool = True
    moving: bool = False
    tidal: bool = False
    prior: CameraPrior | None = None
    source_priors: Mapping[str, SourcePrior] = field(default_factory=dict)
    clocks: Mapping[str, tuple[float, float]] = field(default_factory=dict)


class BoxModel(Protocol):
    """A fitted model: positions in metres with covariance from boxes."""

    @property
    def camera(self) -> Camera | None:
        """The fitted camera, where the model has one."""
        ...

    @property
    def camera_fit(self) -> CameraFit | None:
        """The fitted camera with its covariance, where the model has one."""
        ...

    @property
    def reference_sigma_m(self) -> float:
        """Correlated error of the logs that it learned from, metres; 0 where not estimated."""
        ...

    def locate(
        self, boxes_xyxy_px: FloatArray, source: StrArray | None, above_m: FloatArray
    ) -> Placement:
        """Positions of boxes.

        Args:
            boxes_xyxy_px: (N, 4) pixels, x1, y1, x2, y2.
            source: (N,) or () str, who made the boxes; None: nobody says.
            above_m: (N,) or () float64, how high the water stands above the plane that the camera's
                height is over, metres.
        """
        ...

    def state(self) -> tuple[Arrays, Settings]:
        """State from which `ModelType.load` restores the model."""
        ...


class ModelType(Protocol):
    """Fits models of one kind, and restores them."""

    @property
    def name(self) -> str:
        """Name of the kind, as `fit` and model files have it."""
        ...

    def fit(self, observations: Observations, *, seed: int = 0) -> BoxModel:
        """Fit a model.

        Args:
            observations: What there is to learn from.
            seed: Of whatever is random.

        Raises:
            FitError: There is too little.
        """
        ...

    def load(self, arrays: Arrays, settings: Settings) -> BoxModel:
        """Restore a model from `BoxModel.state`; raises where a part is missing or damaged."""
        ...


@dataclass(frozen=True)
class PaperModelType:
    """The paper's models; see `PaperModel`. They learn from boxes alone."""

    name: str

    def fit(self, observations: Observations, *, seed: int = 0) -> PaperModel:
        """See `ModelType`."""
        pairs = observations.correspondences
        return paper_model(self.name, seed=seed).fit(
            pairs.boxes.xyxy_px, pairs.east_north_m, image_size_px=observations.image_size_px
        )

    def load(self, arrays: Arrays, settings: Settings) -> PaperModel:
        """See `ModelType`."""
        return PaperModel.from_state(arrays, settings)


@dataclass(frozen=True)
class CameraModelType:
    """The camera model, with or without a Gaussian process on its residual.

    Attributes:
        name: Of the model.
        residual: Whether the residual is learned.
    """

    name: str
    residual: bool

    def fit(self, observations: Observations, *, seed: int = 0) -> CameraRegressor:
        """See `ModelType`."""
        return self._fitted(observations, seed, residual=self.residual)

    def first(self, observations: Observations, *, seed: int = 0) -> CameraRegressor:
        """The camera under the usual noise, which is taken as known and independent.

        Few wrong fixes move it little, whatever they are off.

        Args:
            observations: What there is to learn from.
            seed: Of whatever is random.

        Raises:
            FitError: There is too little.
        """
        heave_m = HEAVE_M if observations.moving else 0.0
        noise = PixelNoise(correlated_m=0.0, heave_m=heave_m)
        return self._fitted(observations, seed, residual=False, noise=noise)

    def _fitted(
        self,
        observations: Observations,
        seed: int,
        *,
        residual: bool,
        noise: PixelNoise | None = None,
    ) -> CameraRegressor:
        control, far = observations.control_points, observations.landmarks
        known = Landmarks(
            np.concatenate([control.pixel_px, far.pixel_px]),
            np.concatenate([control.east_north_m, far.east_north_m]),
            np.concatenate([control.sigma_m, far.sigma_m]),
        )
        return CameraRegressor(
            observations.image_size_px,
            # On a vessel the waves that lift the camera while a target passes a place would be
            # learned as of the place.
            residual=residual and not observations.moving,
            prior=observations.prior,
            source_priors=observations.source_priors,
            noise=noise,
            position_known=observations.position_known,
            heaving=observations.moving,
            starts=8 if observations.position_known else 24,
            random_state=seed,
            above_sigma_m=LEVEL_SIGMA_M if observations.tidal else 0.0,
        ).fit_observations(
            CameraObservations.of(
                observations.correspondences,
                above_m=observations.above_m,
                landmarks=known,
                clocks=observations.clocks,
            )
        )

    def load(self, arrays: Arrays, settings: Settings) -> CameraRegressor:
        """See `ModelType`."""
        return CameraRegressor.from_state(arrays, settings)


def control_landmarks(pixel_px: FloatArray, east_north_m: FloatArray) -> Landmarks:
    """Control points as landmarks, with the error of an aerial picture or of a survey."""
    return Landmarks(pixel_px, east_north_m, np.full(len(pixel_px), CONTROL_POINT_SIGMA_M))


def model_type(model: str | ModelType) -> ModelType:
    """A model type by its name; an object is returned as it is.

    Args:
        model: One of `MODELS`, a name that another package registers under the entry point group
            ``sightline.models``, or an object.

    Raises:
        InputError: The name is not known; the message lists those that are.
    """
    if not isinstance(model, str):
        return model
    if model in PAPER_MODELS:
        return PaperModelType(model)
    if model in MODELS:
        return CameraModelType(model, residual=model == "camera+gpr")
    others = registered(ENTRY_POINT_GROUP)
    if model not in others:
        raise unknown_name("model", model, (*MODELS, *sorted(others)))
    found: ModelType = loaded(others[model])
    for needed in ("name", "fit", "load"):
        if not hasattr(found, needed):
            raise InputError(
                f"model {model!r}: what {others[model].value} names has no {needed!r}; an entry "
                f"point of {ENTRY_POINT_GROUP} names an object with name, fit and load"
            )
    return found
