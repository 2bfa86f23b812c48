"""Presentation times of a video from its packets, where decoding would tell the same."""

from __future__ import annotations

import itertools

import av
import numpy as np

from sightline.tally import Tally
from sightline.types import FloatArray
from sightline.video.conversion import Conversion
from sightline.video.decoding import Decoder, Key, PacketClock, Timeline
from sightline.video.sources import BreakError, FileSource, open_source

# Codecs of which one packet is one picture, and of which `_size_mark` sees a change of size.
_CODECS = ("h264", "hevc", "mjpeg")
# Formats of which the size is told once for all, outside of the packets.
_SIZE_OUTSIDE = ("mov,mp4,m4a,3gp,3g2,mj2", "matroska,webm")
# How many frames are decoded to see that the packets tell the same.
_COMPARED = 64
_HEAD_BYTES = 4096


def presentation_of_packets(name: str, tally: Tally) -> tuple[tuple[int, int], FloatArray] | None:
    """Size and times of a video file's frames, told by its packets.

    A packet is one frame, shown in the order of the packets' times, where the codec works that
    way, each packet has a time of its own, none is marked as damaged, the clock does not start
    anew, and no parameters change. That the decoder sees it the same way is looked at in the
    first frames. Damage inside of a packet changes nothing: a lost frame keeps its place.

    Returns:
        None where this does not hold, so that only decoding tells.
    """
    source = open_source(name, Tally(name))
    if not isinstance(source, FileSource):
        source.close()
        return None
    try:
        said = Tally(name)
        seconds = _times(source, said)
    finally:
        source.close()
    if seconds is None:
        return None
    size_px = _compared(name, seconds, said)
    if size_px is None:
        return None
    for note in said.notes:
        tally.note(note)
    tally.count("frames", len(seconds))
    return size_px, seconds


def _times(source: FileSource, tally: Tally) -> FloatArray | None:
    codec, packet_format = source.stream.codec_context.name, source.container.format.name
    clock = PacketClock(source.container)
    if codec not in _CODECS or not clock.timed:
        return None
    keys: list[Key] = []
    mark: bytes | None = None
    try:
        for packet in source.packets():
            if not packet.size:
                continue
            known = packet.dts if clock.by_decoding else packet.pts
            if packet.is_corrupt or (known is None and not keys and packet.dts is None):
                return None
            key = clock.key(packet)
            if (packet.dts if clock.by_decoding else packet.pts) is None or clock.segment:
                return None
            if packet.has_sidedata("new_extradata") or packet.has_sidedata("param_change"):
                return None
            if packet.is_keyframe and packet_format not in _SIZE_OUTSIDE:
                own = _size_mark(codec, bytes(memoryview(packet)[:_HEAD_BYTES]))
                if mark is not None and own != mark:
                    return None
                mark = own
            if key is not None:
                keys.append(key)
    except BreakError as error:
        tally.note(f"breaks off after {len(keys)} frames ({error})")
    if not keys or len(set(keys)) < len(keys) or _has_wrong_times(keys):
        return None
    timeline, tick_s = Timeline(), float(source.stream.time_base or 0)
    seconds = [timeline.place(key.ticks * tick_s) for key in sorted(keys)]
    timeline.note_in(tally)
    return np.array(seconds)


def _has_wrong_times(keys: list[Key]) -> bool:
    """Whether packets come later than their order of showing allows, as it was at the beginning.

    Where one time is wrong, its picture or those around it seem to be shown before they come.
    """
    place = np.empty(len(keys), dtype=np.int64)
    place[sorted(range(len(keys)), key=keys.__getitem__)] = np.arange(len(keys))
    late = np.arange(len(keys)) - place
    return bool(late[_COMPARED:].max(initial=0) > late[:_COMPARED].max(initial=0))


def _size_mark(codec: str, head: bytes) -> bytes:
    """Those bytes of a packet that tell the size of its picture: SPS or SOF."""
    if codec == "mjpeg":
        marks = (head.find(bytes((0xFF, kind))) for kind in (0xC0, 0xC1, 0xC2))
        places = [place for place in marks if place >= 0]
        return head[min(places) : min(places) + 9] if places else b""
    parts = head.split(b"\0\0\1")[1:]
    for part in parts:
        if part and (part[0] & 0x1F == 7 if codec == "h264" else part[0] >> 1 & 0x3F == 33):
            return part.rstrip(b"\0")
    return b""


def _compared(name: str, seconds: FloatArray, tally: Tally) -> tuple[int, int] | None:
    """The size of the pictures, if those first decoded are where the packets say."""
    source = open_source(name, Tally(name))
    conversion = Conversion(source.stream, name, tally)
    seen = []
    try:
        for index, frame in enumerate(itertools.islice(Decoder(source), _COMPARED)):
            seen.append(frame.seconds)
            if frame.picture is not None:
                if frame.picture.interlaced_frame:
                    # Its fields may be packets each.
                    return None
                conversion.check_size(frame.picture, index)
    except (BreakError, av.FFmpegError):
        pass
    finally:
        source.close()
    # The times are sums of the same numbers.
    same = len(seen) == min(_COMPARED, len(seconds)) and np.array_equal(seen, seconds[: len(seen)])
    return conversion.size_px if same else None
