"""Fit a georeferencer to a scene without drawn boxes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sightline.association.associate import (
    LEAST_LEAD,
    Association,
    Weighed,
    associate,
    weigh,
)
from sightline.association.observations import TrackObservations, observe
from sightline.association.search import RecordingObservations
from sightline.camera.observations import Landmarks
from sightline.camera.pinhole import Camera
from sightline.camera.priors import CameraPrior, SourcePrior
from sightline.camera.shore_landmarks import shore_landmarks
from sightline.camera.shoreline import WaterEdge, find_water_edge
from sightline.camera.stated import StatedCamera
from sightline.clock_offset import LARGEST_OFFSET_S, ZONES_S, RecordingClock
from sightline.detection import DEFAULT_DETECTOR, Detector, LowerEdge, check_detector_name
from sightline.errors import FitError, InputError
from sightline.geodesy import LocalPlane
from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.fit import FitInputs, FitSettings
from sightline.georeferencing.fit import fit as fit_inputs
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.georeferencing.models import DEFAULT_MODEL, ModelType, model_type
from sightline.georeferencing.recalibration import detect_camera_change, prior_of
from sightline.pipeline.first_look import NOTHING_MOVES, log_goes
from sightline.pipeline.fit import fit
from sightline.progress import Progress
from sightline.reference_trajectory import ReferenceTrajectory
from sightline.scene import Recording, Scene
from sightline.scene.camera_state import scene_static_intervals
from sightline.scene.clocks import settle_clocks
from sightline.scene.correspondences import (
    levels_at,
    on_leaps,
    scene_clocks,
    scene_correspondences,
)
from sightline.scene.detections import SceneDetections, lower_edges_of
from sightline.scene.hull import Hull
from sightline.synchronisation import LARGEST_GAP_S, check_overlap
from sightline.threads import on_one_thread
from sightline.types import BoolArray, Boxes, FloatArray, IntArray

CORRELATION_TIME_S = 1.5
"""Boxes that teach are at least so far apart: a detector's errors last as long."""

MOST_A_RECORDING = 120

# Between fixes that are further apart a boat has turned, and nobody knows where.
_SPARSE_S = 15.0
# Zones of a wrong clock at which a vessel is recognised; and how far a stated clock may be off.
_MOST_ZONES = 4
_STATED_SIGMAS = 4.0

# Detectors see a hull, not where it meets the water: their boxes end too high by a few pixels, as
# a rule. Where the edge of the water is seen, it tells how many; boxes alone tell next to nothing,
# so that without it a closer guess has to stand in. Whoever draws boxes leaves some water around a
# boat: a pixel and 0.15 m are half of what the detector that ships was taught to leave.
_ANY = CameraPrior(unseen_px=1.0, unseen_m=-0.15)
_WITH_EDGE = replace(_ANY, bias_px=-3.0, bias_px_sigma=5.0)
_WITHOUT_EDGE = replace(_ANY, bias_px=-4.0, bias_px_sigma=2.0)

# Of some detectors it was measured on rendered boats; so much may real ones differ from these, px
# and as a share of what the height of the boat makes.
_UNLIKE_RENDERED_PX = 1.0
_UNLIKE_RENDERED_SHARE = 0.5
_LEAST_SIGMA_M = 0.1
# Errors of a track by other cameras last: their models' until their target is elsewhere.
_TRACK_ERROR_S = 60.0


