"""Tracks from boxes with times: tracking, georeferencing and smoothing."""

from __future__ import annotations

import itertools
import logging
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypedDict, Unpack

import numpy as np

from sightline import formats, stopping, video
from sightline.area import Area
from sightline.camera.horizon_tracker import with_horizons
from sightline.camera.state import CameraHistory, ObservedBoxes
from sightline.clock import Clock
from sightline.detection import Detector, detect, observe
from sightline.errors import BrokenOffError, InputError
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.camera_state import CameraMotionMonitor
from sightline.pipeline.moored import MooredTeller
from sightline.pipeline.sources import (
    Ending,
    FrameRateError,
    check_frame_rate,
    fit_for_use,
    follows_on_earth,
    from_memory,
    groups_of_moments,
    is_table,
    make_detector,
    moments,
    read_table,
    with_times,
)
from sightline.platform import Platform, moved_track, north_up, on_earth
from sightline.progress import Progress
from sightline.scene.scene import MASKED
from sightline.tally import Tally
from sightline.tracking import ImageTracker, TargetTracker, Tracker, WorldTracker, tracker_by_name
from sightline.tracks import Tracks
from sightline.trajectory import TrajectoryMethod, method
from sightline.trajectory.forecast import MotionModel, MotionState
from sightline.trajectory.forecast import follow as follow_motion
from sightline.types import (
    NO_TRACK,
    BoolArray,
    Boxes,
    BoxesWith,
    EastNorthPositions,
    FloatArray,
    Horizons,
    LocatedBoxes,
    Positions,
    Track,
)
from sightline.video.mask import Mask, read_mask
from sightline.video.reader import frame_count
from sightline.water import WaterLevels

_logger = logging.getLogger(__name__)

DEFAULT_TRAJECTORY = "rts"

ON_BOARD_CORRELATION_TIME_S = 1.3
"""How long errors of boxes last on a vessel under way: heave, for a fourth of a wave's period."""

_MOST_PARTS = 256
_MOST_UNSORTED = 10_000
_LEAST_INTERVAL_S = 0.001
_MOST_FORECASTS = 100_000
_LOOKED_AT_BOXES = 1000
# Many at once cost less than each alone; a stream waits for them, and its targets far longer.
_LOCATED_MOMENTS = 64

BOXES_OUTSIDE, TRACKS_OUTSIDE = "boxes outside of the area", "tracks outside of the area"
"""The reasons for which a `Tally` counts them."""


@dataclass(frozen=True)
class TrackSettings:
    """Settings of `track`.

    Attributes:
        trajectory: The trajectory method: ``"rts"``, ``"paper"``, another package's name, or an
            object.
        tracker: The tracker: another package's name, or an object or a callable that makes one.
            None: on the earth where the model has a camera, else in the image.
        interval_s: Time between the points of a track; None: a point a box.
        ends_after_s: A target not seen for as long has gone; its track is smoothed and let go.
        shortest_s: Tracks whose positions span less are dropped: glitter, birds, broken waves.
        longest_s: A track that lasts longer is cut, and goes on under another number, so that a
            source without an end fits into memory.
        forecast_s: How far ahead a track is forecast after its last position, where forecasts
            are asked for.
        forecast_interval_s: Time between the points of a forecast.
        compensate_rotation: Whether camera rotation seen in the video is compensated.
        clock_offset_s: How far the camera's clock is ahead of the true time (the log's); it is
            taken off, so that the tracks are in that.
        area: Where targets can be: boxes with a place outside, and tracks that lie outside for the
            most part, are left out. None: anywhere.
        tell_moored: Whether what never moves is learned and told apart in the tracks.
        tally: Told what the area and a mask leave out.
    """

    trajectory: str | TrajectoryMethod = DEFAULT_TRAJECTORY
    tracker: str | Tracker | Callable[[], Tracker] | None = None
    interval_s: float | None = None
    ends_after_s: float = 20.0
    shortest_s: float = 2.0
    longest_s: float = 1800.0
    forecast_s: float = 60.0
    forecast_interval_s: float = 5.0
    compensate_rotation: bool = True
    clock_offset_s: float = 0.0
    area: Area | None = None
    tell_moored: bool = True
    tally: Tally | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        # An unknown name is told before any work is done.
        method(self.trajectory)
        for name in ("ends_after_s", "longest_s", "forecast_s", "forecast_interval_s"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"{name} must be positive; it is {getattr(self, name):g} s")
        if not np.isfinite(self.clock_offset_s):
            raise InputError("clock_offset_s is not a number; give seconds")
        if not self.forecast_s < np.inf:
            raise InputError("forecast_s is infinite; give the seconds to look ahead")
        if self.forecast_s > _MOST_FORECASTS * self.forecast_interval_s:
            raise InputError(
                f"forecast_s is {self.forecast_s:g} s; with a point every "
                f"{self.forecast_interval_s:g} s it may be "
                f"{_MOST_FORECASTS * self.forecast_interval_s:g} s at most"
            )
        if self.interval_s is not None and not _LEAST_INTERVAL_S <= self.interval_s < np.inf:
            raise InputError(
                f"interval_s is {self.interval_s:g} s; it must be at least {_LEAST_INTERVAL_S:g} "
                "s, since files of tracks keep milliseconds"
            )


