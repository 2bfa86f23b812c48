"""Learn a georeferencer from a scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from sightline.camera.observations import Landmarks
from sightline.camera.pinhole import Camera
from sightline.camera.priors import CameraPrior, SourceBelief
from sightline.camera.rotation import Turns, reference_view
from sightline.camera.stabilisation import level, nominal_camera
from sightline.errors import FitError, unknown_name
from sightline.geodesy import LocalPlane
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.correspondences import Pairs
from sightline.georeferencing.fit_report import fit_report
from sightline.georeferencing.georeferencer import DEFAULT_MODEL, MODELS, Georeferencer
from sightline.georeferencing.observations import CONTROL_POINT_SIGMA_M, CameraObservations
from sightline.georeferencing.paper.model import PAPER_MODELS, PaperModel, paper_model
from sightline.georeferencing.support import Support
from sightline.progress import Progress
from sightline.scene import Scene
from sightline.scene.camera_state import scene_horizons, scene_stances
from sightline.scene.correspondences import scene_pairs
from sightline.types import Boxes, Horizons
from sightline.water import LEVEL_SIGMA_M


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
        if (found := fitted.turns(own, view)) is not None
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
        known = Landmarks(
            np.concatenate([control.pixel_px, far.pixel_px]),
            np.concatenate([control_east_north, far.east_north_m]),
            np.concatenate([np.full(len(control), CONTROL_POINT_SIGMA_M), far.sigma_m]),
        )
        regressor = CameraRegressor(
            image_size_px,
            # On a vessel the waves that lift the camera while a target passes a place would be
            # learned as of the place.
            residual=model == "camera+gpr" and not scene.moves,
            prior=prior,
            source_priors=beliefs,
            position_known=position_known,
            heaving=scene.moves,
            starts=8 if position_known else 24,
            random_state=seed,
            above_sigma_m=0.0 if water_level_m is None else LEVEL_SIGMA_M,
        ).fit_observations(CameraObservations.of(pairs, above_m=above_m, landmarks=known))
        places = regressor.predict(boxes, source=pairs.boxes.source, above_m=above_m)
        pixels = np.concatenate([foot, control.pixel_px])
    report = fit_report(model, regressor, pairs, places, len(control))
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
