"""Containers of videos: which are opened, by which means, and what they say of themselves.

FFmpeg opens whatever it recognises, by whatever name it finds in there: playlists that name other
files, addresses, devices. What may be opened follows from what the user has named: from a file
nothing but that file, from an address what its kind of stream needs.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

import av

from sightline import limits
from sightline.errors import InputError
from sightline.tally import Tally
from sightline.video.kinds import AS_VIDEO, holds_pictures, why_no_video
from sightline.video.pictures import MOST_PIXELS, PICTURE_SUFFIXES

OPEN_TIMEOUT_S = 15.0
"""How long a stream may take until it answers, and again until its first pictures are there."""
SILENCE_TIMEOUT_S = 30.0
"""How long a stream may say nothing before it counts as broken off."""

_FILE_FORMATS = (
    "mov,matroska,avi,mpegts,mpeg,mpegvideo,h264,hevc,vvc,m4v,mjpeg,mpjpeg,obu,ivf,flv,asf,ogg,"
    "mxf,nut,dv,gxf,wtv,dhav,ifv,hxvs,yuv4mpegpipe"
)
_TLS = "tls,tcp"
# Scheme: the protocols that it needs, and the formats that come by it beside those of files.
_STREAMS = {
    "rtsp": ("rtp,udp,tcp,srtp", "rtsp,rtp,sdp"),
    "rtsps": ("rtp,udp,srtp," + _TLS, "rtsp,rtp,sdp"),
    "rtp": ("rtp,udp,srtp", "rtp,sdp"),
    "rtmp": ("rtmp,tcp", "live_flv"),
    "rtmps": ("rtmps," + _TLS, "live_flv"),
    "udp": ("udp", ""),
    "tcp": ("tcp", ""),
    "srt": ("srt", ""),
    "http": ("http,https,httpproxy," + _TLS, "hls"),
    "https": ("https,httpproxy," + _TLS, "hls"),
}
# With FFmpeg's own the first pictures come a second late; with nobuffer the first key picture is
# lost, and all up to the next with it.
_RTSP_OPTIONS = {"rtsp_transport": "tcp", "analyzeduration": "100000", "probesize": "32"}
_STREAM_OPTIONS = {"analyzeduration": "1000000"}
_DEVICE = "v4l2"
LIVE_SCHEMES = tuple(scheme for scheme in _STREAMS if not scheme.startswith("http"))
"""Schemes of addresses that are streams without an end."""


def is_address(name: str) -> bool:
    """Whether a source is named by an address, not by a path."""
    return "://" in name


def open_container(name: str) -> av.container.InputContainer:
    """Open a file or a stream, and nothing that it names.

    Raises:
        InputError: It is missing, empty, no file, of no kind that is read, or does not answer.
    """
    if is_address(name):
        scheme = name.split("://", 1)[0].lower()
        if scheme not in _STREAMS:
            raise InputError(
                f"{name}: is no address of a stream that is read; known are those that begin with "
                f"{', '.join(f'{known}://' for known in _STREAMS)}"
            )
        protocols, formats = _STREAMS[scheme]
        timeout = (OPEN_TIMEOUT_S, SILENCE_TIMEOUT_S)
        return _opened(name, name, protocols, f"{_FILE_FORMATS},{formats}".rstrip(","), timeout)
    _check_file(name)
    if holds_pictures(name):
        raise InputError(f"{name}: {why_no_video(name)}")
    # Without the prefix a name with a colon is taken for an address.
    return _opened(name, f"file:{name}", "file", _FILE_FORMATS, None)


def open_camera(
    address: str,
    name: str,
    *,
    options: Mapping[str, str] | None = None,
    timeout_s: tuple[float, float] = (OPEN_TIMEOUT_S, SILENCE_TIMEOUT_S),
) -> av.container.InputContainer:
    """Open a camera to be watched: with as little delay as its kind of stream allows.

    Args:
        address: Of a stream, or a video device (`/dev/video0`).
        name: What messages call it; an address may hold a password.
        options: Of FFmpeg, beside those that are set here, or instead of them.
        timeout_s: How long it may take to answer, and then be silent.

    Raises:
        InputError: It is no such address, does not answer, or sends nothing that is read.
    """
    scheme = check_camera(address, name)
    if scheme == _DEVICE:
        return _opened(name, address, "file", "v4l2,video4linux2", timeout_s, options or {})
    protocols, formats = _STREAMS[scheme]
    wanted = dict(_RTSP_OPTIONS if scheme.startswith("rtsp") else _STREAM_OPTIONS)
    wanted.update(options or {})
    return _opened(
        name, address, protocols, f"{_FILE_FORMATS},{formats}".rstrip(","), timeout_s, wanted
    )


def check_camera(address: str, name: str) -> str:
    """Scheme of a camera's address; ``"v4l2"`` of a video device.

    Raises:
        InputError: It is no address of a camera.
    """
    if not is_address(address) and address.startswith("/dev/"):
        if not os.path.exists(address):
            raise InputError(f"{name}: there is no such video device")
        return _DEVICE
    scheme = address.split("://", 1)[0].lower() if is_address(address) else ""
    if scheme not in _STREAMS or not address.split("://", 1)[1]:
        raise InputError(
            f"{name}: is no address of a camera; known are those that begin with "
            f"{', '.join(f'{known}://' for known in _STREAMS)}, and video devices (/dev/video0)"
        )
    return scheme


def _check_file(name: str) -> None:
    path = Path(name)
    # os.path answers where pathlib raises: for a name that is too long.
    if "\0" in name or not os.path.exists(name):
        raise InputError(f"{name}: there is no such video, folder or stream")
    status = path.stat()
    if stat.S_ISDIR(status.st_mode):
        raise InputError(f"{name}: is a folder, not a video")
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{name}: is no regular file; give a file, a folder or an address")
    if status.st_size == 0:
        raise InputError(f"{name}: is empty")


def _opened(
    name: str,
    url: str,
    protocols: str,
    formats: str,
    timeout: tuple[float, float] | None,
    options: Mapping[str, str] | None = None,
) -> av.container.InputContainer:
    try:
        container = av.open(
            url,
            format=formats.split(",")[0] if formats.startswith("v4l2") else None,
            # Old cameras write names and comments in the bytes of their country.
            metadata_errors="replace",
            options={"max_pixels": str(MOST_PIXELS)},
            container_options={
                "protocol_whitelist": protocols,
                "format_whitelist": formats,
                "enable_drefs": "0",
                # Pictures that are waited for to learn the frame rate would all arrive at once.
                **({"fpsprobesize": "0"} if timeout else {}),
                **(options or {}),
            },
            timeout=timeout,
        )
    except (av.FFmpegError, OSError, ValueError) as error:
        raise _unreadable(name, error) from error
    if not set(container.format.name.split(",")) & set(formats.split(",")):
        container.close()
        raise _unreadable(name, ValueError(f"a {container.format.name} file"))
    # AVI and its like store no times of showing, and those that FFmpeg makes up are wrong.
    if container.format.name.split(",")[0] in ("avi", "matroska", "asf"):
        container.flags &= ~av.container.Flags["gen_pts"].value  # type: ignore[operator]
    return container


def _unreadable(name: str, error: Exception) -> InputError:
    why = None if is_address(name) else why_no_video(name)
    if why is not None:
        return InputError(f"{name}: {why}")
    if not is_address(name) and Path(name).suffix.lower() in PICTURE_SUFFIXES:
        return InputError(f"{name}: is a picture, not a video; give the folder that it is in")
    if isinstance(error, av.error.FFmpegError) and error.errno == errno.EINVAL:
        return InputError(
            f"{name}: is of no format that is read as a video (what names other files, as a "
            f"playlist does, is not): if it plays elsewhere, {AS_VIDEO}"
        )
    reason = getattr(error, "strerror", None) or str(error)
    if is_address(name):
        return InputError(f"{name}: cannot be read as a video ({reason})")
    return InputError(
        f"{name}: cannot be read as a video ({reason}); the file is damaged, cut short, or of "
        f"another kind: if it plays elsewhere, {AS_VIDEO}"
    )


def film_stream(
    container: av.container.InputContainer, name: str, tally: Tally | None = None
) -> av.VideoStream:
    """The stream of a container that is the film: not its cover, a preview or a smaller copy.

    Raises:
        InputError: There is none.
    """
    films = list(_films(container))
    if not films:
        raise InputError(f"{name}: {_why_no_film(container, name)}")
    longest_s = max(_duration_s(stream) for stream in films)
    whole = [stream for stream in films if _duration_s(stream) * 2.0 >= longest_s]

    def rank(stream: av.VideoStream) -> tuple[bool, int]:
        default = bool(stream.disposition & av.stream.Disposition.default)
        return default, stream.width * stream.height

    # Of equals the first.
    chosen = max(whole, key=rank)
    if chosen.width * chosen.height > MOST_PIXELS:
        raise InputError(
            f"{name}: pictures of {chosen.width} x {chosen.height} px are too large; at most "
            f"{MOST_PIXELS // 1_000_000} megapixels are read"
        )
    if len(films) > 1 and tally is not None:
        tally.note(
            f"holds {len(films)} videos; stream {chosen.index} is read, with {chosen.width} x "
            f"{chosen.height} px"
        )
    # 0, the decoder's own choice, is a thread a core.
    chosen.codec_context.thread_count = limits.most_threads() or 0
    return chosen


def _why_no_film(container: av.container.InputContainer, name: str) -> str:
    why = None if is_address(name) else why_no_video(name)
    if why is not None:
        return why
    if not container.streams.video:
        what = "holds sound and no video" if container.streams.audio else "holds no video"
        return f"{what}; give the video"
    return f"holds no video that can be decoded, or only a cover picture; {AS_VIDEO}"


def _films(container: av.container.InputContainer) -> Iterator[av.VideoStream]:
    kinds = av.stream.Disposition
    still = kinds.attached_pic | kinds.timed_thumbnails | kinds.still_image
    for stream in container.streams.video:
        if stream.codec_context is not None and not stream.disposition & still:
            yield stream


def _duration_s(stream: av.VideoStream) -> float:
    if stream.duration is None or stream.time_base is None:
        return 0.0
    # A damaged header may say less than none.
    return max(float(stream.duration * stream.time_base), 0.0)


def has_times(container: av.container.InputContainer) -> bool:
    """Whether the format stores times: raw streams of pictures do not, FFmpeg makes some up."""
    timeless: int = av.format.Flags["no_timestamps"].value  # type: ignore[assignment]
    return not container.format.flags & timeless


def is_live(container: av.container.InputContainer, name: str) -> bool:
    """Whether a source has no end, so that pictures are of the time at which they arrive."""
    if not is_address(name):
        return False
    if name.split("://", 1)[0].lower() in LIVE_SCHEMES:
        return True
    return container.duration is None and container.size <= 0


def creation_utc_s(container: av.container.InputContainer) -> float | None:
    """POSIX seconds at which a container says that it was made; None if it does not say."""
    stamp = container.metadata.get("creation_time")
    if stamp is None:
        return None
    try:
        moment = datetime.fromisoformat(stamp)
        # Containers that were never told the time say the epoch of their format.
        if moment.year <= 1970:
            return None
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        return None


def is_cut_short(path: Path, format_name: str) -> bool:
    """Whether a file ends before its outermost parts do, by the lengths that these announce.

    The number of frames in a header is no measure: edit lists hide frames, and AVI counts those
    that were never stored.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        if "mp4" in format_name:
            return any(end > size for end in _box_ends(file, size))
        head = file.read(12)
        if format_name == "avi" and head[:4] == b"RIFF":
            # A recorder that lost its power has written no length.
            return int.from_bytes(head[4:8], "little") + 8 > size
        if "matroska" in format_name:
            file.seek(0)
            return _segment_end(file.read(4096)) > size
    return False


