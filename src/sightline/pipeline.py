"""The stages in a row: detection, tracking, inference, trajectory, evaluation."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sightline import formats, video
from sightline.clock import Clock
from sightline.detection import Detector, detector_by_name
from sightline.errors import FitError, InputError, unknown_name
from sightline.evaluation.comparison import Comparison
from sightline.evaluation.metrics import Pairs as ScoredPairs
from sightline.evaluation.metrics import pair_positions, pair_track
from sightline.evaluation.report import (
    Report,
    TracksUsed,
    evaluate_tracks,
    summarise,
)
from sightline.inference.georeferencer import DEFAULT_MODEL, MODELS, Georeferencer, fit
from sightline.inference.pairs import scene_pairs
from sightline.inference.paper import PAPER_MODELS
from sightline.scene import Recording, Scene
from sightline.tracking import ImageTracker
from sightline.tracks import Tracks
from sightline.trajectory import TrajectoryMethod, method
from sightline.types import NO_TRACK, Boxes, Fixes, FloatArray, Frame, Track

Progress = Callable[[str, float], None]
"""Told what is being done and what share of it is done, 0 to 1; NaN where nobody knows."""

DEFAULT_TRAJECTORY = "rts"

_TABLE_SUFFIXES = (".csv", ".txt")
_CHUNK_ROWS = 20_000


@dataclass(frozen=True)
class TrackSettings:
    """How boxes become tracks.

    Attributes:
        trajectory: Name of the trajectory method, ``"rts"`` or ``"paper"``.
        interval_s: Time between the points of a track; None: a point a box.
        ends_after_s: A target not seen for as long has gone; its track is smoothed and let go.
        shortest_s: Tracks that were seen for less are dropped: glitter, birds, broken waves.
        longest_s: A track that lasts longer is cut, and goes on under another number, so that a
            source without an end fits into memory.
    """

    trajectory: str = DEFAULT_TRAJECTORY
    interval_s: float | None = None
    ends_after_s: float = 20.0
    shortest_s: float = 2.0
    longest_s: float = 1800.0

    def __post_init__(self) -> None:
        positive = {"ends_after_s": self.ends_after_s, "longest_s": self.longest_s}
        if self.interval_s is not None:
            positive["interval_s"] = self.interval_s
        for name, value in positive.items():
            if not value > 0.0:
                raise InputError(f"{name} must be positive; it is {value:g} s")


def track(
    source: str | os.PathLike[str] | Boxes,
    model: Georeferencer,
    *,
    detector: Detector | str | None = None,
    clock: Clock | None = None,
    start_utc_s: float | None = None,
    settings: TrackSettings | None = None,
    progress: Progress | None = None,
) -> Tracks:
    """Smooth tracks of everything in a source.

    Args:
        source: A video, a folder of frames, a stream, a table of boxes, or boxes.
        model: Says where a box lies.
        detector: Finds boxes in frames; a name, or one's own. Absent: ``"motion"``.
        clock: Tells the times of frames; absent: the video or the table does.
        start_utc_s: POSIX seconds of a video's first frame.
        settings: How boxes become tracks.
        progress: Told how far it is.

    Raises:
        InputError: The source cannot be read, or nothing tells its times.
    """
    found = iter_tracks(
        source,
        model,
        detector=detector,
        clock=clock,
        start_utc_s=start_utc_s,
        settings=settings,
        progress=progress,
    )
    return Tracks(tuple(found))


def iter_tracks(
    source: str | os.PathLike[str] | Boxes,
    model: Georeferencer,
    *,
    detector: Detector | str | None = None,
    clock: Clock | None = None,
    start_utc_s: float | None = None,
    settings: TrackSettings | None = None,
    progress: Progress | None = None,
) -> Iterator[Track]:
    """As `track`, one track at a time, each as soon as its target has gone; memory stays flat."""
    settings = settings or TrackSettings()
    smoother = method(settings.trajectory)
    if isinstance(source, Boxes):
        batches: Iterator[Boxes] = iter([_one_target(source)])
    elif Path(source).suffix.lower() in _TABLE_SUFFIXES and "://" not in str(source):
        batches = _table(source)
    else:
        frames = video.frames(source, clock=clock, start_utc_s=start_utc_s)
        batches = detect(frames, _detector(detector, model), _length(source), progress)
        clock = None
    timed = (_timed(boxes, clock) for boxes in batches)
    yield from _follow(timed, model, smoother, settings)


def detect(
    frames: Iterable[Frame],
    detector: Detector,
    count: int | None = None,
    progress: Progress | None = None,
) -> Iterator[Boxes]:
    """The boxes of each frame, as the detector finds them.

    Args:
        frames: In the order of time.
        detector: Finds boxes.
        count: How many frames there are, where that is known.
        progress: Told how far it is.
    """
    for i, frame in enumerate(frames):
        if progress:
            progress("detecting", (i + 1) / count if count else float("nan"))
        yield detector.detect(frame)


def _table(path: str | os.PathLike[str]) -> Iterator[Boxes]:
    """The boxes of a table, some thousand rows at a time, in the order of time."""
    ordered, alone, last = True, True, -np.inf
    for chunk in formats.iter_boxes(path, chunk_rows=_CHUNK_ROWS):
        moment = _moment(chunk)
        step = np.diff(moment, prepend=last)
        ordered &= bool((step >= 0.0).all())
        alone &= bool((step > 0.0).all() and (chunk.track_id == NO_TRACK).all())
        last = float(moment[-1])
    if not ordered:
        # Sorted by track, or not at all: only the whole table can be put in order.
        boxes = formats.read_boxes(path)
        yield _one_target(boxes[np.argsort(_moment(boxes), kind="stable")])
        return
    for chunk in formats.iter_boxes(path, chunk_rows=_CHUNK_ROWS):
        yield chunk.with_columns(track_id=np.ones(len(chunk), dtype=np.int64)) if alone else chunk


def _moment(boxes: Boxes) -> FloatArray:
    """(N,) what tells the order of boxes: their times, or else their frames."""
    timed = np.isfinite(boxes.time_utc_s)
    return np.where(timed.all(), boxes.time_utc_s, boxes.frame.astype(np.float64))


def _one_target(boxes: Boxes) -> Boxes:
    """Boxes without ids of which no two are of one time are all of one target."""
    moment = _moment(boxes)
    if (boxes.track_id == NO_TRACK).all() and np.unique(moment).size == len(boxes):
        return boxes.with_columns(track_id=np.ones(len(boxes), dtype=np.int64))
    return boxes


def _detector(detector: Detector | str | None, model: Georeferencer | None) -> Detector:
    if detector is not None and not isinstance(detector, str):
        return detector
    horizon = None
    if model is not None and model.camera is not None:
        rows = model.camera.horizon_y_px([0.0, model.image_size_px[0]])
        if np.isfinite(rows).all():
            horizon = (float(rows[0]), float(rows[1]))
    return detector_by_name(detector or "motion", horizon_px=horizon)


def _length(source: str | os.PathLike[str]) -> int | None:
    path = Path(source)
    if path.is_dir():
        return sum(1 for _ in path.iterdir())
    if "://" in str(source) or not path.is_file():
        return None
    return len(video.video_info(path).presentation_s)


def _timed(boxes: Boxes, clock: Clock | None) -> Boxes:
    if clock is not None and len(boxes):
        boxes = boxes.with_columns(time_utc_s=clock.time_utc_s(boxes.frame))
    unknown = ~np.isfinite(boxes.time_utc_s)
    if unknown.any():
        i = int(np.argmax(unknown))
        raise InputError(
            f"nothing tells the time of frame {boxes.frame[i]}; give the start of the video "
            "(--start-utc), a clock (--clock), or time_utc with the boxes"
        )
    return boxes


def _follow(
    batches: Iterator[Boxes],
    model: Georeferencer,
    smoother: TrajectoryMethod,
    settings: TrackSettings,
) -> Iterator[Track]:
    """Give boxes their track ids, and let each track go when its target has gone.

    Batches come in the order of time, and either all boxes have a track id or none.
    """
    tracker: ImageTracker | None = None
    book = _OpenTracks(settings)

    def finish(ended: Iterable[tuple[int, Boxes]]) -> Iterator[Track]:
        for number, boxes in ended:
            if np.ptp(boxes.time_utc_s) >= settings.shortest_s:
                made = smooth_boxes(boxes, model, smoother, settings, track_id=number)
                if made is not None:
                    yield made

    for batch in batches:
        if not len(batch):
            continue
        if tracker is None and (batch.track_id == NO_TRACK).any():
            tracker = ImageTracker()
        if tracker is not None:
            batch = Boxes.concatenate([tracker.update(one) for one in _moments(batch)])
        yield from finish(book.add(batch))
    yield from finish(book.close())


class _OpenTracks:
    """Boxes of targets that are still there, by track id."""

    def __init__(self, settings: TrackSettings) -> None:
        self._settings = settings
        self._parts: dict[int, list[Boxes]] = {}
        self._first_s: dict[int, float] = {}
        self._last_s: dict[int, float] = {}
        self._used: set[int] = set()

    def add(self, batch: Boxes) -> list[tuple[int, Boxes]]:
        """Take boxes with ids, and give back the targets that have gone."""
        ended: list[tuple[int, Boxes]] = []
        order = np.argsort(batch.time_utc_s, kind="stable")
        batch = batch[order]
        for key in np.unique(batch.track_id[batch.track_id != NO_TRACK]).tolist():
            own = batch[batch.track_id == key]
            before = np.r_[self._last_s.get(key, own.time_utc_s[0]), own.time_utc_s[:-1]]
            gone = own.time_utc_s - before > self._settings.ends_after_s
            start = self._first_s.get(key, float(own.time_utc_s[0]))
            piece = np.floor((own.time_utc_s - start) / self._settings.longest_s)
            cut = gone | (np.diff(piece, prepend=piece[0] if key in self._parts else 0.0) > 0.0)
            for part in np.split(np.arange(len(own)), np.flatnonzero(cut)):
                if not part.size:
                    continue
                if cut[part[0]] and key in self._parts:
                    ended.append(self._end(key))
                rows = own[part]
                self._parts.setdefault(key, []).append(rows)
                self._first_s.setdefault(key, float(rows.time_utc_s[0]))
                self._last_s[key] = float(rows.time_utc_s[-1])
        if len(batch):
            now = float(batch.time_utc_s[-1])
            limit = self._settings.ends_after_s
            ended += [self._end(k) for k in list(self._parts) if now - self._last_s[k] > limit]
        return ended

    def close(self) -> list[tuple[int, Boxes]]:
        """All that are left."""
        return [self._end(key) for key in list(self._parts)]

    def _end(self, key: int) -> tuple[int, Boxes]:
        number = key if key not in self._used else max(self._used) + 1
        self._used.add(number)
        del self._first_s[key], self._last_s[key]
        return number, Boxes.concatenate(self._parts.pop(key))


def _moments(boxes: Boxes) -> Iterator[Boxes]:
    """The boxes of one time after another."""
    order = np.argsort(boxes.time_utc_s, kind="stable")
    cuts = np.flatnonzero(np.diff(boxes.time_utc_s[order]) > 0.0) + 1
    for rows in np.split(order, cuts):
        yield boxes[rows]


def smooth_boxes(
    boxes: Boxes,
    model: Georeferencer,
    smoother: TrajectoryMethod,
    settings: TrackSettings,
    *,
    track_id: int,
) -> Track | None:
    """The smooth track of one target's boxes; None where none of them has a position."""
    positions = model.locate(boxes.xyxy_px, boxes.source)
    if not positions.known.any():
        return None
    at = None
    if settings.interval_s is not None:
        times = boxes.time_utc_s[positions.known]
        at = np.arange(times.min(), times.max() + 1e-9, settings.interval_s)
    return smoother.apply(
        boxes.time_utc_s,
        positions,
        confidence=boxes.confidence,
        at_utc_s=at,
        track_id=track_id,
        label=str(boxes.label[0]),
    )