@on_one_thread
def fit_scene(
    scene: Scene,
    model: str | ModelType = DEFAULT_MODEL,
    *,
    seed: int = 0,
    extra: Mapping[str, Boxes] | None = None,
    detector: str | Detector | None = DEFAULT_DETECTOR,
    seen: SceneDetections | None = None,
    largest_offset_s: float = LARGEST_OFFSET_S,
    progress: Progress | None = None,
) -> Georeferencer:
    """Fit a georeferencer to a scene, with or without drawn boxes.

    Where a recording has drawn boxes and a log, or there are only control points, this is `fit`.
    Otherwise the logged vessels are recognised among the recordings' ``detections``, or among what
    a detector finds in their frames.

    Args:
        scene: The scene.
        model: One of `MODELS`, or a model type.
        seed: Of whatever is random in the fit.
        extra: As for `fit`.
        detector: Name of the detector, or an object, for recordings that have pictures but no boxes
            of any kind; None: these are left out.
        seen: Its detections, where they are there already.
        largest_offset_s: Largest clock offset.
        progress: Told what is being done.

    Raises:
        InputError: The model's name is not known, or a file of the scene cannot be used.
        FitError: There is too little, or nobody can be recognised.

    Examples:
        >>> model = sightline.fit(sightline.Scene.load("scene.toml"), model="camera")
        >>> height = model.report.parameters[0]
        >>> height.name, height.unit, round(height.value)
        ('height_m', 'm', 5)
        >>> path = model.save("camera.safetensors")
    """
    model = model_type(model)
    if detector is not None:
        check_detector_name(detector)
    drawn = any(r.boxes_path and r.fixes_path for r in scene.recordings)
    looks = seen is not None or detector is not None
    able = any(
        r.fixes_path and (r.detections_path or (looks and r.source)) for r in scene.recordings
    )
    if drawn or not able:
        return fit(scene, model, seed=seed, extra=extra, progress=progress)
    if seen is None and detector is not None:
        seen = SceneDetections(scene, detector, progress, stills=True)
    association = associate_scene(
        scene,
        detector=detector,
        seen=seen,
        largest_offset_s=largest_offset_s,
        progress=progress,
    )
    return fit_association(
        scene,
        association,
        model,
        seed=seed,
        lower_edges=seen.lower_edges if seen else None,
        seen=seen,
    )


@on_one_thread
def associate_scene(
    scene: Scene,
    *,
    detector: str | Detector | None = DEFAULT_DETECTOR,
    seen: SceneDetections | None = None,
    largest_offset_s: float = LARGEST_OFFSET_S,
    progress: Progress | None = None,
) -> Association:
    """Associate detections with the logged vessels of a scene.

    Args:
        scene: Says where its camera stands.
        detector: As for `fit_scene`.
        seen: As for `fit_scene`.
        largest_offset_s: As for `fit_scene`.
        progress: Told what is being done.

    Raises:
        InputError: A file cannot be used, or no log overlaps its recording.
        FitError: Nobody can be recognised, or the scene does not say where its camera stands.
    """
    seen_so = _observe_all(scene, detector, seen, largest_offset_s, progress)
    refused: FitError | None = None
    found: list[Association] = []
    for zone_s in seen_so.zones_s:
        watches = seen_so.watches(scene, zone_s)
        if not watches:
            continue
        try:
            found.append(
                associate(watches, scene.image_size_px, largest_offset_s=seen_so.largest_offset_s)
            )
        except FitError as error:
            refused = refused or FitError(f"{scene.path}: {error}{_sparse(watches)}")
        if zone_s == 0.0 and found:
            return found[0]
        if len(found) == _MOST_ZONES:
            break
    if found:
        return _likeliest(found)
    if refused is not None:
        raise refused
    raise seen_so.without_log(scene)


@dataclass(frozen=True, eq=False)
class LogCandidate:
    """A vessel in a recording that one explanation takes for a logged one.

    Attributes:
        explanation: Number of the explanation, from 0; those of one go together.
        recording: Name of the recording.
        vessel: Name of the log; an MMSI where it is of an AIS feed.
        boxes: N boxes of it, thinned as a fit learns from them, in the order of time.
        place_px: (N, 2) float64, where that explanation has the log's place in the picture at the
            times of these; NaN where the log does not tell.
        clock_offset_s: How far the explanation has the camera's clock ahead of the log's.
        seen: How many boxes of the recording it takes for the vessel's.
        evidence: Of the explanation, against no logged vessel in view, in nats.
        probability: Of the explanation among all that were weighed, and none.
        match: Log-likelihood ratio of this vessel's path, in nats.
    """

    explanation: int
    recording: str
    vessel: str
    boxes: Boxes
    place_px: FloatArray
    clock_offset_s: float
    seen: int
    evidence: float
    probability: float
    match: float