class SourceOptions(TypedDict, total=False):
    """What a source comes with, each by its name; see `track`.

    Attributes:
        detector: Finds boxes in frames: a name, the path of an ONNX file, or one's own. Absent:
            ``"harbour"``.
        clock: Tells the times of frames; absent: the video or the table does.
        start_utc_s: POSIX seconds of a video's first frame.
        platform: What the camera stands on, or its log, where that moves.
        horizons: Where the horizon lies, for boxes in a table; in frames it is looked for.
        water_levels: How high the water stands, metres above the datum of the model's scene, or a
            table of it; needed where that scene had such.
        mask: A picture of the frames' size, black where they are neither looked at nor kept.
    """

    detector: Detector | str | None
    clock: Clock | None
    start_utc_s: float | None
    platform: Platform | str | os.PathLike[str] | None
    horizons: Horizons | None
    water_levels: WaterLevels | float | str | os.PathLike[str] | None
    mask: Mask | str | os.PathLike[str] | None


def track(
    source: str | os.PathLike[str] | Boxes,
    model: Georeferencer,
    *,
    settings: TrackSettings | None = None,
    progress: Progress | None = None,
    **options: Unpack[SourceOptions],
) -> Tracks:
    """Smooth tracks of everything in a source.

    Args:
        source: A video, a folder of frames, a stream, a table of boxes, or boxes.
        model: Says where a box lies.
        settings: How boxes become tracks.
        progress: Told how far it is.
        options: What the source comes with: ``detector``, ``clock``, ``start_utc_s``,
            ``platform``, ``horizons``, ``water_levels``, ``mask``; see `SourceOptions`.

    Raises:
        InputError: The source cannot be read, nothing tells its times, or the model is of a camera
            that moves and the source of one that does not, or the reverse, or water levels are
            missing or of no use.
        BrokenOffError: The source could not be read to its end; its ``tracks`` are what was
            tracked until then.

    Examples:
        A table of boxes, as any detector may have written it; a video is given in the same way:

        >>> model = sightline.load("model.safetensors")
        >>> tracks = sightline.track("harbour.csv", model)
        >>> len(tracks), tracks[0].label
        (10, 'sailboat')
    """
    found = iter_tracks(source, model, settings=settings, progress=progress, **options)
    made: list[Track] = []
    try:
        made.extend(found)
    except BrokenOffError as error:
        error.tracks = Tracks(tuple(made))
        raise
    return Tracks(tuple(made))


