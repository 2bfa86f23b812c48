"""Frames and their times into an mp4 file."""

from __future__ import annotations

import os
from collections.abc import Iterable
from datetime import UTC, datetime
from fractions import Fraction

import av
import numpy as np

from sightline.atomic import atomic_path
from sightline.errors import InputError
from sightline.types import Frame
from sightline.video.sound import Sound

# Each codec with the finest time base that it takes: MPEG-4 part 2 has 16 bits for it.
_CODECS = {"libx264": Fraction(1, 1_000_000), "mpeg4": Fraction(1, 60_000)}


def write_video(
    path: str | os.PathLike[str],
    frames: Iterable[Frame],
    *,
    bits_per_second: int = 4_000_000,
    preset: str = "veryfast",
    sound: Sound | None = None,
    comment: str = "",
) -> int:
    """Write frames with the times at which they were taken, whatever their spacing.

    Frames are taken one at a time, so memory does not grow with their number. H.264 where the
    installed FFmpeg can encode it (times exact to a microsecond), else MPEG-4 part 2 (to 9 µs).
    The first frame is at zero; its UTC time becomes the file's creation time, which the format
    keeps in whole seconds only.

    Args:
        path: The file, ending in ``.mp4``.
        frames: In the order of time, all of one size, even in width and height.
        bits_per_second: Mean rate to aim for.
        preset: How long H.264 may search for a better picture at that rate, one of x264's names,
            ``"ultrafast"`` to ``"veryslow"``.
        sound: Copied beside the pictures, as long as these last.
        comment: Of the file; players show it.

    Returns:
        The number of frames written.

    Raises:
        InputError: There is no frame, a time is not known or does not increase, sizes differ, or
            the file cannot be written.
    """
    codec = next(name for name in _CODECS if name in av.codecs_available)
    time_base = _CODECS[codec]
    count = 0
    start_s = last_s = np.nan
    shape: tuple[int, ...] = ()
    stream: av.VideoStream | None = None
    # Without the prefix a name with a colon is taken for an address.
    with (
        atomic_path(path) as temporary,
        av.open(f"file:{temporary}", "w", format="mp4") as container,
    ):
        for frame in frames:
            if not np.isfinite(frame.time_utc_s):
                raise InputError(f"{path}: frame {frame.index} has no time, so it has no place")
            if stream is None:
                start_s, shape = frame.time_utc_s, frame.image_bgr.shape
                if shape[0] % 2 or shape[1] % 2:
                    raise InputError(
                        f"{path}: frames of {shape[1]} x {shape[0]} px cannot be encoded; "
                        "width and height must be even"
                    )
                stream = _add_stream(container, codec, shape, bits_per_second, preset)
                container.metadata["creation_time"] = datetime.fromtimestamp(start_s, UTC).strftime(
                    "%Y-%m-%dT%H:%M:%S.%fZ"
                )
                container.metadata["comment"] = comment
                if sound is not None:
                    sound.begin(container)
            elif frame.time_utc_s - last_s < float(time_base):
                raise InputError(
                    f"{path}: frame {frame.index} is not later than the frame before it; "
                    "the times of a video must increase"
                )
            elif frame.image_bgr.shape != shape:
                raise InputError(
                    f"{path}: frame {frame.index} has the shape {frame.image_bgr.shape}, "
                    f"the frames before it {shape}"
                )
            picture = av.VideoFrame.from_ndarray(frame.image_bgr, format="bgr24")
            picture.time_base = time_base
            picture.pts = round((frame.time_utc_s - start_s) / time_base)
            container.mux(stream.encode(picture))
            if sound is not None:
                sound.until(frame.time_utc_s - start_s)
            last_s = frame.time_utc_s
            count += 1
        if stream is None:
            raise InputError(f"{path}: there is no frame to write")
        container.mux(stream.encode(None))
    return count


def _add_stream(
    container: av.container.OutputContainer,
    codec: str,
    shape: tuple[int, ...],
    bits_per_second: int,
    preset: str,
) -> av.VideoStream:
    stream = container.add_stream(codec, rate=25)
    assert isinstance(stream, av.VideoStream)
    stream.height, stream.width = shape[:2]
    stream.pix_fmt = "yuv420p"
    stream.bit_rate = bits_per_second
    if codec == "libx264":
        stream.options = {"preset": preset}
    stream.time_base = stream.codec_context.time_base = _CODECS[codec]
    return stream
