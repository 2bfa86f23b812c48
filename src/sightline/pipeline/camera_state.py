"""Camera motion monitoring, and the camera state by which boxes are located."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from sightline.camera.motion import CameraMotionDetector, CameraTurn, StaticInterval
from sightline.camera.rotation import seen_again
from sightline.camera.state import CameraHistory, ObservedBoxes
from sightline.camera.static_intervals import LOOKS_APART_S, LOOKS_OF_REFERENCE, least_turn_deg
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.scene import Recording
from sightline.scene.camera_state import recording_static_intervals, scene_horizons
from sightline.types import Boxes, FloatArray, Frame, rfc3339
from sightline.water import WaterLevels

_COLUMNS = 33

_UNRECOGNISED = (
    "the far shore that the model was fitted with is not made out in the first pictures (too few, "
    "night, fog, another season?), so nothing tells whether the camera still lies as for the "
    "model; it is taken to lie so until it turns."
)

_logger = logging.getLogger(__name__)


class CameraMotionMonitor:
    """Observes frames, and detects rotations of a camera that should be static.

    A camera that moves anyway, or whose horizon lies outside the picture, is not monitored.
    """

    def __init__(
        self,
        model: Georeferencer,
        *,
        warn_of: str | None = None,
        compensate: bool = True,
        water: WaterLevels | None = None,
    ) -> None:
        """Take the horizon and the reference view of the model.

        Args:
            model: Of the camera.
            warn_of: The source, where each rotation is to be warned of as it is detected.
            compensate: Whether rotations are compensated in boxes.
            water: How high the water stands.
        """
        self._history = CameraHistory(water=water)
        self._warn_of = warn_of
        self._model, self._compensate = model, compensate
        self._size_px = model.image_size_px
        self._watch = _watch(model)
        self._next_s = -np.inf
        self._known = 0

    @property
    def history(self) -> CameraHistory:
        """The camera history so far."""
        return self._history

    @property
    def able(self) -> bool:
        """Whether the camera can be monitored."""
        return self._watch is not None

    def observe(self, frame: Frame) -> CameraTurn | None:
        """Observe a frame, at most one a second; returns the rotation detected in it."""
        if self._watch is None or not frame.time_utc_s >= self._next_s:
            return None
        if frame.image_bgr.shape[1::-1] != self._size_px:
            return None
        self._next_s = frame.time_utc_s + LOOKS_APART_S
        turn = self._watch.update(frame)
        static_intervals = self._watch.static_intervals
        if len(static_intervals) != self._known:
            if self._known == 0 and not _recognised(self._model, static_intervals):
                self._warn(_UNRECOGNISED)
            self._known = len(static_intervals)
            rotation = self._model.rotation_in(static_intervals)
            if self._compensate:
                self._history = replace(self._history, rotation=rotation)
            if turn is None and rotation is not None:
                self._warn_of_turn(rotation.sentences()[0])
        if turn is not None:
            self._warn_of_turn(turn_sentence(turn))
        return turn

    def _warn_of_turn(self, sentence: str) -> None:
        made_up = self._history.rotation is not None
        after = "Positions are corrected." if made_up else "The model does not hold for it."
        self._warn(f"{sentence} {after}")

    def _warn(self, sentences: str) -> None:
        if self._warn_of is not None:
            _logger.warning("%s: %s", self._warn_of, sentences)

    def observed(self, batches: Iterable[Boxes]) -> Iterator[ObservedBoxes]:
        """Buffer boxes until no earlier rotation can still be detected.

        Args:
            batches: In the order of time, of frames that were observed.
        """
        if self._watch is None or not self._compensate:
            yield from map(self._history.observed, batches)
            return
        waiting: deque[Boxes] = deque()
        for boxes in batches:
            waiting.append(boxes)
            while waiting and _last_s(waiting[0]) <= self._watch.settled_utc_s:
                yield self._history.observed(waiting.popleft())
        for boxes in waiting:
            yield self._history.observed(boxes)


def recording_history(
    recording: Recording, model: Georeferencer, *, pictures: bool = True
) -> CameraHistory:
    """Camera rotation, horizons and water levels of a recording, against a model.

    Args:
        recording: With or without pictures.
        model: To locate its boxes.
        pictures: Whether its frames are observed for camera rotation.

    Raises:
        InputError: The recording has water levels and the model knows of none, or the reverse.
    """
    water = recording.water_levels()
    model.check_water(water is not None, f"recording {recording.name}: ")
    rotation = None
    if pictures and model.camera is not None and not model.moving:
        rotation = model.rotation_in(recording_static_intervals(recording))
    return CameraHistory(rotation, scene_horizons(recording), water)


def camera_turns(recording: Recording, model: Georeferencer) -> str | None:
    """Camera rotations that the frames of a recording show, in words.

    Args:
        recording: With or without pictures.
        model: Whose camera it is compared with.

    Returns:
        A sentence or more, where the camera was rotated in the recording or against the model's
        camera, or its frames cannot be registered against the model's reference view; None where
        it was not rotated, or there are no frames or no view to compare.
    """
    if model.camera is None or model.moving:
        return None
    static_intervals = recording_static_intervals(recording)
    rotation = model.rotation_in(static_intervals)
    seen = recording.source is None or _recognised(model, static_intervals)
    said = [] if seen else [_UNRECOGNISED]
    said += [] if rotation is None else rotation.sentences()
    return f"Recording {recording.name}: {' '.join(said)}" if said else None


def turn_sentence(turn: CameraTurn) -> str:
    """A camera rotation in words."""
    heading = (
        f"{turn.heading_deg:+.2f} degrees in heading"
        if np.isfinite(turn.heading_deg)
        else "an unknown angle, since only the horizon is seen, in heading"
    )
    return (
        f"the camera was turned shortly before {rfc3339(turn.time_utc_s)}: by {heading}, "
        f"{turn.pitch_deg:+.2f} in pitch and {turn.roll_deg:+.2f} in roll, "
        f"{turn.shift_px:.1f} px in the picture."
    )


def _recognised(model: Georeferencer, static_intervals: Sequence[StaticInterval]) -> bool:
    """Whether a recording begins with the static scene of the model's reference view.

    True as well where the model has no view to compare it with.
    """
    if model.view is None or model.camera is None:
        return True
    return bool(static_intervals) and seen_again(model.view, static_intervals[0].view, model.camera)


def _last_s(boxes: Boxes) -> float:
    return float(boxes.time_utc_s.max(initial=-np.inf))


def _watch(model: Georeferencer) -> CameraMotionDetector | None:
    camera = model.camera
    if camera is None or model.moving or not CameraMotionDetector.fits(model.image_size_px):
        return None
    width, height = model.image_size_px
    rows: FloatArray = camera.horizon_y_px(np.linspace(0.0, width, _COLUMNS))
    seen = np.isfinite(rows).all() and (rows > 0.0).all() and (rows < height).all()
    if model.view is None and not seen:
        return None
    return CameraMotionDetector(
        rows if seen else None,
        float(camera.focal_px),
        least_deg=least_turn_deg(float(camera.focal_px)),
        reference_frames=LOOKS_OF_REFERENCE,
        like=model.view,
    )
