"""Videos and pictures with what was found drawn into them."""

from __future__ import annotations

import os
import struct
import threading
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from sightline import stopping, video
from sightline.atomic import atomic_path
from sightline.clock import Clock
from sightline.detection import Detector
from sightline.detection.detector import BatchDetector
from sightline.detection.run import usable
from sightline.errors import BrokenOffError, InputError
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.overlay import Found, Overlay, OverlaySettings
from sightline.overlay.style import Image
from sightline.pipeline.camera_state import CameraMotionMonitor
from sightline.pipeline.sources import is_stream, is_table
from sightline.pipeline.track import TrackSettings, iter_tracks
from sightline.progress import Progress
from sightline.tally import Tally
from sightline.types import Boxes, Frame, Track, rfc3339
from sightline.video.mask import Mask
from sightline.video.reader import frame_count
from sightline.video.sound import Sound
from sightline.water import WaterLevels

MARK = "sightline show"
"""The comment of the files that are written, by which they are known again."""

# Of each pixel and second: at 1280 x 720 it is 5.5 Mbit/s.
_BITS_PER_PX = 6.0
_LEAST_BITS = 1_000_000
# Two frames at one time, which damaged files have, are put so far apart.
_LEAST_APART_S = 1.0 / 20_000


@dataclass(frozen=True)
class Footage:
    """A video file or a folder of frames, with what tells its times.

    Attributes:
        source: Its path.
        clock: Tells the times of frames; None: the video does.
        start_utc_s: POSIX seconds of a video's first frame; None: the container's own.

    Raises:
        InputError: It is a stream, or a table of boxes.
    """

    source: str
    clock: Clock | None = None
    start_utc_s: float | None = None

    def __post_init__(self) -> None:
        if is_stream(self.source):
            raise InputError(
                f"{self.source}: is a stream, which has no end and is seen once; record it to a "
                "file first, or watch it with sightline live"
            )
        if is_table(self.source):
            raise InputError(
                f"{self.source}: is a table of boxes and holds no picture; give the video, and "
                "the table as --boxes"
            )

    def frames(self) -> Iterator[tuple[float, Frame]]:
        """Frames with their UTC times, each behind its presentation time in seconds.

        A clock tells when frames were taken; when they are shown is the video's own matter. Where
        that does not say, they are shown at the pace at which they were taken.

        Raises:
            InputError: See `sightline.video.frames`.
            BrokenOffError: See `sightline.video.frames`.
        """
        if os.path.isdir(self.source):
            if self.start_utc_s is not None or self.clock is not None:
                return self._at_own_pace()
            raise InputError(
                f"{self.source}: nothing tells the times of pictures in a folder; give a clock "
                "(--clock)"
            )
        try:
            shown = video.frames(self.source, start_utc_s=0.0)
        except InputError:
            if self.clock is None:
                raise
            return self._at_own_pace()
        return self._presented(shown)

    def _presented(self, shown: Iterator[Frame]) -> Iterator[tuple[float, Frame]]:
        start_s = self.start_utc_s
        if start_s is None and self.clock is None:
            start_s = video.video_info(self.source, tally=Tally(self.source)).creation_utc_s
        for frame in shown:
            taken_s = np.nan if start_s is None else start_s + frame.time_utc_s
            if self.clock is not None:
                taken_s = float(self.clock.time_utc_s(np.array([frame.index]))[0])
            yield frame.time_utc_s, replace(frame, time_utc_s=taken_s)

    def _at_own_pace(self) -> Iterator[tuple[float, Frame]]:
        first_s: float | None = None
        for frame in video.frames(self.source, clock=self.clock, start_utc_s=self.start_utc_s):
            first_s = frame.time_utc_s if first_s is None else first_s
            yield frame.time_utc_s - first_s, frame


@dataclass(frozen=True)
class Shown:
    """What was written.

    Attributes:
        frames: How many.
        sound: Whether the sound was kept.
        broken: What ended the source too early, if something did.
    """

    frames: int
    sound: bool = False
    broken: BrokenOffError | None = None