def iter_tracks(
    source: str | os.PathLike[str] | Boxes,
    model: Georeferencer,
    *,
    settings: TrackSettings | None = None,
    progress: Progress | None = None,
    forecasts: Callable[[Track], None] | None = None,
    stop: threading.Event | None = None,
    **options: Unpack[SourceOptions],
) -> Iterator[Track]:
    """As `track`, yielding each track once its target has gone, in constant memory.

    Where the source breaks off, the tracks of all targets until then are yielded before the error
    is raised.

    Args:
        source: See `track`.
        model: See `track`.
        settings: See `track`.
        progress: See `track`.
        forecasts: Is given the forecast of each track, from its last position on and by its
            positions alone, as a track of extrapolated points with the same number.
        stop: Ends the source when it is set, by another thread or a signal's handler, as if there
            were no more of it; even while a stream is silent.
        options: See `track`.

    Raises:
        InputError: See `track`.
        BrokenOffError: See `track`.
        StoppedError: ``stop`` was set before anything was seen.

    Examples:
        >>> model = sightline.load("model.safetensors")
        >>> forecasts = []
        >>> tracks = sightline.iter_tracks("harbour.csv", model, forecasts=forecasts.append)
        >>> first = next(tracks)
        >>> first.track_id == forecasts[0].track_id
        True
        >>> bool((forecasts[0].time_utc_s > first.time_utc_s[-1]).all())
        True
    """
    unknown = sorted(options.keys() - SourceOptions.__annotations__.keys())
    if unknown:
        raise TypeError(f"a source has no option {unknown[0]!r}")
    settings = settings or TrackSettings()
    smoother = method(settings.trajectory)
    clock, start_utc_s = options.get("clock"), options.get("start_utc_s")
    platform = options.get("platform")
    if platform is not None and not isinstance(platform, Platform):
        platform = Platform(formats.read_fixes(platform), formats.read_headings(platform))
    check_platform(model, platform)
    late_s = settings.clock_offset_s
    water = _by_camera(_water(options.get("water_levels")), late_s)
    model.check_water(water is not None)
    table = isinstance(source, Boxes) or is_table(source)
    if table and start_utc_s is not None:
        raise InputError(
            "boxes in a table have no presentation times, so a start time does not tell when they "
            "were seen; give a clock (frame,utc), or time_utc with the boxes"
        )
    where = "" if isinstance(source, Boxes) else f"{source}: "
    mask = options.get("mask")
    if mask is not None and not isinstance(mask, Mask):
        mask = read_mask(mask)
    if mask is not None:
        mask.check_size(model.image_size_px, "the model")
    ending = Ending(stop)
    batches: Iterator[Boxes]
    if isinstance(source, Boxes) or table:
        batches, highest_id = (
            from_memory(source)
            if isinstance(source, Boxes)
            else read_table(source, model.image_size_px, stop=stop)
        )
        history = CameraHistory(horizons=options.get("horizons"), water=water)
        dated = (with_times(boxes, clock, model, where) for boxes in ending.until(batches))
        dated = (_unmasked(boxes, mask, settings) for boxes in dated)
        observed: Iterator[ObservedBoxes] = map(history.observed, dated)
    else:
        highest_id = NO_TRACK
        monitor = CameraMotionMonitor(
            model, warn_of=str(source), compensate=settings.compensate_rotation, water=water
        )
        frames = ending.frames(
            partial(video.frames, source, clock=clock, start_utc_s=start_utc_s), str(source)
        )
        if mask is not None:
            frames = mask.painted(fit_for_use(frames, model, str(source)), str(source))
        usable = observe(fit_for_use(frames, model, str(source)), [monitor])
        if model.horizon_px is not None:
            usable = with_horizons(usable)
        count = stopping.call(partial(frame_count, source), stop)
        found = detect(usable, make_detector(options.get("detector"), model), count, progress)
        kept = (_unmasked(boxes, mask, settings) for boxes in found)
        observed = monitor.observed(with_times(boxes, None, model, where) for boxes in kept)
    if late_s:
        observed = (_in_log_time(boxes, late_s) for boxes in observed)
    try:
        yield from follow(
            *(observed, model, smoother, settings, highest_id, platform, forecasts),
            ended_early=lambda: ending.early,
        )
    except FrameRateError:
        # Of a source that has no proper end the pictures until then do not tell the rate.
        if not ending.early:
            raise
    ending.check()


