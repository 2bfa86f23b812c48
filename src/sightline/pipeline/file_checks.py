"""What single files hold, as far as a run is concerned, and what about them would go wrong."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sightline import formats, video
from sightline.clock import Clock
from sightline.clock_offset import ZONES_S
from sightline.errors import InputError, SightlineError
from sightline.geodesy import LocalPlane
from sightline.synchronisation import LARGEST_GAP_S, distinct
from sightline.tally import Tally
from sightline.types import Boxes, Fixes, FloatArray, utc_text
from sightline.video.reader import frame_count

Fact = int | float | str | list[float] | dict[str, int] | None

FARTHEST_M = 100_000.0
"""No camera places what is farther away."""

_FAR_M = 20_000.0
_FASTEST_MPS = 50.0
_STILL_M = 20.0
_UNSTEADY = 0.5
"""A tenth of the frames that differ from their usual interval by more than this share of it."""
_SELDOM_S = 6.0
_TOLD_S = 1e-3
_HOURS = tuple(zone_s / 3600.0 for zone_s in ZONES_S)


@dataclass(eq=False)
class FileCheck:
    """What a file holds.

    Attributes:
        path: The file or folder.
        kind: What it was read as: ``log``, ``video``, ``boxes``...
        said: What it holds, in a line.
        facts: The same in numbers; times are POSIX seconds.
        warnings: What will go wrong, or might.
        problems: Why a run would be refused.
        tally: What was read and left out.
        time_utc_s: (N,) times of what is in it, in order; None where it has none.
        fixes: Of a log of one vessel.
        boxes: Of a table of boxes.
        size_px: Of pictures.
    """

    path: Path
    kind: str
    said: str = ""
    facts: dict[str, Fact] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    tally: Tally = field(default_factory=lambda: Tally(""))
    time_utc_s: FloatArray | None = None
    fixes: Fixes | None = None
    boxes: Boxes | None = None
    size_px: tuple[int, int] | None = None

    def to_dict(self) -> dict[str, object]:
        """As JSON has it."""
        return {
            "path": str(self.path),
            "kind": self.kind,
            "said": self.said,
            **self.facts,
            "read": dict(self.tally.read),
            "left_out": {why: left.count for why, left in self.tally.left_out.items()},
            "notes": list(self.tally.notes),
            "warnings": list(self.warnings),
            "problems": list(self.problems),
        }

    @contextmanager
    def refusing(self) -> Iterator[None]:
        """Take what a reader refuses for a problem of this file."""
        try:
            yield
        except SightlineError as error:
            line = str(error)
            self.problems.append(line if str(self.path) in line else f"{self.path}: {line}")

    def warn(self, what: str) -> None:
        """Keep a warning on this file."""
        self.warnings.append(f"{self.path}: {what}")


def started(path: str | os.PathLike[str], kind: str) -> FileCheck:
    """An empty check of a file."""
    return FileCheck(Path(path), kind, tally=Tally(path))


def span_text(time_utc_s: FloatArray) -> str:
    """First and last of some times, as people read them; the day is said once."""
    first, last = utc_text(float(time_utc_s.min())), utc_text(float(time_utc_s.max()))
    if first == last:
        return first
    return f"{first} to {last[11:] if first[:10] == last[:10] else last}"


def duration_text(seconds: float) -> str:
    """A duration to two figures or the second."""
    if seconds < 100.0:
        return f"{seconds:.2g} s" if seconds < 10.0 else f"{seconds:.0f} s"
    if seconds < 7200.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{seconds / 3600.0:.1f} h"


def distance_text(metres: float) -> str:
    """A distance in metres or kilometres."""
    return f"{metres:.0f} m" if metres < 10_000.0 else f"{metres / 1000.0:,.0f} km"


def distances_text(nearest_m: float, farthest_m: float) -> str:
    """A span of distances; the unit is said once."""
    first, last = distance_text(nearest_m), distance_text(farthest_m)
    return f"{first.split()[0] if first.split()[1] == last.split()[1] else first} to {last}"


def check_log(path: Path, mmsi: int | None, plane: LocalPlane | None) -> FileCheck:
    """A log: its fixes, intervals, gaps and speeds, and where they are from the camera.

    Args:
        path: The log.
        mmsi: Which vessel of an AIS log; None: all of them.
        plane: At the camera; None where its place is not known.
    """
    check = started(path, "log")
    with check.refusing():
        if mmsi is None and formats.holds_tracks(path):
            taught = formats.read_track_logs(path, tally=check.tally)
            check.kind = "tracks"
            check.facts["vessels"] = len(taught)
            _describe_feed(check, {i: one.fixes for i, one in enumerate(taught)}, plane)
            check.problems.append(
                f"{path}: tracks of other cameras teach a camera (sightline fit), and no run is "
                "scored against them; give a run the log of one vessel"
            )
            return check
        if mmsi is None and formats.holds_ais(path):
            feed = formats.read_ais_feed(path, tally=check.tally)
            check.kind = "AIS feed"
            check.facts["vessels"] = len(feed)
            logs = {number: vessel.fixes for number, vessel in feed.items()}
            if len(logs) != 1:
                _describe_feed(check, logs, plane)
                return check
            fixes = next(iter(logs.values()))
        else:
            fixes = formats.read_fixes(path, mmsi=mmsi, tally=check.tally)
        _describe_log(check, fixes, plane)
    return check


def _describe_feed(check: FileCheck, logs: dict[int, Fixes], plane: LocalPlane | None) -> None:
    every = np.concatenate([fixes.time_utc_s for fixes in logs.values()])
    check.time_utc_s = np.sort(every)
    check.facts |= {"fixes": int(every.size), "first_utc_s": every.min(), "last_utc_s": every.max()}
    check.said = f"{len(logs)} vessels, {every.size} fixes, {span_text(every)}"
    if plane is not None:
        nearest = min(float(_range_m(fixes, plane).min()) for fixes in logs.values())
        check.facts["nearest_m"] = nearest
        check.said += f"; the nearest {distance_text(nearest)} from the camera"
        if nearest > FARTHEST_M:
            check.problems.append(_too_far(check.path, nearest, None, plane))


def _describe_log(check: FileCheck, fixes: Fixes, plane: LocalPlane | None) -> None:
    check.fixes, check.time_utc_s = fixes, fixes.time_utc_s
    once = distinct(fixes)
    steps = np.diff(once.time_utc_s)
    check.facts |= {
        "fixes": len(fixes),
        "first_utc_s": float(fixes.time_utc_s[0]),
        "last_utc_s": float(fixes.time_utc_s[-1]),
    }
    check.said = f"{len(fixes)} fixes, {span_text(fixes.time_utc_s)}"
    if not steps.size:
        check.warn("a single fix says nothing of how its vessel moved")
        return
    usual = float(np.median(steps))
    gaps = steps[steps > max(LARGEST_GAP_S, 5.0 * usual)]
    own = LocalPlane(float(fixes.latitude_deg[0]), float(fixes.longitude_deg[0]))
    east, north = own.to_plane(once.latitude_deg, once.longitude_deg)
    speed = np.hypot(np.diff(east), np.diff(north)) / steps
    check.facts |= {
        "usual_interval_s": usual,
        "gaps": int(gaps.size),
        "longest_gap_s": float(steps.max()),
        "median_speed_mps": float(np.median(speed)),
        "largest_speed_mps": float(speed.max()),
    }
    check.said += f", one every {duration_text(usual)}"
    if gaps.size:
        count = f"{gaps.size} gap{'s' * (gaps.size > 1)}"
        check.said += f", {count} (longest {duration_text(gaps.max())})"
    check.said += f"; {np.median(speed):.1f} m/s, at most {speed.max():.1f}"
    if usual > LARGEST_GAP_S:
        check.warn(
            f"a fix every {duration_text(usual)} is seldom: between fixes over {LARGEST_GAP_S:g} s "
            "apart nothing but how it moves tells where the vessel was; log every second"
        )
    if speed.max() > _FASTEST_MPS:
        at = int(np.argmax(speed))
        check.warn(
            f"{speed.max():.0f} m/s at {utc_text(once.time_utc_s[at])} is faster than a vessel; "
            "are fixes wrong, or of several vessels?"
        )
    if np.hypot(np.ptp(east), np.ptp(north)) < _STILL_M:
        check.warn("its vessel hardly moved; a camera is learned from one that drives about")
    if plane is not None:
        _describe_distance(check, fixes, plane)


def _range_m(fixes: Fixes, plane: LocalPlane) -> FloatArray:
    return np.asarray(np.hypot(*plane.to_plane(fixes.latitude_deg, fixes.longitude_deg)))


def _describe_distance(check: FileCheck, fixes: Fixes, plane: LocalPlane) -> None:
    east, north = plane.to_plane(fixes.latitude_deg, fixes.longitude_deg)
    ranges = np.hypot(east, north)
    bearing = np.degrees(np.arctan2(east, north))
    ahead = np.exp(1j * np.radians(bearing)).mean()
    middle = float(np.degrees(np.angle(ahead)))
    around = (bearing - middle + 180.0) % 360.0 - 180.0
    left, right = ((middle + edge) % 360.0 for edge in (float(around.min()), float(around.max())))
    nearest, farthest = float(ranges.min()), float(ranges.max())
    check.facts |= {
        "nearest_m": nearest,
        "farthest_m": farthest,
        "bearings_deg": [round(left, 1), round(right, 1)],
    }
    bearings = f"bearing {left:.0f}° to {right:.0f}°"
    check.said += f"; {distances_text(nearest, farthest)} from the camera, {bearings}"
    if nearest > FARTHEST_M:
        check.problems.append(_too_far(check.path, nearest, fixes, plane))
    elif nearest > _FAR_M:
        check.warn(f"it never comes nearer to the camera than {distance_text(nearest)}")
    elif farthest > FARTHEST_M:
        count = int((ranges > FARTHEST_M).sum())
        check.warn(
            f"{count} of its {len(fixes)} fixes {'is' if count == 1 else 'are'} over "
            f"{distance_text(FARTHEST_M)} from the camera, the farthest {distance_text(farthest)}"
        )


def _too_far(path: Path, nearest_m: float, fixes: Fixes | None, plane: LocalPlane) -> str:
    """What is wrong with a log that is far away: its columns, a sign, or the camera's place."""
    line = f"{path}: its nearest fix is {distance_text(nearest_m)} from the camera"
    if fixes is None:
        return f"{line}; is latitude_deg, longitude_deg of [camera] right?"
    latitude, longitude = fixes.latitude_deg, fixes.longitude_deg
    if np.abs(longitude).max() <= 90.0:
        swapped = plane.to_plane(longitude, latitude)
        if np.hypot(*swapped).min() < FARTHEST_M:
            return f"{line}; latitude and longitude are swapped, in it or in [camera]"
    for what, north, east in (("latitude", -1, 1), ("longitude", 1, -1), ("both", -1, -1)):
        if np.hypot(*plane.to_plane(north * latitude, east * longitude)).min() < FARTHEST_M:
            which = "latitude and longitude" if what == "both" else what
            return f"{line}; the sign of its {which} differs from the camera's"
    return f"{line}; is it the log of this place, and is the place of [camera] right?"


