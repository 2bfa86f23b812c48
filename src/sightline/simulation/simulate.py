"""A synthetic harbour on disk: videos, clocks, boxes, logs, the truth, and a scene of them all."""

from __future__ import annotations

import csv
import json
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Literal

import gpxpy.gpx
import numpy as np
from pyais import encode_dict

from sightline.atomic import atomic_path
from sightline.errors import InputError, unknown_name
from sightline.geodesy import LocalPlane
from sightline.platform import Platform
from sightline.simulation.camera import SimulatedCamera
from sightline.simulation.harbour import (
    DOCK,
    START_UTC_S,
    BoxNoise,
    Harbour,
    HarbourSettings,
    ReceiverNoise,
)
from sightline.simulation.platform import Knock, Warp
from sightline.simulation.render import Look, Renderer
from sightline.simulation.scenery import Image
from sightline.types import Boxes, Fixes, FloatArray, Frame
from sightline.video import write_video

ANNOTATOR = BoxNoise(std_px=1.0, correlation_time_s=0.0, source="annotator")
"""Somebody who draws boxes with care."""

DETECTOR = BoxNoise(
    std_px=1.5,
    correlation_time_s=0.8,
    lower_edge_bias_px=-1.5,
    miss_probability=0.08,
    source="simulated",
)
"""A detector: errors that last for most of a second, boxes that end too high, misses."""

AIS_TRANSPONDER = ReceiverNoise(
    std_m=2.0, interval_s=4.0, interval_jitter=0.4, dropouts_per_minute=0.1, whole_seconds=True
)
"""A class B transponder nearby: a whole second every few seconds."""

LEAST_FOUND_PX = 6.0
"""Boxes before a shore that are narrower or lower no detector finds."""

CLOCK_STEP_S = 5.0
"""How often a ``"stepped"`` clock is read."""

_LONGEST_S = 86_400.0
_FIRST_MMSI = 211_000_001
_NAMED_EVERY = 4
_RATE_JITTER = 0.15
_LOST_FRAMES = 0.004
_STILL_MPS = 0.05
_MICROSECONDS = 1e6
_HORIZON_STD_PX = 0.5

ClockKind = Literal["start", "exact", "stepped"]


@dataclass(frozen=True, eq=False)
class Recording:
    """One video of a simulation.

    Attributes:
        name: As in the scene.
        time_utc_s: (N,) POSIX seconds, the true time of every frame.
    """

    name: str
    time_utc_s: FloatArray


@dataclass(frozen=True, eq=False)
class Simulation:
    """What `simulate` wrote.

    Attributes:
        scene: The scene file.
        harbour: The world behind it.
        recordings: The true times of all frames.
    """

    scene: Path
    harbour: Harbour
    recordings: tuple[Recording, ...]


