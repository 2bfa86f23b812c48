"""The main job: all stages in a row, for every recording of a scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sightline.detection import DEFAULT_DETECTOR
from sightline.errors import FitError
from sightline.evaluation.metrics import ScoredPairs
from sightline.evaluation.report import Report, TracksUsed, pair_target, summarise
from sightline.georeferencing.georeferencer import DEFAULT_MODEL, Georeferencer
from sightline.overlap import iou
from sightline.pipeline.camera_state import Standing, camera_turns, recording_conditions
from sightline.pipeline.evaluate import Placed, leave_one_out, place_boxes, score
from sightline.pipeline.fit_unlabelled import fit_scene
from sightline.pipeline.sources import LOOKED_AT, SeldomError, in_hand, refuse_seldom, timed
from sightline.pipeline.track import TrackSettings, check_platform, follow, smooth_boxes
from sightline.progress import Progress
from sightline.scene import Recording, Scene
from sightline.scene.camera_state import scene_horizons
from sightline.scene.detections import SceneDetections
from sightline.tracks import Tracks
from sightline.trajectory import method
from sightline.types import NO_TRACK, Boxes, Track


@dataclass(frozen=True, eq=False)
class RunResult:
    """What `run` made of a scene.

    Attributes:
        scene: The scene.
        model: Fitted to all of it.
        tracks: Of each recording.
        smoothed: The target's tracks against the log, each made by a model that never saw its
            recording wherever ``left_out`` says so; None where there was no log to compare with.
        single: Single boxes likewise; None where no recording has boxes and a log.
        left_out: Whether each recording was scored with a model that never saw it.
        detected: Names of the recordings whose boxes a detector found.
        placed: The boxes that were scored.
        notes: Sentences for the user.
    """

    scene: Scene
    model: Georeferencer
    tracks: Mapping[str, Tracks]
    smoothed: Report | None
    single: Report | None
    left_out: bool
    detected: tuple[str, ...]
    placed: Sequence[Placed]
    notes: tuple[str, ...] = field(default=())


def run(
    scene: Scene,
    *,
    model: str = DEFAULT_MODEL,
    detector: str = DEFAULT_DETECTOR,
    settings: TrackSettings | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> RunResult:
    """The main job: detect where there are no boxes, fit, track, smooth, evaluate.

    Args:
        scene: The scene.
        model: Name of the model.
        detector: Name of the detector for recordings without boxes.
        settings: How boxes become tracks.
        seed: Of whatever is random in the fit.
        progress: Told how far it is.

    Raises:
        InputError: A file of the scene cannot be used.
        FitError: No model can be learned from the scene.

    Examples:
        >>> result = sightline.run(sightline.Scene.load("scene.toml"))
        >>> {name: len(tracks) for name, tracks in result.tracks.items()}
        {'01': 1, '02': 1, '03': 1}
        >>> result.left_out, round(result.smoothed.ape.rmse)
        (True, 11)
    """
    settings = settings or TrackSettings()
    settings = replace(settings, correct_turns=settings.correct_turns and scene.camera.watched)
    tell = progress or (lambda _what, _share: None)
    seen = SceneDetections(scene, detector, tell, stills=not _drawn(scene))
    extra = _taught(scene, seen) if any(map(_unseen, scene.recordings)) else {}
    tell("fitting", float("nan"))
    fitted = fit_scene(scene, model, seed=seed, extra=extra, seen=seen, progress=tell)
    notes: list[str] = []
    models: dict[str, Georeferencer] = {}
    try:
        if _drawn(scene):
            models = leave_one_out(scene, model, seed=seed, extra=extra)
        else:
            models = _leave_one_out_undrawn(scene, model, seed, seen, tell)
    except FitError:
        notes.append(
            "The figures are of the recordings that the model learned from: there is too little "
            "to leave any out. They are better than what a new recording would give."
        )
    tracks: dict[str, Tracks] = {}
    detected: list[str] = []
    scored: dict[str, tuple[ScoredPairs, TracksUsed]] = {}
    for recording in scene.recordings:
        tell(f"tracking {recording.name}", float("nan"))
        held = models.get(recording.name, fitted)
        try:
            made = track_recording(recording, fitted, seen, settings)
            judged = made if held is fitted else track_recording(recording, held, seen, settings)
        except SeldomError as error:
            made = judged = []
            notes.append(f"Nothing is tracked in recording {recording.name}: {error}.")
        else:
            if _unseen(recording):
                detected.append(recording.name)
        tracks[recording.name] = Tracks(tuple(made))
        turned = camera_turns(recording, fitted) if scene.camera.watched else None
        if turned is not None:
            notes.append(turned)
        pairs = _against_log(recording, judged, held.log_sigma_m)
        if pairs is not None:
            scored[recording.name] = pairs
    placed: list[Placed] = []
    if _drawn(scene):
        placed = place_boxes(scene, lambda name: models.get(name, fitted))
    single = score(placed) if any(len(one.single()) for one in placed) else None
    smoothed = None
    if scored:
        smoothed = summarise(
            {name: pairs for name, (pairs, _) in scored.items()},
            tracks={name: used for name, (_, used) in scored.items()},
        )
    return RunResult(
        scene=scene,
        model=fitted,
        tracks=tracks,
        smoothed=smoothed,
        single=single,
        left_out=bool(models),
        detected=tuple(detected),
        placed=placed,
        notes=tuple(notes),
    )


def _drawn(scene: Scene) -> bool:
    """Whether somebody drew boxes of a logged target."""
    return any(r.boxes_path and r.fixes_path for r in scene.recordings)


def _leave_one_out_undrawn(
    scene: Scene, model: str, seed: int, seen: SceneDetections, tell: Progress
) -> dict[str, Georeferencer]:
    """For each recording with a log a model that never saw it, without drawn boxes.

    Raises:
        FitError: Nothing can be learned without any of them.
    """
    models: dict[str, Georeferencer] = {}
    failed: FitError | None = None
    logged = [recording.name for recording in scene.recordings if recording.fixes_path is not None]
    for i, name in enumerate(logged):
        tell(f"fitting without {name}", i / len(logged))
        try:
            models[name] = fit_scene(scene.without([name]), model, seed=seed, seen=seen)
        except FitError as error:
            failed = error
    if not models and failed is not None:
        raise failed
    return models


def _unseen(recording: Recording) -> bool:
    """Whether a detector has to find the boxes of a recording."""
    return recording.boxes_path is None and recording.detections_path is None


def _taught(scene: Scene, seen: SceneDetections) -> dict[str, Boxes]:
    """What a detector makes of the target where somebody has drawn its boxes.

    Every source of boxes has its own habit at the lower edge. Where the same target was drawn and
    detected in the same frames, the fit learns both.
    """
    out: dict[str, Boxes] = {}
    for recording in scene.recordings:
        if recording.boxes_path is None or recording.source is None:
            continue
        same = _same_target(recording.boxes(), seen.boxes(recording))
        if len(same):
            out[recording.name] = same
    return out


def _same_target(drawn: Boxes, found: Boxes, least_iou: float = 0.3) -> Boxes:
    """Of the boxes found those that lie on a box drawn in the same frame, the best for each."""
    rows = []
    for frame, box in zip(drawn.frame, drawn.xyxy_px, strict=True):
        here = np.flatnonzero(found.frame == frame)
        if not here.size:
            continue
        overlap = iou(box, found.xyxy_px[here])
        best = int(np.argmax(overlap))
        if overlap[best] >= least_iou:
            rows.append(int(here[best]))
    return found[np.array(sorted(set(rows)), dtype=np.int64)]


def track_recording(
    recording: Recording, model: Georeferencer, seen: SceneDetections, settings: TrackSettings
) -> list[Track]:
    """The tracks of a recording: of the target that somebody drew, or of whatever is seen."""
    smoother = method(settings.trajectory)
    where = f"recording {recording.name}"
    platform, horizons = recording.platform(), scene_horizons(recording)
    check_platform(model, platform, f"{where}: ")
    standing = Standing(recording_conditions(recording, model, watched=settings.correct_turns))
    if recording.boxes_path is not None:
        (boxes,) = standing.level([model.level(recording.boxes(), horizons)])
        made = smooth_boxes(
            boxes,
            model,
            smoother,
            settings,
            track_id=1,
            platform=platform,
            conditions=standing.conditions,
        )
        return [] if made is None else [made]
    if recording.detections_path is not None:
        batches, highest_id = in_hand(recording.detections())
    else:
        refuse_seldom(seen.times_utc_s(recording).tolist()[:LOOKED_AT], "pictures", model)
        batches, highest_id = iter([seen.boxes(recording)]), NO_TRACK
    with_times = (timed(boxes, None, model, f"{where}: ") for boxes in batches)
    level = standing.level(model.level(boxes, horizons) for boxes in with_times)
    return list(follow(level, model, smoother, settings, highest_id, platform, standing=standing))


def _against_log(
    recording: Recording, tracks: list[Track], log_sigma_m: float
) -> tuple[ScoredPairs, TracksUsed] | None:
    if recording.fixes_path is None:
        return None
    pairs, used = pair_target(
        tracks, recording.fixes(), platform=recording.platform(), log_sigma_m=log_sigma_m
    )
    return (pairs, used) if len(pairs) else None