@on_one_thread
def weigh_scene(
    scene: Scene,
    *,
    detector: str | Detector | None = DEFAULT_DETECTOR,
    seen: SceneDetections | None = None,
    largest_offset_s: float = LARGEST_OFFSET_S,
    progress: Progress | None = None,
) -> tuple[LogCandidate, ...]:
    """What recognition weighs in a scene, likely or not, the likeliest explanation first.

    Args:
        scene: As for `associate_scene`.
        detector: As for `fit_scene`.
        seen: As for `fit_scene`.
        largest_offset_s: As for `fit_scene`.
        progress: Told what is being done.

    Returns:
        Empty where nothing that is seen moves as a log says.

    Raises:
        InputError: As `associate_scene`.
        FitError: The scene does not say where its camera stands, nothing moves, or no log is of
            the time of what is seen.
    """
    seen_so = _observe_all(scene, detector, seen, largest_offset_s, progress)
    tried = 0
    for zone_s in seen_so.zones_s:
        watches = seen_so.watches(scene, zone_s)
        if not watches:
            continue
        found = weigh(watches, scene.image_size_px, largest_offset_s=seen_so.largest_offset_s)
        if found:
            return tuple(one for i, each in enumerate(found) for one in _candidates(scene, i, each))
        tried += 1
        if tried == _MOST_ZONES:
            break
    if not tried:
        raise seen_so.without_log(scene)
    return ()


def _candidates(scene: Scene, number: int, weighed: Weighed) -> list[LogCandidate]:
    """The vessels of an explanation."""
    association = weighed.association
    by_name = {watch.name: watch for watch in association.watches}
    out = []
    for found in association.found:
        watch = by_name[found.recording]
        path = next(path for path in watch.paths if path.name == found.vessel)
        chosen = found.rows[_thinned(watch.seen.time_utc_s[found.rows])]
        boxes = watch.seen.boxes[watch.seen.box[chosen]]
        times = watch.seen.time_utc_s[chosen] + association.offset_s[found.recording]
        east, north = path.at(times).east_north_m.T
        out.append(
            LogCandidate(
                explanation=number,
                recording=found.recording,
                vessel=found.vessel,
                boxes=boxes,
                place_px=association.camera.project(east, north, watch.above_m[chosen]),
                clock_offset_s=scene[found.recording].clock_offset_s
                + association.ahead_s(found.recording),
                seen=int(found.taken.sum()),
                evidence=weighed.evidence,
                probability=weighed.probability,
                match=found.log_likelihood_ratio,
            )
        )
    return out


@dataclass(frozen=True, eq=False)
class _Observed:
    """What is seen in the recordings of a scene that have a log.

    Attributes:
        plane: At the camera.
        boxes: By recording, boxes of anything.
        observed: By recording, what recognition takes of them.
        zones_s: Time zones of the camera's clock that are tried.
        largest_offset_s: Largest clock offset.
    """

    plane: LocalPlane
    boxes: Mapping[str, Boxes]
    observed: Mapping[str, TrackObservations]
    zones_s: tuple[float, ...]
    largest_offset_s: float

    def watches(self, scene: Scene, zone_s: float) -> list[RecordingObservations]:
        return _watches(scene, self.plane, self.observed, self.largest_offset_s, zone_s)

    def without_log(self, scene: Scene) -> FitError:
        """What is to be said where no log is of the time of any boxes; raises what is clearer."""
        for name, some in self.boxes.items():
            if len(scene[name].logs()) == 1:
                check_overlap(some.time_utc_s, scene[name].fixes(), f"recording {name}")
        return FitError(
            f"{scene.path}: no recording has boxes of anything while its log tells where a vessel "
            "was; nobody can be recognised"
        )


def _observe_all(
    scene: Scene,
    detector: str | Detector | None,
    seen: SceneDetections | None,
    largest_offset_s: float,
    progress: Progress | None,
) -> _Observed:
    """Look at the recordings of a scene; raises as `associate_scene`."""
    plane = scene.plane
    if scene.moves:
        raise FitError(
            f"{scene.path}: its camera stands on a platform that moves, where nobody is recognised "
            "without drawn boxes; give boxes"
        )
    if plane is None:
        raise FitError(
            f"{scene.path}: to recognise a logged vessel without drawn boxes, say where the camera "
            "stands: [camera] latitude_deg and longitude_deg"
        )
    tell = progress or (lambda _what, _share: None)
    if seen is None and detector is not None:
        seen = SceneDetections(scene, detector, progress)
    stated = [one.clock_prior.sigma_s for one in scene.recordings if one.clock_prior.stated]
    if len(stated) == len(scene.recordings):
        largest_offset_s = min(largest_offset_s, max(_STATED_SIGMAS * max(stated), 1.0))
    boxes = {
        recording.name: own
        for recording in scene.recordings
        if recording.fixes_path is not None
        and (own := _boxes_of_anything(recording, seen)) is not None
        and len(own)
    }
    observed = {
        name: observe(some, moving_only=log_goes(scene[name], plane, np.unique(some.time_utc_s)))
        for name, some in boxes.items()
    }
    if boxes and not any(map(len, observed.values())):
        raise FitError(f"{scene.path}: {NOTHING_MOVES}")
    tell("recognising the logged vessels", float("nan"))
    zones_s = (0.0, *(() if stated else ZONES_S))
    return _Observed(plane, boxes, observed, zones_s, largest_offset_s)


