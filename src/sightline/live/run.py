"""A camera that is watched: frames in, moments out, for as long as nobody asks to stop."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.area import Area
from sightline.camera.horizon_tracker import with_horizons
from sightline.camera.state import ObservedBoxes
from sightline.detection import Detector
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.live.ais import AisMatcher
from sightline.live.boundaries import BoundaryWatch
from sightline.live.clips import ClipRecorder
from sightline.live.lines import Lines
from sightline.live.on_the_map import Newest
from sightline.live.source import LiveFrame, Source, SourceEvent
from sightline.live.state import LiveState, StateSettings
from sightline.live.store import Keeper
from sightline.moment import Feed, Moment
from sightline.pipeline.camera_state import CameraMotionMonitor
from sightline.threads import on_one_thread
from sightline.types import Frame
from sightline.video.mask import GREY, Mask
from sightline.water import WaterLevels

_TAKE_S = 0.2
_MOST_FAILURES = 20
_STATE_EVERY_S = 1.0
_STATUS_EVERY_S = 60.0
_FINISH_S = 0.8
_RATE_S = 10.0

Told = Callable[[str, str], None]
"""Is told what happens: a kind, and a text."""


@dataclass(frozen=True)
class Camera:
    """What a camera that is watched is watched with.

    Attributes:
        name: Of the camera.
        model: Its model.
        detector: Finds boxes in its frames.
        mask: Where pictures are neither looked at nor kept nor shown.
        area: Where targets can be.
        water_level_m: How high the water stands, where the model needs it.
        targets: How targets are followed.
        silent_s: Without a frame for so long it counts as silent.
        boundaries: Lines and zones that are watched.
    """

    name: str
    model: Georeferencer
    detector: Detector
    mask: Mask | None = None
    area: Area | None = None
    water_level_m: float | None = None
    targets: StateSettings = field(default_factory=StateSettings)
    silent_s: float = 5.0
    boundaries: BoundaryWatch | None = None


@dataclass(frozen=True)
class EarlierRun:
    """What a run left to the next, so that no number is used twice.

    Attributes:
        highest_id: Of its targets, and of those before.
        state: What identities are carried on with; see `LiveState.carry_on`.
    """

    highest_id: int = 0
    state: Mapping[str, object] = field(default_factory=dict)


class LiveRun:
    """Watches one camera; `run` returns when it is asked to stop, or a recording has ended."""

    def __init__(
        self,
        source: Source,
        camera: Camera,
        *,
        feeds: Mapping[str, Feed] | None = None,
        keeper: Keeper | None = None,
        earlier: EarlierRun | None = None,
        told: Told | None = None,
        ais: AisMatcher | None = None,
    ) -> None:
        """Take all parts; nothing is begun.

        Args:
            source: Hands on frames.
            camera: What it is watched with.
            feeds: Where moments go, by what they are called.
            keeper: Keeps them.
            earlier: What the run before left.
            told: Is told what happens.
            ais: Names targets by what vessels say of themselves.
        """
        earlier = earlier or EarlierRun()
        self._ais = ais
        self._clips: ClipRecorder | None = None
        self._source, self._camera, self._keeper = source, camera, keeper
        self._feeds = dict(feeds or {})
        self._told = told
        self._lines: Lines | None = None
        self.state = LiveState(
            camera.model,
            camera.name,
            settings=camera.targets,
            first_id=earlier.highest_id + 1,
            area=camera.area,
        )
        self._earlier = earlier
        self._water = None
        camera.model.check_water(camera.water_level_m is not None)
        if camera.water_level_m is not None:
            self._water = WaterLevels.constant(camera.water_level_m)
        self._next_camera: Camera | None = None
        self._monitor = self._new_monitor()
        self._begun_s = time.monotonic()
        self._processed = self._failed = self._failed_in_a_row = 0
        self._busy_s: list[float] = []
        self._last: tuple[NDArray[np.uint8], Moment] | None = None
        self._state_due_s = 0.0
        self._status_due_s = time.monotonic() + _STATUS_EVERY_S

    def record(self, clips: ClipRecorder) -> None:
        """Take a clip of each track; before it runs."""
        self._clips = clips

    def add_feed(self, name: str, feed: Feed) -> None:
        """Send moments to one more, from when it runs."""
        self._feeds[name] = feed
        if self._lines is not None:
            self._lines.add(name, feed)

    def remove_feed(self, name: str) -> None:
        """Send moments to one no more, which is closed."""
        self._feeds.pop(name, None)
        if self._lines is not None:
            self._lines.remove(name)

    def change(self, camera: Camera) -> None:
        """Watch with something else, from the next frame on; from any thread.

        Args:
            camera: Of the same model, name and water level.
        """
        self._next_camera = camera

    def _take_change(self) -> None:
        camera, self._next_camera = self._next_camera, None
        if camera is not None:
            before = self._camera.boundaries
            if camera.boundaries is not None and before is not None:
                camera.boundaries.carry_on(before)
            self._camera = camera
            self.state.change(camera.targets, camera.area)

    @on_one_thread
    def run(self, stop: threading.Event) -> None:
        """Watch until ``stop`` is set, or the source has ended.

        Raises:
            Exception: What a detector raises many times in a row.
        """
        self._lines = Lines(self._feeds, lambda text: self._tell("feed", text))
        if self._keeper is not None:
            self._keeper.start()
        if self._clips is not None:
            self._clips.start()
        first = True
        self._source.start()
        try:
            while not stop.is_set():
                live = self._source.take(_TAKE_S)
                if time.monotonic() > self._status_due_s:
                    self._status_due_s += _STATUS_EVERY_S
                    self._tell("status", _in_words(self.health()))
                if live is None:
                    if self._source.health == "ended":
                        break
                    continue
                if first and self.state.carry_on(self._earlier.state, live.frame.time_utc_s):
                    self._tell("carried-on", "the targets of the run before are carried on")
                first = False
                self._take_change()
                self._process(live)
        finally:
            self._finish()

    def _process(self, live: LiveFrame) -> None:
        try:
            moment = self._moment(live)
        except Exception as error:
            self._failed += 1
            self._failed_in_a_row += 1
            if self._failed_in_a_row >= _MOST_FAILURES:
                raise
            if self._failed_in_a_row == 1:
                self._tell("failed", f"a frame could not be looked at: {error!r}")
            return
        self._failed_in_a_row = 0
        self._processed += 1
        now_s = time.monotonic()
        self._busy_s = [one for one in self._busy_s if one > now_s - _RATE_S] + [now_s]
        # Kept first: what is published is on its way to the disk.
        if self._keeper is not None:
            kept_state = None
            if now_s >= self._state_due_s:
                self._state_due_s = now_s + _STATE_EVERY_S
                kept_state = self.state.to_json()
            checks = [] if self._ais is None else self._ais.take_checks()
            self._keeper.keep(moment, (), kept_state, [*moment.alerts, *checks])
        assert self._lines is not None, "made by `run`"
        self._lines.publish(moment)
        parts = self.state.smooth_next(moment.time_utc_s)
        if parts and self._keeper is not None:
            self._keeper.keep(None, parts)

    def _moment(self, live: LiveFrame) -> Moment:
        if live.clock_step_s:
            self.state.shift(live.clock_step_s)
            self._monitor = self._new_monitor()
        frame = self._masked(live.frame)
        self._monitor.observe(frame)
        if self._camera.model.horizon_px is not None:
            (frame,) = with_horizons([frame])
        boxes = self._camera.detector.detect(frame)
        observed = ObservedBoxes.of_frame(boxes, frame)
        if self._camera.mask is not None and len(observed):
            observed = observed[~self._camera.mask.hides(observed)]
        height, width = frame.image_bgr.shape[:2]
        moment = self.state.update(
            self._monitor.history.observed(observed),
            frame.time_utc_s,
            capture=live.capture,
            capture_sigma_s=live.sigma_s,
            frame_size_px=(width, height),
        )
        if self._ais is not None:
            moment = self._ais.identify(moment, str(boxes.source[0]) if len(boxes) else "")
        if self._camera.boundaries is not None:
            moment = self._camera.boundaries.update(moment)
        self._last = frame.image_bgr, moment
        if self._clips is not None:
            self._clips.offer(frame.image_bgr, moment)
        return moment

    def _masked(self, frame: Frame) -> Frame:
        if self._camera.mask is None:
            return frame
        image = frame.image_bgr.copy()
        image[self._camera.mask.hidden] = GREY
        return replace(frame, image_bgr=image)

    def _finish(self) -> None:
        """Make tracks final, send and write what is left, and let go of all threads."""
        parts = self.state.finish(_FINISH_S)
        if self._keeper is not None:
            # A restart soon afterwards carries on from the last frame.
            self._keeper.keep(None, parts, self.state.to_json())
        if self._lines is not None:
            self._lines.close()
        self._source.close()
        if self._keeper is not None:
            self._keeper.close()
        if self._clips is not None:
            self._clips.close()

    def _new_monitor(self) -> CameraMotionMonitor:
        return CameraMotionMonitor(self._camera.model, warn_of=self._camera.name, water=self._water)

    def _tell(self, kind: str, text: str) -> None:
        if self._told is not None:
            self._told(kind, text)

    def health(self) -> dict[str, object]:
        """How it is, in numbers."""
        counts, age_s = self._source.counts, self._source.age_s()
        state, reason = str(self._source.health), self._source.reason
        if state == "ok" and age_s is not None and age_s > 2.0 * self._camera.silent_s:
            state, reason = "silent", f"no frame came for {age_s:.0f} s"
        keeper = self._keeper
        if state == "ok" and keeper is not None and keeper.problem:
            state, reason = "not-kept", keeper.problem
        recent = self._busy_s
        told: dict[str, object] = {
            "state": state,
            "reason": reason,
            "frames_seen": counts.seen,
            "frames_left_out": counts.left_out,
            "frames_paused": counts.paused,
            "frames_processed": self._processed,
            "frames_failed": self._failed,
            "frames_per_s": round(len(recent) / _RATE_S, 2),
            "age_s": None if age_s is None else round(age_s, 3),
            "uptime_s": round(time.monotonic() - self._begun_s, 1),
            "reconnections": counts.reconnections,
            "targets": len(self.state),
            "events": dict(counts.events),
        }
        if self._clips is not None:
            told["clips"] = {"left_out": self._clips.left_out, "problem": self._clips.problem}
        if self._lines is not None:
            told["feeds"] = self._lines.counts()
        if self._ais is not None:
            told["ais"] = self._ais.figures()
        if self._camera.boundaries is not None:
            states = self._camera.boundaries.states()
            told["boundaries"] = [state.to_message() for state in states]
        if keeper is not None:
            known = np.isfinite(keeper.kept_utc_s)
            told["kept_utc_s"] = keeper.kept_utc_s if known else None
            told["moments_lost"] = keeper.lost
        return told

    def newest(self) -> Newest | None:
        """The last frame, masked, and how the camera lay; None before there is one."""
        last, rotation = self._last, self._monitor.history.rotation
        if last is None:
            return None
        image, moment = last
        turned = np.full(3, np.nan)
        if rotation is not None:
            turned = rotation.at(np.array([moment.time_utc_s]))[0][0]
        return Newest(image, turned)

    def picture(self) -> bytes | None:
        """The last frame as JPEG, masked, with boxes; None before there is one."""
        last = self._last
        if last is None:
            return None
        image, moment = last[0].copy(), last[1]
        for target in moment.targets:
            if target.box_xyxy_px is not None:
                x1, y1, x2, y2 = (round(value) for value in target.box_xyxy_px)
                cv2.rectangle(image, (x1, y1), (x2, y2), (0, 200, 255), 2)
                place = (x1, max(12, y1 - 4))
                cv2.putText(
                    image, str(target.id), place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 200, 255), 1
                )
        done, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])
        return jpeg.tobytes() if done else None


def tell_events(told: Told) -> Callable[[SourceEvent], None]:
    """A listener of a source that tells its events."""
    return lambda event: told(event.kind, event.text)


def _in_words(health: Mapping[str, object]) -> str:
    return (
        f"{health['state']}: {health['frames_processed']} frames processed, "
        f"{health['frames_left_out']} left out, {health['frames_per_s']} a second, "
        f"{health['targets']} targets, {health['reconnections']} reconnections"
    )
