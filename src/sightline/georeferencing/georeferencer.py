"""A fitted model with the plane that it works in, and what is to be known about its fit."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sightline.camera.calibration import (
    FIRST_SOURCE,
    TARGET_PARAMETERS,
    CameraPrior,
    SourceBelief,
)
from sightline.camera.motion import Stance, View
from sightline.camera.pinhole import PARAMETERS, Camera
from sightline.camera.rotation import Turns, reference_view, scene_stances
from sightline.camera.stabilisation import level, nominal_camera, scene_horizons
from sightline.detection.run import Progress
from sightline.errors import FitError, InputError, unknown_name
from sightline.geodesy import LocalPlane
from sightline.georeferencing.camera_regressor import CONTROL_POINT_SIGMA_M, CameraRegressor
from sightline.georeferencing.correspondences import Landmarks, Pairs, scene_pairs
from sightline.georeferencing.paper.model import PAPER_MODELS, PaperModel, paper_model
from sightline.georeferencing.support import Support
from sightline.scene import Scene
from sightline.types import BoolArray, Boxes, FloatArray, Horizons, Positions, check_boxes
from sightline.water import LEVEL_SIGMA_M

MODELS = (*PAPER_MODELS, "camera", "camera+gpr")
"""The names of all models: the paper's five, and ours."""

DEFAULT_MODEL = "camera+gpr"

_FOCAL = PARAMETERS.index("focal_px")
_UNITS = {"_m": "m", "_deg": "degrees", "_px": "px"}


@dataclass(frozen=True)
class Parameter:
    """One unknown of the camera or the target as the fit found it.

    Attributes:
        name: As in `PARAMETERS`, then `TARGET_PARAMETERS` where there were boxes.
        value: In ``unit``.
        sigma: Standard deviation, in ``unit``.
        unit: ``"m"``, ``"degrees"``, ``"px"`` or ``""``.
        determined: Whether data, and not belief, says what it is.
    """

    name: str
    value: float
    sigma: float
    unit: str
    determined: bool


@dataclass(frozen=True)
class SourceBias:
    """The habit of a source of boxes at the lower edge.

    Attributes:
        name: Of the annotator or detector.
        n: Boxes of it in the fit.
        bias_px: How many pixels too low its lower edges lie, whatever the range.
        bias_m: At what height above the water or road its lower edges lie, metres; negative is
            too low.
        sigma_px: Standard deviation of ``bias_px``.
        sigma_m: Standard deviation of ``bias_m``.
    """

    name: str
    n: int
    bias_px: float
    bias_m: float
    sigma_px: float
    sigma_m: float


@dataclass(frozen=True)
class FittedBox:
    """One box of the fit: what is left of it, and how much hangs on it.

    Attributes:
        recording: Its recording.
        frame: Its frame, -1 if it had none.
        source: Who made it.
        error_m: Between the model's place and the log's.
        residual_px: Between its foot and where the camera expects it, pixels; NaN where the model
            has no camera.
        leverage: How much of the fit hangs on it, NaN where the model does not tell.
        outlier: Whether the fit took it for one.
    """

    recording: str
    frame: int
    source: str
    error_m: float
    residual_px: float
    leverage: float
    outlier: bool


