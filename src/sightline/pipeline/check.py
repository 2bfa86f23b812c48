"""Check a scene, or any files, before a run: what they hold, and what will go wrong."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sightline import formats
from sightline.clock import Clock
from sightline.clock_offset import LARGEST_OFFSET_S, USUAL_SIGMA_S, ClockOffset
from sightline.errors import SightlineError
from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.georeferencer import load_model
from sightline.pipeline.file_checks import (
    FARTHEST_M,
    FileCheck,
    apart_text,
    check_boxes,
    check_clock,
    check_log,
    check_pictures,
    check_video,
    covered_share,
    distance_text,
    distances_text,
    hours_apart,
    overlap_share,
    span_text,
    started,
)
from sightline.pipeline.file_kinds import kind_of
from sightline.scene import Recording, Scene, named_files
from sightline.scene.correspondences import collect, settled
from sightline.synchronisation import LARGEST_GAP_S
from sightline.tracks import Tracks
from sightline.types import FloatArray
from sightline.video.mask import read_mask

_FEW_BOXES = 20
_SMALL_WIDTH, _SMALL_HEIGHT = 0.25, 0.05
_LEAST_OVERLAP = 0.5
_LEAST_INSIDE = 0.5
_MOST_LINES = 20
_MUCH = 0.1
"""A clock that covers so much more of a recording is worth a word."""


@dataclass(eq=False)
class RecordingCheck:
    """What belongs to a recording, and how it fits together.

    Attributes:
        name: Of the recording.
        files: Its files, those that it shares with others among them.
        said: How they fit together.
        overlap: Share of its times between fixes of its log that are near each other; NaN without
            a log or times.
        placed: How many of its boxes have a place in the log; None where no boxes are drawn.
        range_m: Nearest and farthest of those places from the camera; None where it is not known.
        stated_s: How far its clock is stated to be ahead of the log's.
        clock: How far ahead it is by its boxes and its log; None where a run takes nothing off.
    """

    name: str
    files: list[FileCheck] = field(default_factory=list)
    said: str = ""
    overlap: float = float("nan")
    placed: int | None = None
    range_m: tuple[float, float] | None = None
    stated_s: float = 0.0
    clock: ClockOffset | None = None

    def of(self, *kinds: str) -> FileCheck | None:
        """Its first file of these kinds."""
        return next((one for one in self.files if one.kind in kinds), None)

    @property
    def time_utc_s(self) -> FloatArray | None:
        """Times of its boxes, or else of its frames; None where nothing tells them.

        What its clock is stated to be ahead is taken off.
        """
        for kind in ("boxes", "detections", "video", "pictures", "clock"):
            one = self.of(kind)
            if one is not None and one.time_utc_s is not None:
                # Tables of boxes are read as a run reads them.
                in_log_time = kind in ("boxes", "detections")
                return one.time_utc_s if in_log_time else one.time_utc_s - self.stated_s
        return None


@dataclass(eq=False)
class CheckReport:
    """What a check found.

    Attributes:
        what: The scene file, or the files.
        head: What the scene is, in a line; empty for single files.
        recordings: Of the scene, in its order.
        files: All files, each once.
        warnings: What will go wrong, or might; a run goes on all the same.
        problems: Why a run would be refused; none where it would not.
    """

    what: str
    head: str = ""
    recordings: list[RecordingCheck] = field(default_factory=list)
    files: list[FileCheck] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def add(self, file: FileCheck) -> FileCheck:
        """Keep the check of a file, with its warnings and problems."""
        self.files.append(file)
        return file

    def gather(self) -> None:
        """Bring the files' warnings and problems before those of the whole, each once."""
        for name in ("warnings", "problems"):
            own = [line for file in self.files for line in getattr(file, name)]
            setattr(self, name, list(dict.fromkeys([*own, *getattr(self, name)])))

    @contextmanager
    def refusing(self) -> Iterator[None]:
        """Take an error for a problem."""
        try:
            yield
        except SightlineError as error:
            self.problems.append(str(error))

    def lines(self, problems_from: int = 0) -> list[str]:
        """All that was found, as people read it: about twenty lines.

        Args:
            problems_from: The first of the problems that is among them.
        """
        body = [self.head] if self.head else []
        recordings = [f"recording {one.name}: {one.said}" for one in self.recordings]
        files = [
            f"{one.kind} {one.path}: {one.said}"
            for one in self.files
            if one.said and not (self.recordings and one.kind in _WITH_RECORDING)
        ]
        rest = len(self.warnings) + len(self.problems) + len(body)
        left = max(_MOST_LINES - rest - len(files), 4)
        body += _shortened(recordings, left, "recordings")
        body += _shortened(files, left, "files") if recordings else files
        for one in self.files:
            if one.tally.left_out:
                body.append(f"left out of {one.path}: {one.tally.reasons()}")
            body += [f"note: {one.path}: {sentence}" for sentence in one.tally.notes]
        body += [f"warning: {line}" for line in self.warnings]
        return [*body, *(f"problem: {line}" for line in self.problems[problems_from:])]

    def to_dict(self) -> dict[str, object]:
        """As JSON has it; times are POSIX seconds."""
        return {
            "what": self.what,
            "refused": bool(self.problems),
            "head": self.head,
            "recordings": [
                {
                    "name": one.name,
                    "said": one.said,
                    "files": [str(file.path) for file in one.files],
                    "overlap": None if np.isnan(one.overlap) else one.overlap,
                    "placed": one.placed,
                    "range_m": one.range_m,
                    "clock_ahead_s": None if one.clock is None else one.clock.offset_s,
                }
                for one in self.recordings
            ],
            "files": [one.to_dict() for one in self.files],
            "warnings": list(self.warnings),
            "problems": list(self.problems),
        }