@dataclass(frozen=True)
class SimulationSettings:
    """Settings of `simulate`.

    Attributes:
        seed: The same seed and settings give the same files.
        recordings: How many videos.
        duration_s: Of each.
        pause_s: Between two.
        rate_hz: Mean frames a second.
        image_size_px: Of a random camera; even numbers.
        camera: Absent: a random one.
        plane: Where the camera stands.
        start_utc_s: POSIX seconds of the first video, whole.
        clock: How the scene tells the times: ``"start"`` of each video plus its presentation
            times; an ``"exact"`` table; or a table ``"stepped"`` every `CLOCK_STEP_S`.
        annotation_interval_s: Time between two boxes of the annotator.
        unlabelled: How many recordings, the last ones, have a video and a log alone: no boxes and
            no detections in the scene.
        annotator: Noise of the boxes.
        detector: Noise of the detections.
        receiver: Noise of the target's log; absent: 1.5 m, a fix a second, some dropouts.
        look: What is drawn.
        video: Whether to render at all; without, the clock is a table.
        moving: Whether the camera is on a vessel under way in a swell, rather than on a dock.
        knock: When a camera on a dock was turned, and how.
        shore: Whether a town with a port lies behind the water. What of it a detector takes for
            boats is among the detections.
        moored: How many boats lie along its quay.

    Raises:
        InputError: A setting is out of its range.
    """

    seed: int = 0
    recordings: int = 3
    duration_s: float = 60.0
    pause_s: float = 15.0
    rate_hz: float = 12.0
    image_size_px: tuple[int, int] = (1280, 720)
    camera: SimulatedCamera | None = None
    plane: LocalPlane = DOCK
    start_utc_s: float = START_UTC_S
    clock: ClockKind = "start"
    annotation_interval_s: float = 0.5
    unlabelled: int = 0
    annotator: BoxNoise = ANNOTATOR
    detector: BoxNoise = DETECTOR
    receiver: ReceiverNoise | None = None
    look: Look | None = None
    video: bool = True
    moving: bool = False
    knock: Knock | None = None
    shore: bool = False
    moored: int = 30

    def __post_init__(self) -> None:
        kinds: tuple[ClockKind, ...] = ("start", "exact", "stepped")
        if self.clock not in kinds:
            raise unknown_name("clock", self.clock, kinds)
        size = self.image_size_px if self.camera is None else self.camera.image_size_px
        _check(self.recordings, self.duration_s, self.rate_hz, size)
        if self.clock == "stepped" and self.duration_s < 3.0 * CLOCK_STEP_S:
            raise InputError(
                f"a clock that steps every {CLOCK_STEP_S:g} s cannot tell the times of a recording "
                f"of {self.duration_s:g} s; make it {3.0 * CLOCK_STEP_S:g} s or longer"
            )
        if not 0 <= self.unlabelled <= (self.recordings if self.video else 0):
            raise InputError(
                f"{self.unlabelled} recordings without boxes were asked for, of {self.recordings} "
                f"{'with' if self.video else 'without'} a video; a recording needs one or the other"
            )
        if self.knock is not None and self.moving:
            raise InputError("a camera on a vessel under way is not knocked as well; leave one out")

    @property
    def clock_kind(self) -> ClockKind:
        """How the scene tells the times: without presentation times only a table does."""
        return "exact" if not self.video and self.clock == "start" else self.clock


def simulate(
    directory: str | os.PathLike[str],
    settings: SimulationSettings | None = None,
    *,
    progress: Callable[[float], None] | None = None,
) -> Simulation:
    """Write a synthetic harbour as somebody with a camera on a dock would have recorded it.

    ======================  =======================================================================
    ``scene.toml``          ties it together
    ``01.mp4``, ...         the videos; frames are irregular in time, and some are lost
    ``clock/01.csv``        ``frame,utc``, with ``clock`` ``"exact"`` or ``"stepped"``
    ``boxes/01.csv``        the target's boxes, as an annotator drew them
    ``detections/01.csv``   all boats' boxes, as a detector saw them
    ``target.gpx``          the target's log
    ``ais.nmea``            what the target and the ferries broadcast
    ``truth.csv``           where every boat was at every frame
    ``truth.json``          the camera, and how everything was drawn
    ``truth-boxes/01.csv``  the exact boxes of all boats, ``track_id`` the boat; with a shore also
                            ``state``, ``moored`` or ``moving``
    ``platform.csv``        what the camera's platform logged of itself, if it moves
    ``horizon/01.csv``      the horizon in each frame, if the platform moves and there is no video
    ======================  =======================================================================

    Args:
        directory: Where to; made if it is not there.
        settings: What is in the recordings.
        progress: Called with the share done, 0 to 1.

    Raises:
        InputError: A file cannot be written.
    """
    settings = settings or SimulationSettings()
    folder = Path(directory)
    # A log that begins before the video and ends after it leaves no frame without a place.
    lead_s = 2.0
    apart_s = settings.duration_s + settings.pause_s
    whole_s = settings.recordings * settings.duration_s
    whole_s += (settings.recordings - 1) * settings.pause_s
    harbour = Harbour.random(
        settings.seed,
        HarbourSettings(
            duration_s=whole_s + 2.0 * lead_s,
            camera=settings.camera,
            image_size_px=settings.image_size_px,
            plane=settings.plane,
            start_utc_s=settings.start_utc_s - lead_s,
            moving=settings.moving,
            shore=settings.shore,
            moored=settings.moored,
        ),
    )
    if settings.knock is not None:
        harbour = replace(harbour, knock=settings.knock)
    rng = np.random.default_rng([settings.seed, 5])
    shot = []
    for i in range(settings.recordings):
        begin = settings.start_utc_s + round(i * apart_s)
        times = begin + _frame_times(rng, settings.duration_s, settings.rate_hz)
        shot.append(Recording(f"{i + 1:02d}", times))

    for i, recording in enumerate(shot):
        _write_tables(folder, harbour, recording, i, settings)
    noise = settings.receiver if settings.receiver is not None else ReceiverNoise()
    _write_gpx(folder / "target.gpx", harbour.fixes(noise))
    if settings.moving:
        own = replace(noise, interval_jitter=0.0, dropouts_per_minute=0.0)
        _write_platform(folder / "platform.csv", harbour.platform_log(own))
        if not settings.video:
            for i, recording in enumerate(shot):
                _write_horizon(folder / "horizon" / f"{recording.name}.csv", harbour, recording, i)
    _write_ais(folder / "ais.nmea", harbour)
    drawn: dict[str, object] = {
        "seed": settings.seed,
        "clock": settings.clock_kind,
        "annotator": asdict(settings.annotator),
        "detector": asdict(settings.detector),
        "receiver": asdict(noise),
    }
    _write_truth(folder, harbour, shot, drawn)
    if settings.video:
        _write_videos(folder, harbour, shot, settings.look, progress)
    _write_text(
        folder / "scene.toml",
        _scene(harbour, shot, settings.clock_kind, settings.video, settings.unlabelled),
    )
    return Simulation(folder / "scene.toml", harbour, tuple(shot))