def evaluate(
    what: Tracks | Iterable[Track] | Scene | str | os.PathLike[str],
    *,
    fixes: Fixes | str | os.PathLike[str] | None = None,
    model: Georeferencer | None = None,
    smooth: bool = False,
    trajectory: str = DEFAULT_TRAJECTORY,
    track_id: int | None = None,
    mmsi: int | None = None,
    delta_s: float = 1.0,
) -> Report:
    """How far tracks are from a log, or a model from a scene's boxes and logs.

    Args:
        what: Tracks, or a scene; or the file of either.
        fixes: The log, for tracks.
        model: For a scene.
        smooth: For a scene: score the trajectories made of the boxes, at the boxes' times.
        trajectory: The method of ``smooth``.
        track_id: Which track is the target; absent: the nearest to the log.
        mmsi: Which vessel of an AIS log.
        delta_s: The time of the relative error, seconds.

    Raises:
        InputError: Something is missing, or nothing can be compared.
    """
    if isinstance(what, str | os.PathLike):
        path = Path(what)
        what = Scene.load(path) if path.suffix.lower() == ".toml" else Tracks.read(path)
    if isinstance(what, Scene):
        if model is None:
            raise InputError("a scene is scored with a model; give the model")
        placed = place_boxes(what, lambda _: model)
        return score(placed, trajectory if smooth else None, delta_s=delta_s)
    if fixes is None:
        raise InputError("tracks are scored against a log; give fixes")
    log = fixes if isinstance(fixes, Fixes) else formats.read_fixes(fixes, mmsi=mmsi)
    return evaluate_tracks(what, log, track_id=track_id, delta_s=delta_s)