def _watches(
    scene: Scene,
    plane: LocalPlane,
    observed: Mapping[str, TrackObservations],
    largest_offset_s: float,
    zone_s: float,
) -> list[RecordingObservations]:
    """Observations beside the logs that overlap them, if the camera's clock is of some zone."""
    watches = [
        RecordingObservations(name, seen, paths, zone_s=zone_s)
        for name, seen in observed.items()
        if (paths := _paths(scene[name], plane, seen.boxes, largest_offset_s, zone_s))
    ]
    if not scene.tidal or not watches:
        return watches
    try:
        return _over_water(watches, scene)
    except InputError:
        # The table of the water says nothing of the time at which a clock of that zone was.
        if zone_s:
            return []
        raise


def _likeliest(found: Sequence[Association]) -> Association:
    """The likeliest of associations at several time zones.

    Raises:
        FitError: Two zones are about as likely.
    """
    best, *others = sorted(found, key=lambda one: -one.evidence)
    if others and best.evidence - others[0].evidence < LEAST_LEAD:
        hours = [f"{one.watches[0].zone_s / 3600.0:+g} h" for one in (best, others[0])]
        raise FitError(
            f"the camera's clock is off by hours, and {hours[0]} and {hours[1]} are about as "
            "likely; give clock_offset_s"
        )
    return best


def _sparse(watches: Sequence[RecordingObservations]) -> str:
    """What is to be said of logs that hardly say how their vessels move."""
    gaps = []
    for watch in watches:
        first, last = watch.seen.time_utc_s.min(), watch.seen.time_utc_s.max()
        for path in watch.paths:
            times = path.time_utc_s
            gaps.append(np.diff(times[(times >= first) & (times <= last)]))
    apart_s = np.concatenate(gaps)
    if apart_s.size and np.median(apart_s) < _SPARSE_S:
        return ""
    often = f"a fix every {np.median(apart_s):.0f} s" if apart_s.size else "less than two fixes"
    return (
        f"; while boxes are seen there is {often}, which says little of how a vessel moves: a log "
        "with a fix every 10 s, or boxes that are drawn, tell more"
    )


def _over_water(
    watches: Sequence[RecordingObservations], scene: Scene
) -> list[RecordingObservations]:
    """Observations with their water level, above its median over all of them."""
    levels = [
        levels_at(scene[watch.name], watch.seen.time_utc_s - watch.zone_s) for watch in watches
    ]
    middle_m = float(np.median(np.concatenate(levels)))
    return [
        replace(watch, above_m=own - middle_m) for watch, own in zip(watches, levels, strict=True)
    ]


@on_one_thread
def fit_association(
    scene: Scene,
    association: Association,
    model: str | ModelType = DEFAULT_MODEL,
    *,
    seed: int = 0,
    lower_edges: Mapping[str, LowerEdge | None] | None = None,
    seen: SceneDetections | None = None,
) -> Georeferencer:
    """Fit a georeferencer to the associated boxes.

    Args:
        scene: The scene.
        association: Of the scene.
        model: One of `MODELS`, or a model type.
        seed: Of whatever is random in the fit.
        lower_edges: Where the boxes of each source end, as `SceneDetections` tells.
        seen: Detections in the scene's frames, where they are there already.

    Raises:
        FitError: There are too few boxes.
    """
    plane = scene.plane
    assert plane is not None, "association needs the camera's place"
    landmarks = scene_landmarks(scene, association, seen)
    pairs = recognised_correspondences(association, plane, scene)
    source_priors = _measured(pairs, association.camera, lower_edges)
    inputs = FitInputs(
        correspondences=pairs,
        image_size_px=scene.image_size_px,
        control_points=scene.control_points,
        tidal=scene.tidal,
        static_intervals=scene_static_intervals(scene),
        landmarks=landmarks,
        statements=_on_leaps(association, scene, plane),
        stated=scene.stated,
        clocks=_clocks_of(association, scene),
        name=str(scene.path),
    )
    settings = FitSettings(
        model=model,
        seed=seed,
        prior=_WITH_EDGE if len(landmarks) else _WITHOUT_EDGE,
        source_priors=source_priors,
    )
    fitted = fit_inputs(inputs, settings)
    more = list(association.statements)
    if len(landmarks):
        more.append("The edge of the water in the pictures tells where the horizon is.")
    else:
        more.append(
            "No edge of the water was seen: how far the detector's boxes end off the water is "
            "assumed, and ranges depend on it."
        )
    if pairs.of_tracks:
        more.append(_on_teachers(association, pairs))
    report = replace(
        fitted.report,
        asked=sum(len(watch.seen.boxes) for watch in association.watches),
        statements=(*more, *fitted.report.statements),
    )
    return replace(fitted, report=report)