_WITH_RECORDING = ("video", "pictures", "clock", "boxes", "detections")


def _shortened(lines: list[str], most: int, what: str) -> list[str]:
    if len(lines) <= most:
        return lines
    return [*lines[: most - 1], f"... and {len(lines) - most + 1} more {what}"]


def check(what: str | os.PathLike[str] | Sequence[str | os.PathLike[str]]) -> CheckReport:
    """Check a scene file, or any files beside each other.

    All that a run would read is read; nothing is fitted, and no detector is run. What a run would
    refuse is a problem, not an error.

    Args:
        what: A scene file, or files and folders of any kind that is read.

    Examples:
        >>> report = sightline.check("scene.toml")
        >>> report.problems, [one.name for one in report.recordings]
        ([], ['01', '02', '03'])
        >>> print(report.recordings[0].said)  # doctest: +ELLIPSIS
        58 boxes in 58 frames (58 by annotator), at ...
    """
    paths = [Path(what)] if isinstance(what, str | os.PathLike) else [Path(one) for one in what]
    if len(paths) == 1 and paths[0].suffix.lower() == ".toml":
        return check_scene_file(paths[0])
    return check_files(paths)


def check_scene_file(path: Path) -> CheckReport:
    """Check a scene file; see `check`."""
    report = CheckReport(str(path))
    with report.refusing():
        there, missing = named_files(path)
        if not missing:
            return check_scene(Scene.load(path))
        report.problems += missing
        report.files += map(_check_file, there)
        report.gather()
    return report


def check_scene(scene: Scene, *, every_picture: bool = True) -> CheckReport:
    """Check a scene that has been loaded; see `check`.

    Args:
        scene: The scene.
        every_picture: Whether every picture of a folder is opened, or the first alone.
    """
    report = CheckReport(str(scene.path))
    size_px: tuple[int, int] | None = None
    with report.refusing():
        size_px = scene.image_size_px
    kept: dict[tuple[Path, int | None], FileCheck] = {}

    def once(path: Path, make: Callable[[], FileCheck], mmsi: int | None = None) -> FileCheck:
        key = (path, mmsi)
        if key not in kept:
            kept[key] = report.add(make())
        return kept[key]

    for recording in scene.recordings:
        one = RecordingCheck(recording.name, stated_s=recording.clock_offset_s)
        _check_pictures(scene, recording, one, once, every_picture)
        _check_tables(recording, one, once, size_px)
        _check_logs(scene, recording, one, once)
        report.recordings.append(one)
    _check_mask(scene, report, size_px)
    _check_area(scene, report)
    _check_times(scene, report)
    told = _with_clocks(scene, report)
    _check_overlaps(told, report)
    _check_learning(told, report)
    report.head = _head(scene, size_px)
    for one in report.recordings:
        one.said = _recording_text(one)
    report.gather()
    return report


Once = Callable[..., FileCheck]


