"""The one truth on a video: what is decoded, at its presentation time, numbered in that order.

All that is said of a video's frames comes from here, or from packets where these are shown to tell
the same. A frame that is lost to damage keeps its number and its time, so that those after it
keep theirs.
"""

from __future__ import annotations

import heapq
import statistics
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import av
from av.codec.context import Flags

from sightline.tally import Tally
from sightline.video.containers import has_times
from sightline.video.sources import BreakError, Source

# A step back by less is a time that is wrong, one by more a clock that starts anew.
_DISORDER_S = 0.25
# A step ahead by more, and by more than so many intervals, is a pause or a clock that was set.
_PAUSE_S = 10.0
_PAUSE_INTERVALS = 50.0
# How far from a whole number of intervals a gap may be that lost frames explain.
_WHOLE = 0.2
_REMEMBERED = 31
_FEW_STEPS = 8
# By how much a video must end before its container says for its end to be lost.
_LATE_S = 1.0
_LATE_SHARE = 0.05
# Decoders hold pictures back by at most so many packets to show them in order.
_MOST_REORDERED = 16
# Of these one packet is one picture, so that a packet without one is a lost picture. Others have
# packets that only tell later ones something (VP8), or that repeat the picture (MPEG-4 part 2).
ONE_PICTURE_A_PACKET = ("h264", "hevc", "vvc", "av1", "libdav1d", "mjpeg", "ffv1", "prores")
# Formats in which lost bytes take whole packets with them.
_TRANSPORT = ("mpegts", "mpeg", "rtsp", "rtp", "flv", "matroska,webm")


@dataclass(frozen=True)
class Decoded:
    """One frame of a video; they are numbered as they come.

    Attributes:
        seconds: Presentation time after that of the first; never less than the one before, NaN
            where the video tells none.
        picture: What was decoded, None for a frame that is lost to damage.
    """

    seconds: float
    picture: av.VideoFrame | None


class Timeline:
    """Presentation times that begin at zero and never go back, whatever a video's clock does."""

    def __init__(self) -> None:
        self._origin_s: float | None = None
        self._offset_s = 0.0
        self._last_s = 0.0
        self._segment = 0
        self._intervals: deque[float] = deque(maxlen=_REMEMBERED)
        self._frames = 0
        self._restarts: list[int] = []
        self._pauses: list[tuple[int, float]] = []
        self._disordered: list[int] = []
        self._wrong: list[int] = []

    def interval_s(self) -> float:
        """The usual time from one frame to the next; 0 where that is not known yet."""
        return statistics.median(self._intervals) if self._intervals else 0.0

    def ahead_s(self, segment: int, raw_s: float) -> float:
        """How much later than the last frame a time is; 0 where the clock started anew."""
        if self._origin_s is None or segment != self._segment:
            return 0.0
        return raw_s - self._origin_s + self._offset_s - self._last_s

    def is_regular(self) -> bool:
        """Whether nearly all frames came at the usual interval."""
        usual_s = self.interval_s()
        near = sum(abs(step_s - usual_s) <= _WHOLE * usual_s for step_s in self._intervals)
        return near >= 0.9 * len(self._intervals) and len(self._intervals) >= _FEW_STEPS

    def breaks_at(self, segment: int) -> bool:
        """Whether the clock does not simply go on with a frame."""
        return self._origin_s is not None and segment != self._segment

    def goes_on_with(self, raw_s: float) -> bool:
        """Whether a time follows that of the last frame, as if nothing had been."""
        if self._origin_s is None:
            return False
        step_s = raw_s - self._origin_s + self._offset_s - self._last_s
        return 0.0 < step_s <= longest_step_s(self.interval_s())

    def place(self, segment: int, raw_s: float) -> float:
        """The time of the next frame.

        Args:
            segment: How often the clock of the packets had started anew.
            raw_s: What the video says.
        """
        if self._origin_s is None:
            self._origin_s, self._segment = raw_s, segment
        seconds = raw_s - self._origin_s + self._offset_s
        step_s, interval_s = seconds - self._last_s, self.interval_s()
        longest_s = longest_step_s(interval_s)
        if segment != self._segment:
            self._segment = segment
            if step_s > longest_s:
                self._pauses.append((self._frames, step_s))
            elif step_s <= 0.0:
                self._restarts.append(self._frames)
                self._offset_s += interval_s - step_s
                seconds = self._last_s + interval_s
        elif step_s < 0.0 or (step_s == 0.0 and self._frames):
            self._disordered.append(self._frames)
            seconds = self._last_s
        elif step_s > longest_s and self._frames:
            self._pauses.append((self._frames, step_s))
        elif self._frames:
            self._intervals.append(step_s)
        self._frames += 1
        self._last_s = seconds
        return seconds

    def after_last(self, *, wrong: bool = False) -> float:
        """The time of a frame of which the video tells none, or a wrong one."""
        if wrong:
            self._wrong.append(self._frames)
        self._frames += 1
        self._last_s += self.interval_s()
        return self._last_s

    def note_in(self, tally: Tally) -> None:
        """Say what was bridged."""
        if self._restarts:
            tally.note(
                f"its clock starts anew at {_places(self._restarts)}; the times go on one usual "
                "interval later, so how long the pause was is not known: a clock (frame,utc) "
                "would tell"
            )
        if self._pauses:
            first, longest_s = self._pauses[0][0], max(step_s for _, step_s in self._pauses)
            more = f" and {len(self._pauses) - 1} more" if len(self._pauses) > 1 else ""
            tally.note(
                f"its clock jumps ahead at frame {first}{more}, by up to {longest_s:.1f} s; that "
                "is taken for a pause: a clock (frame,utc) would tell"
            )
        if self._wrong:
            tally.note(
                f"the times of {len(self._wrong)} frames cannot be true (the first is frame "
                f"{self._wrong[0]}); they are taken one usual interval after those before"
            )
        if self._disordered:
            tally.note(
                f"the times of {len(self._disordered)} frames are not later than those before "
                f"(the first is frame {self._disordered[0]}); they are taken at the same time"
            )