def _check(
    recordings: int, duration_s: float, rate_hz: float, image_size_px: tuple[int, int]
) -> None:
    if recordings < 1:
        raise InputError(f"{recordings} recordings were asked for; at least one is needed")
    if not 1.0 <= duration_s <= _LONGEST_S:
        raise InputError(
            f"a recording of {duration_s:g} s is not to be had; give 1 to {_LONGEST_S:g} s"
        )
    if not 0.5 <= rate_hz <= 120.0:
        raise InputError(f"{rate_hz:g} frames a second are not between 0.5 and 120")
    if any(side % 2 or not 64 <= side <= 7680 for side in image_size_px):
        raise InputError(
            f"an image of {image_size_px[0]} x {image_size_px[1]} px cannot be encoded; "
            "width and height must be even, and 64 to 7680"
        )


def _frame_times(rng: np.random.Generator, duration_s: float, rate_hz: float) -> FloatArray:
    """(N,) seconds from 0: no two intervals alike, now and then a frame lost."""
    count = int(np.ceil(duration_s * rate_hz / (1.0 - _RATE_JITTER)))
    intervals = (1.0 + _RATE_JITTER * rng.uniform(-1.0, 1.0, count)) / rate_hz
    times = np.append(0.0, np.cumsum(intervals))
    kept = rng.random(times.size) >= _LOST_FRAMES
    kept[0] = True
    times = times[kept & (times < duration_s)]
    # Presentation times are kept in microseconds.
    return np.asarray(np.round(times * _MICROSECONDS) / _MICROSECONDS)


def _write_tables(
    folder: Path,
    harbour: Harbour,
    recording: Recording,
    seed: int,
    settings: SimulationSettings,
) -> None:
    name, times = recording.name, recording.time_utc_s
    clock = settings.clock_kind
    if clock != "start":
        rng = np.random.default_rng([harbour.seed, 6, seed])
        stamps = _iso(times) if clock == "exact" else _stepped(rng, times)
        _write_rows(folder / "clock" / f"{name}.csv", ("frame", "utc"), enumerate(stamps))
    looked_at = np.unique(
        np.searchsorted(times, np.arange(times[0], times[-1], settings.annotation_interval_s))
    )
    drawn = harbour.boxes(
        times[looked_at], noise=settings.annotator, frame=looked_at, seed=2 * seed
    )
    _write_boxes(folder / "boxes" / f"{name}.csv", drawn, annotator=True)
    detector = settings.detector
    if settings.shore:
        # Before a shore there is much that is too small for any detector.
        detector = replace(detector, least_px=max(detector.least_px, LEAST_FOUND_PX))
    seen = harbour.boxes(times, noise=detector, of="all", seed=2 * seed + 1)
    rng = np.random.default_rng([harbour.seed, 7, seed])
    seen = seen.with_columns(confidence=rng.beta(8.0, 2.0, len(seen)))
    false = harbour.false_boxes(times, noise=detector, seed=seed)
    if len(false):
        seen = Boxes.concatenate([seen, false])
        seen = seen[np.argsort(seen.time_utc_s, kind="stable")]
    _write_boxes(folder / "detections" / f"{name}.csv", seen, label=True)
    exact = harbour.boxes(times, of="all")
    states = _states(harbour, exact) if settings.shore else None
    _write_boxes(
        folder / "truth-boxes" / f"{name}.csv", exact, label=True, track=True, states=states
    )


