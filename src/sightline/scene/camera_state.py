"""How the camera pointed in the recordings of a scene, by their tables or their pictures."""

from __future__ import annotations

import logging
from functools import lru_cache

import numpy as np

from sightline.camera.horizon_tracker import HorizonWatch
from sightline.camera.motion import Stance
from sightline.camera.static_intervals import LOOKS_APART_S, StanceWatch
from sightline.errors import InputError
from sightline.progress import Progress
from sightline.scene import Recording, Scene
from sightline.types import Horizons


def scene_horizons(recording: Recording) -> Horizons | None:
    """Where the horizon lies in a recording: as its table says, or as its pictures show.

    Pictures are only looked at where the camera stands on a platform that moves.

    Raises:
        InputError: A file of the recording cannot be used.
    """
    told = recording.horizons()
    if told is not None or recording.platform_path is None or recording.source is None:
        return told
    return _in_pictures(recording, recording.source.stat().st_mtime_ns)


# Leaving one recording out at a time asks again and again, and a look at every picture takes long.
@lru_cache(maxsize=32)
def _in_pictures(recording: Recording, _modified_ns: int) -> Horizons:
    watch = HorizonWatch()
    found = []
    for frame in recording.frames():
        watch.look(frame)
        found.append(watch.seen)
    return Horizons(
        *(
            np.concatenate([getattr(one, name) for one in found])
            for name in ("time_utc_s", "left_y_px", "right_y_px")
        )
    )


def scene_stances(scene: Scene, progress: Progress | None = None) -> dict[str, tuple[Stance, ...]]:
    """`recording_stances` of all recordings of a scene in which it is asked for.

    Args:
        scene: Its recordings' pictures.
        progress: Told what is being looked at: a long video takes long.
    """
    if scene.moves or not scene.camera.watched:
        return {}
    found = {}
    for i, recording in enumerate(scene.recordings):
        if progress is not None:
            what = f"looking at the pictures of {recording.name}"
            progress(what, i / len(scene.recordings))
        found[recording.name] = recording_stances(recording)
    return {name: stances for name, stances in found.items() if stances}


_logger = logging.getLogger(__name__)


_MOST_REMEMBERED = 128


# Leaving one recording out at a time asks again and again, and to look at pictures takes long.
_remembered: dict[tuple[Recording, int], tuple[Stance, ...]] = {}


def recording_stances(recording: Recording) -> tuple[Stance, ...]:
    """How the camera stood in a recording, by its pictures; none where there are no pictures.

    Where they cannot be read, a warning says so: boxes that somebody drew do without them.
    """
    if recording.source is None or recording.platform_path is not None:
        return ()
    if not stances_known(recording):
        watch = StanceWatch()
        try:
            for frame in recording.frames(apart_s=LOOKS_APART_S):
                watch.look(frame)
        except InputError as error:
            _logger.warning("nobody can tell whether the camera was turned: %s", error)
            watch = StanceWatch()
        remember_stances(recording, watch.stances)
    return _remembered[_key(recording)]


def stances_known(recording: Recording) -> bool:
    """Whether the pictures of a recording were looked at before."""
    return _key(recording) in _remembered


def remember_stances(recording: Recording, stances: tuple[Stance, ...]) -> None:
    """Spare `recording_stances` the look at pictures that a `StanceWatch` was shown.

    Args:
        recording: With pictures.
        stances: What came of them.
    """
    while len(_remembered) >= _MOST_REMEMBERED:
        del _remembered[next(iter(_remembered))]
    _remembered[_key(recording)] = stances


def _key(recording: Recording) -> tuple[Recording, int]:
    assert recording.source is not None, "the caller has looked"
    return recording, recording.source.stat().st_mtime_ns
