"""Collection of a scene's correspondences: boxes beside the places that the logs state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sightline.clock_offset import RecordingClock
from sightline.errors import FitError, InputError
from sightline.geodesy import LocalPlane
from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.fit import FitInputs
from sightline.logged_motion import LARGEST_SIGMA_M, LONGEST_GAP_S
from sightline.platform import to_bow, turned
from sightline.progress import Progress
from sightline.reference_trajectory import ReferenceStates, ReferenceTrajectory, without_leaps
from sightline.scene.camera_state import scene_horizons, scene_static_intervals
from sightline.scene.clocks import settle_clocks
from sightline.scene.scene import Recording, Scene
from sightline.synchronisation import check_overlap, synchronise
from sightline.types import Boxes, Fixes, FloatArray, utc_text

_MOST_NAMED = 5


def collect(
    scene: Scene,
    *,
    extra: Mapping[str, Boxes] | None = None,
    pictures: bool = True,
    progress: Progress | None = None,
) -> FitInputs:
    """Read all inputs of a fit from the files of a scene.

    Args:
        scene: Its recordings' boxes and logs, and its control points.
        extra: Further boxes of the logged target, from another source, by recording: so that the
            bias of a detector is learned beside that of an annotator. The residual process of
            ``camera+gpr`` learns nothing of them.
        pictures: Whether the pictures of the recordings are asked if the camera was turned.
        progress: Told which recording's frames are observed.

    Raises:
        InputError: A file of the scene cannot be used.
        FitError: No box has fixes near enough on both sides, though logs overlap recordings, or
            nothing says where on the earth the scene is.
    """
    plane = scene.plane
    scene = settled(scene)
    dropped: list[Dropped] = []
    pairs = scene_correspondences(
        scene, plane if plane is not None else _middle(scene), extra=extra, dropped=dropped
    )
    anything = len(pairs) or len(scene.control_points)
    horizons = {recording.name: scene_horizons(recording) for recording in scene.recordings}
    return FitInputs(
        correspondences=pairs,
        image_size_px=scene.image_size_px,
        control_points=scene.control_points,
        position_known=plane is not None or scene.moves,
        moving=scene.moves,
        tidal=scene.tidal,
        horizons={name: seen for name, seen in horizons.items() if seen is not None},
        static_intervals=scene_static_intervals(scene, progress) if pictures and anything else {},
        statements=(*_on_leaps(scene, pairs.plane), *_on_dropped(dropped)),
        stated=scene.stated,
        clocks=scene_clocks(scene),
        name=str(scene.path),
    )


@dataclass(frozen=True)
class Dropped:
    """How many boxes of a recording have no place, and why.

    Attributes:
        recording: Its name.
        asked: How many boxes there are.
        outside: Before and after the log, or without a time.
        long: In gaps of the log of more than `LONGEST_GAP_S`.
        unsure: In shorter ones, in which a place is less certain than `LARGEST_SIGMA_M`.
    """

    recording: str
    asked: int
    outside: int
    long: int
    unsure: int

    @classmethod
    def of(cls, recording: str, at: ReferenceStates) -> Dropped:
        """Those of states at the times of boxes."""
        lost = ~np.isfinite(at.east_north_m).all(axis=1)
        gap_s = np.diff(at.fix_time_utc_s, axis=1)[:, 0]
        outside, long = lost & np.isnan(gap_s), lost & (gap_s > LONGEST_GAP_S)
        counts = outside.sum(), long.sum(), (lost & ~outside & ~long).sum()
        return cls(recording, lost.size, *map(int, counts))

    @property
    def boxes(self) -> int:
        """How many in all."""
        return self.outside + self.long + self.unsure


def _on_dropped(dropped: Sequence[Dropped]) -> tuple[str, ...]:
    """What is to be said of boxes without a place; nothing where each has one."""
    some = [one for one in dropped if one.boxes]
    if not some:
        return ()
    reasons = (
        (sum(one.outside for one in some), "outside the time of the log"),
        (sum(one.long for one in some), f"in gaps of the log of more than {LONGEST_GAP_S:g} s"),
        (
            sum(one.unsure for one in some),
            f"in gaps in which the vessel may be off by more than {LARGEST_SIGMA_M:g} m",
        ),
    )
    why = ", ".join(f"{count} {reason}" for count, reason in reasons if count)
    names = ", ".join(one.recording for one in some[:_MOST_NAMED])
    more = f" and {len(some) - _MOST_NAMED} more" if len(some) > _MOST_NAMED else ""
    lost, asked = sum(one.boxes for one in some), sum(one.asked for one in dropped)
    said = f"{lost} of {asked} boxes have no place in the log and are not learned from: {why}"
    return (f"{said} (recordings {names}{more}).",)


def _on_leaps(scene: Scene, plane: LocalPlane) -> tuple[str, ...]:
    said = [
        on_leaps(recording, recording.boxes().time_utc_s, plane)
        for recording in scene.recordings
        if recording.boxes_path is not None and recording.fixes_path is not None
    ]
    return tuple(one for one in said if one)


def on_leaps(recording: Recording, time_utc_s: FloatArray, plane: LocalPlane) -> str:
    """Sentence on the fixes that leap off the path of a recording's log; empty without any.

    Args:
        recording: One that has a log.
        time_utc_s: (N,) POSIX seconds of its boxes; fixes before and after them do not count.
        plane: Near the log.
    """
    known = time_utc_s[np.isfinite(time_utc_s)]
    times = without_leaps(recording.fixes(), plane)[1].time_utc_s
    if not known.size or not times.size:
        return ""
    times = times[(times >= known.min()) & (times <= known.max())]
    if not times.size:
        return ""
    when = ", ".join(utc_text(time) for time in times[:_MOST_NAMED])
    more = f" and {times.size - _MOST_NAMED} more" if times.size > _MOST_NAMED else ""
    leap = "1 fix leaps" if times.size == 1 else f"{times.size} fixes leap"
    return (
        f"Recording {recording.name}: {leap} off the path of the log and back: left out "
        f"({when}{more})."
    )


def settled(scene: Scene) -> Scene:
    """The scene in the logs' time, as far as drawn boxes tell it; see `settle_clocks`."""
    return settle_clocks(scene, scene.plane or _middle(scene))