def longest_step_s(interval_s: float) -> float:
    """The longest step ahead that is no pause, of a video with a usual interval."""
    return max(_PAUSE_S, _PAUSE_INTERVALS * interval_s)


def _places(frames: list[int]) -> str:
    more = f" and {len(frames) - 1} more" if len(frames) > 1 else ""
    return f"frame {frames[0]}{more}"


@dataclass(frozen=True, order=True)
class Key:
    """Where the picture of a packet stands in the order of showing.

    Attributes:
        segment: How often the clock of the packets had started anew.
        ticks: Its time, in units of the stream.
    """

    segment: int
    ticks: int


class PacketClock:
    """What packets say on the times of their pictures.

    Attributes:
        timed: Whether they say anything.
        by_decoding: Whether only times of decoding are stored (AVI): pictures are then shown at
            these times in their order.
        segment: How often the clock has started anew.
    """

    def __init__(self, container: av.container.InputContainer) -> None:
        self.timed = has_times(container)
        self.by_decoding = self.timed and container.format.name == "avi"
        self.segment = 0
        self._decoded_s: float | None = None
        self._steps_s: deque[float] = deque(maxlen=_REMEMBERED)
        self._first: Key | None = None

    def key(self, packet: av.Packet[av.VideoStream]) -> Key | None:
        """Of a packet; None where its picture is not among those shown, or has no time.

        Pictures before the first key picture, and those that lean on one before it, are not.
        """
        if self._first is None:
            # As in Matroska files made from AVI.
            self.by_decoding |= self.timed and packet.pts is None and packet.dts is not None
        if packet.dts is not None and self.timed:
            self._step_to(float(packet.dts * packet.time_base))
        ticks = packet.dts if self.by_decoding else packet.pts
        if not self.timed:
            ticks = 0
        if ticks is None or (self._first is None and not packet.is_keyframe):
            return None
        key = Key(self.segment, ticks)
        self._first = self._first or key
        return None if packet.is_discard or key < self._first else key

    def _step_to(self, decoded_s: float) -> None:
        """Notice a clock that starts anew, or jumps, by the times of decoding: they only grow."""
        if self._decoded_s is not None:
            step_s = decoded_s - self._decoded_s
            # Before it is known what is usual, a long step is no jump.
            known = len(self._steps_s) >= _FEW_STEPS
            usual_s = statistics.median(self._steps_s) if known else float("inf")
            if step_s < -_DISORDER_S or step_s > longest_step_s(usual_s):
                self.segment += 1
            else:
                self._steps_s.append(step_s)
        self._decoded_s = decoded_s