def _head(scene: Scene, size_px: tuple[int, int] | None) -> str:
    camera = scene.camera
    place = "at a place that is not known"
    if camera.latitude_deg is not None and camera.longitude_deg is not None:
        place = f"at {camera.latitude_deg:.5f}, {camera.longitude_deg:.5f}"
    parts = [f"camera {camera.name} {place}".replace("  ", " ")]
    if size_px is not None:
        parts.append(f"pictures of {size_px[0]} x {size_px[1]} px")
    count = len(scene.recordings)
    parts.append(f"{count} recording{'s' * (count != 1)}")
    if len(scene.control_points):
        parts.append(f"{len(scene.control_points)} control points")
    return f"{scene.path}: {', '.join(parts)}"


def _check_pictures(
    scene: Scene, recording: Recording, one: RecordingCheck, once: Once, every: bool
) -> None:
    """The clock and the video or folder of a recording."""
    clock: Clock | None = None
    if recording.clock_path is not None:
        found, clock = check_clock(recording.clock_path)
        one.files.append(once(recording.clock_path, lambda: found))
    if recording.video_path is not None:
        path = recording.video_path
        one.files.append(once(path, lambda: check_video(path, recording.start_utc_s, clock)))
    elif recording.frames_path is not None:
        folder = recording.frames_path
        one.files.append(once(folder, lambda: check_pictures(folder, clock, every=every)))
    seen = one.of("video", "pictures")
    wanted = scene.camera.image_size_px
    if seen is not None and seen.size_px is not None and wanted not in (None, seen.size_px):
        assert wanted is not None
        line = (
            f"has pictures of {seen.size_px[0]} x {seen.size_px[1]} px, and image_size_px says "
            f"{wanted[0]} x {wanted[1]}"
        )
        if recording.boxes_path is None and recording.detections_path is None:
            seen.problems.append(f"{seen.path}: {line}")
        else:
            seen.warn(line)


def _check_mask(scene: Scene, report: CheckReport, size_px: tuple[int, int] | None) -> None:
    """The mask, and whether it is as large as what it masks."""
    if scene.camera.mask_path is None:
        return
    found = report.add(started(scene.camera.mask_path, "mask"))
    with found.refusing():
        mask = read_mask(found.path)
        share = float(mask.hidden.mean())
        found.facts |= {"size_px": [float(v) for v in mask.size_px], "masked_share": share}
        found.said = f"{100.0 * share:.1f} % of the picture is masked"
        if share == 0.0:
            found.warn("masks nothing; paint black what is to be masked")
        if size_px is not None:
            mask.check_size(size_px, f"the scene {scene.path}")
        for one in report.recordings:
            seen = one.of("video", "pictures")
            if seen is not None and seen.size_px is not None:
                mask.check_size(seen.size_px, f"recording {one.name}")


def _check_area(scene: Scene, report: CheckReport) -> None:
    """The area, and whether the logs lie in it."""
    for path in scene.camera.area_paths:
        report.add(_check_area_file(path))
    area = None
    with suppress(SightlineError):
        # What is wrong with a file has been said.
        area = scene.area()
    for one in report.recordings if area is not None else ():
        log = one.of("log")
        if area is None or log is None or log.fixes is None or not len(log.fixes):
            continue
        inside = area.contains(log.fixes.latitude_deg, log.fixes.longitude_deg)
        share = float(inside.mean())
        if share < _LEAST_INSIDE:
            report.warnings.append(
                f"recording {one.name}: {100.0 * (1.0 - share):.0f} % of the fixes of its log lie "
                f"outside of the area ({area.where}), where nothing is kept; is it the right one?"
            )


def _check_area_file(path: Path) -> FileCheck:
    found = started(path, "area")
    with found.refusing():
        area = formats.read_area(path)
        corners = sum(len(ring) for polygon in area.polygons for ring in polygon.rings)
        count = len(area.polygons)
        found.facts |= {"polygons": count, "corners": corners}
        found.said = f"{count} polygon{'s' * (count != 1)} of {corners} corners"
    return found