def scene_clocks(scene: Scene) -> dict[str, RecordingClock]:
    """What is known of the clocks of a scene's recordings."""
    return {
        one.name: RecordingClock(one.clock_offset_s, one.clock_prior, one.clock_found)
        for one in scene.recordings
    }


def _middle(scene: Scene) -> LocalPlane:
    """A plane at the centre of what is known, for a camera of unknown position."""
    latitudes, longitudes = (
        [scene.control_points.latitude_deg],
        [scene.control_points.longitude_deg],
    )
    for recording in scene.recordings:
        if recording.fixes_path is not None and recording.boxes_path is not None:
            fixes = recording.fixes()
            latitudes.append(fixes.latitude_deg)
            longitudes.append(fixes.longitude_deg)
    if not sum(map(len, latitudes)):
        raise FitError(
            f"{scene.path}: nothing says where on the earth the scene is; give [camera] "
            "latitude_deg and longitude_deg, a log (fixes) with boxes, or [[control_points]]"
        )
    return LocalPlane(
        float(np.median(np.concatenate(latitudes))), float(np.median(np.concatenate(longitudes)))
    )


def scene_correspondences(
    scene: Scene,
    plane: LocalPlane,
    *,
    extra: Mapping[str, Boxes] | None = None,
    dropped: list[Dropped] | None = None,
) -> Correspondences:
    """Correspondences of all recordings that have boxes and a log.

    In long gaps of a log places are those that a motion model expects, with how far they may be
    off: see `sightline.logged_motion`.

    Where the camera stands on a platform that moves, places are those that the platform saw: to
    starboard and ahead of it.

    Args:
        scene: The scene.
        plane: The plane of the places.
        extra: Further boxes of the logged target, from another source, by recording.
        dropped: To which is added what has no place, for each recording.

    Raises:
        FitError: No box has fixes near enough on both sides, though logs overlap recordings.
        InputError: No recording's log overlaps it, or a file cannot be used.
    """
    tidal = scene.tidal
    parts: list[Correspondences] = []
    silent: list[Recording] = []
    for recording in scene.recordings:
        if recording.boxes_path is None or recording.fixes_path is None:
            continue
        boxes = recording.boxes()
        drew = np.unique(boxes.source)
        if extra and recording.name in extra:
            boxes = Boxes.concatenate([boxes, extra[recording.name]])
        asked = len(boxes)
        at = _places(recording.fixes(), boxes.time_utc_s, plane)
        en_m, velocity_mps = at.east_north_m, at.velocity_mps
        if dropped is not None:
            dropped.append(Dropped.of(recording.name, at))
        if len(boxes) and not np.isfinite(en_m).any():
            silent.append(recording)
        platform = recording.platform()
        if platform is not None:
            pose = platform.pose(boxes.time_utc_s, plane)
            en_m, velocity_mps = to_bow(en_m, pose), turned(velocity_mps, pose.heading_rad)
        rows = np.flatnonzero(np.isfinite(en_m).all(axis=1))
        times = boxes.time_utc_s[rows]
        parts.append(
            Correspondences(
                boxes=boxes[rows],
                recording=np.full(rows.size, recording.name),
                east_north_m=en_m[rows],
                velocity_mps=np.nan_to_num(velocity_mps[rows]),
                asked=asked,
                plane=plane,
                water_level_m=levels_at(recording, times) if tidal else np.zeros(times.size),
                bias_only=~np.isin(boxes.source[rows], drew),
                fix_sigma_m=at.sigma_m[rows],
                fix_time_utc_s=at.fix_time_utc_s[rows],
                hull_m=np.tile(recording.hull().size_m, (rows.size, 1)),
                at_middle=np.full(rows.size, recording.hull().antenna_known),
            )
        )
    if silent and len(silent) == len(parts):
        for recording in silent:
            check_overlap(
                recording.boxes().time_utc_s, recording.fixes(), f"recording {recording.name}"
            )
        raise FitError(
            f"{scene.path}: no box has fixes near enough on both sides to say where the vessel "
            f"was to {LARGEST_SIGMA_M:g} m (at most {LONGEST_GAP_S:g} s apart); the log has gaps "
            "wherever there are boxes, so give one with a fix every 30 s or more often"
        )
    if not parts:
        nothing = np.empty((0, 2))
        return Correspondences(
            Boxes.of([]), np.empty(0, dtype=np.str_), nothing, nothing.copy(), 0, plane
        )
    return Correspondences(
        boxes=Boxes.concatenate([part.boxes for part in parts]),
        recording=np.concatenate([part.recording for part in parts]),
        east_north_m=np.concatenate([part.east_north_m for part in parts]),
        velocity_mps=np.concatenate([part.velocity_mps for part in parts]),
        asked=sum(part.asked for part in parts),
        plane=plane,
        water_level_m=np.concatenate([part.water_level_m for part in parts]),
        bias_only=np.concatenate([part.bias_only for part in parts]),
        fix_sigma_m=np.concatenate([part.fix_sigma_m for part in parts]),
        fix_time_utc_s=np.concatenate([part.fix_time_utc_s for part in parts]),
        hull_m=np.concatenate([part.hull_m for part in parts]),
        at_middle=np.concatenate([part.at_middle for part in parts]),
    )


