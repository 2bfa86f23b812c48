"""What is seen in the first minute: boats a frame, which of them move, and which never do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from sightline.geodesy import LocalPlane
from sightline.logged_motion import under_way
from sightline.scene import Recording
from sightline.tracking import ImageTracker
from sightline.tracking.static_map import StaticMap, certainly_moves
from sightline.types import NO_TRACK, BoolArray, Boxes, FloatArray, Frame

LOOK_S = 60.0
"""So long is looked before it is said what is seen."""

NOTHING_MOVES = (
    "nothing that was found moves while the log does; if its vessel is in view, look with another "
    "detector (--detector), say where targets can be (area in the scene), or draw boxes "
    "(`sightline detector label`)"
)
"""What is to be done where all that is found stays in its place."""

MOSTLY = 0.8
"""Share of the time for which a log is under way, so that what stays is not its vessel."""

_PICTURES = 10
_FIRST_S = 1.0
_QUALITY = 92


@dataclass(frozen=True, eq=False)
class FirstLook:
    """Boxes of the first minute of a recording, judged by whether they move.

    Attributes:
        recording: Name of the recording.
        seconds: How long was looked.
        frames: Number of frames in that time.
        boxes: All of them.
        moving: (N,) bool, of targets that have certainly moved.
        moored: (N,) bool, of what stays in its place.
        log_goes: Whether the log is under way meanwhile; None where there is none, or there are
            many.
        pictures: Frames of that time by their numbers, as JPEG files.
    """

    recording: str
    seconds: float
    frames: int
    boxes: Boxes
    moving: BoolArray
    moored: BoolArray
    log_goes: bool | None
    pictures: dict[int, bytes]

    @property
    def nothing_moves(self) -> bool:
        """Whether the log moves, and nothing that was found does."""
        return self.log_goes is True and not self.moving.any()

    def per_frame(self, rows: BoolArray) -> float:
        """Mean number of boxes of a kind in a frame."""
        return float(rows.sum()) / max(self.frames, 1)

    @property
    def untold(self) -> BoolArray:
        """(N,) of what was seen for too short a time to tell."""
        return ~(self.moving | self.moored)

    def sentences(self) -> tuple[str, ...]:
        """What is seen, in a line, and where nothing moves, what to do, in another."""
        everything = np.ones(len(self.boxes), dtype=bool)
        seen = (
            f"recording {self.recording}, first {self.seconds:.0f} s: "
            f"{self.per_frame(everything):.1f} boats a frame, of which "
            f"{self.per_frame(self.moving):.1f} moving, {self.per_frame(self.moored):.1f} moored, "
            f"{self.per_frame(self.untold):.1f} not told yet"
        )
        if not self.nothing_moves:
            return (seen,)
        return (seen, f"recording {self.recording}: {NOTHING_MOVES}")

    def to_dict(self) -> dict[str, object]:
        """The look as JSON has it."""
        return {
            "recording": self.recording,
            "seconds": round(self.seconds, 3),
            "frames": self.frames,
            "boats_per_frame": self.per_frame(np.ones(len(self.boxes), dtype=bool)),
            "moving_per_frame": self.per_frame(self.moving),
            "moored_per_frame": self.per_frame(self.moored),
            "untold_per_frame": self.per_frame(self.untold),
            "log_moves": self.log_goes,
            "nothing_moves": self.nothing_moves,
        }


def first_look(
    recording: Recording,
    boxes: Boxes,
    times_utc_s: FloatArray,
    pictures: dict[int, bytes] | None = None,
) -> FirstLook:
    """Judge the boxes of the first minute.

    Args:
        recording: Whose they are.
        boxes: With their times; later ones are left out.
        times_utc_s: (F,) of the frames, also of those without a box.
        pictures: See `FirstLook`.
    """
    until_s = float(times_utc_s[0]) + LOOK_S if times_utc_s.size else np.inf
    boxes = boxes[boxes.time_utc_s <= until_s]
    boxes = boxes[np.argsort(boxes.time_utc_s, kind="stable")]
    times = times_utc_s[times_utc_s <= until_s]
    learned = StaticMap()
    learned.update(boxes)
    learned.finish()
    followed = boxes
    if len(boxes) and (boxes.track_id == NO_TRACK).all():
        cuts = np.flatnonzero(np.diff(boxes.time_utc_s) > 0.0) + 1
        ids = np.full(len(boxes), NO_TRACK, dtype=np.int64)
        tracker = ImageTracker()
        rows = boxes.with_columns(frame=np.arange(len(boxes)))
        for part in np.split(np.arange(len(boxes)), cuts):
            kept = tracker.update(rows[part])
            ids[kept.frame] = kept.track_id
        followed = boxes.with_columns(track_id=ids)
    moving, moored = np.zeros((2, len(boxes)), dtype=bool)
    alone = followed.track_id == NO_TRACK
    moored[alone] = learned.at(followed[alone]) >= 0
    for key in np.unique(followed.track_id[~alone]):
        rows_of = np.flatnonzero(followed.track_id == key)
        moored[rows_of] = learned.staying(followed[rows_of])
        moving[rows_of] = certainly_moves(followed[rows_of]) & ~moored[rows_of]
    return FirstLook(
        recording=recording.name,
        seconds=float(np.ptp(times)) if times.size else 0.0,
        frames=int(times.size),
        boxes=boxes,
        moving=moving,
        moored=moored,
        log_goes=_log_goes(recording, times),
        pictures=pictures or {},
    )


def log_goes(recording: Recording, plane: LocalPlane, times_utc_s: FloatArray) -> bool:
    """Whether all logs of a recording are under way for the most part of some times."""
    for log in recording.logs():
        fixes = log.fixes
        if not len(fixes):
            return False
        here = np.stack(plane.to_plane(fixes.latitude_deg, fixes.longitude_deg), axis=1)
        inside = (times_utc_s >= fixes.time_utc_s[0]) & (times_utc_s <= fixes.time_utc_s[-1])
        told = times_utc_s[inside]
        if not told.size or under_way(fixes.time_utc_s, here, told).mean() < MOSTLY:
            return False
    return True


def _log_goes(recording: Recording, times: FloatArray) -> bool | None:
    if recording.fixes_path is None or not times.size:
        return None
    logs = recording.logs()
    if len(logs) != 1 or not len(logs[0].fixes):
        return None
    fixes = logs[0].fixes
    plane = LocalPlane(float(fixes.latitude_deg[0]), float(fixes.longitude_deg[0]))
    return log_goes(recording, plane, times)


class FirstLooker:
    """Looks along while a detector goes through the first recording, and tells once.

    Attributes:
        look: What was seen; None before a minute has passed.
    """

    def __init__(self, tell: Callable[[FirstLook], None] | None = None) -> None:
        """Begin.

        Args:
            tell: Is given the look as soon as it is there.
        """
        self.look: FirstLook | None = None
        self._tell = tell
        self._recording: Recording | None = None
        self._boxes: list[Boxes] = []
        self._times: list[float] = []
        self._pictures: dict[int, bytes] = {}
        self._next_s = -np.inf

    def begin(self, recording: Recording) -> bool:
        """Begin with a recording; False where another was looked at."""
        if self._recording is not None:
            return False
        self._recording = recording
        return True

    def observe(self, frame: Frame) -> None:
        """Observe a frame, of which some are kept."""
        if self.look is not None:
            return
        if np.isneginf(self._next_s):
            # Nobody is followed yet.
            self._next_s = frame.time_utc_s + _FIRST_S
        if frame.time_utc_s >= self._next_s and len(self._pictures) < _PICTURES:
            self._next_s = frame.time_utc_s + LOOK_S / _PICTURES
            quality = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
            good, content = cv2.imencode(".jpg", frame.image_bgr, quality)
            if good:
                self._pictures[frame.index] = content.tobytes()

    def see(self, boxes: Boxes, time_utc_s: float) -> None:
        """See the boxes of a frame.

        Args:
            boxes: Of the frame.
            time_utc_s: Of the frame.
        """
        if self.look is not None:
            return
        self._times.append(time_utc_s)
        self._boxes.append(boxes)
        if time_utc_s - self._times[0] >= LOOK_S:
            self.end()

    def end(self) -> None:
        """The recording has ended, or a minute has passed."""
        if self.look is not None or self._recording is None:
            return
        boxes = self._recording.unmasked(Boxes.concatenate(self._boxes))
        times = np.array(self._times)
        self.look = first_look(self._recording, boxes, times, self._pictures)
        self._boxes, self._pictures = [], {}
        if self._tell is not None:
            self._tell(self.look)