def tracks_of(
    footage: Footage,
    model: Georeferencer,
    detector: Detector,
    *,
    settings: TrackSettings | None = None,
    progress: Progress | None = None,
    stop: threading.Event | None = None,
    water: WaterLevels | None = None,
    mask: Mask | None = None,
) -> tuple[list[Track], Boxes]:
    """Tracks of everything in a video, and all boxes that a detector found in it.

    Where the video breaks off, they are those until then.

    Args:
        footage: The video.
        model: Says where a box lies.
        detector: Finds the boxes.
        settings: How boxes become tracks.
        progress: Told how far it is.
        stop: Breaks it off when it is set.
        water: How high the water stands, where the model knows of that.
        mask: Where nothing is looked for.

    Raises:
        InputError: See `sightline.track`.
        StoppedError: ``stop`` was set.
    """
    kept = _Kept(detector)
    found = iter_tracks(
        footage.source,
        model,
        settings=settings,
        progress=progress,
        stop=stop,
        detector=kept,
        clock=footage.clock,
        start_utc_s=footage.start_utc_s,
        water_levels=water,
        mask=mask,
    )
    tracks: list[Track] = []
    # Reading it again to draw breaks off as well, and tells it.
    with suppress(BrokenOffError):
        tracks.extend(found)
    stopping.check(stop)
    return tracks, Boxes.concatenate(kept.boxes)


class _Kept:
    """A detector whose boxes are kept."""

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
        self.boxes: list[Boxes] = []
        self.batch_size: int = getattr(detector, "batch_size", 1)

    def detect(self, frame: Frame) -> Boxes:
        """See `Detector`."""
        return self.detect_batch([frame])[0]

    def detect_batch(self, frames: Sequence[Frame]) -> Sequence[Boxes]:
        """See `BatchDetector`."""
        if isinstance(self._detector, BatchDetector):
            found = list(self._detector.detect_batch(frames))
        else:
            found = [self._detector.detect(frame) for frame in frames]
        self.boxes += found
        return found

    def reset(self) -> None:
        """See `Detector`."""
        self._detector.reset()


def show_video(
    footage: Footage,
    model: Georeferencer,
    found: Found,
    output: str | os.PathLike[str],
    *,
    settings: OverlaySettings | None = None,
    progress: Progress | None = None,
    stop: threading.Event | None = None,
    tally: Tally | None = None,
) -> Shown:
    """Write a video with what was found drawn into it.

    Each frame is shown as long as in the source, and the sound of a file is copied. The pictures
    are upright, with square pixels, and even in width and height.

    Args:
        footage: The video.
        model: With a camera that stands still.
        found: What is drawn.
        output: A file that ends in ``.mp4``; it appears whole or not at all.
        settings: What is drawn.
        progress: Told how far it is.
        stop: Ends the video when it is set.
        tally: Told what is noteworthy of the source.

    Raises:
        InputError: The source cannot be read, its pictures are of another size than the model's,
            nothing tells their times, or the file cannot be written.
        StoppedError: ``stop`` was set before the first frame.
    """
    overlay = Overlay(model, found, settings)
    count = stopping.call(partial(frame_count, footage.source), stop)
    pace = _Pace(count, progress)
    broken: list[BrokenOffError] = []
    draw = _Drawing(overlay, model)
    taken = _fitting(_until_broken(footage, stop, broken), model, footage.source)
    drawn = (
        (shown_s, replace(frame, image_bgr=_even(draw(frame))))
        for shown_s, frame in draw.watched(taken)
    )
    width, height = model.image_size_px
    # In a thread of its own, beside the encoder.
    ahead = stopping.iterate(lambda: drawn, threading.Event())
    with Sound(footage.source, tally or Tally(footage.source)) as sound:
        frames = video.write_video(
            output,
            pace.told(_in_order(ahead)),
            bits_per_second=max(round(_BITS_PER_PX * width * height), _LEAST_BITS),
            preset="superfast",
            sound=None if os.path.isdir(footage.source) else sound,
            comment=MARK,
        )
    return Shown(frames, sound.kept, broken[0] if broken else None)


def show_picture(
    footage: Footage,
    model: Georeferencer,
    found: Found,
    output: str | os.PathLike[str],
    *,
    at: int | float,
    settings: OverlaySettings | None = None,
    stop: threading.Event | None = None,
) -> Shown:
    """Write one frame as PNG with what was found drawn into it.

    Args:
        footage: The video.
        model: With a camera that stands still.
        found: What is drawn.
        output: A file that ends in ``.png``; it appears whole or not at all.
        at: The number of the frame, an int; or POSIX seconds, a float: the nearest frame.
        settings: What is drawn.
        stop: Breaks it off when it is set.

    Raises:
        InputError: See `show_video`; or the video has no such frame.
        StoppedError: ``stop`` was set.
    """
    settings = settings or OverlaySettings()
    overlay = Overlay(model, found, settings)
    broken: list[BrokenOffError] = []
    draw = _Drawing(overlay, model)
    taken = draw.watched(_fitting(_until_broken(footage, stop, broken), model, footage.source))
    offset_s = settings.clock_offset_s
    chosen = _frame_at((frame for _, frame in taken), at, offset_s, footage.source)
    stopping.check(stop)
    done, coded = cv2.imencode(".png", draw(chosen))
    if not done:
        raise InputError(f"{output}: the picture cannot be written as PNG")
    with atomic_path(output) as temporary:
        temporary.write_bytes(_marked(coded.tobytes()))
    return Shown(1)