def _unmasked(boxes: Boxes, mask: Mask | None, settings: TrackSettings) -> Boxes:
    """Boxes without those that are masked."""
    if mask is None:
        return boxes
    hidden = mask.hides(boxes)
    if settings.tally is not None:
        settings.tally.leave_out(MASKED, int(hidden.sum()))
    return boxes if not hidden.any() else boxes[~hidden]


def _by_camera(water: WaterLevels | None, late_s: float) -> WaterLevels | None:
    """Water levels by the camera's clock, which is so far ahead."""
    if water is None or not late_s:
        return water
    return WaterLevels(water.time_utc_s + late_s, water.level_m)


def _in_log_time(boxes: ObservedBoxes, late_s: float) -> ObservedBoxes:
    """Boxes by a clock that is so far behind theirs, with the state that the camera had."""
    moved = boxes.boxes.with_columns(time_utc_s=boxes.time_utc_s - late_s)
    return ObservedBoxes.at(moved, boxes.state)


def _water(
    given: WaterLevels | float | str | os.PathLike[str] | None,
) -> WaterLevels | None:
    if given is None or isinstance(given, WaterLevels):
        return given
    if isinstance(given, str | os.PathLike):
        return formats.read_water_levels(given)
    return WaterLevels.constant(given)


def follow(
    batches: Iterator[ObservedBoxes],
    model: Georeferencer,
    smoother: TrajectoryMethod,
    settings: TrackSettings,
    highest_id: int = NO_TRACK,
    platform: Platform | None = None,
    forecasts: Callable[[Track], None] | None = None,
    ended_early: Callable[[], bool] = lambda: False,
) -> Iterator[Track]:
    """Tracks of boxes, each once its target has gone.

    A box is located once: where the tracker needs its place, with those of the moments around it,
    else with the others of its track when that has ended. Both are the same whatever batches they
    came in, since the last digits of a position depend on what is located with it.

    Args:
        batches: In the order of time from one to the next.
        model: Says where a box lies.
        smoother: Makes a track of positions.
        settings: How boxes become tracks.
        highest_id: Of the boxes' track ids; those without one are of no target. `NO_TRACK`: none
            has one, and a tracker gives them.
        platform: What the camera stands on, where that moves.
        forecasts: See `iter_tracks`.
        ended_early: Whether there would have been more batches: then it is nothing to be warned
            of that no track came.

    Raises:
        FrameRateError: No target could be followed, since the boxes come too seldom.
    """
    first_s: list[float] = []
    book = _OpenTracks(settings, highest_id)
    boxes_seen = [0]
    compensated = map(model.compensated, _counted(batches, boxes_seen))
    teller = MooredTeller(model, enabled=settings.tell_moored)
    if highest_id == NO_TRACK:
        tracker = _tracker(model, settings, platform)
        inside = _Inside(settings, model, platform)
        followed = _followed(compensated, model, first_s, tracker, _Before(inside, teller))
        turns = book.turns(teller.finished(followed), by_moment=True)
    else:
        turns = book.turns(teller.learned(compensated))
    count = 0
    waiting: list[tuple[Track, LocatedBoxes]] = []
    for last, ended in turns:
        for number, own in ended:
            boxes = (
                own if isinstance(own, LocatedBoxes) else model.place_compensated(_observed(own))
            )
            if highest_id != NO_TRACK:
                boxes = boxes[_Inside(settings, model, platform).rows(boxes)]
            made = smooth_boxes(
                *(boxes, smoother, settings),
                track_id=number,
                shortest_s=settings.shortest_s,
                platform=platform,
            )
            if made is not None and _lies_in(made, settings):
                waiting.append((made, boxes))
        known = [last or teller.knows(made) for made, _ in waiting]
        for made, boxes in itertools.compress(waiting, known):
            count += 1
            told = teller.told(made, boxes)
            if forecasts is not None:
                forecasts(_forecast(boxes, settings, told, platform))
            yield told
        waiting = [one for one, due in zip(waiting, known, strict=True) if not due]
    if count == 0:
        check_frame_rate(first_s, "boxes", model)
        if boxes_seen[0] and not ended_early():
            _logger.warning(
                "no track came of %d boxes: a track needs boxes below the horizon over at least "
                "%g s, which have a track id in common, or of which one is of confidence 0.4",
                boxes_seen[0],
                settings.shortest_s,
            )


