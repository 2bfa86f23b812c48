"""The one truth on a video: what is decoded, at its presentation time, numbered in that order.

All that is said of a video's frames comes from here, or from packets where these are shown to tell
the same. A frame that is lost to damage keeps its number and its time, so that those after it
keep theirs.
"""

from __future__ import annotations

import heapq
import math
import statistics
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

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
# And by one more for each thread.
_MOST_THREADS = 16
# By so many of the next frames the time of one is judged.
_LOOKED_AHEAD = 3
# So many frames without a time are kept until one comes that has one.
_MOST_UNTOLD = 32
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
        self._untold: list[int] = []
        self._timeless: list[int] = []
        self._since = 0

    @property
    def begun(self) -> bool:
        """Whether a frame had a time."""
        return self._origin_s is not None

    def interval_s(self) -> float:
        """The usual time from one frame to the next; 0 where that is not known yet."""
        return statistics.median(self._intervals) if self._intervals else 0.0

    def ahead_s(self, raw_s: float) -> float:
        """How much later than the last frame a time is; 0 where there is no last frame."""
        if self._origin_s is None:
            return 0.0
        return raw_s - self._origin_s + self._offset_s - self._last_s

    def is_regular(self) -> bool:
        """Whether nearly all frames came at the usual interval."""
        usual_s = self.interval_s()
        near = sum(abs(step_s - usual_s) <= _WHOLE * usual_s for step_s in self._intervals)
        return near >= 0.9 * len(self._intervals) and len(self._intervals) >= _FEW_STEPS

    def is_wrong(self, raw_s: float, next_s: Sequence[float]) -> bool:
        """Whether a time cannot be true, since most of the next go on as if it were not there.

        Args:
            raw_s: What the video says of the next frame.
            next_s: What it says of the few frames behind that.
        """
        if self._origin_s is None or not next_s:
            return False
        step_s, longest_s = self.ahead_s(raw_s), longest_step_s(self.interval_s())
        steps_s = [self.ahead_s(one_s) for one_s in next_s]
        if 0.0 < step_s <= longest_s:
            return len(steps_s) > 1 and _most(0.0 < one_s < step_s for one_s in steps_s)
        if -_DISORDER_S <= step_s <= 0.0:
            return False
        goes_on = _most(0.0 < one_s <= longest_s for one_s in steps_s)
        anew = _most(0.0 < one_s - step_s <= longest_s for one_s in steps_s)
        return goes_on or (step_s < 0.0 and not anew)

    def place(self, raw_s: float, next_s: Sequence[float] = ()) -> float:
        """The time of the next frame.

        Args:
            raw_s: What the video says.
            next_s: What it says of the few frames behind that.
        """
        if self._origin_s is None:
            self._origin_s = raw_s
        elif self.is_wrong(raw_s, next_s):
            self._wrong.append(self._frames)
            later_s = [step_s for one_s in next_s if (step_s := self.ahead_s(one_s)) > 0.0]
            return self.after_last(min(later_s, default=math.inf) / 2.0)
        seconds = raw_s - self._origin_s + self._offset_s
        step_s, interval_s = seconds - self._last_s, self.interval_s()
        if step_s < -_DISORDER_S:
            self._restarts.append(self._frames)
            self._offset_s += interval_s - step_s
            seconds = self._last_s + interval_s
        elif step_s <= 0.0 and self._frames:
            self._disordered.append(self._frames)
            seconds = self._last_s
        elif step_s > longest_step_s(interval_s) and self._frames:
            self._pauses.append((self._frames, step_s))
        elif self._frames:
            self._intervals.append(step_s / (self._since + 1))
        self._frames += 1
        self._since = 0
        self._last_s = seconds
        return seconds

    def between(self, raw_s: float) -> float:
        """The time of a frame of which the video tells none, as those around it have it.

        Args:
            raw_s: What the video would say.
        """
        self._untold.append(self._frames)
        return self.place(raw_s)

    def untold(self) -> float:
        """The time of a frame of which the video tells none; NaN where no interval is known."""
        (self._untold if self._intervals else self._timeless).append(self._frames)
        if self._intervals:
            return self.after_last()
        self._frames += 1
        self._since += 1
        return math.nan

    def after_last(self, most_s: float = math.inf) -> float:
        """The time of a frame of which the video tells none, or a wrong one.

        Args:
            most_s: It is no later than so long after the last.
        """
        self._frames += 1
        self._last_s += min(self.interval_s(), most_s)
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
        if self._untold:
            tally.note(
                f"{len(self._untold)} frames have no time (the first is frame {self._untold[0]}); "
                "they are taken at even intervals between those that have one"
            )
        if self._timeless:
            tally.note(
                f"{len(self._timeless)} frames have no time, nor have enough beside them (the "
                f"first is frame {self._timeless[0]}); a clock (frame,utc) would tell"
            )
        if self._wrong:
            tally.note(
                f"the times of {len(self._wrong)} frames cannot be true (the first is frame "
                f"{self._wrong[0]}); they are taken at most one usual interval after those before"
            )
        if self._disordered:
            tally.note(
                f"the times of {len(self._disordered)} frames are not later than those before "
                f"(the first is frame {self._disordered[0]}); they are taken at the same time"
            )


