"""Whether a camera that ought to stand still did: a model that was fitted does not hold after."""

from __future__ import annotations

import logging
from datetime import UTC, datetime

import numpy as np

from sightline.detection import look
from sightline.detection.camera_motion import CameraMotionWatch, CameraTurn
from sightline.inference.georeferencer import Georeferencer
from sightline.scene import Recording
from sightline.types import FloatArray, Frame

LOOKS_APART_S = 1.0
"""One picture in so long is looked at."""

_LEAST_DEG = 0.05
# Phase correlation is sure to a tenth of a pixel.
_LEAST_PX = 0.8
_REFERENCE = 5
_COLUMNS = 33

_logger = logging.getLogger(__name__)


class StandingWatch:
    """Looks at some of the pictures that pass, and notes when their camera was turned.

    A camera that moves anyway, or whose horizon lies outside the picture, is not watched.

    Attributes:
        turns: So far, in the order of time.
    """

    def __init__(self, model: Georeferencer, warn_of: str | None = None) -> None:
        """Take from the model where the horizon lies.

        Args:
            model: Of the camera.
            warn_of: The source, where each turn is to be warned of as it is noticed.
        """
        self._warn_of = warn_of
        self.turns: list[CameraTurn] = []
        self._size_px = model.image_size_px
        self._watch = _watch(model)
        self._next_s = -np.inf

    @property
    def able(self) -> bool:
        """Whether anything is looked at."""
        return self._watch is not None

    def look(self, frame: Frame) -> CameraTurn | None:
        """Look at a picture, where the last look was long enough ago; the turn noticed in it."""
        if self._watch is None or not frame.time_utc_s >= self._next_s:
            return None
        if frame.image_bgr.shape[1::-1] != self._size_px:
            return None
        self._next_s = frame.time_utc_s + LOOKS_APART_S
        turn = self._watch.update(frame)
        if turn is not None:
            self.turns.append(turn)
            if self._warn_of is not None:
                _logger.warning("%s: %s", self._warn_of, turn_sentence(turn))
        return turn

    def note(self, recording: str) -> str | None:
        """The turns in a sentence or more; None where there was none.

        Args:
            recording: Its name.
        """
        if not self.turns:
            return None
        return f"Recording {recording}: {' '.join(map(turn_sentence, self.turns))}"


def camera_turns(recording: Recording, model: Georeferencer) -> str | None:
    """What the pictures of a recording say of turns of its camera.

    Args:
        recording: With or without pictures.
        model: Says where the horizon lies.

    Returns:
        A sentence, where the camera was turned; None where it was not, or nothing tells.

    Raises:
        InputError: The pictures cannot be read.
    """
    watch = StandingWatch(model)
    if recording.source is None or not watch.able:
        return None
    look(recording.frames(), [watch])
    return watch.note(recording.name)


def turn_sentence(turn: CameraTurn) -> str:
    """A turn in words."""
    when = datetime.fromtimestamp(turn.time_utc_s, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    return (
        f"the camera was turned shortly before {when}: by {turn.heading_deg:+.2f} degrees in "
        f"heading, {turn.pitch_deg:+.2f} in pitch and {turn.roll_deg:+.2f} in roll, "
        f"{turn.shift_px:.1f} px in the picture; a model of the time before does not hold after."
    )


def _watch(model: Georeferencer) -> CameraMotionWatch | None:
    camera = model.camera
    if camera is None or model.moving:
        return None
    width, height = model.image_size_px
    rows: FloatArray = camera.horizon_y_px(np.linspace(0.0, width, _COLUMNS))
    if not (np.isfinite(rows).all() and (rows > 0.0).all() and (rows < height).all()):
        return None
    focal_px = float(camera.focal_px)
    least_deg = max(_LEAST_DEG, float(np.degrees(_LEAST_PX / focal_px)))
    watch = CameraMotionWatch(rows, focal_px, least_deg=least_deg, reference_frames=_REFERENCE)
    return watch if watch.fits(model.image_size_px) else None
