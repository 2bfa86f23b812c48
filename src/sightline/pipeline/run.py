"""The whole pipeline: all stages in a row, for every recording of a scene."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sightline.camera.state import ObservedBoxes
from sightline.clock_offset import ClockOffset
from sightline.detection import DEFAULT_DETECTOR, Detector
from sightline.errors import FitError
from sightline.evaluation.clock_match import match_clock
from sightline.evaluation.metrics import ScoredPairs
from sightline.evaluation.report import Report, TracksUsed, pair_target, summarise
from sightline.georeferencing.fit import FitInputs, FitSettings
from sightline.georeferencing.fit import fit as fit_inputs
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.georeferencing.models import DEFAULT_MODEL, ModelType, model_type
from sightline.georeferencing.paper.model import PAPER_MODELS
from sightline.overlap import iou
from sightline.pipeline.camera_state import camera_turns, recording_history
from sightline.pipeline.evaluate import (
    LocatedRecording,
    clock_notes,
    place_boxes,
    recordings_with_correspondences,
)
from sightline.pipeline.first_look import FirstLook, FirstLooker
from sightline.pipeline.fit_unlabelled import fit_scene
from sightline.pipeline.moored import learn_places
from sightline.pipeline.sources import (
    LOOKED_AT,
    FrameRateError,
    check_frame_rate,
    from_memory,
    with_times,
)
from sightline.pipeline.track import TrackSettings, check_platform, follow, smooth_boxes
from sightline.progress import Progress
from sightline.scene import Recording, Scene
from sightline.scene.correspondences import collect, settled
from sightline.scene.detections import SceneDetections
from sightline.tally import Tally
from sightline.threads import on_one_thread
from sightline.tracks import Tracks
from sightline.trajectory import method
from sightline.types import NO_TRACK, Boxes, Positions, Track

_ALIKE_S = 2.0


@dataclass(frozen=True, eq=False)
class RunResult:
    """Model, tracks and reports that `run` made of a scene.

    Attributes:
        scene: The scene.
        model: Fitted to all of it.
        tracks: Of each recording.
        smoothed: The target's tracks against the log, in the recordings of ``left_out``; where
            there is none, in those that ``model`` learned from. None where there was no log to
            compare with.
        single: Single boxes likewise; None where no such recording has boxes and a log.
        left_out: Names of the recordings that were scored with a model that never saw them. Where
            there is none, all figures are of recordings that the model learned from.
        detected: Names of the recordings whose boxes a detector found.
        placed: The boxes that were scored, each by the model that scored them.
        notes: Sentences for the user.
        smoothed_learned_from: Where some recordings were left out: the tracks in those that could
            not be, by ``model``, which learned from them; None where there is none.
        single_learned_from: Single boxes likewise.
        clocks: By recording, how far its camera's clock is ahead of the log's. Where that is sure,
            the recording's tracks are in the log's time.
        first_look: What the first minute of the first recording that has boxes of anything shows;
            None where there is none.
        left_out_of_area: How many boxes and tracks were left out, since they lie outside of the
            scene's area or in its mask, by the reason.
    """

    scene: Scene
    model: Georeferencer
    tracks: Mapping[str, Tracks]
    smoothed: Report | None
    single: Report | None
    left_out: tuple[str, ...]
    detected: tuple[str, ...]
    placed: Sequence[LocatedRecording]
    notes: tuple[str, ...] = field(default=())
    smoothed_learned_from: Report | None = None
    single_learned_from: Report | None = None
    clocks: Mapping[str, ClockOffset] = field(default_factory=dict)
    left_out_of_area: Mapping[str, int] = field(default_factory=dict)
    first_look: FirstLook | None = None


@on_one_thread
def run(
    scene: Scene,
    *,
    model: str | ModelType = DEFAULT_MODEL,
    detector: str | Detector = DEFAULT_DETECTOR,
    settings: TrackSettings | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    first_look: Callable[[FirstLook], None] | None = None,
) -> RunResult:
    """Run the whole pipeline: detect where there are no boxes, fit, track, smooth, evaluate.

    Args:
        scene: The scene.
        model: Name of the model, or a model type.
        detector: Name of the detector, or an object, for recordings without boxes.
        settings: How boxes become tracks.
        seed: Of whatever is random in the fit.
        progress: Told how far it is.
        first_look: Is given what the first minute shows, as soon as that was looked at.

    Raises:
        InputError: A file of the scene cannot be used.
        FitError: No model can be learned from the scene.

    Examples:
        >>> result = sightline.run(sightline.Scene.load("scene.toml"))
        >>> {name: len(tracks) for name, tracks in result.tracks.items()}
        {'01': 1, '02': 1, '03': 1}
        >>> result.left_out, round(result.smoothed.ape.rmse)
        (('01', '02', '03'), 8)
    """
    settings = settings or TrackSettings()
    settings = replace(
        settings,
        compensate_rotation=settings.compensate_rotation and scene.camera.compensate_rotation,
        area=settings.area or scene.area(),
        tally=Tally(scene.path),
    )
    tell = progress or (lambda _what, _share: None)
    looker = FirstLooker(first_look)
    seen = SceneDetections(scene, detector, tell, stills=not _drawn(scene), observer=looker)
    _look_at_tables(scene, looker)
    tell("fitting", float("nan"))
    by_camera, scene = scene, settled(scene) if _drawn(scene) else scene
    taught = any(map(_unseen, scene.recordings))
    extra = _taught(scene, seen) if taught else {}
    kind = model_type(model)
    inputs: FitInputs | None = None
    if _drawn(scene):
        inputs = collect(scene, extra=extra, pictures=_asks_pictures(kind), progress=tell)
        fitted = fit_inputs(inputs, FitSettings(model=kind, seed=seed))
    else:
        fitted = fit_scene(scene, kind, seed=seed, extra=extra, seen=seen, progress=tell)
    fitted = _with_places(scene, fitted, seen, settings)
    models, failed = _leave_each_out(by_camera, inputs, kind, seed, taught, seen, tell)
    placed: list[LocatedRecording] = []
    if _drawn(scene):
        # A model that never saw a recording knows nothing of its clock.
        placed = place_boxes(by_camera, lambda name: models.get(name, fitted))
    scene, said = _in_log_time(by_camera, fitted)
    judged = scene.with_clocks(
        {one.recording: one.clock.used_s for one in placed if one.clock is not None}
    )
    tracked = _track_each(scene, judged, fitted, models, seen, settings, tell)
    single = {one.recording: pairs for one in placed if len(pairs := one.single())}
    scored = [r.name for r in scene.recordings if r.name in tracked.scored or r.name in single]
    # With drawn boxes nothing is learned from recordings that have none.
    learned_from = fitted.report.recordings if _drawn(scene) else scored
    left_out = tuple(name for name in scored if name in models or name not in learned_from)
    rest = [name for name in scored if name not in left_out]
    smoothed = _report_tracks(tracked.scored, left_out)
    single_boxes = _report_boxes(single, left_out)
    smoothed_rest, single_rest = _report_tracks(tracked.scored, rest), _report_boxes(single, rest)
    own = {one.recording: one.clock for one in placed if one.recording in models}
    own.update(tracked.clocks)
    left = _left_out(settings.tally, seen.tally)
    notes = (*clock_notes(own), *said, *tracked.notes, *_left_out_notes(left))
    notes += () if looker.look is None else looker.look.sentences()[1:]
    if rest:
        notes = (_in_sample(rest if left_out else [], failed), *notes)
    return RunResult(
        scene=scene,
        model=fitted,
        tracks=tracked.tracks,
        smoothed=smoothed if left_out else smoothed_rest,
        single=single_boxes if left_out else single_rest,
        left_out=left_out,
        detected=tracked.detected,
        placed=placed,
        notes=notes,
        smoothed_learned_from=smoothed_rest if left_out else None,
        single_learned_from=single_rest if left_out else None,
        clocks=fitted.report.clocks,
        left_out_of_area=left,
        first_look=looker.look,
    )


def _look_at_tables(scene: Scene, looker: FirstLooker) -> None:
    """Look at the first recording, where its detections are there already."""
    first = scene.recordings[0]
    if first.boxes_path is None and first.detections_path is not None:
        boxes = first.detections()
        if np.isfinite(boxes.time_utc_s).all() and looker.begin(first):
            boxes = boxes[np.argsort(boxes.time_utc_s, kind="stable")]
            cuts = np.flatnonzero(np.diff(boxes.time_utc_s) > 0.0) + 1
            for rows in np.split(np.arange(len(boxes)), cuts):
                if rows.size:
                    looker.see(boxes[rows], float(boxes.time_utc_s[rows[0]]))
            looker.end()


def _with_places(
    scene: Scene, fitted: Georeferencer, seen: SceneDetections, settings: TrackSettings
) -> Georeferencer:
    """The model with what stays in the view of its camera, in all recordings."""
    if fitted.moving or not settings.tell_moored:
        return fitted
    boxes: list[Iterable[ObservedBoxes]] = []
    for recording in scene.recordings:
        if recording.detections_path is not None:
            found = recording.detections()
        elif _unseen(recording):
            found = seen.boxes(recording)
        else:
            continue
        if len(found) and np.isfinite(found.time_utc_s).all():
            history = recording_history(recording, fitted, pictures=settings.compensate_rotation)
            boxes.append([history.observed(found)])
    return replace(fitted, static_places=learn_places(boxes, fitted))


def _left_out(*tallies: Tally | None) -> dict[str, int]:
    """How many boxes and tracks were left out, by the reason."""
    out: dict[str, int] = {}
    for tally in tallies:
        for reason, left in tally.left_out.items() if tally is not None else ():
            out[reason] = out.get(reason, 0) + left.count
    return out


def _left_out_notes(left: Mapping[str, int]) -> tuple[str, ...]:
    """A sentence on what was left out, where something was."""
    if not left:
        return ()
    return (f"Left out: {', '.join(f'{count} {reason}' for reason, count in left.items())}.",)


def _in_log_time(scene: Scene, fitted: Georeferencer) -> tuple[Scene, tuple[str, ...]]:
    """The scene with the clocks that a model has found, and sentences on those it has not.

    The recordings of a camera have one clock: where those that tell it agree, so do the others.

    Args:
        scene: By the camera's clock.
        fitted: To the scene.
    """
    clocks = fitted.report.clocks
    used = {name: clock.used_s for name, clock in clocks.items()}
    offsets = np.array([clock.offset_s for clock in clocks.values()])
    others = [
        recording.name
        for recording in scene.recordings
        if recording.name not in clocks and not recording.clock_prior.stated
    ]
    said: tuple[str, ...] = ()
    if others and any(used.values()) and np.ptp(offsets) < _ALIKE_S and all(used.values()):
        common_s = float(np.median(offsets))
        used |= dict.fromkeys(others, common_s)
        which = "ahead of" if common_s > 0.0 else "behind"
        said = (
            (
                f"Nothing tells the clock of {', '.join(others)}; as in the other recordings it is "
                f"taken to be {abs(common_s):.1f} s {which} the log."
            ),
        )
    return scene.with_clocks(used), said


@dataclass(frozen=True, eq=False)
class _Tracked:
    """Tracks of each recording, with their scores.

    Attributes:
        tracks: By ``RunResult.model``.
        scored: By the model that never saw the recording, where there is one.
        detected: See `RunResult`.
        notes: See `RunResult`.
        clocks: By recording, how far the camera's clock is ahead, by the tracks that the model made
            which never saw it; of recordings without drawn boxes.
    """

    tracks: Mapping[str, Tracks]
    scored: Mapping[str, tuple[ScoredPairs, TracksUsed]]
    detected: tuple[str, ...]
    notes: tuple[str, ...]
    clocks: Mapping[str, ClockOffset | None]


def _track_each(
    scene: Scene,
    judged_scene: Scene,
    fitted: Georeferencer,
    models: Mapping[str, Georeferencer],
    seen: SceneDetections,
    settings: TrackSettings,
    tell: Progress,
) -> _Tracked:
    tracks: dict[str, Tracks] = {}
    scored: dict[str, tuple[ScoredPairs, TracksUsed]] = {}
    detected: list[str] = []
    notes: list[str] = []
    clocks: dict[str, ClockOffset | None] = {}
    for recording in scene.recordings:
        tell(f"tracking {recording.name}", float("nan"))
        held = models.get(recording.name, fitted)
        try:
            made = track_recording(recording, fitted, seen, settings)
            judged = made
            if held is not fitted:
                # What is left out is counted once.
                again = replace(settings, tally=None)
                own = judged_scene[recording.name]
                judged = track_recording(own, held, seen, again)
                if own.boxes_path is None and own.clock_offset_s != own.clock_prior.mean_s:
                    # What is known of its clock so far was told by a model that saw it.
                    clock = clocks[own.name] = _clock_by_tracks(own, judged, held)
                    used_s = own.clock_prior.mean_s if clock is None else clock.used_s
                    if used_s != own.clock_offset_s:
                        judged = track_recording(own.with_clock(used_s), held, seen, again)
        except FrameRateError as error:
            made = judged = []
            notes.append(f"Nothing is tracked in recording {recording.name}: {error}.")
        else:
            if _unseen(recording):
                detected.append(recording.name)
        tracks[recording.name] = Tracks(tuple(made))
        turned = camera_turns(recording, fitted) if scene.camera.compensate_rotation else None
        if turned is not None:
            notes.append(turned)
        pairs = _against_log(recording, judged, held.reference_sigma_m)
        if pairs is not None:
            scored[recording.name] = pairs
    return _Tracked(tracks, scored, tuple(detected), tuple(notes), clocks)


def _clock_by_tracks(
    recording: Recording, tracks: Sequence[Track], model: Georeferencer
) -> ClockOffset | None:
    """The clock of a recording, by the tracks of its logged target; None where nothing tells it."""
    if recording.fixes_path is None:
        return None
    fixes, sigma_m = recording.fixes(), model.reference_sigma_m
    used = pair_target(tracks, fixes, reference_sigma_m=sigma_m)[1].used
    chosen = [track for track in tracks if track.track_id in used]
    if not chosen:
        return None
    covariance_m2 = np.concatenate([track.covariance_m2 for track in chosen])
    times_s = np.concatenate([track.time_utc_s for track in chosen])
    positions = Positions(
        east_m=np.concatenate([track.east_m for track in chosen]),
        north_m=np.concatenate([track.north_m for track in chosen]),
        covariance_m2=covariance_m2,
        extrapolated=np.zeros(times_s.size, dtype=bool),
        plane=chosen[0].plane,
        # Points of a smooth track are off together.
        shared_covariance_m2=covariance_m2,
    )
    return match_clock(
        times_s + recording.clock_offset_s,
        positions,
        fixes,
        prior=recording.clock_prior,
        reference_sigma_m=sigma_m,
    )


def _report_tracks(
    scored: Mapping[str, tuple[ScoredPairs, TracksUsed]], names: Collection[str]
) -> Report | None:
    chosen = {name: one for name, one in scored.items() if name in names}
    if not chosen:
        return None
    return summarise(
        {name: pairs for name, (pairs, _) in chosen.items()},
        tracks={name: used for name, (_, used) in chosen.items()},
    )


def _report_boxes(single: Mapping[str, ScoredPairs], names: Collection[str]) -> Report | None:
    chosen = {name: pairs for name, pairs in single.items() if name in names}
    return summarise(chosen) if chosen else None


def _in_sample(apart: Sequence[str], failed: FitError | None) -> str:
    """Sentence that names the recordings whose figures are in-sample.

    Args:
        apart: Their names; none: all.
        failed: Why the first of them could not be left out.
    """
    if not apart:
        return (
            "The figures are of the recordings that the model learned from: there is too little "
            "to leave any out. They are better than what a new recording would give."
        )
    one = len(apart) == 1
    because = "" if failed is None else f" ({failed})"
    return (
        f"Recording{'' if one else 's'} {', '.join(apart)} could not be left out{because}: "
        f"{'its' if one else 'their'} figures stand apart, of the model that learned from "
        f"{'it' if one else 'them'}. They are better than what a new recording would give."
    )


def _drawn(scene: Scene) -> bool:
    """Whether the scene has drawn boxes of a logged target."""
    return any(r.boxes_path and r.fixes_path for r in scene.recordings)


def _asks_pictures(kind: ModelType) -> bool:
    """Whether a model asks the pictures if the camera was turned."""
    return kind.name not in PAPER_MODELS


def _leave_each_out(
    scene: Scene,
    inputs: FitInputs | None,
    kind: ModelType,
    seed: int,
    taught: bool,
    seen: SceneDetections,
    tell: Progress,
) -> tuple[dict[str, Georeferencer], FitError | None]:
    """Leave-one-out model of each recording that teaches, and why the first has none.

    Args:
        scene: By the camera's clock.
        inputs: Collected from all of it, where boxes are drawn.
        kind: Of the models.
        seed: Of whatever is random in the fits.
        taught: Whether detections of the logged target teach beside its drawn boxes.
        seen: What a detector found.
        tell: Told how far it is.
    """
    models: dict[str, Georeferencer] = {}
    failed: FitError | None = None
    names = [r.name for r in scene.recordings if r.fixes_path is not None]
    if inputs is not None:
        try:
            names = recordings_with_correspondences(scene, inputs)
        except FitError as error:
            return models, error
    for i, name in enumerate(names):
        tell(f"fitting without {name}", i / len(names))
        try:
            if inputs is not None:
                # Anew: the clocks of the others are told without it.
                rest = settled(scene.without([name]))
                extra = _taught(rest, seen) if taught else {}
                others = collect(rest, extra=extra, pictures=_asks_pictures(kind))
                models[name] = fit_inputs(others, FitSettings(model=kind, seed=seed))
            else:
                models[name] = fit_scene(scene.without([name]), kind, seed=seed, seen=seen)
        except FitError as error:
            failed = failed or error
    return models, failed


def _unseen(recording: Recording) -> bool:
    """Whether a detector has to find the boxes of a recording."""
    return recording.boxes_path is None and recording.detections_path is None


def _taught(scene: Scene, seen: SceneDetections) -> dict[str, Boxes]:
    """Detections of the target in recordings where its boxes were drawn.

    Every source of boxes has its own bias at the lower edge. Where the same target was drawn and
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
    """Detections that overlap a box drawn in the same frame, the best for each."""
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
    """Tracks of a recording: of the drawn target, or of all detections."""
    smoother = method(settings.trajectory)
    where = f"recording {recording.name}"
    platform = recording.platform()
    check_platform(model, platform, f"{where}: ")
    history = recording_history(recording, model, pictures=settings.compensate_rotation)
    if recording.boxes_path is not None:
        located = model.place(history.observed(recording.boxes()))
        made = smooth_boxes(located, smoother, settings, track_id=1, platform=platform)
        return [] if made is None else [made]
    if recording.detections_path is not None:
        found = recording.detections(tally=settings.tally)
        batches, highest_id = from_memory(found)
    else:
        check_frame_rate(seen.times_utc_s(recording).tolist()[:LOOKED_AT], "pictures", model)
        batches, highest_id = iter([seen.boxes(recording)]), NO_TRACK
    dated = (with_times(boxes, None, model, f"{where}: ") for boxes in batches)
    observed = map(history.observed, dated)
    return list(follow(observed, model, smoother, settings, highest_id, platform))


def _against_log(
    recording: Recording, tracks: list[Track], reference_sigma_m: float
) -> tuple[ScoredPairs, TracksUsed] | None:
    if recording.fixes_path is None:
        return None
    pairs, used = pair_target(
        tracks,
        recording.fixes(),
        platform=recording.platform(),
        reference_sigma_m=reference_sigma_m,
    )
    return (pairs, used) if len(pairs) else None