def _states(harbour: Harbour, boxes: Boxes) -> list[str]:
    """Whether each boat lies still or is under way, box by box."""
    out = np.full(len(boxes), "moving")
    for boat in harbour.boats:
        rows = np.flatnonzero(boxes.track_id == boat.identity)
        speed = np.hypot(*boat.path.velocity(boxes.time_utc_s[rows] - harbour.start_utc_s).T)
        out[rows[speed < _STILL_MPS]] = "moored"
    return [str(state) for state in out]


def _stepped(rng: np.random.Generator, times: FloatArray) -> list[str]:
    """A clock that a timer reads every few seconds, cut off to the second."""
    phase = float(rng.uniform(0.0, CLOCK_STEP_S))
    since = times[0] - phase
    last_read = since + CLOCK_STEP_S * np.floor((times - since) / CLOCK_STEP_S)
    return [
        datetime.fromtimestamp(int(second), UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        for second in np.floor(last_read)
    ]


def _write_boxes(
    path: Path,
    boxes: Boxes,
    *,
    annotator: bool = False,
    label: bool = False,
    track: bool = False,
    states: list[str] | None = None,
) -> None:
    header = ["frame", "x1", "y1", "x2", "y2"]
    columns: list[list[object]] = [
        boxes.frame.tolist(),
        *(np.round(boxes.xyxy_px[:, i], 2).tolist() for i in range(4)),
    ]
    if label and not track:
        header.append("confidence")
        columns.append(np.round(boxes.confidence, 3).tolist())
    if annotator:
        header.append("annotator")
        columns.append(boxes.source.tolist())
    if track:
        header.append("track_id")
        columns.append(boxes.track_id.tolist())
    if label:
        header.append("label")
        columns.append(boxes.label.tolist())
    if states is not None:
        header.append("state")
        columns.append(list(states))
    _write_rows(path, header, zip(*columns, strict=True))


def _write_gpx(path: Path, fixes: Fixes) -> None:
    gpx = gpxpy.gpx.GPX()
    gpx.creator = "sightline simulate"
    segment = gpxpy.gpx.GPXTrackSegment(
        [
            gpxpy.gpx.GPXTrackPoint(round(latitude, 9), round(longitude, 9), time=_utc(time_s))
            for time_s, latitude, longitude in zip(
                fixes.time_utc_s.tolist(),
                fixes.latitude_deg.tolist(),
                fixes.longitude_deg.tolist(),
                strict=True,
            )
        ]
    )
    track = gpxpy.gpx.GPXTrack(name=fixes.name)
    track.segments.append(segment)
    gpx.tracks.append(track)
    _write_text(path, gpx.to_xml(version="1.1"))


def _write_platform(path: Path, own: Platform) -> None:
    assert own.headings is not None, "a simulated platform has a compass"
    _write_rows(
        path,
        ("time_utc", "latitude_deg", "longitude_deg", "heading_deg"),
        zip(
            _iso(own.fixes.time_utc_s),
            np.round(own.fixes.latitude_deg, 9).tolist(),
            np.round(own.fixes.longitude_deg, 9).tolist(),
            np.round(own.headings.heading_deg, 2).tolist(),
            strict=True,
        ),
    )


def _write_horizon(path: Path, harbour: Harbour, recording: Recording, seed: int) -> None:
    """The horizon as somebody would find it who is off by half a pixel."""
    assert harbour.platform is not None, "the caller has looked"
    rng = np.random.default_rng([harbour.seed, 10, seed])
    turns = harbour.platform.turn(recording.time_utc_s - harbour.start_utc_s)
    lines = np.stack([harbour.camera.horizon_line_px(turn) for turn in turns])
    lines += _HORIZON_STD_PX * rng.standard_normal(lines.shape)
    seen = np.flatnonzero(np.isfinite(lines).all(axis=1))
    rows = zip(seen.tolist(), *np.round(lines[seen], 2).T.tolist(), strict=True)
    _write_rows(path, ("frame", "left_y_px", "right_y_px"), rows)


def _write_ais(path: Path, harbour: Harbour) -> None:
    _write_text(path, "".join(f"{line}\n" for _, line in ais_sentences(harbour)))


def ais_sentences(
    harbour: Harbour, shift_s: float = 0.0, *, names: bool = False
) -> list[tuple[float, str]]:
    """What the target and the ferries of a harbour broadcast: AIS type 18, with tag blocks.

    Args:
        harbour: The world.
        shift_s: Added to all times, as if it were another day.
        names: Whether their names are broadcast too, after each fourth position (type 24, A).

    Returns:
        The shifted time of each sentence, POSIX seconds, and the sentence, in order of time.
    """
    lines = []
    talkers = [boat for boat in harbour.boats if boat.shape.kind == "ferry"]
    for boat in (harbour.target, *talkers):
        fixes = harbour.fixes(AIS_TRANSPONDER, boat=boat, seed=1)
        truth = harbour.truth(fixes.time_utc_s, [boat])
        for i, time_s in enumerate((fixes.time_utc_s + shift_s).tolist()):
            report = {
                "type": 18,
                "mmsi": _FIRST_MMSI + boat.identity - 1,
                "lat": fixes.latitude_deg[i],
                "lon": fixes.longitude_deg[i],
                "speed": round(float(truth.speed_mps[i]) * 3600.0 / 1852.0, 1),
                "course": round(float(truth.course_deg[i]), 1) % 360.0,
                "heading": 511,
                "second": int(time_s) % 60,
                "accuracy": 1,
            }
            sentence = encode_dict(report, talker_id="AI", sentence_type="VDM")[0]
            tag = f"s:sightline,c:{int(time_s)}"
            head = f"\\{tag}*{reduce(xor, tag.encode()):02X}\\"
            lines.append((time_s, head + sentence))
            if names and i % _NAMED_EVERY == 0:
                kind = "FERRY" if boat.shape.kind == "ferry" else "LAUNCH"
                told = {"type": 24, "partno": 0, "mmsi": report["mmsi"]}
                told["shipname"] = f"{kind} {boat.identity}"
                static = encode_dict(told, talker_id="AI", sentence_type="VDM")[0]
                lines.append((time_s, head + static))
    return sorted(lines)


def _write_truth(
    folder: Path, harbour: Harbour, shot: list[Recording], settings: dict[str, object]
) -> None:
    times = np.concatenate([recording.time_utc_s for recording in shot])
    truth = harbour.truth(times, harbour.boats)
    order = np.argsort(truth.time_utc_s, kind="stable")
    _write_rows(
        folder / "truth.csv",
        (
            "time_utc",
            "target",
            "name",
            "latitude_deg",
            "longitude_deg",
            "east_m",
            "north_m",
            "speed_mps",
            "course_deg",
        ),
        zip(
            _iso(truth.time_utc_s[order]),
            truth.boat[order].tolist(),
            truth.name[order].tolist(),
            np.round(truth.latitude_deg[order], 9).tolist(),
            np.round(truth.longitude_deg[order], 9).tolist(),
            np.round(truth.east_m[order], 4).tolist(),
            np.round(truth.north_m[order], 4).tolist(),
            np.round(truth.speed_mps[order], 4).tolist(),
            np.round(truth.course_deg[order], 3).tolist(),
            strict=True,
        ),
    )
    boats = [
        {
            "target": boat.identity,
            "name": boat.name,
            "kind": boat.shape.kind,
            "length_m": round(boat.shape.length_m, 2),
            "beam_m": round(boat.shape.beam_m, 2),
            "moored": not boat.path.moves,
        }
        for boat in harbour.boats
    ]
    platform = harbour.platform
    camera = {
        "latitude_deg": harbour.plane.latitude_deg,
        "longitude_deg": harbour.plane.longitude_deg,
        **asdict(harbour.camera),
    }
    facts: dict[str, object] = {"camera": camera, "boats": boats, "settings": settings}
    if harbour.knock is not None:
        facts["knock"] = asdict(harbour.knock)
    if platform is not None:
        facts["platform"] = {
            "heading_deg": platform.heading_deg,
            "velocity_mps": list(platform.velocity_mps),
        }
    _write_text(folder / "truth.json", json.dumps(facts, indent=2) + "\n")


def _write_videos(
    folder: Path,
    harbour: Harbour,
    shot: list[Recording],
    look: Look | None,
    progress: Callable[[float], None] | None,
) -> None:
    paint = painter(harbour, look)
    total = sum(recording.time_utc_s.size for recording in shot)
    done = 0
    for recording in shot:

        def frames(times: FloatArray = recording.time_utc_s) -> Iterator[Frame]:
            nonlocal done
            for index, image in enumerate(_ahead(paint, times)):
                yield Frame(index, float(times[index]), image)
                done += 1
                if progress is not None:
                    progress(done / total)

        # Nobody keeps these for long: time matters more than the size of the files.
        write_video(folder / f"{recording.name}.mp4", frames(), preset="ultrafast")


def painter(harbour: Harbour, look: Look | None) -> Callable[[float], Image]:
    """What paints the picture of a harbour, (H, W, 3) blue, green, red, at a POSIX time.

    Args:
        harbour: The world.
        look: How it is drawn; None: as its seed says.
    """
    platform, knock = harbour.platform, harbour.knock
    if platform is None and knock is None:
        return Renderer(harbour, look).image
    warp = Warp(harbour.camera)
    if platform is None:
        assert knock is not None, "one of the two"
        before = Renderer(replace(harbour, camera=warp.still), look)

        def paint_knocked(time_utc_s: float) -> Image:
            turn = knock.turn(harbour.camera, time_utc_s)[0]
            return warp.apply(before.image(time_utc_s), turn)

        return paint_knocked
    still = replace(
        harbour,
        camera=warp.still,
        boats=tuple(platform.seen(boat) for boat in harbour.boats),
        platform=None,
    )
    renderer = Renderer(still, look)

    def paint(time_utc_s: float) -> Image:
        since = [time_utc_s - harbour.start_utc_s]
        heave = float(platform.heave_m(since)[0])
        return warp.apply(renderer.image(time_utc_s), platform.turn(since)[0], heave)

    return paint


def _ahead(paint: Callable[[float], Image], times: FloatArray, depth: int = 4) -> Iterator[Image]:
    """Pictures in order, a few painted ahead while the ones before them are encoded."""
    with ThreadPoolExecutor(max_workers=2) as pool:
        waiting: deque[Future[Image]] = deque()
        for time_s in times.tolist():
            waiting.append(pool.submit(paint, time_s))
            if len(waiting) > depth:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _scene(
    harbour: Harbour, shot: list[Recording], clock: ClockKind, video: bool, unlabelled: int
) -> str:
    width, height = harbour.camera.image_size_px
    lines = [
        f"# A synthetic harbour, seed {harbour.seed}. The truth lies in truth.json and truth.csv.",
        "[camera]",
        'name = "synthetic-harbour"',
        f"latitude_deg = {harbour.plane.latitude_deg!r}",
        f"longitude_deg = {harbour.plane.longitude_deg!r}",
        f"image_size_px = [{width}, {height}]",
    ]
    for i, recording in enumerate(shot):
        name = recording.name
        lines += ["", "[[recordings]]", f'name = "{name}"']
        if video:
            lines.append(f'video = "{name}.mp4"')
        if clock == "start":
            lines.append(f"start_utc = {_iso(recording.time_utc_s[:1])[0]}")
        else:
            lines.append(f'clock = "clock/{name}.csv"')
        if i < len(shot) - unlabelled:
            lines.append(f'boxes = "boxes/{name}.csv"')
            lines.append(f'detections = "detections/{name}.csv"')
        lines.append('fixes = "target.gpx"')
        if harbour.platform is not None:
            lines.append('platform = "platform.csv"')
            if not video:
                lines.append(f'horizon = "horizon/{name}.csv"')
    return "\n".join(lines) + "\n"


def _utc(time_s: float) -> datetime:
    return datetime.fromtimestamp(round(time_s, 3), UTC)


def _iso(times: FloatArray) -> list[str]:
    """RFC 3339 in microseconds."""
    micro = np.round(times * _MICROSECONDS).astype(np.int64).astype("datetime64[us]")
    return [f"{text}Z" for text in np.datetime_as_string(micro, unit="us")]


def _write_rows(path: Path, header: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)


def _write_text(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