def _check_tables(
    recording: Recording, one: RecordingCheck, once: Once, size_px: tuple[int, int] | None
) -> None:
    """Boxes, detections, horizons and water levels of a recording."""
    # What is wrong with the mask is said of the mask.
    bare = replace(recording, mask_path=None)
    for kind, path, read in (
        ("boxes", recording.boxes_path, recording.boxes),
        ("detections", recording.detections_path, bare.detections),
    ):
        if path is None:
            continue
        table = check_boxes(path, kind, size_px)
        if not table.problems:
            # As a run reads it: with the times of the frames.
            with table.refusing():
                table.boxes = read()
                table.time_utc_s = np.sort(table.boxes.time_utc_s)
        one.files.append(once(path, lambda table=table: table))
    if recording.horizon_path is not None:
        horizon = started(recording.horizon_path, "horizons")
        with horizon.refusing():
            seen = recording.horizons()
            assert seen is not None
            horizon.said = f"the horizon in {len(seen)} frames"
        one.files.append(once(horizon.path, lambda: horizon))
    if recording.water_levels_path is not None:
        levels = started(recording.water_levels_path, "water levels")
        with levels.refusing():
            found = formats.read_water_levels(levels.path, tally=levels.tally)
            levels.said = (
                f"{found.level_m.size} levels of {found.level_m.min():.2f} to "
                f"{found.level_m.max():.2f} m, {span_text(found.time_utc_s)}"
            )
            times = one.time_utc_s
            if times is not None:
                found.at(times)
        one.files.append(once(levels.path, lambda: levels))


def _check_logs(scene: Scene, recording: Recording, one: RecordingCheck, once: Once) -> None:
    """The log of a recording, and that of its platform."""
    plane = scene.plane
    if recording.fixes_path is not None:
        path, mmsi = recording.fixes_path, recording.mmsi
        away = None if recording.platform_path is not None else plane
        one.files.append(once(path, lambda: check_log(path, mmsi, away), mmsi))
    if recording.platform_path is not None:
        own = check_log(recording.platform_path, None, plane)
        own.kind = "platform's log"
        # It may well lie still for a while.
        own.warnings = [line for line in own.warnings if "hardly moved" not in line]
        with own.refusing():
            found = recording.platform()
            assert found is not None
            times = one.time_utc_s
            if times is not None:
                share = overlap_share(times, found.fixes.time_utc_s)
                if share == 0.0:
                    own.problems.append(f"recording {recording.name}: {_of_platform(times, own)}")
        one.files.append(once(recording.platform_path, lambda: own))


def _of_platform(times: FloatArray, own: FileCheck) -> str:
    assert own.time_utc_s is not None
    return apart_text(times, own.time_utc_s).replace("its log", "its platform's log")


def _check_times(scene: Scene, report: CheckReport) -> None:
    """A run needs the time of every box and frame that it looks at."""
    for recording, one in zip(scene.recordings, report.recordings, strict=True):
        seen = one.of("video", "pictures")
        if one.time_utc_s is not None or any(file.problems for file in one.files):
            continue
        line = (
            f"recording {recording.name}: nothing tells the times of its frames; give start_utc "
            "(with a video that has times), clock (a table frame,utc), or time_utc with the boxes"
        )
        if seen is not None and recording.boxes_path is None and recording.detections_path is None:
            report.problems.append(line)
        else:
            report.warnings.append(line)


def _with_clocks(scene: Scene, report: CheckReport) -> Scene:
    """The scene with the clocks that drawn boxes tell; as it is where a run is refused before."""
    if report.problems or any(file.problems for file in report.files):
        return scene
    try:
        return settled(scene)
    except SightlineError:
        # What it is stands among the problems, once the pairs are looked for.
        return scene


def _check_overlaps(scene: Scene, report: CheckReport) -> None:
    """Whether each log is of the time of its recording; a run needs one that is.

    By the clock that a run would take for right.
    """
    apart: list[str] = []
    together = 0
    for recording, one in zip(scene.recordings, report.recordings, strict=True):
        log, times = one.of("log", "AIS feed"), one.time_utc_s
        if log is None or log.time_utc_s is None or times is None:
            continue
        moved_s = recording.clock_offset_s - one.stated_s
        if moved_s:
            one.clock = recording.clock_found
        one.overlap = covered_share(times - moved_s, log.time_utc_s)
        if overlap_share(times, log.time_utc_s) == 0.0:
            line = f"recording {recording.name}: {apart_text(times, log.time_utc_s)}"
            mended = _mended(recording, one, log.time_utc_s)
            if mended:
                report.warnings.append(f"{line}{mended}")
                together += 1
            else:
                apart.append(line)
            continue
        together += 1
        if one.overlap < _LEAST_OVERLAP:
            share = f"only {100.0 * one.overlap:.0f} %" if one.overlap > 0.0 else "none"
            report.warnings.append(
                f"recording {recording.name}: its log has fixes at most {LARGEST_GAP_S:g} s apart "
                f"for {share} of it; elsewhere places are less certain, or there are none"
                f"{_mended(recording, one, log.time_utc_s)}"
            )
    if apart and not together and not len(scene.control_points):
        report.problems += apart
    else:
        report.warnings += apart