class Decoder:
    """Decodes the frames of a video one at a time, and counts what is lost.

    Attributes:
        timeline: The times of the frames so far.
    """

    def __init__(self, source: Source) -> None:
        container, stream = source.container, source.stream
        self.timeline = Timeline()
        self._source, self._stream = source, stream
        self._clock = PacketClock(container)
        self._tick_s = float(stream.time_base or 0)
        self._transport = container.format.name in _TRANSPORT
        self._one_a_packet = stream.codec_context.name in ONE_PICTURE_A_PACKET
        # Asked before decoding: while threads decode it is true by chance.
        self._in_order = not stream.codec_context.has_b_frames
        self._latest = -1
        self._waiting: dict[int, Key] = {}
        self._slots: list[Key] = []
        self._damage = 0
        self._damaged_at = -_MOST_REORDERED
        self._sent_count = 0
        self._held: tuple[Key, av.VideoFrame | None] | None = None
        self._shown, self._shown_s = 0, 0.0
        self._lost: list[int] = []
        # Each picture says of which packet it is.
        stream.codec_context.flags |= Flags.copy_opaque

    def __iter__(self) -> Iterator[Decoded]:
        """The frames in the order of showing.

        Raises:
            BreakError: The source cannot be read further; its last frames have been yielded.
        """
        broken: BreakError | None = None
        sent = self._sent()
        while broken is None:
            try:
                pictures = next(sent, None)
            except BreakError as error:
                broken, pictures = error, self._drained()
            if pictures is None:
                break
            for picture in pictures:
                yield from self._frames(picture)
        yield from self._left()
        if broken is None and self._ends_early():
            broken = BreakError("its end cannot be decoded")
        if broken is not None:
            raise broken

    def _ends_early(self) -> bool:
        """Whether all that the container announces after a damaged place is lost."""
        container = self._source.container
        damaged = bool(self._lost) or self._damage > 0
        if self._source.live or not damaged or container.duration is None:
            return False
        duration_s = container.duration / av.time_base
        missing_s = duration_s - self._shown_s - self.timeline.interval_s()
        near_the_end = self._damaged_at >= self._sent_count - _MOST_REORDERED
        trailing = bool(self._lost) and self._lost[-1] == self.frames - 1
        return (near_the_end or trailing) and missing_s > max(_LATE_S, _LATE_SHARE * duration_s)

    @property
    def frames(self) -> int:
        """How many frames there were, lost ones as well."""
        return self._shown + len(self._lost)

    def report_in(self, tally: Tally) -> None:
        """Say how many frames were decoded and lost, and what was bridged."""
        tally.count("frames", self._shown)
        if self._lost:
            tally.leave_out("damaged frames", len(self._lost), row=f"frame {self._lost[0]}")
        self.timeline.note_in(tally)

    def _sent(self) -> Iterator[list[av.VideoFrame]]:
        for ordinal, packet in enumerate(self._source.packets()):
            if packet.size:
                self._sent_count = ordinal
                # The library tells objects from each other by their place in memory, in which
                # equal numbers may be one.
                packet.opaque = [ordinal]
                key = self._clock.key(packet)
                if key is not None:
                    self._waiting[ordinal] = key
                    if self._clock.by_decoding:
                        heapq.heappush(self._slots, key)
                # What comes before the first key picture is not damaged, only not ours.
                self._note_damage(ordinal, packet.is_corrupt)
            try:
                pictures: list[av.VideoFrame] = packet.decode()
            except av.FFmpegError:
                self._note_damage(ordinal, True)
                pictures = []
            yield pictures

    def _note_damage(self, ordinal: int, damaged: bool) -> None:
        if damaged and self._waiting:
            self._damage += 1
            self._damaged_at = ordinal

    def _drained(self) -> list[av.VideoFrame]:
        try:
            drained: list[av.VideoFrame] = self._stream.codec_context.decode(None)
        except av.FFmpegError:
            return []
        return drained

    def _frames(self, picture: av.VideoFrame) -> Iterator[Decoded]:
        """A picture behind the frames before it that are lost."""
        self._one_a_packet &= not picture.interlaced_frame
        ordinal = self._ordinal(picture)
        self._in_order &= ordinal > self._latest or ordinal < 0
        self._latest = max(self._latest, ordinal)
        own = self._waiting.pop(ordinal, None)
        key = own
        if not self._clock.by_decoding and picture.pts is not None:
            segment = own.segment if own is not None else self._clock.segment
            key = Key(segment, picture.pts)
        yield from self._lost_before(ordinal, key)
        if self._clock.by_decoding and self._slots:
            key = heapq.heappop(self._slots)
        yield from self._placed(key, None if picture.is_corrupt else picture)

    def _placed(self, key: Key | None, picture: av.VideoFrame | None) -> Iterator[Decoded]:
        """A frame with its time; where the clock breaks, after a look at the next frame's."""
        held, self._held = self._held, None
        timed = key is not None and self._clock.timed
        goes_on = key is not None and self.timeline.goes_on_with(key.ticks * self._tick_s)
        if held is not None:
            wrong = timed and goes_on
            seconds = self.timeline.after_last(wrong=True) if wrong else self._seconds(held[0])
            yield self._frame(seconds, held[1])
        if key is not None and timed and not goes_on and self.timeline.breaks_at(key.segment):
            self._held = key, picture
        else:
            yield self._frame(self._seconds(key), picture)

    def _frame(self, seconds: float, picture: av.VideoFrame | None) -> Decoded:
        if picture is None:
            self._lost.append(self.frames)
        else:
            self._shown += 1
            self._shown_s = seconds
        return Decoded(seconds, picture)

    def _ordinal(self, picture: av.VideoFrame) -> int:
        """Of a picture's packet; -1 where it is not known."""
        if isinstance(picture.opaque, list):
            return int(picture.opaque[0])
        # Of decoders that do not hand on what a packet carries.
        same = (o for o, key in self._waiting.items() if key.ticks == picture.pts)
        return next(same, -1)

    def _seconds(self, key: Key | None) -> float:
        if not self._clock.timed:
            return float("nan")
        if key is None:
            return self.timeline.after_last()
        return self.timeline.place(key.segment, key.ticks * self._tick_s)

    def _lost_before(self, ordinal: int, key: Key | None) -> Iterator[Decoded]:
        gone = [o for o in self._waiting if self._is_lost(o, ordinal, key)]
        lost = [self._waiting.pop(o) for o in gone]
        if self._clock.by_decoding:
            lost = [self._taken_slot(one) for one in lost]
        lost = lost if self._one_a_packet else lost[: self._damage]
        self._damage = 0
        # A transport stream marks the packet before those that are missing, or that behind them.
        near = bool(lost) or ordinal <= self._damaged_at + _MOST_REORDERED
        missing = self._missing(key) if near and self._transport else 0
        if key is not None and missing > len(lost):
            now_s = key.ticks * self._tick_s
            step_s = self.timeline.ahead_s(key.segment, now_s) / (missing + 1)
            for number in range(missing, 0, -1):
                yield self._frame(self.timeline.place(key.segment, now_s - number * step_s), None)
            return
        for one in sorted(lost):
            yield from self._placed(one, None)

    def _taken_slot(self, own: Key) -> Key:
        """The time of a lost frame: its own, or the next if another frame was given that."""
        if own not in self._slots:
            return heapq.heappop(self._slots) if self._slots else own
        self._slots.remove(own)
        heapq.heapify(self._slots)
        return own

    def _is_lost(self, other: int, ordinal: int, key: Key | None) -> bool:
        """Whether the picture of another packet can no longer come, since that of this has."""
        if self._clock.timed and not self._clock.by_decoding:
            return key is not None and self._waiting[other] < key
        # Where nothing tells the order of showing: none is held back for so long.
        return other < ordinal - (0 if self._in_order else _MOST_REORDERED)

    def _missing(self, key: Key | None) -> int:
        """How many frames the time since the last one has room for."""
        interval_s = self.timeline.interval_s()
        if key is None or not self.timeline.is_regular() or self._held is not None:
            return 0
        ahead_s = self.timeline.ahead_s(key.segment, key.ticks * self._tick_s)
        intervals = ahead_s / interval_s
        if ahead_s > _PAUSE_S or abs(intervals - round(intervals)) > _WHOLE:
            return 0
        return round(intervals) - 1

    def _left(self) -> Iterator[Decoded]:
        """The frames at the end that never came."""
        lost = sorted(self._waiting.values())
        for one in lost if self._one_a_packet else lost[: self._damage]:
            yield from self._placed(one, None)
        self._waiting.clear()
        if self._held is not None:
            key, picture = self._held
            self._held = None
            yield self._frame(self._seconds(key), picture)
