"""The stages in a row: detection, tracking, inference, trajectory, evaluation."""

from __future__ import annotations

import itertools
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
from sightline.scene import Recording, Scene, check_inside
from sightline.tracking import ImageTracker, iou
from sightline.tracks import Tracks
from sightline.trajectory import TrajectoryMethod, method
from sightline.types import NO_TRACK, Boxes, Fixes, FloatArray, Frame, Track

Progress = Callable[[str, float], None]
"""Told what is being done and what share of it is done, 0 to 1; NaN where nobody knows."""

DEFAULT_TRAJECTORY = "rts"

_TABLE_SUFFIXES = (".csv", ".txt")
_CHUNK_ROWS = 20_000
_MOST_PARTS = 256
_LOOKED_AT = 5
_LEAST_INTERVAL_S = 0.001
_LOOKED_AT_BOXES = 1000
# In a longer time a boat moves by more than its length.
_SELDOM_S = 1.0


@dataclass(frozen=True)
class TrackSettings:
    """How boxes become tracks.

    Attributes:
        trajectory: Name of the trajectory method, ``"rts"`` or ``"paper"``.
        interval_s: Time between the points of a track; None: a point a box.
        ends_after_s: A target not seen for as long has gone; its track is smoothed and let go.
        shortest_s: Tracks whose positions span less are dropped: glitter, birds, broken waves.
        longest_s: A track that lasts longer is cut, and goes on under another number, so that a
            source without an end fits into memory.
    """

    trajectory: str = DEFAULT_TRAJECTORY
    interval_s: float | None = None
    ends_after_s: float = 20.0
    shortest_s: float = 2.0
    longest_s: float = 1800.0

    def __post_init__(self) -> None:
        # An unknown name is told before any work is done.
        method(self.trajectory)
        for name in ("ends_after_s", "longest_s"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"{name} must be positive; it is {getattr(self, name):g} s")
        if self.interval_s is not None and not _LEAST_INTERVAL_S <= self.interval_s < np.inf:
            raise InputError(
                f"interval_s is {self.interval_s:g} s; it must be at least {_LEAST_INTERVAL_S:g} "
                "s, since files of tracks keep milliseconds"
            )


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
    table = isinstance(source, Boxes) or _is_table(source)
    if table and start_utc_s is not None:
        raise InputError(
            "boxes in a table have no presentation times, so a start time does not tell when they "
            "were seen; give a clock (frame,utc), or time_utc with the boxes"
        )
    if isinstance(source, Boxes):
        batches, highest_id = _in_hand(source)
    elif table:
        batches, highest_id = _table(source)
    else:
        frames = video.frames(source, clock=clock, start_utc_s=start_utc_s)
        fit_for_use = _fit_for_use(frames, model, str(source))
        batches = detect(fit_for_use, _detector(detector, model), _length(source), progress)
        clock, highest_id = None, NO_TRACK
    where = "" if isinstance(source, Boxes) else f"{source}: "
    timed = (_timed(boxes, clock, model, where) for boxes in batches)
    yield from _follow(timed, model, smoother, settings, highest_id)


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


def _is_table(source: str | os.PathLike[str]) -> bool:
    return Path(source).suffix.lower() in _TABLE_SUFFIXES and "://" not in str(source)


def _table(path: str | os.PathLike[str]) -> tuple[Iterator[Boxes], int]:
    """The boxes of a table, some thousand rows at a time, in the order of time.

    Boxes without width or height, which some detectors put out, are left out.

    Returns:
        The boxes, and the highest track id, `NO_TRACK` if they have none.
    """
    ordered, alone, last, highest_id = True, True, -np.inf, NO_TRACK
    for chunk in formats.iter_boxes(path, chunk_rows=_CHUNK_ROWS, skip_empty=True):
        if not len(chunk):
            continue
        moment = _moment(chunk)
        step = np.diff(moment, prepend=last)
        ordered &= bool((step >= 0.0).all())
        alone &= bool((step > 0.0).all())
        highest_id = max(highest_id, int(chunk.track_id.max()))
        last = float(moment[-1])
    if not ordered:
        # Sorted by track, or not at all: only the whole table can be put in order.
        return _in_hand(formats.read_boxes(path, skip_empty=True))
    chunks = formats.iter_boxes(path, chunk_rows=_CHUNK_ROWS, skip_empty=True)
    if alone and highest_id == NO_TRACK:
        return (_as_one_target(chunk) for chunk in chunks), 1
    return chunks, highest_id


def _in_hand(boxes: Boxes) -> tuple[Iterator[Boxes], int]:
    """Boxes in any order, as `_table`.

    Boxes without ids of which no two are of one time are all of one target.
    """
    highest_id = int(boxes.track_id.max(initial=NO_TRACK))
    if highest_id == NO_TRACK and np.unique(_moment(boxes)).size == len(boxes):
        return iter([_as_one_target(boxes)]), 1
    return iter([boxes]), highest_id


