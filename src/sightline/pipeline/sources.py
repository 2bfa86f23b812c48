"""Sources of boxes with times: tables, boxes in memory, or frames for a detector."""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from sightline import formats, stopping
from sightline.clock import Clock
from sightline.detection import DEFAULT_DETECTOR, Detector, DetectorOptions, detector_by_name
from sightline.detection.run import usable
from sightline.errors import BrokenOffError, InputError, SightlineError
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.tally import Tally
from sightline.types import NO_TRACK, Boxes, FloatArray, Frame, check_inside

T = TypeVar("T")

_TABLE_SUFFIXES = (".csv", ".txt", ".otdet", ".ottrk")
_CHUNK_ROWS = 20_000
LOOKED_AT = 5
"""Number of frames whose times tell the frame rate."""
# In a longer time a boat moves by more than its length in the image.
_SELDOM_S = 1.0
# On the earth a vessel's path can be predicted for longer.
_SELDOM_ON_EARTH_S = 6.0


def is_table(source: str | os.PathLike[str]) -> bool:
    """Whether a source is a table of boxes, by its suffix."""
    return Path(source).suffix.lower() in _TABLE_SUFFIXES and "://" not in str(source)


class Ending:
    """How a source ends: by itself, because somebody asks for it, or because it breaks off.

    What comes after only sees that there is no more, so that all that was begun is finished.
    """

    def __init__(self, stop: threading.Event | None = None) -> None:
        """Take the event that ends the source when it is set."""
        self._stop = stop
        self._broken: SightlineError | None = None
        self._seen = False

    @property
    def early(self) -> bool:
        """Whether the source did not end by itself."""
        return self._broken is not None or (self._stop is not None and self._stop.is_set())

    def frames(self, start: Callable[[], Iterator[Frame]], name: str) -> Iterator[Frame]:
        """Frames of a source, to where it ends or breaks off.

        A stream breaks off with whatever else is wrong with it from some frame on: nobody can be
        asked to send it again.

        Args:
            start: Opens the source, and may wait for it.
            name: Its path or address.
        """
        kind = SightlineError if is_stream(name) else BrokenOffError
        try:
            yield from self.until(stopping.iterate(start, self._stop))
        except kind as error:
            if not self._seen:
                raise
            self._broken = error

    def until(self, items: Iterable[T]) -> Iterator[T]:
        """Items until somebody asks to stop.

        Raises:
            StoppedError: That was before the first.
        """
        for item in items:
            if self._stop is not None and self._stop.is_set():
                break
            self._seen = True
            if isinstance(self._stop, stopping.Stop):
                self._stop.begun = True
            yield item
        if not self._seen:
            stopping.check(self._stop)

    def check(self) -> None:
        """Raise what broke the source off, once all that came before has been handed on.

        Raises:
            BrokenOffError: It did.
        """
        if isinstance(self._broken, BrokenOffError):
            raise self._broken
        if self._broken is not None:
            raise BrokenOffError(str(self._broken)) from self._broken


def is_stream(source: str | os.PathLike[str]) -> bool:
    """Whether a source is an address, not a path."""
    return "://" in str(source) and not str(source).lower().startswith("file:")


def read_table(
    path: str | os.PathLike[str],
    image_size_px: tuple[int, int] | None = None,
    tally: Tally | None = None,
    stop: threading.Event | None = None,
) -> tuple[Iterator[Boxes], int]:
    """Read the boxes of a table in chunks, in the order of time.

    Boxes without width or height, which some detectors put out, are left out.

    Args:
        path: The table.
        image_size_px: Width and height of the picture, for boxes in shares of it.
        tally: Counts rows and boxes, and what is left out; None: a warning tells of it.
        stop: Is set by whoever no longer wants it.

    Returns:
        The boxes, and the highest track id, `NO_TRACK` if they have none.

    Raises:
        InputError: The table cannot be used.
        StoppedError: ``stop`` was set before the table had been looked at.
    """
    ordered, alone, last, highest_id = True, True, -np.inf, NO_TRACK
    read = partial(formats.iter_boxes, path, skip_empty=True, image_size_px=image_size_px)
    # It is read again below, and then tells what it left out.
    for chunk in read(_CHUNK_ROWS, tally=Tally(path)):
        stopping.check(stop)
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
        return from_memory(Boxes.concatenate(list(read(tally=tally))))
    chunks = read(_CHUNK_ROWS, tally=tally)
    if alone and highest_id == NO_TRACK:
        return (_as_one_target(chunk) for chunk in chunks), 1
    return chunks, highest_id


def from_memory(boxes: Boxes) -> tuple[Iterator[Boxes], int]:
    """Boxes in memory, in any order, as `read_table`.

    Boxes without ids of which no two are of one time are all of one target.
    """
    highest_id = int(boxes.track_id.max(initial=NO_TRACK))
    if highest_id == NO_TRACK and np.unique(_moment(boxes)).size == len(boxes):
        return iter([_as_one_target(boxes)]), 1
    return iter([boxes]), highest_id


