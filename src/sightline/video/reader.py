"""Frames and their times from files, folders and streams."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sightline.clock import Clock
from sightline.errors import BrokenOffError, InputError
from sightline.tally import Tally
from sightline.types import FloatArray, Frame
from sightline.video.containers import creation_utc_s, has_times, is_address
from sightline.video.conversion import Conversion
from sightline.video.decoding import Decoder
from sightline.video.pictures import FolderReader, numbered_pictures
from sightline.video.presentation import presentation_of_packets
from sightline.video.sources import BreakError, Source, open_source

_logger = logging.getLogger(__name__)

# Up to so many packets, decoding only to count frames costs a second or two.
_FEW_PACKETS = 1000


@dataclass(frozen=True, eq=False)
class VideoInfo:
    """What a video holds: its size, and the time of each frame that `frames` numbers.

    Attributes:
        image_size_px: Width and height, as shown: after the turn that telephones ask for, with
            square pixels.
        presentation_s: (N,) float64, seconds after the first frame, by the number of the frame;
            of frames that are lost to damage as well, which have a number, too. They never
            decrease; NaN where the video tells none.
        creation_utc_s: POSIX seconds at which the container says that it was made; None if it
            does not say. Cameras that write the time at which they stopped exist.
    """

    image_size_px: tuple[int, int]
    presentation_s: FloatArray
    creation_utc_s: float | None


def video_info(path: str | os.PathLike[str], *, tally: Tally | None = None) -> VideoInfo:
    """Size, exact presentation times and creation time of a video file.

    Where the packets tell the times beyond doubt, the pictures are not decoded, which takes a
    second for an hour; else all are, which takes as long as to read its frames.

    Args:
        path: A video file.
        tally: Told what was read, lost and bridged; without one it is logged.

    Raises:
        InputError: The file is missing or empty, is no video, holds no frame that can be decoded,
            or tells no times.
    """
    name, own = os.fspath(path), tally is None
    tally = Tally(name) if tally is None else tally
    source = open_source(name, tally)
    try:
        if source.live:
            raise InputError(f"{name}: is a stream without an end, not a video file")
        if not has_times(source.container):
            raise _timeless(name)
        created_utc_s = creation_utc_s(source.container)
    finally:
        source.close()
    known = presentation_of_packets(name, tally)
    size_px, presentation_s = _decoded_times(name, tally) if known is None else known
    if own:
        tally.warn(_logger)
    return VideoInfo(size_px, presentation_s, created_utc_s)


def _decoded_times(name: str, tally: Tally) -> tuple[tuple[int, int], FloatArray]:
    """Size and times by decoding all there is."""
    # Opening it has said what there is to say of the container.
    source = open_source(name, Tally(name))
    conversion, decoder = Conversion(source.stream, name, tally), Decoder(source)
    seconds: list[float] = []
    try:
        for index, frame in enumerate(decoder):
            if frame.picture is not None:
                conversion.check_size(frame.picture, index)
            seconds.append(frame.seconds)
    except BreakError as error:
        tally.note(f"breaks off after {len(seconds)} frames ({error})")
    except BrokenOffError as error:
        tally.note(str(error).removeprefix(f"{name}: "))
    finally:
        source.close()
    decoder.report_in(tally)
    if conversion.size_px is None:
        raise _nothing(name)
    return conversion.size_px, np.array(seconds)


def frames(
    source: str | os.PathLike[str],
    *,
    clock: Clock | None = None,
    start_utc_s: float | None = None,
    apart_s: float = 0.0,
    tally: Tally | None = None,
) -> Iterator[Frame]:
    """The frames of a source, one at a time, with the UTC time at which each was taken.

    * A **video file**: times are the start plus the exact presentation times; the start is
      ``start_utc_s`` or else the container's creation time. Without either, times are NaN.
      Frames that are lost to damage keep their numbers and times. Raw streams of pictures
      (``.h264``, ``.mjpeg``) tell no times.
    * A **folder** of ``FRAME.jpg`` or ``FRAME.png``: the frame's index is the number in its name.
      Times come from the clock alone.
    * A **live stream** (an RTSP, RTMP, SRT or UDP address, or HTTP without an end): a frame's
      time is that of its arrival, since the times in such streams start anew at each connection
      and the first frame may have none.

    Args:
        source: A path or an address.
        clock: Where it is given, it alone tells the times.
        start_utc_s: POSIX seconds of a video file's first frame.
        apart_s: Frames that follow the one before them sooner are left out, which costs less than
            to hand them on. Frames without a time are kept.
        tally: Told what was read, lost and bridged; without one it is logged at the end.

    Yields:
        Frames in order, all of one size; only one is held at a time.

    Raises:
        InputError: There is no such source, nothing in it can be decoded, or it is asked for
            times that it does not tell.
        BrokenOffError: A file is cut short, a stream ends, is reset or falls silent, or the
            pictures change their size; the frames before have been yielded.
    """
    name = os.fspath(source)
    own = tally is None
    tally = Tally(name) if tally is None else tally
    thinned = _Thinned(clock, apart_s)
    found: Iterator[Frame]
    if not is_address(name) and Path(name).is_dir():
        if start_utc_s is not None:
            raise InputError(
                f"{name}: pictures in a folder have no presentation times, so a start time does "
                "not tell when they were taken; give a clock (frame,utc)"
            )
        found = _pictures(FolderReader(Path(name), tally), thinned)
    else:
        # Opened at once, so that a bad name is told before the loop.
        opened = open_source(name, tally)
        if clock is None and not opened.live and not has_times(opened.container):
            if start_utc_s is not None:
                opened.close()
                raise _timeless(name)
            tally.note("its format stores no times of the frames; a clock (frame,utc) tells them")
        found = _decoded(opened, name, start_utc_s, thinned, tally)
    return _told(found, tally) if own else found


def _told(found: Iterator[Frame], tally: Tally) -> Iterator[Frame]:
    try:
        yield from found
    except InputError:
        tally.warn(_logger)
        raise
    tally.warn(_logger)


class _Thinned:
    """The time of each frame, and whether it is handed on."""

    def __init__(self, clock: Clock | None, apart_s: float) -> None:
        self._clock, self._apart_s = clock, apart_s
        self._next_s = -np.inf

    def time_utc_s(self, index: int, own_s: float = np.nan) -> float:
        """Of a frame that says ``own_s`` of itself."""
        if self._clock is None:
            return own_s
        return float(self._clock.time_utc_s(np.array([index]))[0])

    def wants(self, when_s: float) -> bool:
        """Whether the frame of a time is handed on."""
        if when_s < self._next_s:
            return False
        if np.isfinite(when_s):
            self._next_s = when_s + self._apart_s
        return True


def image_size_px(source: str | os.PathLike[str]) -> tuple[int, int]:
    """Width and height of a source's first frame.

    Raises:
        InputError: As `frames`.
    """
    for frame in frames(source, tally=Tally(source)):
        return frame.image_bgr.shape[1], frame.image_bgr.shape[0]
    raise InputError(f"{source}: holds no frame")


def frame_count(source: str | os.PathLike[str]) -> int | None:
    """How many frames a source has, lost ones included.

    None for a stream, for what cannot be read, and for a long video of which only decoding it
    would tell.
    """
    name = os.fspath(source)
    if is_address(name):
        return None
    tally = Tally(name)
    try:
        if Path(name).is_dir():
            return len(numbered_pictures(Path(name)))
        known = presentation_of_packets(name, tally)
        if known is None:
            return _count_few(name)
        return len(known[1])
    except InputError:
        return None


def _count_few(name: str) -> int | None:
    source = open_source(name, Tally(name))
    try:
        packets = source.packets()
        if any(number >= _FEW_PACKETS for number, _ in enumerate(packets)):
            return None
    except BreakError:
        pass
    finally:
        source.close()
    return len(_decoded_times(name, Tally(name))[1])


def _pictures(folder: FolderReader, thinned: _Thinned) -> Iterator[Frame]:
    for index in folder:
        when_s = thinned.time_utc_s(index)
        if thinned.wants(when_s):
            image = folder.read(index)
            if image is not None:
                yield Frame(index, when_s, image)
    folder.finish()


def _decoded(
    source: Source, name: str, start_utc_s: float | None, thinned: _Thinned, tally: Tally
) -> Iterator[Frame]:
    start_s = start_utc_s if start_utc_s is not None else creation_utc_s(source.container)
    conversion, decoder = Conversion(source.stream, name, tally), Decoder(source)
    try:
        for index, frame in enumerate(decoder):
            if frame.picture is None:
                continue
            conversion.check_size(frame.picture, index)
            if source.live:
                when_s = source.arrival_s()
            else:
                when_s = np.nan if start_s is None else start_s + frame.seconds
            when_s = thinned.time_utc_s(index, when_s)
            if thinned.wants(when_s):
                yield Frame(index, when_s, conversion.to_bgr(frame.picture))
    except BreakError as error:
        if conversion.size_px is not None:
            mend = "" if source.live else "; the file is damaged or cut short"
            raise BrokenOffError(
                f"{name}: breaks off after {decoder.frames} frames ({error}){mend}"
            ) from error
    finally:
        source.close()
        decoder.report_in(tally)
    if conversion.size_px is None:
        raise _nothing(name)


def _nothing(name: str) -> InputError:
    return InputError(f"{name}: no frame can be decoded; the file is damaged or cut short")


def _timeless(name: str) -> InputError:
    return InputError(
        f"{name}: its format stores no times of the frames, so a start does not tell when they "
        "were taken; give a clock (frame,utc)"
    )
