"""Which log is whose: what recognition weighs, for somebody to look at and to confirm."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sightline.detection import Detector
from sightline.errors import InputError, SightlineError
from sightline.pipeline.fit_unlabelled import LogCandidate, weigh_scene
from sightline.scene import Recording, Scene
from sightline.text import encodable_text

if TYPE_CHECKING:
    from sightline.labelling.drawing import Drawing

IDLE, RUNNING, DONE, FAILED = "idle", "running", "done", "failed"
"""States of the weighing."""

_MOST_SHOWN = 24


class _ClosedError(Exception):
    """The page is closed, and nobody waits any more."""


@dataclass(frozen=True)
class _State:
    """How far it is.

    Attributes:
        word: One of the states.
        doing: What is being done.
        share: Of that, 0 to 1; NaN where it is not known.
        reason: Why it failed.
        found: Candidates of the recording that is drawn in.
    """

    word: str = IDLE
    doing: str = ""
    share: float = math.nan
    reason: str = ""
    found: tuple[LogCandidate, ...] = ()


class WhoseBench:
    """Weighs which vessel in a recording kept the log, in a thread of its own.

    The recordings of the scene that have a table of detections are weighed together, since they
    share the camera, and with them the one that is drawn in, by a detector where it has none.

    Args:
        scene: The scene file.
        drawing: The recording that is drawn in.
        detector: Finds boxes in its frames; an object or a name.
    """

    def __init__(self, scene: Path, drawing: Drawing, detector: str | Detector) -> None:
        self._scene, self._drawing, self._detector = scene, drawing, detector
        self._lock = threading.Lock()
        self._state = _State()
        self._closed = False

    def shown(self) -> dict[str, object]:
        """How far it is, and the candidates."""
        with self._lock:
            state = self._state
        explanations = {one.explanation: one.probability for one in state.found}
        return {
            "state": state.word,
            "doing": encodable_text(state.doing),
            "share": state.share if math.isfinite(state.share) else None,
            "reason": encodable_text(state.reason),
            "feed": self._is_feed(),
            "others": max(1.0 - sum(explanations.values()), 0.0) if state.word == DONE else None,
            "candidates": [
                _candidate(number, one) for number, one in enumerate(state.found[:_MOST_SHOWN])
            ],
        }

    def weigh(self) -> None:
        """Begin to weigh, unless it is being done."""
        with self._lock:
            if self._state.word == RUNNING or self._closed:
                return
            self._state = _State(RUNNING, "reading the scene")
        threading.Thread(target=self._work, daemon=True, name="weigh").start()

    def confirm(self, number: int) -> int:
        """Write the boxes of a candidate into the table of the recording; how many there are.

        Raises:
            InputError: There is no such candidate, or it cannot be written.
        """
        with self._lock:
            found = self._state.found[:_MOST_SHOWN]
        if number >= len(found):
            raise InputError(f"there is no candidate {number} any more; weigh them anew")
        candidate = found[number]
        mmsi = None
        if self._is_feed():
            if not candidate.vessel.isdecimal():
                raise InputError(
                    f"{candidate.vessel!r} is no MMSI, by which the scene would name the vessel of "
                    "the AIS log; write mmsi = … in the scene"
                )
            mmsi = int(candidate.vessel)
        return self._drawing.confirm(candidate.boxes, mmsi)

    def close(self) -> None:
        """Weigh no more; what is under way ends when it next tells how far it is."""
        self._closed = True

    def _is_feed(self) -> bool:
        """Whether the log is of many vessels, of which none is chosen yet."""
        try:
            return self._drawing.logged.is_feed()
        except InputError:
            return False

    def _work(self) -> None:
        try:
            scene = Scene.load(self._scene)
            name = self._drawing.recording
            asked = [
                one.name for one in scene.recordings if one.name == name or _has_boxes_and_log(one)
            ]
            found = weigh_scene(scene.select(asked), detector=self._detector, progress=self._tell)
            own = tuple(one for one in found if one.recording == name)
            self._set(_State(DONE, found=own))
        except _ClosedError:
            return
        except SightlineError as error:
            self._set(_State(FAILED, reason=str(error)))
        # What nobody foresaw must not leave the page waiting.
        except Exception as error:
            self._set(_State(FAILED, reason=f"weighing failed: {error!r}"[:300]))

    def _tell(self, doing: str, share: float) -> None:
        if self._closed:
            raise _ClosedError
        with self._lock:
            self._state = replace(self._state, doing=doing, share=share)

    def _set(self, state: _State) -> None:
        with self._lock:
            self._state = state


def _has_boxes_and_log(recording: Recording) -> bool:
    return recording.detections_path is not None and recording.fixes_path is not None


def _candidate(number: int, one: LogCandidate) -> dict[str, object]:
    seen = np.asarray(np.isfinite(one.place_px).all(axis=1))
    return {
        "number": number,
        "explanation": one.explanation,
        "vessel": encodable_text(one.vessel),
        "probability": one.probability,
        "evidence": round(one.evidence, 2),
        "match": round(one.match, 2),
        "clock_offset_s": round(one.clock_offset_s, 2),
        "seen": one.seen,
        "sources": sorted({encodable_text(name) for name in one.boxes.source.tolist()}),
        "boxes": [
            {
                "frame": frame,
                "box_px": box,
                "place_px": place if there else None,
            }
            for frame, box, place, there in zip(
                one.boxes.frame.tolist(),
                one.boxes.xyxy_px.round(2).tolist(),
                one.place_px.round(2).tolist(),
                seen.tolist(),
                strict=True,
            )
        ],
    }