def _moment(boxes: Boxes) -> FloatArray:
    """(N,) what tells the order of boxes: their times, or else their frames."""
    timed = np.isfinite(boxes.time_utc_s)
    return np.where(timed.all(), boxes.time_utc_s, boxes.frame.astype(np.float64))


def _as_one_target(boxes: Boxes) -> Boxes:
    return boxes.with_columns(track_id=np.ones(len(boxes), dtype=np.int64))


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


class _SeldomError(InputError):
    """Pictures or boxes between which a target cannot be followed."""


def _fit_for_use(frames: Iterable[Frame], model: Georeferencer, where: str) -> Iterator[Frame]:
    """Pass pictures on, and refuse those that no target can be found and followed in.

    Raises:
        InputError: A picture has no time, or another size than those that the model learned from.
        _SeldomError: They come too seldom.
    """
    first_s: list[float] = []
    for frame in frames:
        size_px = (frame.image_bgr.shape[1], frame.image_bgr.shape[0])
        if size_px != model.image_size_px:
            raise InputError(
                f"{where}: its pictures have {size_px[0]} x {size_px[1]} px, the model learned "
                f"from {model.image_size_px[0]} x {model.image_size_px[1]} px; fit one to pictures "
                "of this size"
            )
        if not np.isfinite(frame.time_utc_s):
            raise InputError(
                f"{where}: nothing tells the time of frame {frame.index}; give the start of the "
                "video (--start-utc), or a clock (--clock)"
            )
        yield frame
        if len(first_s) < _LOOKED_AT:
            first_s.append(frame.time_utc_s)
            if len(first_s) == _LOOKED_AT:
                _refuse_seldom(first_s, "pictures")
    if len(first_s) < _LOOKED_AT:
        _refuse_seldom(first_s, "pictures")


def _refuse_seldom(times_s: Sequence[float], what: str) -> None:
    apart_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
    if apart_s > _SELDOM_S:
        raise _SeldomError(
            f"the {what} are {apart_s:.1f} s apart, and a target can be followed only where they "
            f"are at most {_SELDOM_S:g} s apart; give the video itself, or boxes with a track_id"
        )


def _timed(boxes: Boxes, clock: Clock | None, model: Georeferencer, where: str) -> Boxes:
    """Boxes with their times, of the picture that the model knows."""
    if clock is not None and len(boxes):
        boxes = boxes.with_columns(time_utc_s=clock.time_utc_s(boxes.frame))
    unknown = ~np.isfinite(boxes.time_utc_s)
    if unknown.any():
        i = int(np.argmax(unknown))
        raise InputError(
            f"{where}nothing tells the time of frame {boxes.frame[i]}; give a clock (--clock), or "
            "time_utc with the boxes"
        )
    check_inside(boxes, model.image_size_px, where)
    return boxes


def _follow(
    batches: Iterator[Boxes],
    model: Georeferencer,
    smoother: TrajectoryMethod,
    settings: TrackSettings,
    highest_id: int = NO_TRACK,
) -> Iterator[Track]:
    """The tracks of boxes, each as soon as its target has gone.

    Args:
        batches: In the order of time from one to the next.
        model: Says where a box lies.
        smoother: Makes a track of positions.
        settings: How boxes become tracks.
        highest_id: Of the boxes' track ids; those without one are of no target. `NO_TRACK`: none
            has one, and a tracker gives them.

    Raises:
        _SeldomError: No target could be followed, since the boxes come too seldom.
    """
    first_s: list[float] = []
    if highest_id == NO_TRACK:
        batches = _followed(batches, first_s)
    book = _OpenTracks(settings, highest_id)
    count = 0
    for number, boxes in book.ended(batches):
        made = smooth_boxes(
            boxes, model, smoother, settings, track_id=number, shortest_s=settings.shortest_s
        )
        if made is not None:
            count += 1
            yield made
    if count == 0:
        _refuse_seldom(first_s, "boxes")


def _followed(batches: Iterator[Boxes], first_s: list[float]) -> Iterator[Boxes]:
    """Boxes with the ids that a tracker gives them; the boxes of one time after another.

    Args:
        batches: In the order of time from one to the next.
        first_s: Is given the first of their times.
    """
    tracker = ImageTracker()
    for boxes in _moments(batches):
        if len(first_s) < _LOOKED_AT_BOXES:
            first_s.append(float(boxes.time_utc_s[0]))
        yield tracker.update(boxes)


def _moments(batches: Iterable[Boxes]) -> Iterator[Boxes]:
    """The boxes of one time after another, though those of one time may come in two batches."""
    waiting: list[Boxes] = []
    for batch in batches:
        if not len(batch):
            continue
        boxes = Boxes.concatenate([*waiting, batch])
        order = np.argsort(boxes.time_utc_s, kind="stable")
        cuts = np.flatnonzero(np.diff(boxes.time_utc_s[order]) > 0.0) + 1
        *whole, last = np.split(order, cuts)
        for rows in whole:
            yield boxes[rows]
        waiting = [boxes[last]]
    yield from waiting