def _box_ends(file: BinaryIO, size: int) -> Iterator[int]:
    """Ends of the outermost boxes of an ISO file that hold pictures."""
    place = 0
    while place + 8 <= size:
        file.seek(place)
        head = file.read(16)
        length = int.from_bytes(head[:4], "big")
        if length == 1:
            length = int.from_bytes(head[8:16], "big")
        if length < 8:
            return
        place += length
        if head[4:8] in (b"mdat", b"moof"):
            yield place


def _segment_end(head: bytes) -> int:
    """Where the segment of a Matroska file ends; 0 where it does not say."""
    place = 0
    while place < len(head):
        identifier, place = _variable(head, place, keep_marker=True)
        length, place = _variable(head, place, keep_marker=False)
        if identifier == 0x18538067:
            return 0 if length < 0 else place + length
        if length < 0:
            return 0
        place += length
    return 0


def _variable(head: bytes, place: int, *, keep_marker: bool) -> tuple[int, int]:
    """An integer of variable length (EBML), and the place behind it; -1 for "not known"."""
    if place >= len(head) or head[place] == 0:
        return -1, len(head)
    width = 9 - head[place].bit_length()
    value = int.from_bytes(head[place : place + width], "big")
    unmarked = value & ((1 << 7 * width) - 1)
    if keep_marker:
        return value, place + width
    return (-1 if unmarked == (1 << 7 * width) - 1 else unmarked), place + width