def _moment(boxes: Boxes) -> FloatArray:
    """(N,) sort key of boxes: their times, or else their frames."""
    timed = np.isfinite(boxes.time_utc_s)
    return np.where(timed.all(), boxes.time_utc_s, boxes.frame.astype(np.float64))


def _as_one_target(boxes: Boxes) -> Boxes:
    return boxes.with_columns(track_id=np.ones(len(boxes), dtype=np.int64))


def make_detector(
    detector: Detector | str | None,
    model: Georeferencer | None,
    options: DetectorOptions | None = None,
) -> Detector:
    """A detector by its name, given the model's horizon; an object is returned as it is.

    Args:
        detector: As `detector_by_name` takes it, or one's own. Absent: the default.
        model: That knows the camera; without one the horizon is not known.
        options: How a detector in an ONNX file is run.

    Raises:
        InputError: The name is not known, or the options do not fit.
    """
    if detector is not None and not isinstance(detector, str):
        return detector_by_name(detector)
    horizon = None
    if model is not None and model.camera is not None:
        rows = model.camera.horizon_y_px([0.0, model.image_size_px[0]])
        if np.isfinite(rows).all():
            horizon = (float(rows[0]), float(rows[1]))
    return detector_by_name(detector or DEFAULT_DETECTOR, horizon_px=horizon, options=options)


class FrameRateError(InputError):
    """The frame rate is too low to follow targets."""


def fit_for_use(frames: Iterable[Frame], model: Georeferencer, where: str) -> Iterator[Frame]:
    """Pass frames on; raise where no target can be detected and tracked in them.

    Raises:
        InputError: See `usable`.
        FrameRateError: They come too seldom.
    """
    first_s: list[float] = []
    for frame in usable(frames, model.image_size_px, where):
        yield frame
        if len(first_s) < LOOKED_AT:
            first_s.append(frame.time_utc_s)
            if len(first_s) == LOOKED_AT:
                check_frame_rate(first_s, "pictures", model)
    if len(first_s) < LOOKED_AT:
        check_frame_rate(first_s, "pictures", model)


def follows_on_earth(model: Georeferencer) -> bool:
    """Whether targets are tracked on the earth's plane: a camera is known.

    The places of other models are too rough.
    """
    return model.camera is not None


def check_frame_rate(times_s: Sequence[float], what: str, model: Georeferencer) -> None:
    """Raise FrameRateError where frames are too far apart in time to follow targets.

    Raises:
        FrameRateError: The times are too far apart.
    """
    apart_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
    most_s = _SELDOM_ON_EARTH_S if follows_on_earth(model) else _SELDOM_S
    if apart_s > most_s:
        raise FrameRateError(
            f"the {what} are {apart_s:.1f} s apart, and a target can be followed only where they "
            f"are at most {most_s:g} s apart; give the video itself, or boxes with a track_id"
        )


def with_times(boxes: Boxes, clock: Clock | None, model: Georeferencer, where: str) -> Boxes:
    """Boxes with their times; raises where these or the image size do not fit."""
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


def whole_moments(batches: Iterable[Boxes]) -> Iterator[Boxes]:
    """Regroup batches of boxes in the order of time, without splitting a moment.

    Those of one time may come in two batches, so the last time of a batch waits for the next.
    """
    waiting: list[Boxes] = []
    for batch in batches:
        if not len(batch):
            continue
        boxes = Boxes.concatenate([*waiting, batch])
        order = np.argsort(boxes.time_utc_s, kind="stable")
        boxes = boxes[order]
        # A time that is none is last, and is told by whoever needs it.
        last = int(np.searchsorted(boxes.time_utc_s, boxes.time_utc_s[-1]))
        if last:
            yield boxes[:last]
        waiting = [boxes[last:]]
    yield from waiting


def groups_of_moments(batches: Iterable[Boxes], count: int) -> Iterator[Boxes]:
    """Regroup batches of boxes into so many moments each, in the order of time.

    Which boxes come together does not depend on the batches that they came in, so that what is
    computed of a group does not either, to the last digit.
    """
    waiting: list[Boxes] = []
    moments_waiting = 0
    for boxes in whole_moments(batches):
        begins = np.flatnonzero(np.diff(boxes.time_utc_s, prepend=-np.inf) > 0.0)
        start = 0
        for full in range(count - moments_waiting, begins.size + 1, count):
            stop = int(begins[full]) if full < begins.size else len(boxes)
            yield Boxes.concatenate([*waiting, boxes[start:stop]])
            waiting, start = [], stop
            moments_waiting = -full
        moments_waiting += begins.size
        if start < len(boxes):
            waiting.append(boxes[start:])
    if waiting:
        yield Boxes.concatenate(waiting)


def moments(batches: Iterable[Boxes]) -> Iterator[Boxes]:
    """Regroup batches of boxes into single moments, in the order of time."""
    for boxes in whole_moments(batches):
        cuts = np.flatnonzero(np.diff(boxes.time_utc_s) > 0.0) + 1
        for start, stop in itertools.pairwise([0, *cuts.tolist(), len(boxes)]):
            yield boxes[start:stop]