def _mended(recording: Recording, one: RecordingCheck, log_utc_s: FloatArray) -> str:
    """What another clock makes of a recording that its log hardly covers; empty where nothing."""
    times = one.time_utc_s
    assert times is not None, "the caller has looked"
    if one.clock is not None:
        return f"; its clock is {one.clock.words} by its boxes, which is taken off"
    if overlap_share(times, log_utc_s) == 0.0 and hours_apart(times, log_utc_s) is not None:
        # A fit tries the clocks of other zones.
        return " A run tries that clock, and says so"
    found, drawn = recording.clock_found, recording.boxes_path is not None
    sure = found is not None and found.sigma_s < USUAL_SIGMA_S
    if recording.clock_prior.stated or sure or (drawn and one.overlap == 0.0):
        return ""
    tried_s = sorted(np.arange(-LARGEST_OFFSET_S, LARGEST_OFFSET_S + 1.0).tolist(), key=abs)
    shares = [covered_share(times - ahead_s, log_utc_s) for ahead_s in tried_s]
    best = int(np.argmax(shares))
    if shares[best] < one.overlap + _MUCH:
        return ""
    side = "ahead of" if tried_s[best] > 0.0 else "behind"
    does = "give clock_offset_s if it is" if drawn else "a run looks whether it is"
    return (
        f"; were its clock {abs(tried_s[best]):.0f} s {side} the log's, there would be for "
        f"{100.0 * shares[best]:.0f} %: {does}"
    )


def _check_learning(scene: Scene, report: CheckReport) -> None:
    """What a model would be learned from, and whether that is enough."""
    if report.problems or any(file.problems for file in report.files):
        return
    drawn = any(r.boxes_path and r.fixes_path for r in scene.recordings)
    seen = any(r.fixes_path and (r.detections_path or r.source) for r in scene.recordings)
    with report.refusing():
        _ = scene.moves, scene.tidal
        if not drawn and seen:
            _check_recognition(scene, report)
            return
        inputs = collect(scene, pictures=False)
        pairs, points = inputs.correspondences, len(scene.control_points)
        if not len(pairs) and not points:
            report.problems.append(
                f"{scene.path}: no pairs of a box and a fix, and no control points; give a "
                "recording boxes and fixes, or [[control_points]]"
            )
        if len(pairs):
            _describe_pairs(scene, report, pairs)


def _check_recognition(scene: Scene, report: CheckReport) -> None:
    """What a scene without drawn boxes needs, so that somebody can be recognised."""
    if scene.moves:
        report.problems.append(
            f"{scene.path}: its camera stands on a platform that moves, where nobody is recognised "
            "without drawn boxes; give boxes"
        )
    elif scene.plane is None:
        report.problems.append(
            f"{scene.path}: to recognise a logged vessel without drawn boxes, say where the camera "
            "stands: [camera] latitude_deg and longitude_deg"
        )


def _describe_pairs(scene: Scene, report: CheckReport, pairs: Correspondences) -> None:
    """Where the boxes with a place lie: in the picture, and how far away."""
    ranges = np.hypot(*pairs.east_north_m.T)
    known = scene.plane is not None or scene.moves
    for one in report.recordings:
        rows = pairs.recording == one.name
        if one.of("boxes") is None or one.of("log", "AIS feed") is None:
            continue
        one.placed = int(rows.sum())
        if known and rows.any():
            one.range_m = float(ranges[rows].min()), float(ranges[rows].max())
    if len(pairs) < _FEW_BOXES:
        report.warnings.append(
            f"{scene.path}: only {len(pairs)} of {pairs.asked} boxes have a place in a log; "
            "thirty, spread over the picture, are good"
        )
    width, height = scene.image_size_px
    x1, _, x2, y2 = pairs.boxes.xyxy_px.T
    across, down = float(np.ptp(x1 + x2) / 2.0 / width), float(np.ptp(y2) / height)
    if across < _SMALL_WIDTH or down < _SMALL_HEIGHT:
        report.warnings.append(
            f"{scene.path}: the boxes with a place lie in {100.0 * across:.0f} % of the picture's "
            f"width and {100.0 * down:.0f} % of its height; elsewhere a model can only guess"
        )
    if known and ranges.min() > FARTHEST_M:
        report.problems.append(
            f"{scene.path}: the places of the boxes are {distance_text(ranges.min())} or more from "
            "the camera"
        )