def check_boxes(path: Path, kind: str, size_px: tuple[int, int] | None) -> FileCheck:
    """A table of boxes: how many, whose, and which part of the picture they cover.

    Args:
        path: The table.
        kind: ``boxes`` of the logged target, or ``detections`` of anything.
        size_px: Of the picture; None where it is not known.
    """
    check = started(path, kind)
    with check.refusing():
        source = path.stem if kind == "detections" else None
        boxes = formats.read_boxes(
            path,
            source=source,
            skip_empty=kind == "detections",
            image_size_px=size_px,
            tally=check.tally,
        )
        describe_boxes(check, boxes, size_px)
    return check


def describe_boxes(check: FileCheck, boxes: Boxes, size_px: tuple[int, int] | None) -> None:
    """Say what boxes there are."""
    check.boxes = boxes
    names, counts = np.unique(boxes.source, return_counts=True)
    sources = dict(zip(names.tolist(), counts.tolist(), strict=True))
    frames = int(np.unique(boxes.frame).size)
    check.facts |= {"boxes": len(boxes), "frames": frames, "sources": sources}
    by = ", ".join(f"{count} by {name}" for name, count in sources.items() if name)
    check.said = f"{len(boxes)} boxes in {frames} frames" + (f" ({by})" if by else "")
    timed = np.isfinite(boxes.time_utc_s)
    if timed.any():
        check.time_utc_s = np.sort(boxes.time_utc_s[timed])
    if not len(boxes):
        check.warn("holds no box")
    elif size_px is not None:
        _describe_part(check, boxes, size_px)