def _on_teachers(association: Association, pairs: Correspondences) -> str:
    """What the tracks of other cameras were worth."""
    vessels = len({(one.recording, one.vessel) for one in association.found})
    return (
        f"Taught by the tracks of other cameras: {vessels} of their targets, {len(pairs)} boxes. "
        f"The tracks state ± {np.median(pairs.fix_sigma_m):.1f} m for the places (median, along "
        f"either axis; at most {pairs.fix_sigma_m.max():.1f} m), which is carried into the "
        "model's uncertainty."
    )


def _on_leaps(association: Association, scene: Scene, plane: LocalPlane) -> tuple[str, ...]:
    """Sentences on fixes that leap off the path of a log; those of a feed tell course and speed."""
    said = []
    for watch in association.watches:
        recording = scene[watch.name]
        if len(recording.logs()) == 1:
            said.append(on_leaps(recording, watch.seen.time_utc_s, plane))
    return tuple(one for one in said if one)


def _clocks_of(association: Association, scene: Scene) -> dict[str, RecordingClock]:
    """What was taken off the recordings' times, and what is believed of their clocks."""
    return {
        name: RecordingClock(
            scene[name].clock_offset_s + association.ahead_s(name), scene[name].clock_prior
        )
        for name in association.offset_s
    }


@on_one_thread
def update_scene(
    scene: Scene,
    old: Georeferencer,
    *,
    seed: int = 0,
    detector: str | Detector | None = DEFAULT_DETECTOR,
    seen: SceneDetections | None = None,
    largest_offset_s: float = LARGEST_OFFSET_S,
    progress: Progress | None = None,
) -> Georeferencer:
    """Recalibrate a model with a new day, and detect whether its camera was rotated since.

    The old model's height, focal length, pitch and roll are the prior, with twice their standard
    deviations; pitch and roll are estimated anew where the camera was rotated.

    Args:
        scene: The new day, of the same camera.
        old: The model.
        seed: Of whatever is random in the fit.
        detector: As for `fit_scene`.
        seen: As for `fit_scene`.
        largest_offset_s: As for `fit_scene`.
        progress: Told what is being done.

    Raises:
        InputError: The old model has no camera or is for pictures of another size, or a file of
            the scene cannot be used.
        FitError: There is too little, or nobody can be recognised.
    """
    if old.camera is None:
        raise InputError(f"model {old.model!r} has no camera, so it cannot be updated; fit anew")
    if scene.image_size_px != old.image_size_px:
        raise InputError(
            f"{scene.path}: its pictures have {scene.image_size_px} px, the model learned from "
            f"{old.image_size_px} px; fit anew"
        )
    old.check_water(scene.tidal, f"{scene.path}: ")
    landmarks = Landmarks.none()
    source_priors: dict[str, SourcePrior] = {}
    more: tuple[str, ...] = ()
    if any(r.boxes_path and r.fixes_path for r in scene.recordings):
        scene = settle_clocks(scene, old.plane, prior_of(old, turned=True))
        pairs = scene_correspondences(scene, old.plane)
        clocks = scene_clocks(scene)
        usual = CameraPrior()
    else:
        moved_scene = replace(
            scene,
            camera=replace(
                scene.camera,
                latitude_deg=old.plane.latitude_deg,
                longitude_deg=old.plane.longitude_deg,
            ),
        )
        if seen is None and detector is not None:
            seen = SceneDetections(moved_scene, detector, progress, stills=True)
        association = associate_scene(
            moved_scene,
            detector=detector,
            seen=seen,
            largest_offset_s=largest_offset_s,
            progress=progress,
        )
        pairs = recognised_correspondences(association, old.plane, scene)
        clocks = _clocks_of(association, scene)
        landmarks = scene_landmarks(scene, association, seen)
        usual = _WITH_EDGE if len(landmarks) else _WITHOUT_EDGE
        source_priors = _measured(pairs, association.camera, seen.lower_edges if seen else None)
        more = association.statements
    static_intervals = scene_static_intervals(scene, progress)
    now = detect_camera_change(old, pairs.certain(), static_intervals)
    prior = replace(
        prior_of(old, turned=now.turned),
        bias_px=usual.bias_px,
        bias_px_sigma=usual.bias_px_sigma,
        unseen_px=usual.unseen_px,
        unseen_m=usual.unseen_m,
    )
    inputs = FitInputs(
        correspondences=pairs,
        image_size_px=old.image_size_px,
        control_points=scene.control_points,
        moving=scene.moves,
        tidal=scene.tidal,
        static_intervals=static_intervals,
        landmarks=landmarks,
        # All else was told to the model; refraction is another on another day.
        stated=StatedCamera(effective_earth_radius_m=scene.camera.stated.effective_earth_radius_m),
        clocks=clocks,
        name=str(scene.path),
    )
    settings = FitSettings(
        model=old.model,
        seed=seed,
        prior=prior,
        source_priors=source_priors,
        water_level_m=old.water_level_m,
    )
    fitted = fit_inputs(inputs, settings)
    statements = (*now.statements, *more, *fitted.report.statements)
    return replace(fitted, report=replace(fitted.report, statements=statements))


