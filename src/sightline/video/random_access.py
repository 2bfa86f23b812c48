"""Pictures of single frames, in any order, of a video file or a folder."""

from __future__ import annotations

import os
from collections import OrderedDict, deque
from collections.abc import Iterator
from pathlib import Path
from threading import Lock

import av
import numpy as np
from numpy.typing import NDArray

from sightline.errors import BrokenOffError, InputError
from sightline.tally import Tally
from sightline.types import FloatArray, IntArray
from sightline.video.containers import is_address
from sightline.video.conversion import Conversion
from sightline.video.decoding import PacketClock
from sightline.video.pictures import FolderReader
from sightline.video.reader import frames, video_info
from sightline.video.sources import BreakError, Source, open_source

Image = NDArray[np.uint8]

MOST_BYTES = 256_000_000
"""Of decoded pictures so much is kept."""

# Who asks for a frame often asks for those around it, and backwards is the dear way.
_KEPT_BEFORE = 12
# So many frames ahead it is cheaper to decode on than to seek.
_AHEAD = 60
# Of the time to the nearest other frame, by how much a picture may be off its own.
_SAME = 0.25


class FramePictures:
    """Pictures of the frames of a source by number, decoded when asked for.

    What was decoded last is kept, at most `MOST_BYTES` of it; never the whole video. Numbers and
    pictures are those of `frames`. A video whose packets tell the times of its frames beyond
    doubt is read from the key picture before the frame; another from its beginning.
    """

    def __init__(self, source: str | os.PathLike[str], most_bytes: int = MOST_BYTES) -> None:
        """Open the source.

        Args:
            source: A video file, or a folder of pictures.
            most_bytes: Of decoded pictures so much is kept.

        Raises:
            InputError: It is a stream, is missing, or nothing in it can be decoded.
        """
        self._name, self._most_bytes = os.fspath(source), most_bytes
        if is_address(self._name):
            raise InputError(f"{self._name}: is an address; single frames are had of files alone")
        self._kept: OrderedDict[int, Image] = OrderedDict()
        self._lock = Lock()
        self._reader: _Folder | _Video
        if Path(self._name).is_dir():
            self._reader = _Folder(Path(self._name))
        else:
            self._reader = _Video(self._name)

    @property
    def frame(self) -> IntArray:
        """(N,) int64, numbers of the frames, increasing."""
        return self._reader.numbers

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the pictures."""
        height, width = self.read(int(self.frame[0])).shape[:2]
        return width, height

    def read(self, frame: int) -> Image:
        """(H, W, 3) BGR picture of a frame; not to be written to.

        Raises:
            InputError: There is no such frame, or it cannot be decoded.
        """
        with self._lock:
            if frame in self._kept:
                self._kept.move_to_end(frame)
                return self._kept[frame]
            numbers = self.frame
            at = int(np.searchsorted(numbers, frame))
            if at == numbers.size or numbers[at] != frame:
                raise InputError(
                    f"{self._name}: has no frame {frame}; its {numbers.size} frames are between "
                    f"{numbers[0]} and {numbers[-1]}"
                )
            found: Image | None = None
            for number, image in self._reader.read(frame):
                image.flags.writeable = False
                self._keep(number, image)
                found = image if number == frame else found
            if found is None:
                raise InputError(f"{self._name}: frame {frame} is lost to damage")
            return found

    def close(self) -> None:
        """Close the file, and forget what was decoded."""
        with self._lock:
            self._reader.close()
            self._kept.clear()

    def _keep(self, frame: int, image: Image) -> None:
        self._kept[frame] = image
        self._kept.move_to_end(frame)
        most = max(1, self._most_bytes // max(image.nbytes, 1))
        while len(self._kept) > most:
            self._kept.popitem(last=False)


class _Folder:
    """Frames of a folder of pictures."""

    def __init__(self, folder: Path) -> None:
        self._pictures = FolderReader(folder, Tally(folder))
        self.numbers = np.array(list(self._pictures.pictures), dtype=np.int64)
        self._first_read = False

    def read(self, frame: int) -> Iterator[tuple[int, Image]]:
        """The frame's picture, with its number."""
        if not self._first_read:
            # The range of deep grey values is that of the first picture, whichever is asked for.
            self._pictures.read(int(self.numbers[0]))
            self._first_read = True
        yield frame, self._pictures.read(frame)

    def close(self) -> None:
        """Nothing is open."""


