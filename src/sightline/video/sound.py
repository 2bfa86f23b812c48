"""The sound of a video, copied beside new pictures without being decoded."""

from __future__ import annotations

import os
from collections.abc import Iterator
from types import TracebackType

import av

from sightline.errors import InputError
from sightline.tally import Tally
from sightline.video.containers import open_container

# What players expect in an mp4 file; its format can hold more, which hardly any plays.
_KEPT = ("aac", "mp3", "ac3", "eac3", "opus", "alac")


class Sound:
    """The first sound of a video file, from its first picture on.

    Packets are handed to the new file as its pictures reach their times, so that players find the
    two side by side.
    """

    def __init__(self, path: str | os.PathLike[str], tally: Tally) -> None:
        """Take the file.

        Args:
            path: The video whose sound it is.
            tally: Told where there is a sound that cannot be kept.
        """
        self._path, self._tally = os.fspath(path), tally
        self._input: av.container.InputContainer | None = None
        self._output: av.container.OutputContainer | None = None
        self._packets: Iterator[tuple[float, av.Packet[av.AudioStream]]] = iter(())
        self._next: tuple[float, av.Packet[av.AudioStream]] | None = None
        self.kept = False

    def __enter__(self) -> Sound:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._input is not None:
            self._input.close()

    def begin(self, output: av.container.OutputContainer) -> None:
        """Add the sound to a file to which nothing was written yet, where there is one."""
        try:
            self._input = open_container(self._path)
            if not self._input.streams.audio:
                return
            own = self._input.streams.audio[0]
            codec = own.codec_context.codec.canonical_name
            if codec not in _KEPT:
                self._tally.note(
                    f"its sound ({codec}) is left out, since an mp4 file holds {', '.join(_KEPT)}"
                )
                return
            pictures = self._input.streams.video[0]
            first_s = float((pictures.start_time or 0) * (pictures.time_base or 0))
            copy = output.add_stream_from_template(own)
        except (InputError, av.FFmpegError, ValueError, IndexError) as error:
            self._tally.note(f"its sound is left out ({error})")
            return
        self._output, self.kept = output, True
        self._packets = self._from(own, copy, first_s)
        self._next = next(self._packets, None)

    def until(self, seconds: float) -> None:
        """Write what is heard before a picture; its time is after the first."""
        while self._next is not None and self._next[0] <= seconds:
            assert self._output is not None, "there is a packet for it"
            try:
                self._output.mux(self._next[1])
            except av.FFmpegError as error:
                self._tally.note(f"its sound ends after {self._next[0]:.1f} s ({error})")
                self._next = None
                return
            self._next = next(self._packets, None)

    def _from(
        self, own: av.AudioStream, copy: av.AudioStream, first_s: float
    ) -> Iterator[tuple[float, av.Packet[av.AudioStream]]]:
        assert self._input is not None, "it has the stream"
        try:
            for packet in self._input.demux(own):
                if packet.dts is None or packet.pts is None or packet.time_base is None:
                    continue
                shift = round(first_s / packet.time_base)
                packet.pts, packet.dts = packet.pts - shift, packet.dts - shift
                if packet.dts < 0:
                    continue
                packet.stream = copy
                yield float(packet.pts * packet.time_base), packet
        except av.FFmpegError as error:
            self._tally.note(f"its sound breaks off ({error})")