def recognised_correspondences(
    association: Association, plane: LocalPlane, scene: Scene
) -> Correspondences:
    """Correspondences of the associated boxes, thinned."""
    boxes, names, vessels, places, velocities, levels = [], [], [], [], [], []
    sigmas, around = [], []
    sizes, middles = [], []
    by_name = {watch.name: watch for watch in association.watches}
    for found in association.found:
        watch = by_name[found.recording]
        path = next(path for path in watch.paths if path.name == found.vessel)
        rows = _thinned(watch.seen.time_utc_s[found.rows])
        chosen = found.rows[rows]
        times = watch.seen.time_utc_s[chosen] + association.offset_s[found.recording]
        at = path.at(times)
        known = np.isfinite(at.east_north_m).all(axis=1)
        boxes.append(watch.seen.boxes[watch.seen.box[chosen[known]]])
        names.append(np.full(int(known.sum()), found.recording))
        vessels.append(np.full(int(known.sum()), found.vessel))
        places.append(at.east_north_m[known])
        velocities.append(path.smooth_velocity(times)[known])
        if path.fix_sigma_m is None:
            # What short gaps leave open is told by the noise that the fit estimates.
            sigmas.append(np.where(_long(at.fix_time_utc_s), at.sigma_m, 0.0)[known])
            around.append(at.fix_time_utc_s[known])
        else:
            sigmas.append(at.sigma_m[known])
            around.append(_alike(times[known]))
        recording = scene[found.recording]
        hull = recording.hull() if len(recording.logs()) == 1 else Hull()
        sizes.append(np.tile(hull.size_m, (int(known.sum()), 1)))
        middles.append(np.full(int(known.sum()), hull.antenna_known))
        if scene.tidal:
            levels.append(levels_at(scene[found.recording], times[known] - watch.zone_s))
    return Correspondences(
        boxes=Boxes.concatenate(boxes),
        recording=np.concatenate(names),
        east_north_m=np.concatenate(places),
        velocity_mps=np.concatenate(velocities),
        asked=sum(map(len, boxes)),
        plane=plane,
        vessel=np.concatenate(vessels),
        water_level_m=np.concatenate([np.empty(0), *levels]),
        fix_sigma_m=np.concatenate(sigmas),
        fix_time_utc_s=np.concatenate(around),
        hull_m=np.concatenate(sizes),
        at_middle=np.concatenate(middles),
        of_tracks=all(
            path.fix_sigma_m is not None for watch in by_name.values() for path in watch.paths
        ),
    )


def _alike(time_utc_s: FloatArray) -> FloatArray:
    """(N, 2) beginning and end of the stretch in which the error of a track is one and the same."""
    begin = np.floor(time_utc_s / _TRACK_ERROR_S) * _TRACK_ERROR_S
    return np.stack([begin, begin + _TRACK_ERROR_S], axis=1)