def longest_step_s(interval_s: float) -> float:
    """The longest step ahead that is no pause, of a video with a usual interval."""
    return max(_PAUSE_S, _PAUSE_INTERVALS * interval_s)


def _most(those: Iterable[bool]) -> bool:
    """Whether more are true than not."""
    known = list(those)
    return 2 * sum(known) > len(known)


def _places(frames: list[int]) -> str:
    more = f" and {len(frames) - 1} more" if len(frames) > 1 else ""
    return f"frame {frames[0]}{more}"


class Key(NamedTuple):
    """Where the picture of a packet stands in the order of showing.

    Attributes:
        segment: How often the clock of the packets had started anew.
        ticks: Its time, in units of the stream.
    """

    segment: int
    ticks: int


_NO_KEY = Key(0, 0)


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
        """Notice a clock that starts anew by the times of decoding: they only grow.

        One that jumps ahead keeps the order. Pictures from before the jump may be decoded behind
        it, so that it parts nothing.
        """
        if self._decoded_s is not None and decoded_s - self._decoded_s < -_DISORDER_S:
            self.segment += 1
        self._decoded_s = decoded_s


@dataclass(frozen=True, eq=False)
class _Picture:
    """A picture that has come, and the packets whose pictures should have come before it."""

    picture: av.VideoFrame
    key: Key | None
    ordinal: int
    before: Sequence[int]