@dataclass(frozen=True)
class FitReport:
    """What is to be known about a fit.

    Attributes:
        model: Name of the model.
        n: Pairs that it learned from.
        asked: Boxes that there were.
        control_points: Control points that it learned from.
        recordings: Their names.
        rmse_m: Root mean square error of the pairs themselves, metres.
        median_m: Median error of the pairs themselves, metres.
        parameters: Of the camera; none for the paper's models.
        sources: Of the boxes; none for the paper's models.
        clock_offset_s: By recording, how far its clock is to be moved on to agree with the log.
        boxes: One a pair.
        statements: Sentences for people: what could not be determined, what stands out.
    """

    model: str
    n: int
    asked: int
    control_points: int
    recordings: tuple[str, ...]
    rmse_m: float
    median_m: float
    parameters: tuple[Parameter, ...] = ()
    sources: tuple[SourceBias, ...] = ()
    clock_offset_s: dict[str, float] = field(default_factory=dict)
    boxes: tuple[FittedBox, ...] = ()
    statements: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """As JSON can hold it; numbers that are none become None."""
        content: dict[str, Any] = _jsonable(asdict(self))
        return content

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> FitReport:
        """What `to_dict` wrote.

        Raises:
            LookupError: A field is missing.
            TypeError: There are others than there should be.
        """

        def number(value: Any) -> float:
            return float("nan") if value is None else float(value)

        fields = dict(content)
        fields["rmse_m"], fields["median_m"] = number(fields["rmse_m"]), number(fields["median_m"])
        fields["recordings"] = tuple(fields["recordings"])
        fields["statements"] = tuple(fields["statements"])
        fields["parameters"] = tuple(Parameter(**p) for p in fields["parameters"])
        fields["sources"] = tuple(SourceBias(**s) for s in fields["sources"])
        fields["boxes"] = tuple(
            FittedBox(**{**b, **{k: number(b[k]) for k in ("error_m", "residual_px", "leverage")}})
            for b in fields["boxes"]
        )
        return cls(**fields)