@dataclass(frozen=True, eq=False)
class Placed:
    """The target's boxes in one recording, where a model puts them, and its log.

    Attributes:
        recording: Its name.
        boxes: With their times.
        model: That placed them.
        fixes: The log.
    """

    recording: str
    boxes: Boxes
    model: Georeferencer
    fixes: Fixes

    def single(self) -> ScoredPairs:
        """Each box by itself beside the log."""
        positions = self.model.locate(self.boxes.xyxy_px, self.boxes.source)
        return pair_positions(self.boxes.time_utc_s, positions, self.fixes)

    def track(self, trajectory: str) -> Track | None:
        """The trajectory of the boxes, at their times."""
        settings = TrackSettings(trajectory=trajectory)
        return smooth_boxes(self.boxes, self.model, method(trajectory), settings, track_id=1)


def place_boxes(scene: Scene, model_for: Callable[[str], Georeferencer]) -> list[Placed]:
    """The boxes of all recordings that have boxes and a log, each with its model.

    Args:
        scene: The scene.
        model_for: From a recording's name to the model that is to place its boxes.

    Raises:
        InputError: No recording has both.
    """
    placed = [
        Placed(recording.name, recording.boxes(), model_for(recording.name), recording.fixes())
        for recording in scene.recordings
        if recording.boxes_path is not None and recording.fixes_path is not None
    ]
    if not placed:
        raise InputError(
            f"{scene.path}: no recording has boxes and fixes, so there is nothing to compare"
        )
    return placed