def _places(fixes: Fixes, time_utc_s: FloatArray, plane: LocalPlane) -> ReferenceStates:
    """Places of a log at times: on a line between near fixes, as a motion model says in gaps."""
    fixes, _ = without_leaps(fixes, plane)
    near = synchronise(fixes, time_utc_s, plane)
    path = ReferenceTrajectory.of(fixes, plane)
    at = path.at(time_utc_s)
    place, velocity, sigma = at.east_north_m, path.smooth_velocity(time_utc_s), at.sigma_m
    rows = near.matched
    place[rows] = np.stack([near.east_m, near.north_m], axis=1)[rows]
    sigma[rows] = 0.0
    return ReferenceStates(place, velocity, sigma, at.fix_time_utc_s)


def levels_at(recording: Recording, time_utc_s: FloatArray) -> FloatArray:
    """(N,) water level of a recording at times, metres above the datum.

    Args:
        recording: One that has a water level.
        time_utc_s: (N,) POSIX seconds.

    Raises:
        InputError: Its table cannot be used, or says nothing of a time.
    """
    levels = recording.water_levels()
    assert levels is not None, "all recordings of a tidal scene have one"
    try:
        return levels.at(time_utc_s)
    except InputError as error:
        raise InputError(f"recording {recording.name}: {error}") from error