def _jsonable(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _jsonable(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_jsonable(v) for v in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


@dataclass(frozen=True, eq=False)
class Georeferencer:
    """Says where boxes lie on the earth.

    Attributes:
        model: Name of the model, one of `MODELS`.
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
        view: What stands still before the camera as it lies for the model, so that it shows in
            later pictures whether it was turned since; None where no pictures tell.
    """

    model: str
    regressor: PaperModel | CameraRegressor
    plane: LocalPlane
    image_size_px: tuple[int, int]
    support: Support
    report: FitReport
    horizon_px: tuple[float, float] | None = None
    moving: bool = False
    view: View | None = None
    water_level_m: float | None = None

    @property
    def camera(self) -> Camera | None:
        """The camera, where the model has one."""
        return self.regressor.camera_ if isinstance(self.regressor, CameraRegressor) else None

    @property
    def log_sigma_m(self) -> float:
        """How far off the logs that it learned from were, metres east and north.

        The part that lasts: what changes from fix to fix cannot be told from the boxes' own noise,
        and is part of each position's covariance. 0 where the model does not tell the two apart.
        """
        if not isinstance(self.regressor, CameraRegressor):
            return 0.0
        return self.regressor.fit_.noise.drift_m

    def locate(
        self,
        boxes_xyxy_px: ArrayLike,
        source: ArrayLike | None = None,
        water_level_m: ArrayLike | None = None,
    ) -> Positions:
        """Where boxes lie.

        Args:
            boxes_xyxy_px: (N, 4) pixels, x1, y1, x2, y2.
            source: Who made the boxes, (N,) str or one for all: the annotator's or detector's
                name, as in the fit. Its bias is taken off. The paper's models know no sources.
            water_level_m: How high the water stands, (N,) or one value for all, metres above the
                datum of the water levels of the fit; needed where there were such.

        Returns:
            N positions, NaN where there is none: at or above the horizon, or where the range
            would be less certain than half of itself.

        Raises:
            InputError: A box is reversed, or not a number; or the water level is missing, is
                given to a model that knows of none, or is not below the camera.
        """
        boxes = np.asarray(boxes_xyxy_px, dtype=np.float64)
        boxes = boxes.reshape(-1, 4) if boxes.size == 0 or boxes.ndim == 1 else boxes
        check_boxes(boxes)
        above_m = self.above_m(water_level_m)
        if isinstance(self.regressor, CameraRegressor):
            places, covariance, shared = self.regressor.predict(
                boxes, source=source, above_m=above_m, return_shared=True
            )
        else:
            places, covariance = self.regressor.predict(boxes)
            shared = None
        foot = np.empty((len(boxes), 2))
        foot[:, 0], foot[:, 1] = 0.5 * (boxes[:, 0] + boxes[:, 2]), boxes[:, 3]
        known = np.isfinite(places[:, 0])
        return Positions(
            east_m=places[:, 0],
            north_m=places[:, 1],
            covariance_m2=covariance,
            extrapolated=~(known & self.support.holds(foot)),
            plane=self.plane,
            shared_covariance_m2=shared,
        )

    def check_water(self, given: bool, where: str = "") -> None:
        """Refuse to place boxes without a water level where the model needs one, or the reverse.

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
        """How high the water stands above the plane that the camera's height is over.

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

    def level(self, boxes: Boxes, horizons: Horizons | None) -> Boxes:
        """Boxes as if the camera had lain as it did for the model.

        Args:
            boxes: With their times.
            horizons: Of the same recording; None: the camera is taken not to have moved.

        Returns:
            The boxes in whose frames the horizon was seen; all of them, as they are, where the
            model or the recording knows of none.
        """
        if self.horizon_px is None or horizons is None:
            return boxes
        camera = self.camera or nominal_camera(self.image_size_px)
        return level(boxes, horizons, self.horizon_px, camera)[0]

    def turns(self, stances: Sequence[Stance]) -> Turns | None:
        """How the camera lay in the stances of a recording, against how it lies for the model.

        Returns:
            None where it was not turned, nothing tells, or the model has no camera that stands
            still.
        """
        if self.camera is None or self.moving:
            return None
        return _turns(self, stances, self.view)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the model to a file, whole or not at all; see `sightline.load`."""
        from sightline.georeferencing.model_file import save_model

        return save_model(self, path)


def fit(
    scene: Scene,
    model: str = DEFAULT_MODEL,
    *,
    seed: int = 0,
    extra: Mapping[str, Boxes] | None = None,
    progress: Progress | None = None,
) -> Georeferencer:
    """Learn a georeferencer from a scene.

    Args:
        scene: Its recordings' boxes and logs, and its control points.
        model: One of `MODELS`. The paper's learn from boxes alone, ours from control points too.
        seed: Of whatever is random in the fit.
        extra: Further boxes of the logged target, from another source, by recording: so that the
            habits of a detector are learned beside those of an annotator. The residual process of
            ``camera+gpr`` learns nothing of them.
        progress: Told which recording's pictures are looked at.

    Raises:
        InputError: The model's name is not known, or a file of the scene cannot be used.
        FitError: There are too few pairs, all in one place, or no camera explains them.
    """
    if model not in MODELS:
        raise unknown_name("model", model, MODELS)
    moving = scene.moves
    plane = scene.plane
    known = plane is not None or moving
    if plane is None:
        plane = _middle(scene)
    horizons = {r.name: seen for r in scene.recordings if (seen := scene_horizons(r)) is not None}
    reference = _typical(list(horizons.values()))
    lens: Camera | None = None

    def learn(plane: LocalPlane, position_known: bool) -> Georeferencer:
        def levelled(name: str, boxes: Boxes) -> Boxes:
            if reference is None or name not in horizons:
                return boxes
            camera = lens or nominal_camera(scene.image_size_px)
            return level(boxes, horizons[name], reference, camera)[0]

        pairs = scene_pairs(scene, plane, extra=extra, levelled=levelled if horizons else None)
        if not len(pairs) and not len(scene.control_points):
            raise FitError(
                f"{scene.path}: no pairs of a box and a fix, and no control points; give a "
                "recording boxes and fixes, or [[control_points]]"
            )
        fitted = fit_pairs(
            pairs,
            scene,
            model,
            position_known=position_known,
            image_size_px=scene.image_size_px,
            seed=seed,
            progress=progress,
        )
        return replace(fitted, horizon_px=reference, moving=moving)

    fitted = learn(plane, known)
    if reference is not None and fitted.camera is not None:
        # How far a pixel turns the camera is the lens's to say, and now it is known.
        lens = fitted.camera
        fitted = learn(plane, known)
    if known or fitted.camera is None:
        return fitted
    # The origin of the plane is where the camera stands; now it is known where that is.
    latitude, longitude = plane.to_geographic([fitted.camera.east_m], [fitted.camera.north_m])
    return learn(LocalPlane(float(latitude[0]), float(longitude[0])), False)


def _typical(horizons: list[Horizons]) -> tuple[float, float] | None:
    """Where the horizon lies in the middle of all that the camera did."""
    if not sum(map(len, horizons)):
        return None
    left = np.concatenate([one.left_y_px for one in horizons])
    right = np.concatenate([one.right_y_px for one in horizons])
    return float(np.median(left)), float(np.median(right))


def _middle(scene: Scene) -> LocalPlane:
    """A plane in the middle of what is known, for a camera of which nobody knows where it is."""
    latitudes, longitudes = (
        [scene.control_points.latitude_deg],
        [scene.control_points.longitude_deg],
    )
    for recording in scene.recordings:
        if recording.fixes_path is not None and recording.boxes_path is not None:
            fixes = recording.fixes()
            latitudes.append(fixes.latitude_deg)
            longitudes.append(fixes.longitude_deg)
    if not sum(map(len, latitudes)):
        raise FitError(
            f"{scene.path}: nothing says where on the earth the scene is; give [camera] "
            "latitude_deg and longitude_deg, a log (fixes) with boxes, or [[control_points]]"
        )
    return LocalPlane(
        float(np.median(np.concatenate(latitudes))), float(np.median(np.concatenate(longitudes)))
    )


def fit_pairs(
    pairs: Pairs,
    scene: Scene,
    model: str,
    *,
    position_known: bool,
    image_size_px: tuple[int, int],
    seed: int = 0,
    prior: CameraPrior | None = None,
    landmarks: Landmarks | None = None,
    beliefs: Mapping[str, SourceBelief] | None = None,
    progress: Progress | None = None,
    water_level_m: float | None = None,
) -> Georeferencer:
    """Learn a georeferencer from pairs, control points and landmarks; see `fit`.

    Where the pictures of the scene show that its camera was turned, in a recording or between two,
    boxes are put where they would be without the turn, and the model is of the camera as it lay
    at the end. The paper's models have no camera, and learn from the boxes as they are.

    Where the scene has water levels, the camera's height is that over ``water_level_m``; absent:
    over the median of the boxes' levels, so that it is a height over the water as one sees it.
    """

    def learn(pairs: Pairs) -> Georeferencer:
        return _fit_pairs(
            pairs,
            scene,
            model,
            position_known=position_known,
            image_size_px=image_size_px,
            seed=seed,
            prior=prior,
            landmarks=landmarks,
            beliefs=beliefs,
            water_level_m=water_level_m,
        )

    fitted = learn(pairs)
    camera = fitted.camera
    stances = {} if camera is None else scene_stances(scene, progress)
    view = reference_view(stances)
    if camera is None or view is None:
        return fitted
    turns = {
        name: found
        for name, own in stances.items()
        if (found := _turns(fitted, own, view)) is not None
    }
    if turns:
        levelled = _levelled(pairs, turns)
        fitted = learn(levelled)
        said = (
            f"The camera was turned: in recordings {', '.join(turns)} it did not always lie as at "
            "the end. Their boxes were put where they would be if it had."
        )
        report = replace(fitted.report, statements=(*fitted.report.statements, said))
        fitted = replace(fitted, report=report)
    return replace(fitted, view=view)


def _turns(fitted: Georeferencer, stances: Sequence[Stance], view: View | None) -> Turns | None:
    assert isinstance(fitted.regressor, CameraRegressor), "the caller has looked"
    fit = fitted.regressor.fit_
    focal_log_sigma = float(np.sqrt(fit.covariance[_FOCAL, _FOCAL]))
    return Turns.of(stances, fit.camera, view, focal_log_sigma=focal_log_sigma)


def _levelled(pairs: Pairs, turns: Mapping[str, Turns]) -> Pairs:
    """Pairs with the turns of their recordings taken off their boxes."""
    xyxy_px = pairs.boxes.xyxy_px.copy()
    usable = np.ones(len(pairs), dtype=bool)
    for name, own in turns.items():
        rows = np.flatnonzero(pairs.recording == name)
        moved, known = own.moved(pairs.boxes[rows])
        xyxy_px[rows[known]] = moved[known]
        usable[rows] = known
    return replace(pairs, boxes=pairs.boxes.with_columns(xyxy_px=xyxy_px))[usable]


def _fit_pairs(
    pairs: Pairs,
    scene: Scene,
    model: str,
    *,
    position_known: bool,
    image_size_px: tuple[int, int],
    seed: int,
    prior: CameraPrior | None,
    landmarks: Landmarks | None,
    beliefs: Mapping[str, SourceBelief] | None,
    water_level_m: float | None,
) -> Georeferencer:
    far = Landmarks.none() if landmarks is None else landmarks
    control = scene.control_points
    control_east_north = np.stack(
        pairs.plane.to_plane(control.latitude_deg, control.longitude_deg), axis=1
    )
    boxes = pairs.boxes.xyxy_px
    if water_level_m is None and scene.tidal and len(pairs):
        water_level_m = float(np.median(pairs.water_level_m))
    above_m = pairs.water_level_m - (water_level_m or 0.0)
    regressor: PaperModel | CameraRegressor
    foot = np.stack([0.5 * (boxes[:, 0] + boxes[:, 2]), boxes[:, 3]], axis=1)
    if model in PAPER_MODELS:
        regressor = paper_model(model, seed=seed).fit(
            boxes, pairs.east_north_m, image_size_px=image_size_px
        )
        places = regressor.predict(boxes)[0]
        pixels = foot
    else:
        regressor = CameraRegressor(
            image_size_px,
            # On a vessel the waves that lift the camera while a target passes a place would be
            # learned as of the place.
            residual=model == "camera+gpr" and not scene.moves,
            prior=prior,
            position_known=position_known,
            heaving=scene.moves,
            starts=8 if position_known else 24,
            random_state=seed,
            above_sigma_m=0.0 if water_level_m is None else LEVEL_SIGMA_M,
        ).fit(
            boxes,
            pairs.east_north_m,
            source=pairs.boxes.source,
            group=pairs.recording,
            vessel=pairs.vessel,
            velocity_mps=pairs.velocity_mps,
            time_s=pairs.boxes.time_utc_s,
            above_m=above_m,
            beside=pairs.beside,
            control_px=np.concatenate([control.pixel_px, far.pixel_px]),
            control_east_north_m=np.concatenate([control_east_north, far.east_north_m]),
            control_sigma_m=np.concatenate(
                [np.full(len(control), CONTROL_POINT_SIGMA_M), far.sigma_m]
            ),
            beliefs=beliefs,
        )
        places = regressor.predict(boxes, source=pairs.boxes.source, above_m=above_m)
        pixels = np.concatenate([foot, control.pixel_px])
    report = _report(model, regressor, pairs, places, len(control))
    if water_level_m is not None and model not in PAPER_MODELS:
        said = f"The height of the camera is that over a water level of {water_level_m:.2f} m."
        report = replace(report, statements=(*report.statements, said))
    return Georeferencer(
        model=model,
        regressor=regressor,
        plane=pairs.plane,
        image_size_px=image_size_px,
        support=Support.of(pixels, image_size_px),
        report=report,
        water_level_m=None if model in PAPER_MODELS else water_level_m,
    )


def _report(
    model: str,
    regressor: PaperModel | CameraRegressor,
    pairs: Pairs,
    places: FloatArray,
    control_points: int,
) -> FitReport:
    error = np.hypot(*(places - pairs.east_north_m).T)
    n = len(pairs)
    leverage, outlier = np.full(n, np.nan), np.zeros(n, dtype=bool)
    residual = np.full(n, np.nan)
    more: dict[str, Any] = {}
    if isinstance(regressor, CameraRegressor):
        leverage, outlier = regressor.fit_.leverage[:n], regressor.fit_.outlier[:n]
        residual = np.hypot(*regressor.fit_.residual_px[:n].T)
        more = _camera_report(regressor, pairs, control_points, outlier)
    return FitReport(
        model=model,
        n=n,
        asked=pairs.asked,
        control_points=control_points if more else 0,
        recordings=tuple(str(name) for name in np.unique(pairs.recording)),
        rmse_m=float(np.sqrt(np.nanmean(error**2))) if n else float("nan"),
        median_m=float(np.nanmedian(error)) if n else float("nan"),
        boxes=tuple(
            FittedBox(
                recording=str(pairs.recording[i]),
                frame=int(pairs.boxes.frame[i]),
                source=str(pairs.boxes.source[i]),
                error_m=float(error[i]),
                residual_px=float(residual[i]),
                leverage=float(leverage[i]),
                outlier=bool(outlier[i]),
            )
            for i in range(n)
        ),
        **more,
    )


def _camera_report(
    regressor: CameraRegressor, pairs: Pairs, control_points: int, outlier: BoolArray
) -> dict[str, Any]:
    fitted = regressor.fit_
    camera, determined = fitted.camera, fitted.determined()
    sigma = np.sqrt(np.diag(fitted.covariance))
    parameters = []
    for i, name in enumerate(PARAMETERS):
        value = float(getattr(camera, name))
        scale = {"height_m": value, "focal_px": value}.get(
            name, np.degrees(1.0) if name.endswith("_deg") else 1.0
        )
        unit = next((u for end, u in _UNITS.items() if name.endswith(end)), "")
        parameters.append(
            Parameter(name, value, float(sigma[i] * scale), unit, bool(determined[i]))
        )
    if len(pairs):
        known = fitted.target_determined()
        for i, name in enumerate(TARGET_PARAMETERS):
            at = len(PARAMETERS) + i
            value = float(fitted.vector[at])
            parameters.append(Parameter(name, value, float(sigma[at]), "m", bool(known[i])))
    sources = []
    for i, name in enumerate(regressor.sources_):
        at = FIRST_SOURCE + 2 * i
        sources.append(
            SourceBias(
                name=name,
                n=int(np.sum(pairs.boxes.source == name)),
                bias_px=float(fitted.vector[at]),
                bias_m=float(fitted.vector[at + 1]),
                sigma_px=float(sigma[at]),
                sigma_m=float(sigma[at + 1]),
            )
        )
    names = np.unique(pairs.recording)
    clocks = {
        str(names[group]): float(offset)
        for group, offset in zip(fitted.clock_groups, fitted.clock_offset_s, strict=True)
    }
    return {
        "parameters": tuple(parameters),
        "sources": tuple(sources),
        "clock_offset_s": clocks,
        "statements": _statements(parameters, fitted, pairs, control_points, outlier),
    }


def _statements(
    parameters: list[Parameter],
    fitted: Any,
    pairs: Pairs,
    control_points: int,
    outlier: BoolArray,
) -> tuple[str, ...]:
    out = []
    unknown = [p.name for p in parameters if p.name in PARAMETERS and not p.determined]
    if unknown:
        out.append(
            f"The data does not determine {', '.join(unknown)}: what is assumed of an ordinary "
            "camera decides, and positions away from the training boxes are as unsure as stated."
        )
    if fitted.noise.heave_m > 0.0:
        share = fitted.noise.heave_m / fitted.camera.height_m
        out.append(
            f"The camera rises and falls by {fitted.noise.heave_m:.2f} m (standard deviation), and "
            f"with it all ranges by {100.0 * share:.1f} %; the ellipses answer for it."
        )
    if fitted.starts_agreeing < 0.5 * fitted.starts:
        out.append(
            f"Only {fitted.starts_agreeing} of {fitted.starts} starts ended at this camera; "
            "another may explain the data as well."
        )
    if outlier.any():
        where = ", ".join(
            f"{pairs.recording[i]}/{pairs.boxes.frame[i]}" for i in np.flatnonzero(outlier)[:5]
        )
        out.append(
            f"{int(outlier.sum())} of {len(pairs)} boxes disagree with all others and count "
            f"little (recording/frame {where})."
        )
    heavy = fitted.leverage.max(initial=0.0)
    if heavy > 1.5 and len(pairs) + control_points > 8:
        out.append(
            f"A single box carries {heavy:.1f} parameters of the fit; more boxes near it would "
            "make the camera surer."
        )
    late = {
        str(name): offset
        for name, offset in zip(
            np.unique(pairs.recording)[fitted.clock_groups] if len(pairs) else [],
            fitted.clock_offset_s,
            strict=True,
        )
        if abs(offset) > 1.0
    }
    for name, offset in late.items():
        out.append(
            f"The clock of recording {name} seems {abs(offset):.1f} s "
            f"{'behind' if offset > 0 else 'ahead of'} the log."
        )
    return tuple(out)