def score(
    placed: Sequence[Placed], trajectory: str | None = None, *, delta_s: float = 1.0
) -> Report:
    """The report of placed boxes, single or as trajectories.

    Recordings of which no box falls into the log are left out.

    Raises:
        InputError: No box falls into a log.
    """
    parts: dict[str, ScoredPairs] = {}
    for one in placed:
        if trajectory is None:
            pairs = one.single()
        else:
            made = one.track(trajectory)
            if made is None:
                continue
            pairs = pair_track(made, one.fixes)
        if len(pairs):
            parts[one.recording] = pairs
    if not parts:
        raise InputError(
            "no box falls between two fixes of its log that are near enough to each other; check "
            "the clocks and the log"
        )
    return summarise(parts, delta_s=delta_s)


def leave_one_out(
    scene: Scene, model: str = DEFAULT_MODEL, *, seed: int = 0
) -> dict[str, Georeferencer]:
    """For each recording with pairs a model that never saw it.

    Raises:
        FitError: Fewer than two recordings have pairs, or what is left is too little.
    """
    plane = scene.plane
    names = [
        recording.name
        for recording in scene.recordings
        if recording.boxes_path is not None and recording.fixes_path is not None
    ]
    if plane is not None and names:
        held = scene_pairs(scene, plane).recording
        names = [name for name in names if name in held]
    if len(names) < 2:
        raise FitError(
            f"{scene.path}: leaving one recording out needs at least two recordings with boxes "
            f"and fixes at the same times; there {'is' if len(names) == 1 else 'are'} {len(names)}"
        )
    return {name: fit(scene.without([name]), model, seed=seed) for name in names}


