"""Whether a camera that ought to stand still did, and what a turn does to boxes."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from sightline.camera.motion import CameraMotionWatch, CameraTurn, Stance
from sightline.camera.rotation import seen_again
from sightline.camera.static_intervals import LOOKS_APART_S, LOOKS_OF_REFERENCE, least_turn_deg
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.conditions import Conditions
from sightline.scene import Recording
from sightline.scene.camera_state import recording_stances
from sightline.types import Boxes, FloatArray, Frame, rfc3339
from sightline.water import WaterLevels

_COLUMNS = 33

_UNRECOGNISED = (
    "the far shore that the model was fitted with is not made out in the first pictures (too few, "
    "night, fog, another season?), so nothing tells whether the camera still lies as for the "
    "model; it is taken to lie so until it turns."
)

_logger = logging.getLogger(__name__)


class Standing:
    """Knows how the camera lay in a recording, and how high the water stood."""

    def __init__(self, conditions: Conditions | None = None) -> None:
        """Take what is known of it; None: it lay as for the model."""
        self._conditions = conditions or Conditions()

    @property
    def conditions(self) -> Conditions:
        """What is known by now."""
        return self._conditions

    def level(self, batches: Iterable[Boxes]) -> Iterator[Boxes]:
        """Boxes as the camera of the model would have seen them.

        Args:
            batches: In the order of time.
        """
        return map(self._conditions.level, batches)


class StandingWatch(Standing):
    """Looks at some of the pictures that pass, and notes when their camera was turned.

    A camera that moves anyway, or whose horizon lies outside the picture, is not watched.
    """

    def __init__(
        self,
        model: Georeferencer,
        *,
        warn_of: str | None = None,
        correct: bool = True,
        water: WaterLevels | None = None,
    ) -> None:
        """Take from the model where the horizon lies, and what stood still before it.

        Args:
            model: Of the camera.
            warn_of: The source, where each turn is to be warned of as it is noticed.
            correct: Whether boxes are to be levelled.
            water: How high the water stands.
        """
        super().__init__(Conditions(water=water))
        self._warn_of = warn_of
        self._noticed: list[CameraTurn] = []
        self._model, self._correct = model, correct
        self._size_px = model.image_size_px
        self._watch = _watch(model)
        self._next_s = -np.inf
        self._known = 0

    @property
    def noticed(self) -> tuple[CameraTurn, ...]:
        """The turns so far, in the order of time."""
        return tuple(self._noticed)

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
        stances = self._watch.stances
        if len(stances) != self._known:
            if self._known == 0 and not _recognised(self._model, stances):
                self._warn(_UNRECOGNISED)
            self._known = len(stances)
            turns = self._model.turns(stances)
            if self._correct:
                self._conditions = replace(self._conditions, turns=turns)
            if turn is None and turns is not None:
                self._warn_of_turn(turns.sentences()[0])
        if turn is not None:
            self._noticed.append(turn)
            self._warn_of_turn(turn_sentence(turn))
        return turn

    def _warn_of_turn(self, sentence: str) -> None:
        made_up = self._conditions.turns is not None
        after = "Positions are corrected." if made_up else "The model does not hold for it."
        self._warn(f"{sentence} {after}")

    def _warn(self, sentences: str) -> None:
        if self._warn_of is not None:
            _logger.warning("%s: %s", self._warn_of, sentences)

    def level(self, batches: Iterable[Boxes]) -> Iterator[Boxes]:
        """See `Standing`; boxes wait until no turn before them can be told of any more."""
        if self._watch is None or not self._correct:
            yield from batches
            return
        waiting: deque[Boxes] = deque()
        for boxes in batches:
            waiting.append(boxes)
            while waiting and _last_s(waiting[0]) <= self._watch.settled_utc_s:
                yield self._conditions.level(waiting.popleft())
        for boxes in waiting:
            yield self._conditions.level(boxes)


def recording_conditions(
    recording: Recording, model: Georeferencer, *, watched: bool = True
) -> Conditions:
    """How the camera lay in a recording, against how it lies for a model, and the water.

    Args:
        recording: With or without pictures.
        model: To place its boxes.
        watched: Whether its pictures are asked if the camera was turned.

    Raises:
        InputError: The recording has water levels and the model knows of none, or the reverse.
    """
    water = recording.water_levels()
    model.check_water(water is not None, f"recording {recording.name}: ")
    seen = watched and model.camera is not None and not model.moving
    return Conditions(model.turns(recording_stances(recording)) if seen else None, water)


def camera_turns(recording: Recording, model: Georeferencer) -> str | None:
    """What the pictures of a recording say of turns of its camera.

    Args:
        recording: With or without pictures.
        model: Says how its camera lies.

    Returns:
        A sentence or more, where the camera was turned in the recording, or lay otherwise than
        for the model, or its pictures cannot be compared with what the model's camera saw; None
        where it lay as for the model, or there are no pictures or no view to compare.
    """
    if model.camera is None or model.moving:
        return None
    stances = recording_stances(recording)
    turns = model.turns(stances)
    seen = recording.source is None or _recognised(model, stances)
    said = [] if seen else [_UNRECOGNISED]
    said += [] if turns is None else turns.sentences()
    return f"Recording {recording.name}: {' '.join(said)}" if said else None


def turn_sentence(turn: CameraTurn) -> str:
    """A turn in words."""
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


def _recognised(model: Georeferencer, stances: Sequence[Stance]) -> bool:
    """Whether a recording's beginning shows what stood still before the model's camera.

    True as well where the model has no view to compare it with.
    """
    if model.view is None or model.camera is None:
        return True
    return bool(stances) and seen_again(model.view, stances[0].view, model.camera)


def _last_s(boxes: Boxes) -> float:
    return float(boxes.time_utc_s.max(initial=-np.inf))


def _watch(model: Georeferencer) -> CameraMotionWatch | None:
    camera = model.camera
    if camera is None or model.moving or not CameraMotionWatch.fits(model.image_size_px):
        return None
    width, height = model.image_size_px
    rows: FloatArray = camera.horizon_y_px(np.linspace(0.0, width, _COLUMNS))
    seen = np.isfinite(rows).all() and (rows > 0.0).all() and (rows < height).all()
    if model.view is None and not seen:
        return None
    return CameraMotionWatch(
        rows if seen else None,
        float(camera.focal_px),
        least_deg=least_turn_deg(float(camera.focal_px)),
        reference_frames=LOOKS_OF_REFERENCE,
        like=model.view,
    )