class _Inside:
    """Tells which boxes lie in the area, and counts those that do not.

    A box without a place, above the horizon, is left to who follows it.
    """

    def __init__(
        self, settings: TrackSettings, model: Georeferencer, platform: Platform | None
    ) -> None:
        self._settings, self._model, self._platform = settings, model, platform

    @property
    def asked(self) -> bool:
        """Whether there is an area."""
        return self._settings.area is not None

    def rows(self, boxes: Boxes) -> BoolArray:
        """(N,) bool.

        Args:
            boxes: Located, or else they are here.
        """
        area = self._settings.area
        if area is None:
            return np.ones(len(boxes), dtype=bool)
        if not isinstance(boxes, LocatedBoxes):
            boxes = self._model.place_compensated(_observed(boxes))
        places = positions_on_earth(boxes, self._platform, until_then=True)
        inside = area.contains(places.latitude_deg, places.longitude_deg) | ~places.known
        if self._settings.tally is not None:
            self._settings.tally.leave_out(BOXES_OUTSIDE, int((~inside).sum()))
        return inside


@dataclass(frozen=True)
class _Before:
    """What boxes pass before they are followed."""

    inside: _Inside
    teller: MooredTeller


def _lies_in(track: Track, settings: TrackSettings) -> bool:
    """Whether a track lies in the area for the most part; one that does not is counted."""
    if settings.area is None:
        return True
    inside = settings.area.contains(track.latitude_deg, track.longitude_deg)
    if 2 * int(inside.sum()) >= len(track):
        return True
    if settings.tally is not None:
        settings.tally.leave_out(TRACKS_OUTSIDE)
    return False


def _counted(batches: Iterable[ObservedBoxes], seen: list[int]) -> Iterator[ObservedBoxes]:
    for batch in batches:
        seen[0] += len(batch.boxes)
        yield batch


def _tracker(model: Georeferencer, settings: TrackSettings, platform: Platform | None) -> Tracker:
    if settings.tracker is not None:
        return tracker_by_name(settings.tracker)
    if not follows_on_earth(model):
        return ImageTracker()
    return WorldTracker(
        partial(positions_on_earth, platform=platform, until_then=True), platform=platform
    )


def _forecast(
    boxes: LocatedBoxes, settings: TrackSettings, track: Track, platform: Platform | None
) -> Track:
    """Forecast of a track from its last position on."""
    known = states(boxes, platform, track_id=track.track_id)
    assert known is not None, "the track is of these boxes"
    state = known[-1:]
    step = min(settings.forecast_interval_s, settings.forecast_s)
    lags = np.arange(1, int(settings.forecast_s / step + 1e-9) + 1) * step
    ahead = state.forecast(lags, track_id=track.track_id, label=track.label)
    assert track.moored is not None, "filled in"
    stays = np.full(len(ahead), track.moored[-1], dtype=bool)
    return replace(ahead, moored=stays, untold=track.untold)


