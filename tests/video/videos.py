"""Small videos of known pictures and times, and the reading of a picture's number."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

TICK = Fraction(1, 1000)
SIZE_PX = (64, 48)


def picture(number: int, size_px: tuple[int, int] = SIZE_PX) -> np.ndarray:
    """Eight columns, dark or bright, which are the bits of the number."""
    bits = np.array([number >> bit & 1 for bit in range(8)])
    row = np.repeat(np.where(bits, 210, 40), size_px[0] // 8)
    return np.tile(row[None, :, None], (size_px[1], 1, 3)).astype(np.uint8)


def number_of(image: np.ndarray) -> int:
    """Of a picture."""
    width = image.shape[1] // 8
    bright = [image[:, bit * width + 2 : (bit + 1) * width - 2].mean() > 125 for bit in range(8)]
    return sum(1 << bit for bit, is_bright in enumerate(bright) if is_bright)


def write(
    path: Path,
    times_ms: Sequence[int],
    codec: str = "libx264",
    *,
    size_px: tuple[int, int] = SIZE_PX,
    first: int = 0,
    b_frames: int = 0,
    gop: int = 10,
    tick: Fraction = TICK,
    container_format: str | None = None,
    options: dict[str, str] | None = None,
    prepare: Callable[[av.VideoStream], None] = lambda _stream: None,
    pix_fmt: str = "yuv420p",
    images: Iterable[np.ndarray] | None = None,
    image_format: str = "bgr24",
    metadata: dict[str, str] | None = None,
) -> Path:
    """Write pictures with the numbers from ``first`` on at presentation times."""
    images = images or [picture(first + index, size_px) for index in range(len(times_ms))]
    with av.open(str(path), "w", format=container_format, options=options or {}) as container:
        container.metadata.update(metadata or {})
        stream = container.add_stream(
            codec, rate=round(1 / tick) if tick > Fraction(1, 100) else 25
        )
        stream.width, stream.height, stream.pix_fmt = *size_px, pix_fmt
        stream.time_base = stream.codec_context.time_base = tick
        stream.codec_context.gop_size = gop
        if b_frames:
            stream.codec_context.max_b_frames = b_frames
        if codec == "libx264":
            stream.options = {
                "preset": "ultrafast",
                "bf": str(b_frames),
                "b-pyramid": "normal",
                "sc_threshold": "0",
                "x264-params": f"keyint={gop}:min-keyint={gop}",
            }
        prepare(stream)
        for time_ms, image in zip(times_ms, images, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format=image_format)
            frame.time_base, frame.pts = tick, round(time_ms * TICK / tick)
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode(None):
            container.mux(packet)
    return path


def packet_places(path: Path) -> list[tuple[int, int]]:
    """Where each packet's data begin in a file, and how long they are, in the order of the file."""
    data = path.read_bytes()
    places = []
    with av.open(str(path)) as container:
        for packet in container.demux(container.streams.video[0]):
            if packet.size:
                begun = data.find(bytes(packet), packet.pos)
                # Transport streams cut packets into pieces.
                places.append((packet.pos if begun < 0 else begun, packet.size))
    return places


def overwrite(path: Path, place: int, size: int) -> None:
    """Put zeros over a part of a file."""
    data = bytearray(path.read_bytes())
    data[place : place + size] = bytes(size)
    path.write_bytes(data)
