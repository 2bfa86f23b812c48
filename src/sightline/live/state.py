"""What is known of all targets, frame by frame: online, and smoothed a few seconds behind."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from sightline.area import Area
from sightline.camera.state import ObservedBoxes
from sightline.errors import InputError
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.live.filter import TargetFilter
from sightline.moment import CaptureClock, Moment, State, TargetState
from sightline.pipeline.sources import follows_on_earth
from sightline.pipeline.track import positions_on_earth
from sightline.tracking import ImageTracker, TargetTracker, WorldTracker
from sightline.trajectory.base import measurements
from sightline.trajectory.smoother import RtsSmoother
from sightline.types import Boxes, FloatArray, LocatedBoxes, Positions, Track

_EDGE_PX = 3.0
_LEFT_S = 2.0
_UNKNOWN_MPS = 2.5
_SLOWEST_MPS = 0.2
_CORRELATION_S = 0.9
_BLOCKS = 4
_MOST_BOXES = 8000
_EARLIEST_SMOOTHED = 6


@dataclass(frozen=True)
class StateSettings:
    """Settings of the online state.

    Attributes:
        shown_s: A target without a box is predicted and published for so long.
        gone_s: After so long without a box it has gone, and its track is final.
        lag_s: How far the smoothed track is behind.
        smooth_every_s: How often it is carried on.
        window_s: Of how long the smoothed track is made, and stillness judged.
        moored_after_s: A target lies still once it did so for so long.
        moored_mps: It does so if its mean speed was, with 95 %, below that.
        longest_s: Tracks are made final in parts of so long, so that a boat that stays for weeks
            fits into memory.
        shortest_s: Final tracks that are shorter are dropped: glitter, birds.
        apart_s: Boxes of a target that follow each other faster are smoothed as one.
    """

    shown_s: float = 10.0
    gone_s: float = 20.0
    lag_s: float = 5.0
    smooth_every_s: float = 4.0
    window_s: float = 120.0
    moored_after_s: float = 30.0
    moored_mps: float = 0.5
    longest_s: float = 600.0
    shortest_s: float = 2.0
    apart_s: float = 0.1

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 < value < np.inf:
                raise InputError(f"state: {name} is {value:g}; expected above 0")


@dataclass(frozen=True, eq=False)
class SmoothedPart:
    """Next part of a target's smoothed track.

    Attributes:
        track: Points later than those of the part before, or all of a final one.
        final: Whether it replaces what was smoothed behind its target for its time.
    """

    track: Track
    final: bool


@dataclass(eq=False)
class _Target:
    """What is kept of a target: its positions for a while."""

    number: int
    label: str
    first_utc_s: float
    last_utc_s: float
    box: tuple[float, float, float, float]
    confidence: float
    times: list[float] = field(default_factory=list)
    rows: list[tuple[FloatArray, FloatArray, FloatArray]] = field(default_factory=list)
    smoothed_utc_s: float = -np.inf
    final_utc_s: float = -np.inf
    due_utc_s: float = -np.inf
    moored: bool = False

    def shift(self, step_s: float) -> None:
        for name in ("first", "last", "smoothed", "final", "due"):
            setattr(self, f"{name}_utc_s", getattr(self, f"{name}_utc_s") + step_s)
        self.times = [time + step_s for time in self.times]


class LiveState:
    """Tracks targets frame by frame, on the earth where the model has a camera.

    Ids go up and are never used twice; those of an earlier run are continued with `first_id`.
    """

    def __init__(
        self,
        model: Georeferencer,
        camera: str,
        *,
        settings: StateSettings | None = None,
        first_id: int = 1,
        area: Area | None = None,
    ) -> None:
        """Begin without targets.

        Args:
            model: Says where boxes lie; of a camera that stands still.
            camera: Its name.
            settings: How targets begin and end.
            first_id: Of the next target.
            area: Where targets can be; None: anywhere.

        Raises:
            InputError: The camera stands on a platform that moves.
        """
        if model.moving:
            raise InputError(
                "the model is of a camera on a platform that moves, which cannot be watched live; "
                "give one of a camera that stands still"
            )
        self._model, self._camera, self._area = model, camera, area
        self._settings = settings or StateSettings()
        self._smoother = RtsSmoother()
        self._tracker: TargetTracker = ImageTracker()
        if follows_on_earth(model):
            self._tracker = WorldTracker(partial(_places, model))
        self._tracker.restore({**self._tracker.state(), "next_id": first_id})
        self._filter = TargetFilter()
        self._targets: dict[int, _Target] = {}
        self._finished: deque[SmoothedPart] = deque()
        self._last_utc_s = -np.inf

    def __len__(self) -> int:
        """Number of targets that have not gone."""
        return len(self._targets)

    def to_json(self) -> dict[str, object]:
        """What identities are carried on with after a restart; see `carry_on`."""
        return {"tracker": self._tracker.state(), "time_utc_s": self._last_utc_s}

    def carry_on(self, kept: Mapping[str, object], now_utc_s: float) -> bool:
        """Carry on the identities of an earlier run, if that was not long ago.

        Args:
            kept: What `to_json` gave.
            now_utc_s: POSIX seconds.

        Returns:
            Whether there is something to carry on.
        """
        told, then = kept.get("tracker"), kept.get("time_utc_s")
        if not isinstance(told, dict) or not isinstance(then, int | float):
            return False
        if not 0.0 <= now_utc_s - then <= self._settings.gone_s:
            return False
        fresh = self._tracker.state()
        own, before = fresh["next_id"], told.get("next_id")
        assert isinstance(own, int)
        try:
            next_id = max(own, before if isinstance(before, int) else 0)
            self._tracker.restore({**told, "next_id": next_id})
        except InputError:
            self._tracker.restore(fresh)
            return False
        self._last_utc_s = float(then)
        return True

    def change(self, settings: StateSettings, area: Area | None) -> None:
        """Go on with other settings, and targets elsewhere."""
        self._settings, self._area = settings, area

    def shift(self, step_s: float) -> None:
        """Carry on by a clock that was set by a step."""
        state = self._tracker.state()
        moved: dict[str, object] = dict(state)
        for name in ("time_utc_s", "before_utc_s", "first_utc_s", "last_utc_s"):
            told = state[name]
            if isinstance(told, list):
                moved[name] = [value + step_s for value in told]
            elif isinstance(told, float):
                moved[name] = told + step_s
        self._tracker.restore(moved)
        self._filter.shift(step_s)
        self._last_utc_s += step_s
        for target in self._targets.values():
            target.shift(step_s)

    def update(
        self,
        observed: ObservedBoxes,
        time_utc_s: float,
        *,
        capture: CaptureClock = "arrival",
        capture_sigma_s: float | None = None,
        frame_size_px: tuple[int, int] | None = None,
    ) -> Moment:
        """The targets after a frame.

        Args:
            observed: Boxes of the frame, with the state of the camera.
            time_utc_s: Its capture time, later than that of the frame before.
            capture: Whose clock that is.
            capture_sigma_s: Its standard deviation.
            frame_size_px: Width and height of the frame.

        Raises:
            InputError: The time is not later than that before.
        """
        if not time_utc_s > self._last_utc_s:
            raise InputError(
                f"a frame comes {self._last_utc_s - time_utc_s:g} s before the one seen last; "
                "frames are taken in the order of time"
            )
        self._last_utc_s = time_utc_s
        located = self._model.place(observed)
        located = self._inside(located)
        followed = self._tracker.update(located) if len(located) else located
        self._filter.predict(time_utc_s)
        assert isinstance(followed, LocatedBoxes), (
            "a tracker of ours hands on the rows it was given"
        )
        measured = self._measure(followed, time_utc_s)
        self._let_go(time_utc_s)
        return Moment(
            time_utc_s=time_utc_s,
            capture=capture,
            camera=self._camera,
            targets=self._states(time_utc_s, measured),
            frame_size_px=frame_size_px or self._model.image_size_px,
            capture_sigma_s=capture_sigma_s,
        )

    def _inside(self, located: LocatedBoxes) -> LocatedBoxes:
        if self._area is None or not len(located):
            return located
        places = positions_on_earth(located)
        inside = self._area.contains(places.latitude_deg, places.longitude_deg) | ~places.known
        return located[inside]

    def _measure(self, followed: LocatedBoxes, time_utc_s: float) -> set[int]:
        """Take the positions of a frame; returns the numbers of the targets that have one."""
        positions = followed.positions
        assert isinstance(positions, Positions), "the camera stands still"
        known = positions.known & np.isfinite(positions.covariance_m2).all(axis=(1, 2))
        followed = followed[known]
        if not len(followed):
            return set()
        numbers = followed.track_id
        rank = np.arange(len(followed), dtype=np.float64)
        measured, _ = measurements(rank, followed.positions, None, None, 0)  # type: ignore[arg-type]
        own_m2, shared_m2 = measured.covariance_m2, measured.shared_m2
        self._filter.update(numbers, measured.en_m, own_m2, shared_m2)
        for row, number in enumerate(numbers.tolist()):
            x1, y1, x2, y2 = followed.xyxy_px[row].tolist()
            target = self._targets.get(number)
            if target is None:
                target = _Target(number, "", time_utc_s, time_utc_s, (x1, y1, x2, y2), 0.0)
                target.due_utc_s = time_utc_s + self._settings.smooth_every_s
                self._targets[number] = target
            target.last_utc_s, target.box = time_utc_s, (x1, y1, x2, y2)
            target.confidence = float(followed.confidence[row])
            target.label = str(followed.label[row]) or target.label
            if not target.times or time_utc_s - target.times[-1] >= self._settings.apart_s:
                target.times.append(time_utc_s)
                stated = own_m2[row] + shared_m2[row]
                target.rows.append((measured.en_m[row], stated, shared_m2[row]))
        return set(numbers.tolist())

    def _states(self, now_s: float, measured: set[int]) -> tuple[TargetState, ...]:
        mean, covariance = self._filter.moments()
        latitude, longitude = self._model.plane.to_geographic(mean[:, 0], mean[:, 1])
        found = []
        for row in np.argsort(self._filter.ids).tolist():
            target = self._targets.get(int(self._filter.ids[row]))
            if target is None or not self._is_shown(target, now_s):
                continue
            seen = target.number in measured
            state: State = "moored" if target.moored else "measured" if seen else "predicted"
            sigma_mps = float(np.sqrt(0.5 * np.trace(covariance[row, 2:, 2:])))
            speed = float(np.hypot(mean[row, 2], mean[row, 3]))
            course = float(np.degrees(np.arctan2(mean[row, 2], mean[row, 3])) % 360.0)
            known = sigma_mps <= _UNKNOWN_MPS
            steady = known and speed >= max(sigma_mps, _SLOWEST_MPS)
            if target.moored:
                speed, steady = 0.0, False
            found.append(
                TargetState(
                    id=target.number,
                    latitude_deg=float(latitude[row]),
                    longitude_deg=float(longitude[row]),
                    covariance_m2=covariance[row, :2, :2],
                    speed_mps=speed if known or target.moored else None,
                    course_deg=course if steady else None,
                    state=state,
                    box_xyxy_px=target.box if seen else None,
                    confidence=target.confidence if seen else None,
                    velocity_sigma_mps=sigma_mps if known else None,
                    label=target.label,
                )
            )
        return tuple(found)

    def _is_shown(self, target: _Target, now_s: float) -> bool:
        silent_s = now_s - target.last_utc_s
        x1, y1, x2, y2 = target.box
        width, height = self._model.image_size_px
        at_edge = x1 <= _EDGE_PX or y1 <= _EDGE_PX or x2 >= width - _EDGE_PX
        # What was cut by the border, and is gone, has left the view.
        at_edge = at_edge or y2 >= height - _EDGE_PX
        return silent_s <= (
            min(_LEFT_S, self._settings.shown_s) if at_edge else self._settings.shown_s
        )

    def _let_go(self, now_s: float) -> None:
        gone = [t for t in self._targets.values() if now_s - t.last_utc_s > self._settings.gone_s]
        for target in gone:
            self._finish(target)
            del self._targets[target.number]
        if gone:
            self._filter.keep(np.array(list(self._targets), dtype=np.int64))

    def smooth_next(self, now_utc_s: float) -> list[SmoothedPart]:
        """Carry on the smoothed track that has waited longest; nothing where none is due.

        Args:
            now_utc_s: Time of the newest frame.
        """
        done = list(self._finished)
        self._finished.clear()
        due = [one for one in self._targets.values() if one.due_utc_s <= now_utc_s]
        if due:
            target = min(due, key=lambda one: one.due_utc_s)
            target.due_utc_s = now_utc_s + self._settings.smooth_every_s
            done += self._carry_on(target, now_utc_s)
        return done

    def finish(self, most_s: float = math.inf) -> list[SmoothedPart]:
        """Make all tracks final: there are no more frames.

        Args:
            most_s: How long that may take; tracks that are left are as they were smoothed before.
        """
        until_s = time.monotonic() + most_s
        for target in self._targets.values():
            if time.monotonic() < until_s:
                self._finish(target)
        self._targets.clear()
        self._filter.keep(np.empty(0, dtype=np.int64))
        done = list(self._finished)
        self._finished.clear()
        return done

    def _carry_on(self, target: _Target, now_s: float) -> list[SmoothedPart]:
        if len(target.times) < _EARLIEST_SMOOTHED:
            return []
        target.moored = self._lies_still(target)
        if len(target.times) > _MOST_BOXES or now_s - target.times[0] > self._settings.longest_s:
            part = self._final_part(target)
            self._drop_before(target, now_s - self._settings.window_s)
            return [] if part is None else [part]
        first = int(np.searchsorted(target.times, now_s - self._settings.window_s))
        times = np.array(target.times[first:])
        if times.size < _EARLIEST_SMOOTHED:
            return []
        smoothed = self._smoother.smooth(
            times, self._positions(target, first), track_id=target.number
        )
        self._filter.learn(target.number, smoothed.noise)
        after = max(target.smoothed_utc_s, target.final_utc_s)
        at = times[(times > after) & (times <= now_s - self._settings.lag_s)]
        if not at.size:
            return []
        target.smoothed_utc_s = float(at[-1])
        return [
            SmoothedPart(smoothed.at(at, track_id=target.number, label=target.label), final=False)
        ]

    def _finish(self, target: _Target) -> None:
        long_enough = target.last_utc_s - target.first_utc_s >= self._settings.shortest_s
        part = self._final_part(target) if long_enough else None
        if part is not None:
            self._finished.append(part)

    def _final_part(self, target: _Target) -> SmoothedPart | None:
        times = np.array(target.times)
        at = times[times > target.final_utc_s]
        if times.size < 2 or not at.size:
            return None
        made = self._smoother.apply(
            times,
            self._positions(target, 0),
            at_utc_s=at,
            track_id=target.number,
            label=target.label,
        )
        target.final_utc_s = float(at[-1])
        return SmoothedPart(made, final=True)

    def _drop_before(self, target: _Target, time_utc_s: float) -> None:
        kept = int(np.searchsorted(target.times, time_utc_s))
        target.times, target.rows = target.times[kept:], target.rows[kept:]

    def _positions(self, target: _Target, first: int) -> Positions:
        en, stated, shared = (np.array(part) for part in zip(*target.rows[first:], strict=True))
        return Positions(
            east_m=en[:, 0],
            north_m=en[:, 1],
            covariance_m2=stated,
            extrapolated=np.zeros(len(en), dtype=bool),
            plane=self._model.plane,
            shared_covariance_m2=shared,
        )

    def _lies_still(self, target: _Target) -> bool:
        """Whether a target has not moved for a while, as far as its boxes can tell."""
        times = np.array(target.times)
        times = times[times > times[-1] - self._settings.window_s]
        span_s = float(times[-1] - times[0])
        if span_s < self._settings.moored_after_s:
            return False
        rows = target.rows[-times.size :]
        en = np.array([row[0] for row in rows])
        own = np.array([np.trace(row[1] - row[2]) for row in rows])
        block = np.minimum(((times - times[0]) / span_s * _BLOCKS).astype(int), _BLOCKS - 1)
        count = np.bincount(block, minlength=_BLOCKS)
        if count.min() < 3:
            return False
        means = np.stack([np.bincount(block, column) / count for column in en.T], axis=1)
        block_s = span_s / _BLOCKS
        # Errors last, so that boxes in a second are one.
        draws = np.minimum(count, max(1.0, block_s / (2.0 * _CORRELATION_S)))
        sigma_m = float(np.sqrt(2.0 * np.mean(own) / draws.min()))
        farthest_m = float(np.hypot(*(means[:, None] - means[None]).transpose(2, 0, 1)).max())
        return (farthest_m + 2.0 * sigma_m) / block_s < self._settings.moored_mps


def _places(model: Georeferencer, boxes: Boxes) -> Positions:
    """Places of boxes; a tracker that is restored asks for those of none, which nobody located."""
    if isinstance(boxes, LocatedBoxes):
        return positions_on_earth(boxes)
    level_m = model.water_level_m
    return model.locate(boxes.xyxy_px, boxes.source, level_m)