def _describe_part(check: FileCheck, boxes: Boxes, size_px: tuple[int, int]) -> None:
    width, height = size_px
    x1, y1, x2, y2 = boxes.xyxy_px.T
    gone = (x2 <= 0.0) | (y2 <= 0.0) | (x1 >= width) | (y1 >= height)
    over = (x1 < -2.0) | (y1 < -2.0) | (x2 > width + 2.0) | (y2 > height + 2.0)
    foot_x, foot_y = (x1 + x2) / 2.0 / width, y2 / height
    part = [float(v) for v in (foot_x.min(), foot_x.max(), foot_y.min(), foot_y.max())]
    check.facts["part_of_picture"] = [round(value, 3) for value in part]
    left, right, top, bottom = (100.0 * value for value in part)
    check.said += f", at {left:.0f} to {right:.0f} % of the width, {top:.0f} to {bottom:.0f} % down"
    if gone.any():
        largest = f"{x2.max():.0f} x {y2.max():.0f}"
        check.problems.append(
            f"{check.path}: {gone.sum()} of {len(boxes)} boxes lie outside the picture of {width} "
            f"x {height} px (they reach {largest}); were they drawn in a picture of another size?"
        )
    elif over.sum() > 0.1 * len(boxes):
        check.warn(f"{over.sum()} of {len(boxes)} boxes reach out of the picture")


