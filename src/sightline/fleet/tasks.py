"""One recording of a fleet from its source to files of tracks, in any process."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TypedDict

from pydantic import BaseModel, ConfigDict

from sightline import formats
from sightline.detection import DetectorOptions
from sightline.errors import BrokenOffError, InputError
from sightline.evaluation.report import Report, evaluate_tracks
from sightline.fleet.config import Fleet, FleetCamera, FleetRecording
from sightline.fleet.partitions import TrackPartitions
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.sources import is_table, make_detector
from sightline.pipeline.track import DEFAULT_TRAJECTORY, TrackSettings, iter_tracks
from sightline.tally import Tally
from sightline.types import Track


@dataclass(frozen=True)
class Task:
    """A recording, and all that its tracks depend on; small, and sent to any process.

    Attributes:
        camera: Its camera.
        recording: The recording.
        trajectory: The trajectory method.
        interval_s: See `TrackSettings`.
        moving_only: Whether what never moves is left out.
        threads: Of the detector.
    """

    camera: FleetCamera
    recording: FleetRecording
    trajectory: str = DEFAULT_TRAJECTORY
    interval_s: float | None = None
    moving_only: bool = False
    threads: int = 1

    @property
    def name(self) -> str:
        """Names the task among all of its fleet."""
        return f"{self.camera.name}/{self.recording.name}"

    def fingerprint(self, models: Mapping[Path, str]) -> str:
        """Tells whether a result is of the same inputs and settings.

        Files are told by their sizes and the times when they were changed: an archive is too large
        to be read twice. Models are told by their content.

        Args:
            models: The digest of each model file.
        """
        camera, recording = self.camera, self.recording
        files = [recording.source, recording.clock, recording.platform, recording.water_levels]
        files += [recording.log, camera.mask, *camera.area]
        if camera.detector is not None and os.path.exists(camera.detector):
            files.append(Path(camera.detector))
        content = {
            "version": version("sightline"),
            "model": models[camera.model],
            "files": [_stamp(path) for path in files],
            "settings": [self.trajectory, self.interval_s, self.moving_only],
            "detector": [camera.detector, camera.classes, camera.threshold],
            "recording": [
                *(recording.start_utc_s, recording.clock_offset_s),
                *(recording.water_level_m, recording.mmsi),
            ],
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


class TaskResult(BaseModel):
    """What a task has made.

    Attributes:
        tracks: How many.
        points: Of all tracks.
        moored: Tracks of what never moves.
        first_utc_s: POSIX seconds of the first point; None where there is none.
        last_utc_s: Of the last.
        complete: Whether the source was read to its end.
        line: What is to be told of it, in a line; None where nothing is.
        rmse_m: Against the log, where there is one and it meets a track; None else.
        median_m: Likewise.
        coverage_p95: Share of the log's places in the stated 95 % ellipses.
        compared: How many moments were compared.
        files: Where the tracks lie, below the folder of results.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    tracks: int
    points: int
    moored: int
    first_utc_s: float | None = None
    last_utc_s: float | None = None
    complete: bool
    line: str | None = None
    rmse_m: float | None = None
    median_m: float | None = None
    coverage_p95: float | None = None
    compared: int = 0
    files: tuple[str, ...] = ()

    @property
    def tracked_s(self) -> float:
        """Seconds from the first point to the last."""
        if self.first_utc_s is None or self.last_utc_s is None:
            return 0.0
        return self.last_utc_s - self.first_utc_s


