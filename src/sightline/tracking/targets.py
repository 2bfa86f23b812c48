"""Target management in any plane: birth, assignment, occlusion, death and stitching.

Boxes come in two passes, as in ByteTrack (Zhang et al. 2022): those that the detector is sure of
first; then the doubtful ones, which may go on with a target that has none yet, and never begin
one. All times are in seconds, so frames may come as they like.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sightline.errors import InputError
from sightline.tracking.assignment import assign
from sightline.tracking.plane import Columns, Plane
from sightline.types import NO_TRACK, BoolArray, Boxes, FloatArray, IntArray

_STATE_VERSION = 1


@dataclass(frozen=True)
class TrackerSettings:
    """Settings for when targets begin and end.

    Attributes:
        confirm_s: A target counts once it has been followed for this long.
        coast_s: A confirmed target is kept for this long without a box: behind a post, say.
        coast_unconfirmed_s: The same for one that is not confirmed, once it was missed.
        direct_s: A target that has had no box for longer is not given single boxes, any of which
            may be clutter: it is taken up again by a new target that is found to be its
            continuation when it is confirmed.
        sure_confidence: Boxes of less confidence begin no target, and may only go on with a
            confirmed one that has none better.
        least_confidence: Boxes of less confidence are left out.
        doubtful_s: A doubtful box goes on only with a target that had a box this recently.
    """

    confirm_s: float = 0.4
    coast_s: float = 3.0
    coast_unconfirmed_s: float = 0.3
    direct_s: float = 3.0
    sure_confidence: float = 0.4
    least_confidence: float = 0.0
    doubtful_s: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value >= 0.0:
                raise InputError(f"tracker: {name} is {value:g}; it must not be negative")


class TargetTracker:
    """Multi-target tracker in a plane; see `Tracker`.

    Ids start at 1, and belong to the instance.
    """

    def __init__(self, plane: Plane, settings: TrackerSettings) -> None:
        """Begin without targets.

        Args:
            plane: What is measured of targets, and how that moves.
            settings: When targets begin and end.
        """
        self._plane = plane
        self._settings = settings
        self._next_id = 1
        self.reset()

    def reset(self) -> None:
        """Forget all targets; see `Tracker`."""
        self._time_s = self._before_s = -np.inf
        self._first_s: FloatArray = np.empty(0)
        self._last_s: FloatArray = np.empty(0)
        self._track_id: IntArray = np.empty(0, dtype=np.int64)
        self._state: Columns | None = None

    def __len__(self) -> int:
        """Number of targets that are tracked, lost and unconfirmed ones among them."""
        return self._track_id.size

    def update(self, boxes: Boxes) -> Boxes:
        """Assign track ids to the boxes of one moment; see `Tracker`."""
        if not len(boxes):
            return boxes
        if not (boxes.time_utc_s == boxes.time_utc_s[0]).all():
            raise InputError("a tracker takes the boxes of one known time; these have several")
        return self.follow(boxes)

    def follow(self, boxes: Boxes) -> Boxes:
        """Assign track ids to the boxes of several moments: as `update`, moment by moment.

        What boxes tell by themselves is measured of all of them at once.

        Args:
            boxes: In the order of time, all of them later than the boxes before; those of one
                time are one moment.

        Returns:
            Those boxes that belong to a confirmed track, with its id, in the order given.

        Raises:
            InputError: Times are not known, or not in order.
        """
        if not len(boxes):
            return boxes
        times = boxes.time_utc_s
        if times[0] <= self._time_s:
            raise InputError(
                f"boxes come {self._time_s - times[0]:g} s before those seen last; a tracker takes "
                "them in the order of time, and is reset between recordings"
            )
        later = np.diff(times)
        if not (np.isfinite(times[0]) and (later >= 0.0).all()):
            raise InputError("a tracker takes boxes in the order of time; these are in no order")
        measured = self._plane.measure(boxes)
        ids = np.empty(len(boxes), dtype=np.int64)
        cuts = [0, *(np.flatnonzero(later > 0.0) + 1).tolist(), len(boxes)]
        for start, stop in itertools.pairwise(cuts):
            moment = slice(start, stop)
            ids[moment] = self._moment(
                measured[moment], boxes.confidence[moment], float(times[start])
            )
        return boxes.with_columns(track_id=ids)[ids != NO_TRACK]

    def _moment(self, measured: Columns, confidence: FloatArray, time_s: float) -> IntArray:
        """(N,) track ids of the boxes of one moment, `NO_TRACK` where there is none."""
        self._keep(~self._gone(time_s))
        self._before_s = self._time_s
        if self._state is not None and len(self):
            self._plane.predict(self._state, time_s - self._time_s)
        self._time_s = time_s
        owner = self._assign(measured, confidence)
        self._take(owner, measured, time_s)
        self._begin(owner, measured, confidence, time_s)
        joined = self._confirm(time_s)
        if not len(self):
            return owner
        ids = np.where(owner >= 0, self._track_id[owner], NO_TRACK)
        if joined.size:
            kept = np.ones(len(self), dtype=bool)
            kept[joined] = False
            self._keep(kept)
        return ids

    def state(self) -> dict[str, object]:
        """State of the tracker, as JSON can hold it; see `restore`."""
        return {
            "version": _STATE_VERSION,
            "next_id": self._next_id,
            "time_utc_s": None if np.isneginf(self._time_s) else self._time_s,
            "before_utc_s": None if np.isneginf(self._before_s) else self._before_s,
            "first_utc_s": self._first_s.tolist(),
            "last_utc_s": self._last_s.tolist(),
            "track_id": self._track_id.tolist(),
            "targets": {}
            if self._state is None
            else {name: self._state[name].tolist() for name in self._state.dtype.names or ()},
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore the `state` of a tracker of the same plane and settings.

        Raises:
            InputError: That is no state of such a tracker.
        """
        if not isinstance(state, Mapping) or state.get("version") != _STATE_VERSION:
            raise InputError(
                f"this is no state of a tracker in version {_STATE_VERSION}; begin without one"
            )
        template = self._plane.start(self._plane.measure(Boxes.of([])))
        try:
            next_id = int(state["next_id"])
            times = [
                -np.inf if state[name] is None else float(state[name])
                for name in ("time_utc_s", "before_utc_s")
            ]
            first, last = (
                np.array(state[name], dtype=np.float64) for name in ("first_utc_s", "last_utc_s")
            )
            ids = np.array(state["track_id"], dtype=np.int64)
            n = ids.size
            columns = np.zeros(n, dtype=template.dtype)
            for name in (template.dtype.names or ()) if n else ():
                told = np.array(state["targets"][name], dtype=np.float64)
                columns[name] = told.reshape(columns[name].shape)
        except (LookupError, TypeError, ValueError, OverflowError) as error:
            raise InputError(
                f"the state of a tracker is damaged, or of a tracker in another plane ({error!r}); "
                "begin without one"
            ) from error
        parts = (first, last, *(columns[name] for name in template.dtype.names or ()))
        if (
            first.shape != (n,)
            or last.shape != (n,)
            or not all(np.isfinite(part).all() for part in parts)
            or next_id <= int(ids.max(initial=0))
            or np.isnan(times).any()
        ):
            raise InputError(
                "the state of a tracker is damaged: its columns do not fit together; "
                "begin without one"
            )
        self._next_id = next_id
        self._time_s, self._before_s = times
        self._first_s, self._last_s, self._track_id = first, last, ids
        self._state = columns if n else None

    def _gone(self, time_s: float) -> BoolArray:
        silent_s = time_s - self._last_s
        # With few frames a second, the next one is not late.
        missed = self._last_s < self._time_s
        return np.where(
            self._track_id != NO_TRACK,
            silent_s > self._settings.coast_s,
            missed & (silent_s > self._settings.coast_unconfirmed_s),
        )

    def _keep(self, kept: BoolArray) -> None:
        if kept.all():
            return
        self._first_s, self._last_s = self._first_s[kept], self._last_s[kept]
        self._track_id = self._track_id[kept]
        if self._state is not None:
            self._state = self._state[kept]

    def _assign(self, measured: Columns, confidence: FloatArray) -> IntArray:
        """(N,) row of the target of each box, -1 where there is none."""
        settings = self._settings
        owner = np.full(confidence.size, -1, dtype=np.int64)
        if self._state is None or not len(self):
            return owner
        silent_s = self._time_s - self._last_s
        sure = confidence >= settings.sure_confidence
        doubtful = ~sure & (confidence >= settings.least_confidence)
        confirmed = self._track_id != NO_TRACK
        free = np.ones(len(self), dtype=bool)
        # Confirmed targets choose first: clutter beside a boat must not take its box.
        for who, which in (
            (
                confirmed & ((silent_s <= settings.direct_s) | ~(self._last_s < self._before_s)),
                sure,
            ),
            (confirmed & (silent_s <= settings.doubtful_s), doubtful),
            (~confirmed, sure),
        ):
            targets = np.flatnonzero(who & free)
            if not targets.size:
                continue
            boxes = np.flatnonzero(which & (owner < 0))
            if not boxes.size:
                continue
            i, j, cost = self._plane.candidates(
                self._state[targets], silent_s[targets], measured[boxes]
            )
            i, j = assign(i, j, cost, (targets.size, boxes.size))
            owner[boxes[j]] = targets[i]
            free[targets[i]] = False
        return owner

    def _take(self, owner: IntArray, measured: Columns, time_s: float) -> None:
        """Update the targets that boxes were assigned to."""
        boxes = np.flatnonzero(owner >= 0)
        if self._state is None or not boxes.size:
            return
        targets = owner[boxes]
        silent_s = time_s - self._last_s[targets]
        updated = self._state[targets]
        self._plane.update(updated, silent_s, measured[boxes])
        self._state[targets] = updated
        self._last_s[targets] = time_s

    def _begin(
        self, owner: IntArray, measured: Columns, confidence: FloatArray, time_s: float
    ) -> None:
        """Begin a target for each unassigned box, and write down its row."""
        new = np.flatnonzero((owner < 0) & (confidence >= self._settings.sure_confidence))
        if not new.size:
            return
        owner[new] = len(self) + np.arange(new.size)
        begun = self._plane.start(measured[new])
        first = self._state is None or not len(self)
        self._state = begun if first else np.concatenate([self._state, begun])
        self._first_s = np.append(self._first_s, np.full(new.size, time_s))
        self._last_s = np.append(self._last_s, np.full(new.size, time_s))
        self._track_id = np.append(self._track_id, np.full(new.size, NO_TRACK, dtype=np.int64))

    def _confirm(self, time_s: float) -> IntArray:
        """Confirm targets tracked for long enough, or stitch them to lost ones.

        Returns:
            Rows of the lost ones that were taken up, and are to be dropped.
        """
        fresh = (self._track_id == NO_TRACK) & (self._last_s == time_s)
        new = np.flatnonzero(fresh & (time_s - self._first_s >= self._settings.confirm_s))
        joined = np.empty(0, dtype=np.int64)
        if not new.size or self._state is None:
            return joined
        lost = np.flatnonzero((self._track_id != NO_TRACK) & (self._last_s < time_s))
        if lost.size:
            silent_s = time_s - self._last_s[lost]
            i, j, cost = self._plane.continuations(self._state[lost], silent_s, self._state[new])
            # Nothing goes on as something that was there beside it.
            after = self._last_s[lost[i]] < self._first_s[new[j]]
            i, j = assign(i[after], j[after], cost[after], (lost.size, new.size))
            joined = lost[i]
            self._track_id[new[j]] = self._track_id[joined]
            self._first_s[new[j]] = self._first_s[joined]
        numbered = new[self._track_id[new] == NO_TRACK]
        self._track_id[numbered] = self._next_id + np.arange(numbered.size)
        self._next_id += numbered.size
        return joined