def _recording_text(one: RecordingCheck) -> str:
    """A recording in a line: what is seen, and how it fits its log."""
    kinds = ["video", "pictures", "boxes", "detections"]
    if one.of("video", "pictures") is None:
        kinds.append("clock")
    parts = [
        file.said if kind in ("boxes", "video", "pictures") else f"{kind}: {file.said}"
        for kind in kinds
        if (file := one.of(kind)) is not None and file.said
    ]
    log = one.of("log", "AIS feed")
    if log is not None and np.isfinite(one.overlap):
        parts.append(f"{log.path.name} has near fixes for {100.0 * one.overlap:.0f} % of it")
    if one.clock is not None:
        parts.append(f"its clock is {one.clock.words}, which is taken off")
    if one.placed is not None:
        away = ""
        if one.range_m is not None:
            away = f", {distances_text(*one.range_m)} away"
        parts.append(f"{one.placed} boxes have a place{away}")
    return "; ".join(parts) or "nothing could be read"


def check_files(paths: Sequence[Path]) -> CheckReport:
    """Check single files, each by what is in it, and whether their times overlap."""
    report = CheckReport(", ".join(map(str, paths)))
    for path in paths:
        report.add(_check_file(path))
    logs = [one for one in report.files if one.kind in ("log", "AIS feed")]
    for log in logs:
        for one in report.files:
            if one.kind not in ("video", "clock", "boxes", "tracks", "pictures"):
                continue
            if one.time_utc_s is None or log.time_utc_s is None:
                continue
            if overlap_share(one.time_utc_s, log.time_utc_s) == 0.0:
                line = apart_text(one.time_utc_s, log.time_utc_s)
                log.warn(
                    line.replace("its log does not overlap it", f"does not overlap {one.path}")
                )
    report.gather()
    return report


def _check_file(path: Path) -> FileCheck:
    """Check a file by what is in it."""
    unknown = started(path, "file")
    with unknown.refusing():
        kind = kind_of(path)
        if kind == "scene":
            inner = check_scene_file(path)
            unknown.kind, unknown.said = kind, inner.head.partition(": ")[2]
            unknown.warnings, unknown.problems = inner.warnings, inner.problems
            return unknown
        if kind == "log":
            return check_log(path, None, None)
        if kind == "boxes":
            return check_boxes(path, kind, None)
        if kind == "video":
            return check_video(path, None, None)
        if kind == "pictures":
            return check_pictures(path, None)
        if kind == "clock":
            return check_clock(path)[0]
        if kind == "area":
            return _check_area_file(path)
        unknown.kind = kind
        _OTHERS[kind](unknown)
    return unknown


def _check_tracks(one: FileCheck) -> None:
    tracks = Tracks.read(one.path)
    times = np.concatenate([track.time_utc_s for track in tracks])
    one.time_utc_s = np.sort(times)
    one.facts |= {"tracks": len(tracks), "points": int(times.size)}
    one.said = f"{len(tracks)} tracks of {times.size} points, {span_text(times)}"


def _check_model(one: FileCheck) -> None:
    model = load_model(one.path)
    width, height = model.image_size_px
    name = model.report.model
    one.facts |= {"size_px": [float(width), float(height)]}
    one.said = (
        f"{name}, for pictures of {width} x {height} px, camera at "
        f"{model.plane.latitude_deg:.5f}, {model.plane.longitude_deg:.5f}"
    )


def _check_detector(one: FileCheck) -> None:
    from sightline.detection import detector_by_name

    made = detector_by_name(str(one.path))
    classes = getattr(made, "classes", ())
    one.said = f"a detector of {len(classes)} classes ({', '.join(classes[:5])}...)"


def _check_points(one: FileCheck) -> None:
    points = formats.read_control_points(one.path, tally=one.tally)
    one.facts["points"] = len(points)
    one.said = f"{len(points)} control points"


def _check_levels(one: FileCheck) -> None:
    levels = formats.read_water_levels(one.path, tally=one.tally)
    one.time_utc_s = levels.time_utc_s
    one.said = f"{levels.level_m.size} levels, {span_text(levels.time_utc_s)}"


_OTHERS: dict[str, Callable[[FileCheck], None]] = {
    "tracks": _check_tracks,
    "model": _check_model,
    "detector": _check_detector,
    "control points": _check_points,
    "water levels": _check_levels,
}