def check_video(
    path: Path, start_utc_s: float | None, clock: Clock | None, info: video.VideoInfo | None = None
) -> FileCheck:
    """A video: frames, size, rate, and what tells its times.

    Args:
        path: The file.
        start_utc_s: When its first frame was taken; None where nobody said.
        clock: Tells the times alone, where it is given.
        info: What the file says of itself, where it has been read.
    """
    check = started(path, "video")
    with check.refusing():
        if info is None:
            info = _info(path, clock, check.tally)
        seconds = info.presentation_s
        check.size_px = info.image_size_px
        width, height = info.image_size_px
        check.facts |= {"frames": int(seconds.size), "size_px": [float(width), float(height)]}
        check.said = f"{seconds.size} frames of {width} x {height} px"
        start = start_utc_s if start_utc_s is not None else info.creation_utc_s
        times = None if start is None else start + seconds
        told = "start_utc" if start_utc_s is not None else "its creation time"
        if clock is not None:
            told = "its clock"
            times = np.asarray(clock.time_utc_s(np.arange(seconds.size)))
        describe_times(check, times, seconds if times is None else times, told)
        if clock is None and start_utc_s is None and info.creation_utc_s is not None:
            check.tally.note(
                f"is taken to begin at {utc_text(info.creation_utc_s)}, the creation time that it "
                "says; some cameras write when they stopped, or local time: give start_utc"
            )
    return check


def _info(path: Path, clock: Clock | None, tally: Tally) -> video.VideoInfo:
    """What a video says of itself; one without times needs a clock, and has no more to say."""
    try:
        return video.video_info(path, tally=tally)
    except InputError:
        if clock is None:
            raise
        count = frame_count(path)
        if count is None:
            raise
        return video.VideoInfo(video.image_size_px(path), np.full(count, np.nan), None)


def describe_times(
    check: FileCheck, time_utc_s: FloatArray | None, moments_s: FloatArray, told: str
) -> None:
    """Say what the times of frames are, and how steady.

    Args:
        check: Of the pictures.
        time_utc_s: (N,) POSIX seconds; None where nothing tells them.
        moments_s: (N,) seconds from any beginning.
        told: What tells the times.
    """
    known = time_utc_s if time_utc_s is not None else moments_s
    steps = np.diff(known)
    steps = steps[np.isfinite(steps)]
    usual = float(np.median(steps)) if steps.size else float("nan")
    if usual > 0.0:
        often = np.percentile(steps, [5.0, 95.0])
        check.facts |= {
            "usual_interval_s": usual,
            "intervals_s": [float(steps.min()), float(steps.max())],
        }
        check.said += f", {1.0 / usual:.3g} a second" if usual < 1.0 else f", every {usual:.3g} s"
        if np.abs(often / usual - 1.0).max() > _UNSTEADY:
            check.warn(
                f"its rate is unsteady: frames are {often[0]:.3g} to {often[1]:.3g} s apart (nine "
                f"in ten), and at most {steps.max():.3g} s"
            )
        if usual > _SELDOM_S:
            check.warn(
                f"its frames are {usual:.1f} s apart, and a target can be followed only where they "
                f"are at most {_SELDOM_S:g} s apart"
            )
    elif steps.size:
        check.warn("its frames have no times of their own; give clock (a table frame,utc)")
    if time_utc_s is not None:
        time_utc_s = time_utc_s[np.isfinite(time_utc_s)]
    if time_utc_s is None or not time_utc_s.size:
        check.facts["times_from"] = None
        check.said += ", and nothing tells when"
        return
    check.time_utc_s = time_utc_s
    check.facts |= {
        "times_from": told,
        "first_utc_s": float(time_utc_s[0]),
        "last_utc_s": float(time_utc_s[-1]),
    }
    check.said += f", {span_text(time_utc_s)} by {told}"