def _followed(
    batches: Iterator[ObservedBoxes],
    model: Georeferencer,
    first_s: list[float],
    tracker: Tracker,
    before: _Before,
) -> Iterator[Boxes]:
    """Boxes with the track ids that a tracker assigns, in the order of time.

    They are located where the tracker needed it; what follows in the image needs no places, and
    gives the boxes back as they were observed.

    Args:
        batches: In the order of time from one to the next, compensated.
        model: Says where a box lies, as the tracker needs it.
        first_s: Is given the first of their times.
        tracker: Gives the ids.
        before: Tells which boxes it is given, and how sure they are.
    """
    several = tracker.follow if isinstance(tracker, TargetTracker) else None
    for boxes in groups_of_moments(batches, _LOCATED_MOMENTS):
        assert isinstance(boxes, ObservedBoxes), "parts of such have their state"
        boxes = before.teller.lowered(boxes)
        located = boxes if isinstance(tracker, ImageTracker) else model.place_compensated(boxes)
        first_s += _first_times(boxes, _LOOKED_AT_BOXES - len(first_s))
        if before.inside.asked:
            rows = before.inside.rows(located)
            boxes, located = boxes[rows], located[rows]
            if not len(boxes):
                continue
        if several is not None:
            yield several(located)
            continue
        for given in moments([located]):
            yield _given_back(tracker.update(given), given)


def _first_times(boxes: Boxes, most: int) -> list[float]:
    times: list[float] = np.unique(boxes.time_utc_s)[:most].tolist() if most > 0 else []
    return times


def _given_back(kept: Boxes, given: Boxes) -> Boxes:
    """Boxes that a tracker gave back: rows of those that it was given, with its ids.

    Raises:
        InputError: One of them was not given.
    """
    if isinstance(kept, BoxesWith):
        return kept
    same = (kept.xyxy_px[:, None] == given.xyxy_px[None]).all(axis=2)
    same &= kept.time_utc_s[:, None] == given.time_utc_s[None]
    if not same.any(axis=1).all():
        raise InputError("the tracker gave back a box that it was not given; it only adds ids")
    return given[np.argmax(same, axis=1)].with_columns(track_id=kept.track_id)


def _observed(boxes: Boxes) -> ObservedBoxes:
    assert isinstance(boxes, ObservedBoxes), "the book hands on the rows that it was given"
    return boxes


