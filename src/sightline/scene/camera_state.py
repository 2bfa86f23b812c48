"""Horizons and static intervals of a scene's recordings, from their tables or frames."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import lru_cache

import numpy as np

from sightline.camera.horizon_tracker import with_horizons
from sightline.camera.motion import StaticInterval
from sightline.camera.static_intervals import LOOKS_APART_S, StaticIntervalMonitor
from sightline.errors import InputError
from sightline.progress import Progress
from sightline.scene import Recording, Scene
from sightline.types import Horizons


def scene_horizons(recording: Recording) -> Horizons | None:
    """Horizons of a recording: from its table, or detected in its frames.

    Frames are only decoded where the camera is on a platform that moves.

    Raises:
        InputError: A file of the recording cannot be used.
    """
    told = recording.horizons()
    if told is not None or recording.platform_path is None or recording.source is None:
        return told
    bare = replace(recording.by_camera(), clock_found=None)
    seen = _in_pictures(bare, recording.source.stat().st_mtime_ns)
    return replace(seen, time_utc_s=seen.time_utc_s - recording.clock_offset_s)


# Leaving one recording out at a time asks again and again, and to decode every frame takes long.
@lru_cache(maxsize=32)
def _in_pictures(recording: Recording, _modified_ns: int) -> Horizons:
    seen = [
        (frame.time_utc_s, *frame.horizon_px)
        for frame in with_horizons(recording.frames())
        if frame.horizon_px is not None and np.isfinite(frame.time_utc_s)
    ]
    return Horizons(*np.array(seen, dtype=np.float64).reshape(-1, 3).T)


def scene_static_intervals(
    scene: Scene, progress: Progress | None = None
) -> dict[str, tuple[StaticInterval, ...]]:
    """Static intervals of all recordings of a scene that compensates camera rotation.

    Args:
        scene: Its recordings' pictures.
        progress: Told which recording is observed: a long video takes long.
    """
    if scene.moves or not scene.camera.compensate_rotation:
        return {}
    found = {}
    for i, recording in enumerate(scene.recordings):
        if progress is not None:
            what = f"looking at the pictures of {recording.name}"
            progress(what, i / len(scene.recordings))
        found[recording.name] = recording_static_intervals(recording)
    return {name: static_intervals for name, static_intervals in found.items() if static_intervals}


_logger = logging.getLogger(__name__)


_MOST_REMEMBERED = 128


# Leaving one recording out at a time asks again and again, and to decode frames takes long.
_remembered: dict[tuple[Recording, int], tuple[StaticInterval, ...]] = {}


def recording_static_intervals(recording: Recording) -> tuple[StaticInterval, ...]:
    """Static intervals of a recording, from its frames; none where there are no frames.

    Where they cannot be read, a warning says so: boxes that somebody drew do without them.
    """
    if recording.source is None or recording.platform_path is not None:
        return ()
    if not static_intervals_known(recording):
        watch = StaticIntervalMonitor()
        try:
            for frame in recording.by_camera().frames(apart_s=LOOKS_APART_S):
                watch.observe(frame)
        except InputError as error:
            _logger.warning("nothing tells whether the camera was rotated: %s", error)
            watch = StaticIntervalMonitor()
        remember_static_intervals(recording, watch.static_intervals)
    late_s = recording.clock_offset_s
    return tuple(
        replace(one, before_utc_s=one.before_utc_s - late_s, since_utc_s=one.since_utc_s - late_s)
        for one in _remembered[_key(recording)]
    )


def static_intervals_known(recording: Recording) -> bool:
    """Whether the static intervals of a recording are cached."""
    return _key(recording) in _remembered


def remember_static_intervals(
    recording: Recording, static_intervals: tuple[StaticInterval, ...]
) -> None:
    """Cache static intervals that a monitor found during another pass.

    Args:
        recording: With pictures.
        static_intervals: What came of them, by the camera's clock.
    """
    while len(_remembered) >= _MOST_REMEMBERED:
        del _remembered[next(iter(_remembered))]
    _remembered[_key(recording)] = static_intervals


def _key(recording: Recording) -> tuple[Recording, int]:
    assert recording.source is not None, "the caller has looked"
    by_camera = replace(recording.by_camera(), clock_found=None)
    return by_camera, recording.source.stat().st_mtime_ns