def compare(
    scene: Scene,
    models: Sequence[str] = MODELS,
    *,
    trajectory: str | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Comparison, dict[str, list[Placed]]]:
    """Leave one recording out at a time, for each model, as in the paper's Table 2.

    Args:
        scene: At least two recordings with boxes and fixes.
        models: Names of models.
        trajectory: The method after each model. Absent: the paper's chain after the paper's
            models, the smoother after ours.
        seed: Of whatever is random in the fits.
        progress: Told how far it is.

    Returns:
        The comparison, and the boxes as each model placed them.

    Raises:
        InputError: A name is not known.
        FitError: See `leave_one_out`.
    """
    for name in models:
        if name not in MODELS:
            raise unknown_name("model", name, MODELS)
    single: dict[str, Report] = {}
    smooth: dict[str, Report] = {}
    all_placed: dict[str, list[Placed]] = {}
    for i, name in enumerate(models):
        if progress:
            progress(f"fitting {name}", i / len(models))
        fitted = leave_one_out(scene, name, seed=seed)
        placed = place_boxes(scene.select(fitted), fitted.__getitem__)
        single[name] = score(placed)
        after = trajectory or ("paper" if name in PAPER_MODELS else DEFAULT_TRAJECTORY)
        smooth[name] = score(placed, after)
        all_placed[name] = placed
    return Comparison(single, smooth), all_placed


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
    tell = progress or (lambda _what, _share: None)
    tell("fitting", 0.0)
    fitted = fit(scene, model, seed=seed)
    notes: list[str] = []
    models: dict[str, Georeferencer] = {}
    try:
        models = leave_one_out(scene, model, seed=seed)
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
            judged = list(_others(recording, fitted, detector, settings, tell))
            tracks[recording.name] = Tracks(tuple(t for t in judged if t is not None))
            if recording.detections_path is None:
                detected.append(recording.name)
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


def _target(recording: Recording, model: Georeferencer, settings: TrackSettings) -> Track | None:
    """The one track of the boxes of the target that was logged."""
    return smooth_boxes(recording.boxes(), model, method(settings.trajectory), settings, track_id=1)


def _others(
    recording: Recording,
    model: Georeferencer,
    detector: str,
    settings: TrackSettings,
    tell: Progress,
) -> Iterator[Track]:
    """The tracks of whatever is seen in a recording without boxes."""
    smoother = method(settings.trajectory)
    if recording.detections_path is not None:
        batches: Iterator[Boxes] = iter([_one_target(recording.detections())])
    else:
        assert recording.source is not None, "a recording has boxes, detections or pictures"
        batches = detect(
            recording.frames(),
            _detector(detector, model),
            _length(recording.source),
            lambda _, share: tell(f"detecting in {recording.name}", share),
        )
    yield from _follow((_timed(boxes, None) for boxes in batches), model, smoother, settings)


def _against_log(
    recording: Recording, tracks: list[Track]
) -> tuple[ScoredPairs, TracksUsed] | None:
    if recording.fixes_path is None or not tracks:
        return None
    fixes = recording.fixes()
    try:
        report = evaluate_tracks(tracks, fixes)
    except InputError:
        return None
    assert report.tracks is not None, "tracks were scored"
    used = set(report.tracks.used)
    pairs = ScoredPairs.concatenate(
        pair_track(one, fixes) for one in tracks if one.track_id in used
    )
    return pairs, report.tracks
