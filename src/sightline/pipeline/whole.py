"""The main job: all stages in a row, for every recording of a scene."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sightline.errors import FitError
from sightline.evaluation.metrics import Pairs as ScoredPairs
from sightline.evaluation.report import Report, TracksUsed, pair_target, summarise
from sightline.inference.georeferencer import DEFAULT_MODEL, Georeferencer, fit
from sightline.inference.levelling import scene_horizons
from sightline.pipeline.boxes import (
    Progress,
    SeldomError,
    detect,
    fit_for_use,
    frame_count,
    in_hand,
    make_detector,
    timed,
)
from sightline.pipeline.scoring import Placed, leave_one_out, place_boxes, score
from sightline.pipeline.tracking import TrackSettings, follow, smooth_boxes
from sightline.scene import Recording, Scene
from sightline.tracking import iou
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
    detector: str = "motion",
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
    """
    settings = settings or TrackSettings()
    # Unknown names are told before the work begins.
    make_detector(detector, None)
    tell = progress or (lambda _what, _share: None)
    extra = _taught(scene, detector, tell) if any(map(_unseen, scene.recordings)) else {}
    tell("fitting", float("nan"))
    fitted = fit(scene, model, seed=seed, extra=extra)
    notes: list[str] = []
    models: dict[str, Georeferencer] = {}
    try:
        models = leave_one_out(scene, model, seed=seed, extra=extra)
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
        if recording.boxes_path is not None:
            made = [_target(recording, fitted, settings)]
            tracks[recording.name] = Tracks(tuple(t for t in made if t is not None))
            held = models.get(recording.name)
            judged = made if held is None else [_target(recording, held, settings)]
        else:
            try:
                judged = list(_others(recording, fitted, detector, settings, tell))
            except SeldomError as error:
                judged = []
                notes.append(f"Nothing is tracked in recording {recording.name}: {error}.")
            else:
                if recording.detections_path is None:
                    detected.append(recording.name)
            tracks[recording.name] = Tracks(tuple(t for t in judged if t is not None))
        pairs = _against_log(recording, [t for t in judged if t is not None])
        if pairs is not None:
            scored[recording.name] = pairs
    placed: list[Placed] = []
    if any(r.boxes_path and r.fixes_path for r in scene.recordings):
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


def _unseen(recording: Recording) -> bool:
    """Whether a detector has to find the boxes of a recording."""
    return recording.boxes_path is None and recording.detections_path is None


def _taught(scene: Scene, detector: str, tell: Progress) -> dict[str, Boxes]:
    """What a detector makes of the target where somebody has drawn its boxes.

    Every source of boxes has its own habit at the lower edge. Where the same target was drawn and
    detected in the same frames, the fit learns both.
    """
    out: dict[str, Boxes] = {}
    for recording in scene.recordings:
        if recording.boxes_path is None or recording.video_path is None:
            continue
        drawn = recording.boxes()
        found = [
            boxes[np.isin(boxes.frame, drawn.frame)]
            for boxes in detect(
                recording.frames(),
                make_detector(detector, None),
                frame_count(recording.video_path),
                _renamed(tell, f"detecting in {recording.name}"),
            )
        ]
        same = _same_target(drawn, Boxes.concatenate(found))
        if len(same):
            out[recording.name] = same
    return out


def _renamed(tell: Progress, what: str) -> Progress:
    return lambda _what, share: tell(what, share)


def _same_target(drawn: Boxes, found: Boxes, least_iou: float = 0.3) -> Boxes:
    """Of the boxes found those that lie on a box drawn in the same frame, the best for each."""
    rows = []
    for frame, box in zip(drawn.frame, drawn.xyxy_px, strict=True):
        here = np.flatnonzero(found.frame == frame)
        if not here.size:
            continue
        overlap = iou(box[None, :], found.xyxy_px[here])[0]
        best = int(np.argmax(overlap))
        if overlap[best] >= least_iou:
            rows.append(int(here[best]))
    return found[np.array(sorted(set(rows)), dtype=np.int64)]


def _target(recording: Recording, model: Georeferencer, settings: TrackSettings) -> Track | None:
    """The one track of the boxes of the target that was logged."""
    return smooth_boxes(
        model.level(recording.boxes(), scene_horizons(recording)),
        model,
        method(settings.trajectory),
        settings,
        track_id=1,
        platform=recording.platform(),
    )


def _others(
    recording: Recording,
    model: Georeferencer,
    detector: str,
    settings: TrackSettings,
    tell: Progress,
) -> Iterator[Track]:
    """The tracks of whatever is seen in a recording without boxes."""
    smoother = method(settings.trajectory)
    where = f"recording {recording.name}"
    highest_id = NO_TRACK
    if recording.detections_path is not None:
        batches, highest_id = in_hand(recording.detections())
    else:
        assert recording.source is not None, "a recording has boxes, detections or pictures"
        batches = detect(
            fit_for_use(recording.frames(), model, where),
            make_detector(detector, model),
            frame_count(recording.source),
            _renamed(tell, f"detecting in {recording.name}"),
        )
    with_times = (timed(boxes, None, model, f"{where}: ") for boxes in batches)
    horizons = scene_horizons(recording)
    level = (model.level(boxes, horizons) for boxes in with_times)
    yield from follow(level, model, smoother, settings, highest_id, recording.platform())


def _against_log(
    recording: Recording, tracks: list[Track]
) -> tuple[ScoredPairs, TracksUsed] | None:
    if recording.fixes_path is None:
        return None
    pairs, used = pair_target(tracks, recording.fixes(), platform=recording.platform())
    return (pairs, used) if len(pairs) else None