class _Video:
    """Frames of a video file."""

    def __init__(self, name: str) -> None:
        self._name = name
        info = video_info(name, tally=Tally(name))
        self._seconds = info.presentation_s
        self.numbers = np.arange(self._seconds.size, dtype=np.int64)
        self._open: _Seeking | None = None
        self._from_start: Iterator[tuple[int, Image]] | None = None
        self._next = 0
        self._seeks = _packets_tell(name, self._seconds)

    def read(self, frame: int) -> Iterator[tuple[int, Image]]:
        """The frame's picture with its number, and those decoded on the way that are worth it."""
        if self._seeks:
            try:
                if self._open is None:
                    self._open = _Seeking(self._name, self._seconds)
                found = list(self._open.read(frame))
            except (av.FFmpegError, BreakError):
                self._seeks = False
            else:
                if any(number == frame for number, _ in found):
                    yield from found
                    return
                # Lost to damage, or decoders show it otherwise: from the beginning it is certain.
        yield from self._decoded_from_start(frame)

    def _decoded_from_start(self, frame: int) -> Iterator[tuple[int, Image]]:
        if self._from_start is None or frame < self._next:
            self._from_start = (
                (one.index, one.image_bgr) for one in frames(self._name, tally=Tally(self._name))
            )
        recent: deque[tuple[int, Image]] = deque(maxlen=_KEPT_BEFORE)
        try:
            for number, image in self._from_start:
                self._next = number + 1
                recent.append((number, image))
                if number >= frame:
                    break
        except BrokenOffError:
            self._from_start = None
        yield from recent

    def close(self) -> None:
        """Close what is open."""
        if self._open is not None:
            self._open.close()
        self._open = self._from_start = None


class _Seeking:
    """Reads a video from the key picture before a frame."""

    def __init__(self, name: str, seconds: FloatArray) -> None:
        tally = Tally(name)
        self._source: Source = open_source(name, tally)
        self._conversion = Conversion(self._source.stream, name, tally)
        self._seconds = seconds
        gap_s = np.diff(seconds)
        least = np.minimum(np.append(gap_s, np.inf), np.insert(gap_s, 0, np.inf))
        self._tolerance_s = np.where(np.isfinite(least), _SAME * least, 0.5)
        self._tick_s = float(self._source.stream.time_base or 1)
        self._origin_ticks = 0
        self._pictures: Iterator[av.VideoFrame] = self._decode()
        self._at = -1
        for picture in self._pictures:
            # The range of deep grey values is that of the first picture.
            self._conversion.check_size(picture, 0)
            self._conversion.to_bgr(picture)
            self._origin_ticks = int(picture.pts or 0)
            self._at = 0
            break
        self._first = True

    def read(self, frame: int) -> Iterator[tuple[int, Image]]:
        """The frame's picture and those just before it, with their numbers."""
        if self._first or not self._at < frame <= self._at + _AHEAD:
            self._first = False
            wanted = self._origin_ticks + round(float(self._seconds[frame]) / self._tick_s)
            # FFmpeg seeks by the time of decoding, which may be later than that of showing.
            self._source.container.seek(wanted, stream=self._source.stream, backward=True)
            self._pictures = self._decode()
            self._at = -1
        recent: deque[tuple[int, av.VideoFrame]] = deque(maxlen=_KEPT_BEFORE)
        for picture in self._pictures:
            number = self._number(picture)
            if number is None:
                continue
            self._at = number
            if number > frame and not any(one == frame for one, _ in recent):
                break
            recent.append((number, picture))
            if number >= frame:
                break
        for number, picture in recent:
            self._conversion.check_size(picture, number)
            yield number, self._conversion.to_bgr(picture)

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    def _decode(self) -> Iterator[av.VideoFrame]:
        for packet in self._source.packets():
            yield from (picture for picture in packet.decode() if not picture.is_corrupt)

    def _number(self, picture: av.VideoFrame) -> int | None:
        """The number of a picture by its time; None for one that is none of the frames."""
        if picture.pts is None:
            return None
        seconds = (picture.pts - self._origin_ticks) * self._tick_s
        right = int(np.clip(np.searchsorted(self._seconds, seconds), 1, len(self._seconds) - 1))
        at = (
            right - 1
            if seconds - self._seconds[right - 1] < self._seconds[right] - seconds
            else right
        )
        return at if abs(self._seconds[at] - seconds) <= self._tolerance_s[at] else None


def _packets_tell(name: str, seconds: FloatArray) -> bool:
    """Whether the packets' times are those of the frames, all different and from one clock."""
    if seconds.size < 2 or not (np.diff(seconds) > 0.0).all():
        return False
    source = open_source(name, Tally(name))
    try:
        clock = PacketClock(source.container)
        if not clock.timed or clock.by_decoding:
            return False
        ticks = [packet.pts for packet in source.packets() if packet.size]
        if any(one is None for one in ticks):
            return False
        shown = np.sort(np.array(ticks, dtype=np.int64))
        own = (shown - shown[0]) * float(source.stream.time_base or 1)
        return own.size == seconds.size and bool(np.allclose(own, seconds, rtol=0.0, atol=1e-6))
    except BreakError:
        return False
    finally:
        source.close()