def check_pictures(path: Path, clock: Clock | None, *, every: bool = True) -> FileCheck:
    """A folder of pictures: how many, their size, and what tells their times.

    Args:
        path: The folder.
        clock: Tells the times.
        every: Whether each is opened, or the first alone.
    """
    check = started(path, "pictures")
    with check.refusing():
        times = []
        for frame in video.frames(path, clock=clock, tally=check.tally):
            check.size_px = (frame.image_bgr.shape[1], frame.image_bgr.shape[0])
            times.append(frame.time_utc_s)
            if not every:
                break
        assert check.size_px is not None, "a folder without a picture is refused"
        width, height = check.size_px
        check.facts["size_px"] = [float(width), float(height)]
        check.said = f"pictures of {width} x {height} px"
        if every:
            check.facts["frames"] = len(times)
            check.said = f"{len(times)} {check.said}"
        moments = np.array(times)
        known = np.isfinite(moments).all()
        describe_times(check, moments if known else None, moments, "their clock")
    return check


def check_clock(path: Path) -> tuple[FileCheck, Clock | None]:
    """A table of the times of frames, and the clock that it makes."""
    check = started(path, "clock")
    clock = None
    with check.refusing():
        clock = formats.read_clock(path, tally=check.tally)
        check.time_utc_s = clock.time_utc_s(clock.frame)
        sigma = float(np.median(clock.sigma_s(clock.frame)))
        first, last = int(clock.frame[0]), int(clock.frame[-1])
        check.facts |= {
            "first_frame": first,
            "last_frame": last,
            "sigma_s": sigma,
            "first_utc_s": float(check.time_utc_s[0]),
            "last_utc_s": float(check.time_utc_s[-1]),
        }
        check.said = f"frames {first} to {last}, {span_text(check.time_utc_s)}"
        if sigma >= _TOLD_S:
            check.said += f", ± {sigma:.2g} s"
    return check, clock


def hours_apart(time_utc_s: FloatArray, log_utc_s: FloatArray) -> tuple[float, float] | None:
    """The hours of a time zone later at which times would lie within a log's, and their share.

    Args:
        time_utc_s: (N,) times of a recording.
        log_utc_s: (M,) times of a log, in order.

    Returns:
        None where no time zone brings them together.
    """
    best: tuple[float, float] | None = None
    for hours in sorted(_HOURS, key=lambda hours: (hours % 1.0 != 0.0, abs(hours))):
        share = overlap_share(time_utc_s + 3600.0 * hours, log_utc_s)
        if share > 0.0 and (best is None or share > best[1] + 0.05):
            best = hours, share
    return best


def overlap_share(time_utc_s: FloatArray, log_utc_s: FloatArray) -> float:
    """Share of times that lie between the first and the last of a log."""
    known = time_utc_s[np.isfinite(time_utc_s)]
    if not known.size or not log_utc_s.size:
        return 0.0
    return float(((known >= log_utc_s[0]) & (known <= log_utc_s[-1])).mean())


def covered_share(time_utc_s: FloatArray, log_utc_s: FloatArray) -> float:
    """Share of times at which the fixes on either side are near enough to tell the place."""
    known = time_utc_s[np.isfinite(time_utc_s)]
    if not known.size or not log_utc_s.size:
        return 0.0
    after = np.clip(np.searchsorted(log_utc_s, known), 1, max(log_utc_s.size - 1, 1))
    if log_utc_s.size == 1:
        return float((known == log_utc_s[0]).mean())
    inside = (known >= log_utc_s[0]) & (known <= log_utc_s[-1])
    return float((inside & (log_utc_s[after] - log_utc_s[after - 1] <= LARGEST_GAP_S)).mean())


def apart_text(time_utc_s: FloatArray, log_utc_s: FloatArray) -> str:
    """A sentence on a recording and a log that do not overlap."""
    line = (
        f"its log does not overlap it: the recording runs from {span_text(time_utc_s)}, the log "
        f"from {span_text(log_utc_s)}"
    )
    hours = hours_apart(time_utc_s, log_utc_s)
    if hours is None:
        return line
    number, share = hours
    unit = "hour" if abs(number) == 1 else "hours"
    when = "later" if number > 0 else "earlier"
    return (
        f"{line}; {abs(number):g} {unit} {when}, {100.0 * share:.0f} % of the recording would lie "
        "within the log: is one of them in local time?"
    )