def _long(fix_time_utc_s: FloatArray) -> BoolArray:
    return np.asarray(np.diff(fix_time_utc_s, axis=1)[:, 0] > LARGEST_GAP_S)


def _measured(
    pairs: Correspondences, camera: Camera, lower_edges: Mapping[str, LowerEdge | None] | None
) -> dict[str, SourcePrior]:
    """Priors of the lower-edge bias of detectors for which it was measured.

    A share of the boat's height is metres at the boat, as many as it is high.
    """
    known = dict(lower_edges or {})
    names = np.unique(pairs.boxes.source).tolist()
    shipped = any(name.split("/")[0] == DEFAULT_DETECTOR for name in names)
    if shipped and DEFAULT_DETECTOR not in known:
        # A table of what it found may be all that there is.
        known |= lower_edges_of(DEFAULT_DETECTOR)
    away = pairs.east_north_m - (camera.east_m, camera.north_m)
    slant_m = np.hypot(np.hypot(away[:, 0], away[:, 1]), camera.height_m)
    height_px = pairs.boxes.xyxy_px[:, 3] - pairs.boxes.xyxy_px[:, 1]
    out = {}
    for name in names:
        edge = known.get(name)
        if edge is None:
            continue
        rows = pairs.boxes.source == name
        boat_m = float(np.median(edge.hull_px(height_px[rows]) * slant_m[rows])) / camera.focal_px
        below_m = edge.share * boat_m
        out[name] = SourcePrior(
            bias_px=(edge.px, float(np.hypot(edge.spread_px, _UNLIKE_RENDERED_PX))),
            bias_m=(-below_m, max(_UNLIKE_RENDERED_SHARE * abs(below_m), _LEAST_SIGMA_M)),
        )
    return out


def scene_landmarks(
    scene: Scene, association: Association, seen: SceneDetections | None = None
) -> Landmarks:
    """Landmarks along the shoreline in a scene's frames; none where it is not seen.

    Args:
        scene: The scene.
        association: Of the scene.
        seen: Detections in the scene's frames, where they are there already.
    """
    seen = seen or SceneDetections(scene, None)
    width = scene.image_size_px[0]
    edges = [
        edge
        for name in association.offset_s
        if scene[name].source is not None
        and (edge := _edge(scene[name], association.camera, width, seen)) is not None
    ]
    afloat = [path.east_north_m for watch in association.watches for path in watch.paths]
    return shore_landmarks(edges, association.camera, afloat)


def _edge(
    recording: Recording, camera: Camera, width: int, seen: SceneDetections
) -> WaterEdge | None:
    still = seen.still(recording)
    if still.shape[1] != width:
        return None
    return find_water_edge(still, camera.horizon_y_px(np.arange(float(width))))


def _boxes_of_anything(recording: Recording, seen: SceneDetections | None) -> Boxes | None:
    """Detections in a recording; None where there are none."""
    if recording.detections_path is not None:
        return recording.detections()
    if seen is None or recording.source is None:
        return None
    return seen.boxes(recording)


def _paths(
    recording: Recording, plane: LocalPlane, boxes: Boxes, largest_offset_s: float, zone_s: float
) -> tuple[ReferenceTrajectory, ...]:
    """Reference trajectories, in a time zone, of the logs that overlap a recording in time."""
    first = boxes.time_utc_s.min() - largest_offset_s
    last = boxes.time_utc_s.max() + largest_offset_s
    out = []
    for log in recording.logs():
        times = log.fixes.time_utc_s + zone_s
        if np.sum((times >= first) & (times <= last)) >= 2:
            path = ReferenceTrajectory.of(log.fixes, plane, log.velocity_mps, log.sigma_m)
            out.append(replace(path, time_utc_s=path.time_utc_s + zone_s))
    return tuple(out)


def _thinned(time_s: FloatArray) -> IntArray:
    """Indices of times in order, thinned to the correlation time and to a maximum count."""
    apart = max(CORRELATION_TIME_S, float(np.ptp(time_s)) / MOST_A_RECORDING)
    out: list[int] = []
    last = -np.inf
    for i, time in enumerate(time_s):
        if time - last >= apart:
            out.append(i)
            last = time
    return np.array(out, dtype=np.int64)