class _OpenTracks:
    """Boxes of targets that are still there, by track id."""

    def __init__(self, settings: TrackSettings, highest_id: int) -> None:
        self._settings = settings
        self._highest_id = highest_id
        self._spare = itertools.count(max(highest_id, 0) + 1)
        self._used: set[int] = set()
        self._parts: dict[int, list[Boxes]] = {}
        self._first_s: dict[int, float] = {}
        self._last_s: dict[int, float] = {}

    def ended(self, batches: Iterable[Boxes]) -> Iterator[tuple[int, Boxes]]:
        """Take boxes with ids, and give back the boxes of each target when it has gone."""
        for batch in batches:
            yield from self._add(batch)
        for key in list(self._parts):
            yield self._end(key)

    def _add(self, batch: Boxes) -> list[tuple[int, Boxes]]:
        if not len(batch):
            return []
        ended: list[tuple[int, Boxes]] = []
        batch = batch[np.argsort(batch.time_utc_s, kind="stable")]
        for key in np.unique(batch.track_id[batch.track_id != NO_TRACK]).tolist():
            own = batch[batch.track_id == key]
            while len(own):
                rows = self._until_cut(key, own.time_utc_s)
                if rows:
                    self._take(key, own[:rows])
                    own = own[rows:]
                if len(own):
                    ended.append(self._end(key))
        now = float(batch.time_utc_s[-1])
        limit = self._settings.ends_after_s
        return ended + [self._end(k) for k in list(self._parts) if now - self._last_s[k] > limit]

    def _until_cut(self, key: int, times_s: FloatArray) -> int:
        """How many of the next boxes still belong to the open track of a target."""
        first_s = self._first_s.get(key, float(times_s[0]))
        before = np.r_[self._last_s.get(key, times_s[0]), times_s[:-1]]
        cut = times_s - before > self._settings.ends_after_s
        cut |= times_s - first_s > self._settings.longest_s
        return int(np.argmax(cut)) if cut.any() else len(times_s)

    def _take(self, key: int, boxes: Boxes) -> None:
        parts = self._parts.setdefault(key, [])
        parts.append(boxes)
        if len(parts) == _MOST_PARTS:
            # A table of one row is a hundred times its row.
            parts[:] = [Boxes.concatenate(parts)]
        self._first_s.setdefault(key, float(boxes.time_utc_s[0]))
        self._last_s[key] = float(boxes.time_utc_s[-1])

    def _end(self, key: int) -> tuple[int, Boxes]:
        del self._first_s[key], self._last_s[key]
        return self._number(key), Boxes.concatenate(self._parts.pop(key))

    def _number(self, key: int) -> int:
        """The id of a track: the boxes' own where they have one, another when a target returns."""
        if key > self._highest_id or key in self._used:
            return next(self._spare)
        self._used.add(key)
        return key


def smooth_boxes(
    boxes: Boxes,
    model: Georeferencer,
    smoother: TrajectoryMethod,
    settings: TrackSettings,
    *,
    track_id: int,
    shortest_s: float = 0.0,
) -> Track | None:
    """The smooth track of one target's boxes; None where they have positions for too short."""
    positions = model.locate(boxes.xyxy_px, boxes.source)
    times = boxes.time_utc_s[positions.known]
    if not times.size or np.ptp(times) < shortest_s:
        return None
    at = None
    if settings.interval_s is not None:
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
    scene: Scene,
    model: str = DEFAULT_MODEL,
    *,
    seed: int = 0,
    extra: Mapping[str, Boxes] | None = None,
) -> dict[str, Georeferencer]:
    """For each recording with pairs a model that never saw it.

    Args:
        scene: The scene.
        model: Name of the model.
        seed: Of whatever is random in the fits.
        extra: Further boxes of the logged target, by recording; see `fit`.

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
    return {name: fit(scene.without([name]), model, seed=seed, extra=extra) for name in names}


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
    if not models:
        raise InputError(f"no model is named; known are {', '.join(MODELS)}")
    for name in models:
        if name not in MODELS:
            raise unknown_name("model", name, MODELS)
    if trajectory is not None:
        method(trajectory)
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
    # Unknown names are told before the work begins.
    _detector(detector, None)
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
            except _SeldomError as error:
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
                _detector(detector, None),
                _length(recording.video_path),
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
    where = f"recording {recording.name}"
    highest_id = NO_TRACK
    if recording.detections_path is not None:
        batches, highest_id = _in_hand(recording.detections())
    else:
        assert recording.source is not None, "a recording has boxes, detections or pictures"
        batches = detect(
            _fit_for_use(recording.frames(), model, where),
            _detector(detector, model),
            _length(recording.source),
            _renamed(tell, f"detecting in {recording.name}"),
        )
    timed = (_timed(boxes, None, model, f"{where}: ") for boxes in batches)
    yield from _follow(timed, model, smoother, settings, highest_id)


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
