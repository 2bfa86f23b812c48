"""A recording of a scene while boxes of its logged target are drawn."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sightline.detection import Detector
from sightline.errors import InputError, OutputError
from sightline.geodesy import LocalPlane
from sightline.labelling.advice import Advice
from sightline.labelling.box_table import WAIT_S, Box, BoxTable, RowKey, TableRow
from sightline.labelling.expected_gain import spread_rows
from sightline.labelling.following import LONGEST_STEP_S, Followed, follow_box, where_expected
from sightline.labelling.logged_frames import LoggedFrames
from sightline.labelling.refit import Frames, Refits, Situation, expected_in, frame_times
from sightline.labelling.snapping import Background
from sightline.labelling.suggestions import by_information, by_spread
from sightline.scene import Recording, Scene
from sightline.scene.naming import state_number
from sightline.types import NO_FRAME, Boxes, FloatArray, Frame, IntArray
from sightline.video.random_access import FramePictures

NONE, DRAWN, PROPOSED = "none", "drawn", "proposed"
"""States of a frame."""

_LONGEST_NAME = 80
_MOST_STEPS = 1000
_MOST_CANDIDATES = 600
_MOST_OF_BACKGROUND, _FEWEST_OF_BACKGROUND = 40, 3
_LEAST_SURE = 0.15
_FEWEST_FOR_INFORMATION = 8


@dataclass(frozen=True)
class FrameSummary:
    """What is known of a frame.

    Attributes:
        frame: Its number.
        time_utc_s: POSIX seconds, NaN where nothing tells it.
        position_known: Whether the log says where the target was.
        gap_s: Seconds to the nearest fix of the log; infinite without any.
        state: ``"none"``, ``"drawn"`` (by anybody), or ``"proposed"``.
    """

    frame: int
    time_utc_s: float
    position_known: bool
    gap_s: float
    state: str


@dataclass(frozen=True)
class DrawnBox:
    """A box in a frame: drawn, or proposed.

    Attributes:
        frame: Its frame.
        x1: Left, pixels.
        y1: Top.
        x2: Right.
        y2: Bottom: the waterline.
        annotator: Who drew it.
        accepted: Whether it stands in the table; else it is proposed.
        confidence: 0 to 1; 1 for what somebody drew.
    """

    frame: int
    x1: float
    y1: float
    x2: float
    y2: float
    annotator: str
    accepted: bool
    confidence: float

    @property
    def xyxy_px(self) -> Box:
        """Left, top, right and bottom, pixels."""
        return self.x1, self.y1, self.x2, self.y2


Proposals = Mapping[int, DrawnBox | None]
"""By frame, the proposed box, None where there is none."""


@dataclass(frozen=True)
class _Step:
    """A change that can be undone.

    Attributes:
        rows: By frame and annotator, the rows of the table before and after.
        before: Proposals of the frames that it changed.
        after: The same afterwards.
        mmsi: Which vessel of an AIS log was chosen with it; None: that was none of it.
    """

    rows: Mapping[RowKey, tuple[tuple[TableRow, ...], tuple[TableRow, ...]]]
    before: Proposals
    after: Proposals
    mmsi: int | None = None


class Drawing:
    """A recording of a scene while boxes of its logged target are drawn.

    Every box that is accepted is written at once, whole, to the table that the scene names for the
    recording; one is begun, and named in the scene file, where there is none. Several people may
    draw in the same table: each has the own boxes of a frame, and nobody replaces another's.

    All methods may be called from several threads.
    """

    def __init__(
        self,
        scene: Path,
        recording: str | None = None,
        *,
        annotator: str,
        detector: Detector | None = None,
    ) -> None:
        """Open a recording.

        Args:
            scene: The scene file.
            recording: Its name; a scene with one recording needs none.
            annotator: Who draws.
            detector: Checks what is followed. Absent: nothing does.

        Raises:
            InputError: A file of the scene cannot be used, there is no such recording, it has no
                pictures, or the annotator has no name.
        """
        self.annotator = _checked_name(annotator)
        self._path = Path(scene)
        self._scene = Scene.load(self._path)
        self._recording = _chosen(self._scene, recording)
        self._detector = detector
        if self._recording.source is None:
            raise InputError(
                f"recording {self._recording.name}: has no pictures to draw in; give video or "
                "frames"
            )
        self._pictures = FramePictures(self._recording.source)
        self._mask = self._recording.mask()
        self._size_px = self._pictures.size_px
        stated = self._scene.camera.image_size_px
        if stated is not None and stated != self._size_px:
            raise InputError(
                f"{self._path}: [camera] image_size_px is {stated[0]} x {stated[1]}, and the "
                f"pictures of recording {self._recording.name} have {self._size_px[0]} x "
                f"{self._size_px[1]} px; boxes are drawn in pictures of full size"
            )
        self._numbers: IntArray = self._pictures.frame
        self._time_utc_s = frame_times(self._recording, self._numbers)
        self._table = BoxTable(
            self._path, self._recording.name, self._recording.boxes_path, self._size_px
        )
        self._proposed: dict[int, DrawnBox] = {}
        self._done: list[_Step] = []
        self._undone: list[_Step] = []
        self._skipped: set[int] = set()
        self._lock = threading.RLock()
        self._following = threading.Lock()
        self._background: Background | None = None
        self._logged = self._beside_log()
        self._refits = Refits(
            self._path,
            Frames(self._recording.name, self.annotator, self._numbers, self._size_px),
        )
        self._last_rows = self._table.rows()
        if any(one.boxes_path is not None for one in self._scene.recordings):
            self._refits.ask()

    @property
    def recording(self) -> str:
        """Name of the recording."""
        return self._recording.name

    @property
    def logged(self) -> Recording:
        """The recording with its log, by the clock that the scene states."""
        return self._recording

    def state_clock(self, offset_s: float | None) -> float | None:
        """Write how far the camera's clock is ahead of the log's into the scene file.

        Args:
            offset_s: Seconds; None: it says nothing of the clock any more.

        Returns:
            What was stated before; None where nothing was.

        Raises:
            InputError: The scene file cannot be read or written, or a line cannot be changed in it
                as it is written.
        """
        with self._lock:
            prior = Scene.load(self._path)[self._recording.name].clock_prior
            rounded = None if offset_s is None else round(float(offset_s), 3)
            state_number(self._path, self._recording.name, "clock_offset_s", rounded, wait_s=WAIT_S)
            self._load_again()
        return prior.mean_s if prior.stated else None

    @property
    def frame_size_px(self) -> tuple[int, int]:
        """Width and height of the pictures."""
        return self._size_px

    def frames(self) -> list[FrameSummary]:
        """All frames, in order."""
        drawn = {row.frame for row in self._rows()}
        with self._lock:
            proposed = set(self._proposed)
        known, gap_s = self._logged.known, self._logged.gap_s
        return [
            FrameSummary(
                frame=number,
                time_utc_s=float(self._time_utc_s[i]),
                position_known=bool(known[i]),
                gap_s=float(gap_s[i]),
                state=DRAWN if number in drawn else PROPOSED if number in proposed else NONE,
            )
            for i, number in enumerate(self._numbers.tolist())
        ]

    def picture(self, frame: int) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 BGR picture of a frame; what is masked is grey. Not to be written to.

        Raises:
            InputError: There is no such frame, or it cannot be decoded.
        """
        image = self._pictures.read(self._checked(frame))
        if self._mask is None:
            return image
        painted = self._mask.painted([Frame(frame, math.nan, image)], self._recording.name)
        return next(iter(painted)).image_bgr

    def time_utc_s(self, frame: int) -> float:
        """When a frame was taken, by the log's clock as far as the scene states it; NaN: unknown.

        Raises:
            InputError: There is no such frame.
        """
        return float(self._time_utc_s[np.searchsorted(self._numbers, self._checked(frame))])

    def boxes(self) -> list[DrawnBox]:
        """All boxes of the logged target: drawn by anybody, then proposed; in order of frames."""
        drawn = [
            DrawnBox(row.frame, *row.box, row.annotator, True, row.confidence)
            for row in self._rows()
        ]
        with self._lock:
            proposed = list(self._proposed.values())
        return sorted([*drawn, *proposed], key=lambda box: (box.frame, not box.accepted))

    def accept(self, frame: int, box_px: Box) -> None:
        """Write a box into the table; the annotator's own one of that frame is replaced.

        A proposed box of the frame is settled by it.

        Args:
            frame: Its frame.
            box_px: Left, top, right and bottom, within the picture.

        Raises:
            InputError: There is no such frame, the box is none or not in the picture, somebody
                else draws under the same name and has changed it, or it cannot be written.
        """
        number, box = self._checked(frame), self._checked_box(frame, box_px)
        with self._lock:
            before = self._table.of(number, self.annotator)
            after = self._table.put(number, self.annotator, [box], expected=before)
            self._skipped.discard(number)
            self._did({(number, self.annotator): (before, after)}, {number: None})
            self._changed()

    def remove(self, frame: int) -> None:
        """Throw the proposed box of a frame away, or else the annotator's own.

        A frame without any is left out of the suggested ones from now on: there is nothing to draw.

        Raises:
            InputError: There is no such frame, its only boxes are other people's, or it cannot be
                written.
        """
        number = self._checked(frame)
        with self._lock:
            if number in self._proposed:
                self._did({}, {number: None})
                return
            before = self._table.of(number, self.annotator)
            if before:
                self._table.put(number, self.annotator, [], expected=before)
                self._did({(number, self.annotator): (before, ())}, {})
                self._changed()
                return
            others = {row.annotator for row in self._table.rows() if row.frame == number}
            if others:
                raise InputError(
                    f"frame {number}: its box is by {', '.join(sorted(others)) or 'nobody named'}, "
                    f"and {self.annotator} removes only boxes of {self.annotator}"
                )
            self._skipped.add(number)

    def confirm(self, boxes: Boxes, mmsi: int | None = None) -> int:
        """Write boxes that somebody has recognised as the logged target's into the table.

        They keep their source for their annotator, since a detector's boxes have a bias of their
        own. Frames in which that source has a box already get this one in its place, and no other
        box is touched. One `undo` takes all of it back.

        Args:
            boxes: Of the recording, with frames.
            mmsi: Which vessel of an AIS log it is, which the scene then states; None: the log is
                of one vessel.

        Returns:
            How many were written.

        Raises:
            InputError: A frame or a box is none of the recording, none has a frame, or it cannot
                be written.
        """
        chosen: dict[RowKey, Box] = {}
        for frame, box, source in zip(
            boxes.frame.tolist(), boxes.xyxy_px, boxes.source.tolist(), strict=True
        ):
            if frame == NO_FRAME:
                continue
            limits = np.tile(self._size_px, 2)
            x1, y1, x2, y2 = np.clip(box, 0.0, limits).tolist()
            chosen[self._checked(frame), source] = self._checked_box(frame, (x1, y1, x2, y2))
        if not chosen:
            raise InputError("none of these boxes says its frame, so none can be labelled")
        with self._lock:
            before = {key: self._table.of(*key) for key in chosen}
            if mmsi is not None:
                self._choose(mmsi)
            try:
                after = self._table.put_all(
                    {key: (before[key], [box]) for key, box in chosen.items()}
                )
            except InputError:
                if mmsi is not None:
                    self._choose(None)
                raise
            self._did(
                {key: (before[key], after[key]) for key in chosen},
                {frame: None for frame, _ in chosen},
                mmsi,
            )
            self._changed()
        return len(chosen)

    def undo(self) -> bool:
        """Take the last change back.

        Returns:
            Whether there was one.

        Raises:
            InputError: Somebody else has changed that box since, or it cannot be written.
        """
        with self._lock:
            if not self._done:
                return False
            step = self._done[-1]
            self._go(self._done, back=True)
            self._undone.append(step)
            return True

    def redo(self) -> bool:
        """Do again what was taken back last.

        Returns:
            Whether there was something.

        Raises:
            InputError: As `undo`.
        """
        with self._lock:
            if not self._undone:
                return False
            step = self._undone[-1]
            self._go(self._undone, back=False)
            self._done.append(step)
            return True

    def suggested(self, count: int = 30) -> list[int]:
        """Frames that teach most, the best first.

        Args:
            count: At most so many.
        """
        drawn = np.array([row.frame for row in self._table.rows()], dtype=np.int64)
        with self._lock:
            closed = np.array([*drawn.tolist(), *self._skipped], dtype=np.int64)
        advice, situation = self._refits.newest()
        logged = self._logged[spread_rows(len(self._logged), _MOST_CANDIDATES)]
        if situation is not None and situation.design is not None and len(situation.views):
            views = situation.views
            logged = views.logged
            if advice.boxes >= _FEWEST_FOR_INFORMATION:
                rows = by_information(
                    situation.design,
                    situation.georeferencer,
                    views,
                    ~np.isin(logged.frame, closed),
                    views[np.isin(logged.frame, drawn)],
                    count,
                )
                return [int(number) for number in logged.frame[rows]]
        # What few boxes say of the camera is no guide yet, but for what it sees.
        free = ~np.isin(logged.frame, closed)
        rows = by_spread(logged, free, drawn, self._scene.plane is not None, count)
        return [int(number) for number in logged.frame[rows]]

    def follow(
        self, frame: int, *, forward: bool = True, backward: bool = True, count: int = 40
    ) -> list[DrawnBox]:
        """Propose boxes in the frames around a drawn one, as far as it is sure.

        Where frames are more than a second apart, boats look too different to be followed: then the
        newest fit and the log say where to look. Frames in which anybody has drawn stay as they
        are. One `undo` takes all that was proposed back.

        Args:
            frame: Has a box.
            forward: Whether to later frames.
            backward: Whether to earlier ones.
            count: At most so many frames either way.

        Returns:
            What is proposed.

        Raises:
            InputError: There is no such frame, no box in it, or a frame cannot be decoded.
        """
        at = int(np.searchsorted(self._numbers, self._checked(frame)))
        box = self._box_of(frame)
        most = max(count, 0)
        ways = []
        if forward:
            ways.append(self._numbers[at : at + 1 + most])
        if backward:
            ways.append(self._numbers[max(at - most, 0) : at + 1][::-1])
        _, situation = self._refits.newest()
        expected = self._expected(situation)
        found: dict[int, Followed] = {}
        apart: list[int] = []
        with self._following:
            for way in ways:
                steps = follow_box(
                    self._frames_of(way.tolist()), box, expected=expected, detector=self._detector
                )
                found |= {one.frame: one for one in steps}
                if self._is_apart(way):
                    apart += way[1:].tolist()
            if apart and situation is not None and situation.design is not None:
                found |= self._where_expected(sorted({*apart, frame}), situation)
        return self._proposed_from(found)

    def advice(self) -> Advice:
        """What the newest fit that is finished says of the boxes so far."""
        # A table that is broken is told where it is asked for.
        with suppress(InputError):
            self._rows()
        return self._refits.newest()[0]

    def wait(self, timeout_s: float = 60.0) -> bool:
        """Wait until no fit is running; whether that came to be in time."""
        return self._refits.wait(timeout_s)

    def close(self) -> None:
        """End the fit that is running, and close the pictures."""
        self._refits.close()
        self._pictures.close()

    def _proposed_from(self, found: Mapping[int, Followed]) -> list[DrawnBox]:
        """Propose what was found where nobody has drawn, and nothing surer is proposed."""
        with self._lock:
            drawn = {row.frame for row in self._table.rows()}
            new: dict[int, DrawnBox | None] = {}
            for number, one in sorted(found.items()):
                limits = np.tile(self._size_px, 2)
                x1, y1, x2, y2 = np.clip(one.xyxy_px, 0.0, limits).round(2).tolist()
                before = self._proposed.get(number)
                surer = before is not None and before.confidence > one.confidence
                if number in drawn or surer or not (x1 < x2 and y1 < y2):
                    continue
                sure = round(one.confidence, 4)
                new[number] = DrawnBox(number, x1, y1, x2, y2, self.annotator, False, sure)
            if new:
                self._did({}, new)
            return [box for box in new.values() if box is not None]

    def _box_of(self, frame: int) -> FloatArray:
        """The box to follow: the annotator's own, else what is proposed, else another's."""
        rows = [row for row in self._table.rows() if row.frame == frame]
        own = [row.box for row in rows if row.annotator == self.annotator]
        with self._lock:
            proposed = self._proposed.get(frame)
        if own:
            return np.array(own[0])
        if proposed is not None:
            return np.array(proposed.xyxy_px)
        if rows:
            return np.array(rows[0].box)
        raise InputError(f"frame {frame}: has no box to follow; draw one first")

    def _frames_of(self, numbers: list[int]) -> Iterator[Frame]:
        for number in numbers:
            row = int(np.searchsorted(self._numbers, number))
            yield Frame(number, float(self._time_utc_s[row]), self.picture(number))

    def _is_apart(self, numbers: IntArray) -> bool:
        """Whether frames are too far apart to be followed."""
        times = self._time_utc_s[np.searchsorted(self._numbers, numbers)]
        steps = np.abs(np.diff(times))
        return bool(steps.size and np.nanmedian(steps) > LONGEST_STEP_S)

    def _expected(self, situation: Situation | None) -> Callable[[int], FloatArray | None]:
        """From a frame, the box that the newest fit expects in it."""
        if situation is None or situation.design is None:
            return lambda _: None
        views = situation.views
        at = {number: row for row, number in enumerate(views.logged.frame.tolist())}
        return lambda number: views.box_xyxy_px[at[number]] if number in at else None

    def _where_expected(self, numbers: Sequence[int], situation: Situation) -> dict[int, Followed]:
        """Boxes where the newest fit expects them, in frames that are far apart."""
        if self._background is None:
            some = self._numbers[spread_rows(self._numbers.size, _MOST_OF_BACKGROUND)]
            if some.size < _FEWEST_OF_BACKGROUND:
                return {}
            name = self._recording.name
            self._background = Background.of(self._frames_of(some.tolist()), name)
        drawn = {row.frame: row.box for row in self._table.rows() if self._mine(row)}
        # The boxes that are drawn tell how tight somebody draws.
        asked = np.array(sorted({*numbers, *drawn}), dtype=np.int64)
        asked = asked[np.isin(asked, self._numbers)]
        boxes = np.array([drawn.get(number, (np.nan,) * 4) for number in asked.tolist()])
        expected = expected_in(self._recording, asked, situation.georeferencer)
        found, sure = where_expected(
            list(self._frames_of(asked.tolist())), expected, self._background, boxes
        )
        return {
            number: Followed(number, found[i], float(sure[i]))
            for i, number in enumerate(asked.tolist())
            if np.isfinite(found[i]).all() and number in numbers and sure[i] >= _LEAST_SURE
        }

    def _mine(self, row: TableRow) -> bool:
        return row.annotator == self.annotator

    def _beside_log(self) -> LoggedFrames:
        """All frames beside the log, by the clocks as the scene has them."""
        recording, plane = self._recording, self._scene.plane
        if recording.is_feed():
            # Which of its vessels the boxes are of is still to be said.
            recording = replace(recording, fixes_path=None)
        if plane is None and recording.fixes_path is not None:
            fixes = recording.fixes()
            if len(fixes):
                middle = np.median(fixes.latitude_deg), np.median(fixes.longitude_deg)
                plane = LocalPlane(float(middle[0]), float(middle[1]))
        if plane is None:
            recording, plane = replace(recording, fixes_path=None), LocalPlane(0.0, 0.0)
        return LoggedFrames.of(recording, self._numbers, self._time_utc_s, plane)

    def _rows(self) -> list[TableRow]:
        """The rows of the table; where others have changed them, a fit to these is asked for."""
        rows = self._table.rows()
        with self._lock:
            if rows != self._last_rows:
                self._last_rows = rows
                self._refits.ask()
        return rows

    def _changed(self) -> None:
        self._last_rows = self._table.rows()
        self._refits.ask()

    def _go(self, steps: list[_Step], *, back: bool) -> None:
        """Take back, or make again, the last of some steps, which is then none of them any more."""
        step = steps[-1]
        try:
            if step.rows:
                self._table.put_all(
                    {
                        key: (after, before) if back else (before, after)
                        for key, (before, after) in step.rows.items()
                    }
                )
                self._changed()
            if step.mmsi is not None:
                self._choose(None if back else step.mmsi)
        except OutputError:
            raise
        except InputError:
            # What somebody else has changed is no longer ours to take back.
            steps.pop()
            raise
        self._propose(step.before if back else step.after)
        steps.pop()

    def _did(
        self,
        rows: Mapping[RowKey, tuple[tuple[TableRow, ...], tuple[TableRow, ...]]],
        proposals: Proposals,
        mmsi: int | None = None,
    ) -> None:
        """Remember a change of the table, and make that of the proposals."""
        had = {number: self._proposed.get(number) for number in proposals}
        self._propose(proposals)
        self._done.append(_Step(rows, had, dict(proposals), mmsi))
        del self._done[:-_MOST_STEPS]
        self._undone.clear()

    def _choose(self, mmsi: int | None) -> None:
        """State which vessel of an AIS log is the target, or none."""
        state_number(self._path, self._recording.name, "mmsi", mmsi, wait_s=WAIT_S)
        self._load_again()

    def _load_again(self) -> None:
        """Take what the scene file says by now of clock and log."""
        self._scene = Scene.load(self._path)
        self._recording = self._scene[self._recording.name]
        self._time_utc_s = frame_times(self._recording, self._numbers)
        self._logged = self._beside_log()
        self._refits.forget_clocks()
        self._refits.ask()

    def _propose(self, proposals: Proposals) -> None:
        for number, box in proposals.items():
            if box is None:
                self._proposed.pop(number, None)
            else:
                self._proposed[number] = box

    def _checked(self, frame: int) -> int:
        at = int(np.searchsorted(self._numbers, frame))
        if at == self._numbers.size or int(self._numbers[at]) != frame:
            raise InputError(
                f"recording {self._recording.name}: has no picture of frame {frame}; its "
                f"{self._numbers.size} frames are between {self._numbers[0]} and "
                f"{self._numbers[-1]}"
            )
        return int(frame)

    def _checked_box(self, frame: int, box_px: Box) -> Box:
        width, height = self._size_px
        if len(box_px) != 4 or not all(math.isfinite(value) for value in box_px):
            raise InputError(f"frame {frame}: a box is four finite numbers, x1, y1, x2, y2")
        x1, y1, x2, y2 = (round(float(value), 2) for value in box_px)
        shown = f"frame {frame}: the box ({x1:g}, {y1:g}, {x2:g}, {y2:g})"
        if not (x1 < x2 and y1 < y2):
            raise InputError(f"{shown} is empty or inverted; expected x1 < x2 and y1 < y2")
        if x1 < 0.0 or y1 < 0.0 or x2 > width or y2 > height:
            raise InputError(
                f"{shown} reaches out of the picture of {width} x {height} px; draw it within"
            )
        return x1, y1, x2, y2


def _checked_name(annotator: str) -> str:
    name = annotator.strip()
    if not name or len(name) > _LONGEST_NAME or not name.isprintable():
        raise InputError(
            f"an annotator needs a name of up to {_LONGEST_NAME} printable letters; it is "
            f"{annotator[:_LONGEST_NAME]!r}"
        )
    return name


def _chosen(scene: Scene, name: str | None) -> Recording:
    if name is not None:
        return scene[name]
    if len(scene.recordings) != 1:
        names = ", ".join(one.name for one in scene.recordings) or "none"
        raise InputError(f"{scene.path}: say which recording to draw in; there are {names}")
    return scene.recordings[0]
