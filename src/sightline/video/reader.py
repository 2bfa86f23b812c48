"""Frames and their times from files, folders and streams."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from sightline import video
from sightline.clock import Clock
from sightline.errors import BrokenOffError, InputError
from sightline.types import FloatArray, Frame

_IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
_MOST_DIGITS = 18
_LIVE_SCHEMES = ("rtsp", "rtsps", "rtmp", "rtmps", "rtp", "udp", "srt", "tcp")


@dataclass(frozen=True, eq=False)
class VideoInfo:
    """What a video file says of itself, found by decoding no more than its first frame.

    Attributes:
        image_size_px: Width and height, as shown: after the turn that telephones ask for.
        presentation_s: (N,) float64, seconds after the first frame, in the order of showing.
        creation_utc_s: POSIX seconds at which the container says that it was made; None if it
            does not say. Cameras that write the time at which they stopped exist.
    """

    image_size_px: tuple[int, int]
    presentation_s: FloatArray
    creation_utc_s: float | None


def video_info(path: str | os.PathLike[str]) -> VideoInfo:
    """Size, exact presentation times and creation time of a video file.

    Args:
        path: A file that FFmpeg can read.

    Raises:
        InputError: The file is missing or empty, is no video, or is damaged.
    """
    with _open(str(path)) as container:
        stream = _stream(container, str(path))
        try:
            ticks = [
                packet.pts
                for packet in container.demux(stream)
                if packet.pts is not None and not packet.is_discard
            ]
        except av.FFmpegError as error:
            raise _damaged(str(path), error) from error
        if not ticks or stream.time_base is None:
            raise InputError(f"{path}: holds no frame")
        seconds = np.sort(np.array(ticks, dtype=np.int64)) * float(stream.time_base)
        creation_utc_s = _creation(container)
    return VideoInfo(image_size_px(path), seconds - seconds[0], creation_utc_s)


def frames(
    source: str | os.PathLike[str],
    *,
    clock: Clock | None = None,
    start_utc_s: float | None = None,
    apart_s: float = 0.0,
) -> Iterator[Frame]:
    """The frames of a source, one at a time, with the UTC time at which each was taken.

    * A **video file**: times are the start plus the exact presentation times; the start is
      ``start_utc_s`` or else the container's creation time. Without either, times are NaN.
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

    Yields:
        Frames in order; only one is held at a time.

    Raises:
        InputError: There is no such source, nothing in it can be decoded, or it breaks off; then
            the frames before have been yielded, and the message says how many.
    """
    name = os.fspath(source)
    if "://" not in name and Path(name).is_dir():
        if start_utc_s is not None:
            raise InputError(
                f"{name}: pictures in a folder have no presentation times, so a start time does "
                "not tell when they were taken; give a clock (frame,utc)"
            )
        return _from_folder(Path(name), _Thinned(clock, apart_s))
    return _from_container(name, start_utc_s, _Thinned(clock, apart_s))


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
    for frame in frames(source):
        return frame.image_bgr.shape[1], frame.image_bgr.shape[0]
    raise InputError(f"{source}: holds no frame")


def _from_folder(folder: Path, thinned: _Thinned) -> Iterator[Frame]:
    numbered: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in _IMAGE_SUFFIXES:
            continue
        number = re.search(r"(\d+)$", path.stem)
        if number is None:
            raise InputError(
                f"{path}: the name does not end in the number of the frame, as in 000100.jpg"
            )
        if len(number[1]) > _MOST_DIGITS:
            raise InputError(f"{path}: its number is too large for that of a frame")
        other = numbered.setdefault(int(number[1]), path)
        if other != path:
            raise InputError(f"{folder}: {other.name} and {path.name} are both frame {number[1]}")
    if not numbered:
        raise InputError(f"{folder}: holds no picture; expected FRAME.jpg or FRAME.png")
    return _pictures(numbered, thinned)


def _pictures(numbered: dict[int, Path], thinned: _Thinned) -> Iterator[Frame]:
    for index in sorted(numbered):
        when_s = thinned.time_utc_s(index)
        if thinned.wants(when_s):
            yield Frame(index, when_s, _picture(numbered[index]))


def _picture(path: Path) -> NDArray[np.uint8]:
    """(H, W, 3) BGR. OpenCV would show what there is of a picture that is cut short."""
    try:
        with Image.open(path) as stored:
            upright = ImageOps.exif_transpose(stored).convert("RGB")
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: is no picture that can be read, or is damaged") from error
    return np.ascontiguousarray(np.asarray(upright)[..., ::-1])


def _from_container(name: str, start_utc_s: float | None, thinned: _Thinned) -> Iterator[Frame]:
    """Decode a file or a stream; opened at once, so that a bad name is told before the loop."""
    container = _open(name)
    try:
        _stream(container, name)
    except InputError:
        container.close()
        raise
    return _decoded(container, name, start_utc_s, thinned)


def _decoded(
    container: av.container.InputContainer,
    name: str,
    start_utc_s: float | None,
    thinned: _Thinned,
) -> Iterator[Frame]:
    with container:
        stream = _stream(container, name)
        stream.thread_type = "AUTO"
        live = _is_live(container, name)
        start_s = start_utc_s if start_utc_s is not None else _creation(container)
        first_s: float | None = None
        index = packets = 0
        try:
            for packet in container.demux(stream):
                packets += packet.size > 0
                for picture in packet.decode():
                    if live:
                        when_s = time.time()
                    elif start_s is None or picture.time is None:
                        when_s = np.nan
                    else:
                        first_s = picture.time if first_s is None else first_s
                        when_s = start_s + (picture.time - first_s)
                    when_s = thinned.time_utc_s(index, when_s)
                    if thinned.wants(when_s):
                        image = picture.to_ndarray(format="bgr24")
                        yield Frame(index, when_s, _upright(image, picture.rotation))
                    index += 1
        except av.FFmpegError as error:
            raise _broken(name, index, error.strerror) from error
        if index == 0:
            raise InputError(f"{name}: no frame can be decoded; the file is damaged or cut short")
        if packets < stream.frames:
            raise _broken(name, index, f"the container announces {stream.frames} frames")


def _upright(image: np.ndarray, rotation_deg: int) -> np.ndarray:
    """A picture as players show it: telephones store it lying and say how to turn it."""
    return np.ascontiguousarray(np.rot90(image, round(rotation_deg / 90)))


def _open(name: str) -> av.container.InputContainer:
    if "://" not in name:
        path = Path(name)
        # os.path answers where pathlib raises: for a name that is too long.
        if not os.path.exists(name):
            raise InputError(f"{name}: there is no such video, folder or stream")
        if path.is_dir():
            raise InputError(f"{name}: is a folder, not a video")
        if path.stat().st_size == 0:
            raise InputError(f"{name}: is empty")
    try:
        return av.open(name)
    except (av.FFmpegError, OSError) as error:
        raise _damaged(name, error) from error


def _stream(container: av.container.InputContainer, name: str) -> av.VideoStream:
    if not container.streams.video:
        raise InputError(f"{name}: holds no video")
    return container.streams.video[0]


def _is_live(container: av.container.InputContainer, name: str) -> bool:
    if "://" not in name:
        return False
    return name.split("://", 1)[0].lower() in _LIVE_SCHEMES or container.duration is None


def _creation(container: av.container.InputContainer) -> float | None:
    stamp = container.metadata.get("creation_time")
    if stamp is None:
        return None
    try:
        moment = datetime.fromisoformat(stamp)
    except ValueError:
        return None
    # Containers that were never told the time say the epoch of their format.
    if moment.year <= 1970:
        return None
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _damaged(name: str, error: Exception) -> InputError:
    reason = getattr(error, "strerror", None) or str(error)
    return InputError(
        f"{name}: cannot be read as a video ({reason}); the file is damaged, cut short, or of "
        "another kind"
    )


def _broken(name: str, index: int, reason: str | None) -> BrokenOffError:
    return BrokenOffError(
        f"{name}: breaks off after {index} frames ({reason or 'it cannot be decoded'}); "
        "the file is damaged or cut short"
    )


def frame_count(source: str | os.PathLike[str]) -> int | None:
    """How many frames a source has; None for a stream."""
    path = Path(source)
    if path.is_dir():
        return sum(1 for _ in path.iterdir())
    if "://" in str(source) or not path.is_file():
        return None
    return len(video.video_info(path).presentation_s)