class _OpenTracks:
    """Boxes of targets that have not gone yet, by track id."""

    def __init__(self, settings: TrackSettings, highest_id: int) -> None:
        self._settings = settings
        self._highest_id = highest_id
        self._spare = itertools.count(max(highest_id, 0) + 1)
        self._used: set[int] = set()
        self._parts: dict[int, list[Boxes]] = {}
        self._unsorted: list[Boxes] = []
        self._unsorted_rows = 0
        self._first_s: dict[int, float] = {}
        self._last_s: dict[int, float] = {}

    def turns(
        self, batches: Iterable[Boxes], *, by_moment: bool = False
    ) -> Iterator[tuple[bool, list[tuple[int, Boxes]]]]:
        """Add boxes with track ids, and return the boxes of the targets that have gone.

        Args:
            batches: In the order of time from one to the next.
            by_moment: Whether they are in the order of time, each moment whole, all with ids.

        Returns:
            With each batch, and once more at the end: whether that is it, and who has gone.
        """
        for batch in batches:
            yield False, self._add_moments(batch) if by_moment else self._add(batch)
        yield True, [self._end(key) for key in list(self._first_s)]

    def ended(self, batches: Iterable[Boxes]) -> Iterator[tuple[int, Boxes]]:
        """The boxes of each target that has gone, of batches as `turns` takes them."""
        for _, ended in self.turns(batches):
            yield from ended

    def ended_by_moment(self, batches: Iterable[Boxes]) -> Iterator[tuple[int, Boxes]]:
        """As `ended`, where each moment is a batch of its own.

        Args:
            batches: In the order of time, each moment whole, all boxes with ids.
        """
        for _, ended in self.turns(batches, by_moment=True):
            yield from ended

    def _add(self, batch: Boxes) -> list[tuple[int, Boxes]]:
        if not len(batch):
            return []
        ended: list[tuple[int, Boxes]] = []
        batch = batch[np.argsort(batch.time_utc_s, kind="stable")]
        for key in np.unique(batch.track_id[batch.track_id != NO_TRACK]).tolist():
            own = batch[np.flatnonzero(batch.track_id == key)]
            while len(own):
                rows = self._until_cut(key, own.time_utc_s)
                if rows:
                    self._first_s.setdefault(key, float(own.time_utc_s[0]))
                    self._last_s[key] = float(own.time_utc_s[rows - 1])
                    self._take(key, own[:rows])
                    own = own[rows:]
                if len(own):
                    ended.append(self._end(key))
        return ended + self._end_the_gone(float(batch.time_utc_s[-1]))

    def _add_moments(self, batch: Boxes) -> list[tuple[int, Boxes]]:
        """As `_add`, moment by moment, in plain Python: each is of a few boxes."""
        ended: list[tuple[int, Boxes]] = []
        longest_s, gap_s = self._settings.longest_s, self._settings.ends_after_s
        first, last = self._first_s, self._last_s
        times, ids = batch.time_utc_s, batch.track_id.tolist()
        cuts = (np.flatnonzero(np.diff(times) > 0.0) + 1).tolist()
        kept = 0
        for start, stop in itertools.pairwise([0, *cuts, len(batch)] if ids else []):
            now = float(times[start])
            for key in sorted(set(ids[start:stop])):
                if key in last and (now - last[key] > gap_s or now - first[key] > longest_s):
                    self._put_by(batch, kept, start)
                    kept = start
                    ended.append(self._end(key))
                first.setdefault(key, now)
                last[key] = now
            if now - min(last.values()) > gap_s:
                self._put_by(batch, kept, stop)
                kept = stop
                ended += self._end_the_gone(now)
        self._put_by(batch, kept, len(batch))
        return ended

    def _end_the_gone(self, now_s: float) -> list[tuple[int, Boxes]]:
        limit = self._settings.ends_after_s
        return [self._end(k) for k in list(self._first_s) if now_s - self._last_s[k] > limit]

    def _put_by(self, batch: Boxes, start: int, stop: int) -> None:
        """Buffer rows, to be sorted by track with others."""
        if start < stop:
            self._unsorted.append(batch[start:stop])
            self._unsorted_rows += stop - start
        if len(self._unsorted) >= _MOST_PARTS or self._unsorted_rows >= _MOST_UNSORTED:
            self._sort()

    def _sort(self) -> None:
        """Move all buffered boxes to their tracks."""
        if not self._unsorted:
            return
        boxes = Boxes.concatenate(self._unsorted)
        self._unsorted.clear()
        self._unsorted_rows = 0
        order = np.argsort(boxes.track_id, kind="stable")
        ids = boxes.track_id[order]
        for rows in np.split(order, np.flatnonzero(np.diff(ids)) + 1):
            self._take(int(boxes.track_id[rows[0]]), boxes[rows])

    def _until_cut(self, key: int, times_s: FloatArray) -> int:
        """Number of the next boxes that still belong to the open track of a target."""
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

    def _end(self, key: int) -> tuple[int, Boxes]:
        self._sort()
        del self._first_s[key], self._last_s[key]
        return self._number(key), Boxes.concatenate(self._parts.pop(key))

    def _number(self, key: int) -> int:
        """Track id: the boxes' own where they have one, a new one when a target returns."""
        if key > self._highest_id or key in self._used:
            return next(self._spare)
        self._used.add(key)
        return key