class Finished(BaseModel):
    """The file that says that a recording is finished.

    Attributes:
        fingerprint: Of its inputs and settings; see `Task.fingerprint`.
        result: What was made of it.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    fingerprint: str
    result: TaskResult


def tasks_of(fleet: Fleet, threads: int = 1) -> list[Task]:
    """The tasks of a fleet, a recording each, in the order of cameras and names."""
    trajectory = fleet.trajectory or DEFAULT_TRAJECTORY
    return [
        Task(camera, recording, trajectory, fleet.interval_s, fleet.moving_only, threads)
        for camera in fleet.cameras
        for recording in camera.recordings
    ]


def perform(task: Task, model: Georeferencer, folder: Path) -> TaskResult:
    """Make the tracks of a recording, and write them below a folder, a file a day.

    Args:
        task: The recording.
        model: Of its camera.
        folder: Of the task's own; the files lie in it as they will in the folder of results,
            ``tracks/camera=NAME/day=YYYY-MM-DD/RECORDING.parquet``.

    Raises:
        InputError: The recording cannot be used. Where it breaks off, what was tracked until then
            is kept, and the result says so.
    """
    camera, recording = task.camera, task.recording
    table = is_table(recording.source)
    detector = None
    if not table:
        options = DetectorOptions(
            classes=camera.classes, threshold=camera.threshold, threads=task.threads
        )
        detector = make_detector(camera.detector, model, options)
    settings = TrackSettings(
        trajectory=task.trajectory,
        interval_s=task.interval_s,
        clock_offset_s=recording.clock_offset_s,
        area=formats.read_area(list(camera.area)) if camera.area else None,
        tally=Tally(str(recording.source)),
    )
    water = recording.water_levels if recording.water_levels else recording.water_level_m
    found = iter_tracks(
        recording.source,
        model,
        settings=settings,
        detector=detector,
        clock=formats.read_clock(recording.clock) if recording.clock is not None else None,
        start_utc_s=recording.start_utc_s,
        platform=recording.platform,
        water_levels=water,
        mask=camera.mask,
    )
    totals = _Totals(keep=recording.log is not None)
    line = None
    with TrackPartitions(folder / "tracks" / f"camera={camera.name}", recording.name) as files:
        try:
            for track in found:
                if not (task.moving_only and track.never_moves):
                    files.add(track)
                    totals.add(track)
        except BrokenOffError as error:
            line = str(error)
        paths = files.finish()
    complete, scores = line is None, _Scores()
    if recording.log is not None:
        try:
            log = formats.read_fixes(recording.log, mmsi=recording.mmsi)
            scores = _scores(evaluate_tracks(totals.kept, log))
        except InputError as error:
            # The tracks are there all the same.
            line = line or f"not scored: {error}"
    first, last = totals.span_utc_s or (None, None)
    return TaskResult(
        tracks=totals.tracks,
        points=totals.points,
        moored=totals.moored,
        first_utc_s=first,
        last_utc_s=last,
        complete=complete,
        line=line,
        files=tuple(path.relative_to(folder).as_posix() for path in paths),
        **scores,
    )


class _Totals:
    """Counts tracks, and keeps those that are scored."""

    def __init__(self, *, keep: bool) -> None:
        self.tracks = self.points = self.moored = 0
        self.span_utc_s: tuple[float, float] | None = None
        self.kept: list[Track] = []
        self._keep = keep

    def add(self, track: Track) -> None:
        self.tracks += 1
        self.points += len(track)
        self.moored += track.never_moves
        first, last = float(track.time_utc_s[0]), float(track.time_utc_s[-1])
        before = self.span_utc_s or (first, last)
        self.span_utc_s = (min(before[0], first), max(before[1], last))
        if self._keep:
            self.kept.append(track)


class _Scores(TypedDict, total=False):
    rmse_m: float | None
    median_m: float | None
    coverage_p95: float | None
    compared: int


def _scores(report: Report) -> _Scores:
    """The fields of a `TaskResult` that a log tells."""
    return {
        "rmse_m": _finite(report.ape.rmse),
        "median_m": _finite(report.ape.median),
        "coverage_p95": _finite(report.coverage.p95),
        "compared": report.ape.n,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _stamp(path: Path | None) -> object:
    """What tells whether a file, or what is in a folder, was changed."""
    if path is None:
        return None
    status = path.stat()
    if not path.is_dir():
        return [str(path), status.st_size, status.st_mtime_ns]
    inside = [entry.stat() for entry in os.scandir(path)]
    sizes = [one.st_size for one in inside]
    return [str(path), len(sizes), sum(sizes), max((one.st_mtime_ns for one in inside), default=0)]