@dataclass(frozen=True)
class _Place:
    """A frame at its place, behind others that are lost.

    Attributes:
        key: When it is shown.
        picture: None for a frame that is lost.
        lost: When those before it would have been shown, in order.
        room: Whether more may be missing than there are packets of.
    """

    key: Key | None
    picture: av.VideoFrame | None
    lost: Sequence[Key] = ()
    room: bool = False


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
        self._came: deque[_Picture] = deque()
        self._next: deque[_Place] = deque()
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
                self._take(picture)
            self._line_up()
            yield from self._placed(0 if self._source.live else _LOOKED_AHEAD)
        self._line_up(ended=True)
        yield from self._placed(0)
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

    def _take(self, picture: av.VideoFrame) -> None:
        """Keep a picture until it is known which of the frames before it are lost."""
        self._one_a_packet &= not picture.interlaced_frame
        ordinal = self._ordinal(picture)
        self._in_order &= ordinal > self._latest or ordinal < 0
        self._latest = max(self._latest, ordinal)
        own = self._waiting.pop(ordinal, None)
        key = own
        if not self._clock.by_decoding and picture.pts is not None:
            segment = own.segment if own is not None else self._clock.segment
            key = Key(segment, picture.pts)
        before = [o for o in self._waiting if self._is_lost(o, ordinal, key)]
        if not self._one_a_packet:
            before = before[: self._damage]
        self._damage = 0
        self._came.append(_Picture(picture, key, ordinal, before))

    def _line_up(self, *, ended: bool = False) -> None:
        """Give pictures their places, behind the frames before them that are lost.

        That a picture has not come although a later one has, by the times of both, may be due to a
        time that is wrong. So it is waited for as long as it may still come.
        """
        while self._came and (ended or not any(map(self._may_come, self._came[0].before))):
            self._put_late_first()
            came = self._came.popleft()
            lost = [self._waiting.pop(o) for o in came.before if o in self._waiting]
            if self._clock.by_decoding:
                lost = [self._taken_slot(one) for one in lost]
            # A transport stream marks the packet before those that are missing, or that behind.
            near = bool(lost) or came.ordinal <= self._damaged_at + _MOST_REORDERED
            key = came.key
            if self._clock.by_decoding and self._slots:
                key = heapq.heappop(self._slots)
            picture = None if came.picture.is_corrupt else came.picture
            room = near and self._transport
            self._next.append(_Place(key, picture, tuple(sorted(lost)), room=room))
        if ended:
            lost = sorted(self._waiting.values())
            self._waiting.clear()
            lost = lost if self._one_a_packet else lost[: self._damage]
            self._next += [_Place(one, None) for one in lost]

    def _put_late_first(self) -> None:
        """Put pictures that decoders show too late, behind damage, before that which stands first.

        Where most of the pictures behind it are later than the first, its time is no wrong one.
        """
        first, *rest = self._came
        late = [one for one in rest if one.ordinal in first.before and self._is_before(one, first)]
        damaged = first.ordinal <= self._damaged_at + _MOST_REORDERED
        if late and damaged and not _most(self._is_before(one, first) for one in rest):
            late.sort(key=lambda one: one.key or _NO_KEY)
            self._came = deque([*late, first, *(one for one in rest if one not in late)])

    def _is_before(self, one: _Picture, other: _Picture) -> bool:
        return one.key is not None and other.key is not None and one.key < other.key

    def _may_come(self, ordinal: int) -> bool:
        """Whether the decoder may still show a picture that it has been given."""
        certain = self._source.live or not self._clock.timed or self._clock.by_decoding
        if certain or not self._one_a_packet or ordinal not in self._waiting:
            return False
        return self._sent_count <= ordinal + _MOST_REORDERED + _MOST_THREADS

    def _placed(self, behind: int) -> Iterator[Decoded]:
        """The frames behind which there are so many others, with their times."""
        while len(self._next) > behind:
            if self._clock.timed and self._next[0].key is None:
                told = self._between(waits=behind > 0)
                if told is None:
                    return
                yield from told
                continue
            place = self._next.popleft()
            next_s = [self._raw_s(one.key) for one in self._next if one.key is not None]
            next_s = next_s[:_LOOKED_AHEAD]
            missing = self._missing(place.key, next_s) if place.room else 0
            if place.key is not None and missing > len(place.lost):
                raw_s = self._raw_s(place.key)
                step_s = self.timeline.ahead_s(raw_s) / (missing + 1)
                for number in range(missing, 0, -1):
                    yield self._frame(self.timeline.place(raw_s - number * step_s), None)
            else:
                own_s = [] if place.key is None else [self._raw_s(place.key)]
                for one in place.lost:
                    yield self._frame(self._seconds(one, [*own_s, *next_s]), None)
            yield self._frame(self._seconds(place.key, next_s), place.picture)

    def _between(self, *, waits: bool) -> list[Decoded] | None:
        """The frames without a time that come first, evenly between those around them.

        Args:
            waits: Whether more frames will come. None is returned where they are waited for.
        """
        told = [index for index, place in enumerate(self._next) if place.key is not None]
        if len(told) < (1 if self.timeline.begun else 2):
            # That of an interval as well, where nothing came before.
            if waits and len(self._next) < _MOST_UNTOLD:
                return None
            count = told[0] if told else len(self._next)
            return [
                self._frame(self.timeline.untold(), self._next.popleft().picture)
                for _ in range(count)
            ]
        key = self._next[told[0]].key or _NO_KEY
        raw_s = self._raw_s(key)
        step_s = self.timeline.ahead_s(raw_s) / (told[0] + 1)
        if not self.timeline.begun:
            apart_s = self._raw_s(self._next[told[1]].key or key) - raw_s
            step_s = max(0.0, apart_s / (told[1] - told[0]))
        even = 0.0 < step_s <= _PAUSE_S / (told[0] + 1)
        out = []
        for number in range(told[0], 0, -1):
            seconds = (
                self.timeline.between(raw_s - number * step_s) if even else self.timeline.untold()
            )
            out.append(self._frame(seconds, self._next.popleft().picture))
        return out

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

    def _raw_s(self, key: Key) -> float:
        return key.ticks * self._tick_s

    def _seconds(self, key: Key | None, next_s: Sequence[float]) -> float:
        if not self._clock.timed or key is None:
            return float("nan")
        return self.timeline.place(self._raw_s(key), next_s)

    def _taken_slot(self, own: Key) -> Key:
        """The time of a lost frame: its own, or the next if another frame was given that."""
        if own not in self._slots:
            return heapq.heappop(self._slots) if self._slots else own
        self._slots.remove(own)
        heapq.heapify(self._slots)
        return own

    def _is_lost(self, other: int, ordinal: int, key: Key | None) -> bool:
        """Whether the picture of another packet should have come before this one."""
        if self._clock.timed and not self._clock.by_decoding:
            return key is not None and self._waiting[other] < key
        # Where nothing tells the order of showing: none is held back for so long.
        return other < ordinal - (0 if self._in_order else _MOST_REORDERED)

    def _missing(self, key: Key | None, next_s: Sequence[float]) -> int:
        """How many frames the time since the last one has room for."""
        interval_s = self.timeline.interval_s()
        if key is None or not self.timeline.is_regular():
            return 0
        raw_s = self._raw_s(key)
        ahead_s = self.timeline.ahead_s(raw_s)
        intervals = ahead_s / interval_s
        if not 0.0 < ahead_s <= _PAUSE_S or abs(intervals - round(intervals)) > _WHOLE:
            return 0
        return 0 if self.timeline.is_wrong(raw_s, next_s) else round(intervals) - 1