def check_platform(model: Georeferencer, platform: Platform | None, where: str = "") -> None:
    """Raise InputError where only one of model and recording has a moving platform.

    Args:
        model: The model.
        platform: What the camera stands on, where that moves.
        where: Begins the message.

    Raises:
        InputError: They do not fit.
    """
    if model.moving and platform is None:
        raise InputError(
            f"{where}the model is of a camera on a platform that moves; give the platform's own "
            "log (--platform FILE, or platform in the scene)"
        )
    if platform is not None and not model.moving:
        raise InputError(
            f"{where}the model is of a camera that stands still, and a platform is given; fit a "
            "model to recordings with platform logs"
        )


def positions_on_earth(
    boxes: Boxes, platform: Platform | None = None, *, until_then: bool = False
) -> Positions:
    """Positions of located boxes on the earth.

    Args:
        boxes: `LocatedBoxes`.
        platform: What the camera stands on, where that moves.
        until_then: Whether its pose is estimated from its fixes until each time only.
    """
    if not isinstance(boxes, LocatedBoxes):
        raise TypeError("boxes have positions once a model has placed them (Georeferencer.place)")
    positions = boxes.positions
    if isinstance(positions, Positions):
        return positions
    assert platform is not None, "refused by `check_platform`"
    pose = platform.pose(boxes.time_utc_s, positions.plane, until_then=until_then)
    return on_earth(positions, pose)


def states(
    boxes: LocatedBoxes,
    platform: Platform | None = None,
    *,
    motion: MotionModel | None = None,
    track_id: int = 0,
) -> MotionState | None:
    """Filtered states of one target, one at each located box.

    A camera that moves was where its own log says by its fixes until then.

    Args:
        boxes: Of one target.
        platform: What the camera stands on, where that moves.
        motion: How targets move. Absent: as vessels do.
        track_id: For messages.

    Returns:
        None where no box has a place.
    """
    positions = positions_on_earth(boxes, platform, until_then=True)
    if not positions.known.any():
        return None
    if platform is None:
        return follow_motion(boxes.time_utc_s, positions, motion, track_id=track_id)
    motion = motion or MotionModel()
    motion = replace(
        motion, correlation_time_s=max(motion.correlation_time_s, ON_BOARD_CORRELATION_TIME_S)
    )
    pose = platform.pose(boxes.time_utc_s, positions.plane, until_then=True)
    followed = follow_motion(
        boxes.time_utc_s, positions, motion, camera_position_m=pose.en_m, track_id=track_id
    )
    then = platform.pose(followed.time_utc_s, positions.plane, until_then=True)
    return followed.carried(then.covariance)


def smooth_boxes(
    boxes: LocatedBoxes,
    smoother: TrajectoryMethod,
    settings: TrackSettings,
    *,
    track_id: int,
    shortest_s: float = 0.0,
    platform: Platform | None = None,
) -> Track | None:
    """Smooth track of one target's boxes; None where they cover too short a time.

    Before a moving camera the path relative to it is smoothed, and then put where the camera was.
    """
    plane = boxes.positions.plane
    positions: EastNorthPositions
    if isinstance(boxes.positions, Positions):
        positions = boxes.positions
    else:
        assert platform is not None, "refused by `check_platform`"
        positions = north_up(boxes.positions, platform.pose(boxes.time_utc_s, plane))
    times = boxes.time_utc_s[positions.known]
    if not times.size or np.ptp(times) < shortest_s:
        return None
    at = None
    if settings.interval_s is not None:
        at = np.arange(times.min(), times.max() + 1e-9, settings.interval_s)
    made = smoother.apply(
        boxes.time_utc_s,
        positions,
        confidence=boxes.confidence,
        at_utc_s=at,
        track_id=track_id,
        label=str(boxes.label[0]),
    )
    if platform is None:
        return made
    moved = moved_track(made, platform.pose(made.time_utc_s, plane))
    return moved if len(moved) else None