def _frame_at(frames: Iterable[Frame], at: int | float, offset_s: float, where: str) -> Frame:
    """The frame of a number or the one nearest to a time."""
    first: Frame | None = None
    last: Frame | None = None
    for frame in frames:
        first = first or frame
        if isinstance(at, int):
            if frame.index == at:
                return frame
        elif frame.time_utc_s - offset_s >= at:
            if last is None:
                if frame.time_utc_s - offset_s == at:
                    return frame
                break
            before_s = at - (last.time_utc_s - offset_s)
            return last if before_s < frame.time_utc_s - offset_s - at else frame
        last = frame
    if first is None:
        raise InputError(f"{where}: holds no frame")
    last = last or first
    if isinstance(at, int):
        raise InputError(
            f"{where}: has no frame {at}; its frames are {first.index} to {last.index}"
        )
    begin, end = (rfc3339(one.time_utc_s - offset_s) for one in (first, last))
    raise InputError(f"{where}: has no frame at {rfc3339(at)}; it lasts from {begin} to {end}")


def _until_broken(
    footage: Footage, stop: threading.Event | None, broken: list[BrokenOffError]
) -> Iterator[tuple[float, Frame]]:
    """Frames to where the source ends, breaks off or is stopped."""
    seen = False
    try:
        for one in stopping.iterate(footage.frames, stop):
            seen = True
            if isinstance(stop, stopping.Stop):
                stop.begun = True
            yield one
    except BrokenOffError as error:
        if not seen:
            raise
        broken.append(error)
    if not seen:
        stopping.check(stop)


def _fitting(
    taken: Iterable[tuple[float, Frame]], model: Georeferencer, where: str
) -> Iterator[tuple[float, Frame]]:
    """Pass frames on; raise for those of another size than the model's, or without a time."""
    for shown_s, frame in taken:
        for one in usable([frame], model.image_size_px, where):
            yield shown_s, one


def _in_order(drawn: Iterable[tuple[float, Frame]]) -> Iterator[Frame]:
    """Frames at the times at which they are shown, counted from when the first was taken."""
    start_s = last_s = -np.inf
    for shown_s, frame in drawn:
        if not np.isfinite(start_s):
            start_s = frame.time_utc_s - shown_s
        last_s = max(start_s + shown_s, last_s + _LEAST_APART_S)
        yield replace(frame, time_utc_s=last_s)


def _even(image: Image) -> Image:
    """A picture whose last column and row are there twice, where there is an odd number of them."""
    height, width = image.shape[:2]
    if not (height % 2 or width % 2):
        return image
    return np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


class _Drawing:
    """Draws into frames as the camera lies in them."""

    def __init__(self, overlay: Overlay, model: Georeferencer) -> None:
        self._overlay = overlay
        self._monitor = CameraMotionMonitor(model)

    def watched(self, taken: Iterable[tuple[float, Frame]]) -> Iterator[tuple[float, Frame]]:
        """Pass frames on, each once it has been looked at for how the camera lies."""
        for shown_s, frame in taken:
            self._monitor.observe(frame)
            yield shown_s, frame

    def __call__(self, frame: Frame) -> Image:
        """A frame with what was found drawn into it."""
        turned = self._monitor.history.rotation
        if turned is None:
            return self._overlay.drawn(frame)
        return self._overlay.drawn(frame, turned.at(np.array([frame.time_utc_s]))[0][0])


@dataclass
class _Pace:
    """Tells how far a video is."""

    count: int | None
    progress: Callable[[str, float], None] | None

    def told(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Pass frames on."""
        for done, frame in enumerate(frames, 1):
            if self.progress:
                self.progress("drawing", done / self.count if self.count else float("nan"))
            yield frame


def _marked(png: bytes) -> bytes:
    """A PNG that says what made it, as figures do."""
    kind, text = b"tEXt", b"Software\0" + MARK.encode()
    chunk = struct.pack(">I", len(text)) + kind + text + struct.pack(">I", zlib.crc32(kind + text))
    # Behind the signature and the header, which are 8 and 25 bytes long.
    return png[:33] + chunk + png[33:]
