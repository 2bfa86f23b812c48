"""The evaluation report: the metrics of section 4.4 for all recordings and for each."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from sightline.atomic import atomic_path
from sightline.clock_offset import ClockOffset
from sightline.errors import InputError
from sightline.evaluation.forecast import ForecastError
from sightline.evaluation.metrics import (
    DELTA_S,
    AbsoluteError,
    Coverage,
    LineOfSight,
    RangeBin,
    RelativeError,
    ScoredPairs,
    absolute_error,
    by_range,
    coverage,
    line_of_sight,
    pair_positions,
    pair_track,
    relative_error,
)
from sightline.logged_motion import under_way
from sightline.platform import Platform
from sightline.synchronisation import LARGEST_GAP_S
from sightline.text import json_text
from sightline.types import Fixes, FloatArray, Positions, Track, rfc3339

LEAST_OVERLAP_S = 5.0
"""A track that meets the log for less is not taken for the target while another meets it longer."""

_AS_NEAR, _AS_LONG = 2.0, 0.5


@dataclass(frozen=True)
class Matched:
    """How many of the times asked for could be compared.

    Attributes:
        asked: Times looked up: boxes, or points of a track.
        matched: Of those, the ones compared.
        share: ``matched / asked``; NaN if nothing was asked.
        without_position: Times that the log knows but the estimate has no position for.
    """

    asked: int
    matched: int
    share: float
    without_position: int


@dataclass(frozen=True)
class TracksUsed:
    """Tracks that were matched to the logged target.

    Attributes:
        used: Their ids, one a recording (or as many as were named).
        overlapping: How many tracks overlap the log in time, without those that never move while
            the log does.
        chosen_by: ``"track_id"`` if the caller named them, ``"smallest median error"`` if the log
            decided. The latter flatters a tracker that breaks the target into pieces.
    """

    used: tuple[int, ...]
    overlapping: int
    chosen_by: str


def _coverage_dict(coverage: Coverage) -> dict[str, object]:
    """The coverage as JSON has it: the key of the log's error is that of release 0.1."""
    out = asdict(coverage)
    return {"log_sigma_m" if key == "reference_sigma_m" else key: out[key] for key in out}


@dataclass(frozen=True)
class Report:
    """Errors of positions against a log: pooled over recordings, and for each of them.

    Attributes:
        ape: Absolute pose error.
        rpe: Relative pose error.
        coverage: Of the stated ellipses.
        matched: How much could be compared.
        bias: Error along and across the line of sight.
        by_range: Error in bins of the true distance from the camera.
        recordings: A report without further recordings for each; may be empty.
        tracks: Which tracks were scored, where tracks were.
        forecast: Errors of forecasts by the time ahead in seconds, where they were scored.
        clock: How far the camera's clock is ahead of the log's, where the positions were scored in
            the log's time since theirs is off.
    """

    ape: AbsoluteError
    rpe: RelativeError
    coverage: Coverage
    matched: Matched
    bias: LineOfSight
    by_range: tuple[RangeBin, ...]
    recordings: Mapping[str, Report] = field(default_factory=dict)
    tracks: TracksUsed | None = None
    forecast: Mapping[str, ForecastError] | None = None
    clock: ClockOffset | None = None

    def to_dict(self) -> dict[str, object]:
        """The report as JSON has it; NaN and infinities become None."""
        return {
            **self._own(),
            "recordings": {name: report._own() for name, report in self.recordings.items()},
        }

    def _own(self) -> dict[str, object]:
        out: dict[str, object] = {
            "ape": asdict(self.ape),
            "rpe": asdict(self.rpe),
            "coverage": _coverage_dict(self.coverage),
            "matched": asdict(self.matched),
            "bias": asdict(self.bias),
            "by_range": [asdict(row) for row in self.by_range],
        }
        if self.tracks is not None:
            out["tracks"] = {**asdict(self.tracks), "used": list(self.tracks.used)}
        if self.clock is not None:
            out["clock"] = asdict(self.clock)
        if self.forecast is not None:
            out["forecast"] = {ahead: asdict(error) for ahead, error in self.forecast.items()}
        return {key: without_nan(value) for key, value in out.items()}

    def without_camera(self) -> Report:
        """The report without what needs the camera's place, for tracks that do not tell it."""
        nan = math.nan
        return replace(
            self,
            ape=replace(self.ape, per_range=nan),
            bias=LineOfSight(*([nan] * len(fields(LineOfSight)))),
            by_range=(),
            recordings={name: part.without_camera() for name, part in self.recordings.items()},
        )

    def write(self, path: str | Path) -> None:
        """Write the report as JSON.

        Raises:
            InputError: The file cannot be written.
        """
        write_json(path, self.to_dict())


def without_nan(value: object) -> object:
    """A copy of nested dicts and lists in which numbers that are not finite are None."""
    if isinstance(value, Mapping):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_json(path: str | Path, content: Mapping[str, object]) -> None:
    """Write JSON without NaN, atomically.

    Args:
        path: The file.
        content: What to write; numbers that are not finite become null.

    Raises:
        InputError: The file cannot be written.
    """
    text = json.dumps(without_nan(content), indent=2, allow_nan=False, ensure_ascii=False)
    with atomic_path(Path(path)) as temporary:
        temporary.write_text(json_text(text) + "\n", encoding="utf-8")


def summarise(
    pairs: ScoredPairs | Mapping[str, ScoredPairs],
    *,
    delta_s: float = DELTA_S,
    largest_gap_s: float = LARGEST_GAP_S,
    tracks: TracksUsed | Mapping[str, TracksUsed] | None = None,
) -> Report:
    """Compute the report of pairs.

    Args:
        pairs: All in one, or for each recording; then the report pools them and has each.
        delta_s: The time of the relative error, seconds.
        largest_gap_s: The relative error interpolates no further.
        tracks: Which tracks the pairs come from, in the form of ``pairs``.
    """
    if isinstance(pairs, ScoredPairs):
        used = tracks if isinstance(tracks, TracksUsed) else None
        return Report(
            ape=absolute_error(pairs),
            rpe=relative_error(pairs, delta_s, largest_gap_s=largest_gap_s),
            coverage=coverage(pairs),
            matched=Matched(pairs.asked, len(pairs), pairs.share, pairs.without_position),
            bias=line_of_sight(pairs),
            by_range=by_range(pairs),
            tracks=used,
        )
    each = tracks if isinstance(tracks, Mapping) else {}
    pooled = summarise(
        ScoredPairs.concatenate(pairs.values()),
        delta_s=delta_s,
        largest_gap_s=largest_gap_s,
        tracks=_pool_tracks(each),
    )
    recordings = {
        name: summarise(part, delta_s=delta_s, largest_gap_s=largest_gap_s, tracks=each.get(name))
        for name, part in pairs.items()
    }
    return Report(
        ape=pooled.ape,
        rpe=pooled.rpe,
        coverage=pooled.coverage,
        matched=pooled.matched,
        bias=pooled.bias,
        by_range=pooled.by_range,
        recordings=recordings,
        tracks=pooled.tracks,
    )


def _pool_tracks(tracks: Mapping[str, TracksUsed]) -> TracksUsed | None:
    if not tracks:
        return None
    return TracksUsed(
        used=tuple(number for part in tracks.values() for number in part.used),
        overlapping=sum(part.overlapping for part in tracks.values()),
        chosen_by=", ".join(dict.fromkeys(part.chosen_by for part in tracks.values())),
    )


def evaluate_positions(
    time_utc_s: ArrayLike,
    positions: Positions,
    fixes: Fixes | Mapping[str, Fixes],
    *,
    recording: ArrayLike | None = None,
    delta_s: float = DELTA_S,
    largest_gap_s: float = LARGEST_GAP_S,
) -> Report:
    """Evaluate single positions, one a box, without smoothing.

    Args:
        time_utc_s: (N,) POSIX seconds of the positions.
        positions: N positions of the target that was logged.
        fixes: The log, or a log for each recording.
        recording: (N,) the name of each position's recording; absent: all are of one, and the
            report has no part for each.
        delta_s: The time of the relative error, seconds.
        largest_gap_s: Times between fixes that are further apart are not compared.

    Raises:
        InputError: No position falls into the log, or a recording has no log.
    """
    times = np.asarray(time_utc_s, dtype=np.float64)
    if recording is None:
        if isinstance(fixes, Mapping):
            raise InputError("a log for each recording needs the recording of each position")
        pairs = pair_positions(times, positions, fixes, largest_gap_s=largest_gap_s)
        _refuse_nothing(pairs, times, [fixes], largest_gap_s)
        return summarise(pairs, delta_s=delta_s, largest_gap_s=largest_gap_s)
    names = np.asarray(recording, dtype=np.str_)
    if names.shape != times.shape:
        raise InputError(f"{times.size} positions need as many recordings, not {names.shape}")
    parts: dict[str, ScoredPairs] = {}
    logs: list[Fixes] = []
    for name in dict.fromkeys(names.tolist()):
        rows = names == name
        logs.append(_log_of(fixes, name))
        parts[name] = pair_positions(
            times[rows], positions[rows], logs[-1], largest_gap_s=largest_gap_s
        )
    _refuse_nothing(ScoredPairs.concatenate(parts.values()), times, logs, largest_gap_s)
    return summarise(parts, delta_s=delta_s, largest_gap_s=largest_gap_s)


def evaluate_tracks(
    tracks: Iterable[Track] | Mapping[str, Iterable[Track]],
    fixes: Fixes | Mapping[str, Fixes],
    *,
    track_id: int | Iterable[int] | None = None,
    delta_s: float = DELTA_S,
    largest_gap_s: float = LARGEST_GAP_S,
    least_overlap_s: float = LEAST_OVERLAP_S,
) -> Report:
    """Evaluate tracks against the log of one target, at the tracks' own times.

    Without a ``track_id`` the target is, in each recording, the one track with the smallest
    median error among those that meet the log for at least ``least_overlap_s`` (or, if none does,
    for as long as any does), and half as long as the longest whose ellipses hold the log for most
    of the time; with those that continue it: tracks of other times that are about as near and agree
    as well. The report names them and says who chose.

    Args:
        tracks: Tracks, or the tracks of each recording.
        fixes: The log, or a log for each recording.
        track_id: The track, or the tracks, that are the target. With tracks for each recording
            it is looked for in all.
        delta_s: The time of the relative error, seconds.
        largest_gap_s: Times between fixes that are further apart are not compared.
        least_overlap_s: Seconds.

    Raises:
        InputError: No track overlaps the log, or there is no track with the id.
    """
    if isinstance(tracks, Mapping):
        groups = {name: list(group) for name, group in tracks.items()}
    else:
        groups = {"": list(tracks)}
    everyone = [track for group in groups.values() for track in group]
    if not everyone:
        raise InputError("there is no track to evaluate")
    wanted = _wanted(track_id, everyone)
    parts: dict[str, ScoredPairs] = {}
    used: dict[str, TracksUsed] = {}
    logs: list[Fixes] = []
    for name, group in groups.items():
        logs.append(_log_of(fixes, name))
        parts[name], used[name] = pair_target(
            group,
            logs[-1],
            wanted=wanted,
            largest_gap_s=largest_gap_s,
            least_overlap_s=least_overlap_s,
            where=_where(name),
        )
    if not any(map(len, parts.values())):
        _refuse_moored(everyone, logs)
    times = np.concatenate([track.time_utc_s for track in everyone])
    _refuse_nothing(ScoredPairs.concatenate(parts.values()), times, logs, largest_gap_s)
    if not isinstance(tracks, Mapping):
        return summarise(parts[""], delta_s=delta_s, largest_gap_s=largest_gap_s, tracks=used[""])
    return summarise(parts, delta_s=delta_s, largest_gap_s=largest_gap_s, tracks=used)


def pair_target(
    tracks: Iterable[Track],
    fixes: Fixes,
    *,
    wanted: Collection[int] | None = None,
    largest_gap_s: float = LARGEST_GAP_S,
    least_overlap_s: float = LEAST_OVERLAP_S,
    platform: Platform | None = None,
    reference_sigma_m: float = 0.0,
    where: str = "",
) -> tuple[ScoredPairs, TracksUsed]:
    """Pair the tracks that are the logged target with its log; see `evaluate_tracks`.

    Args:
        tracks: Of one recording.
        fixes: The log.
        wanted: The ids of the target's tracks; absent: the nearest track is the target, of those
            that never move only while the log does not either.
        largest_gap_s: Times between fixes that are further apart are not compared.
        least_overlap_s: Seconds.
        platform: What the camera stood on, where that moved.
        reference_sigma_m: Standard deviation of the log's own error, metres east and north.
        where: Begins the message: the recording.

    Returns:
        The pairs, none where no track overlaps the log, and which tracks they are of.

    Raises:
        InputError: Two tracks have the same id.
    """
    paired: dict[int, ScoredPairs] = {}
    tracks = list(tracks)
    for track in tracks:
        if track.track_id in paired:
            raise InputError(
                f"{where}two tracks have the id {track.track_id}; give each one of its own"
            )
        paired[track.track_id] = pair_track(
            track,
            fixes,
            largest_gap_s=largest_gap_s,
            platform=platform,
            reference_sigma_m=reference_sigma_m,
        )
    overlapping = {number: pairs for number, pairs in paired.items() if len(pairs)}
    if wanted is not None:
        chosen, by = [number for number in paired if number in wanted], "track_id"
    else:
        still = {track.track_id for track in tracks if track.never_moves}
        overlapping = {
            number: pairs
            for number, pairs in overlapping.items()
            if not (number in still and _log_goes(pairs))
        }
        chosen = _nearest(overlapping, least_overlap_s)
        chosen += _continued(chosen, overlapping)
        by = "smallest median error"
    pairs = ScoredPairs.concatenate(paired[number] for number in chosen)
    return pairs, TracksUsed(tuple(chosen), len(overlapping), by)


def _wanted(track_id: int | Iterable[int] | None, tracks: list[Track]) -> set[int] | None:
    if track_id is None:
        return None
    wanted = (
        {int(track_id)}
        if isinstance(track_id, int | np.integer)
        else {int(number) for number in track_id}
    )
    known = {track.track_id for track in tracks}
    missing = sorted(wanted - known)
    if missing:
        listed = ", ".join(str(number) for number in sorted(known)[:20])
        more = ", …" if len(known) > 20 else ""
        raise InputError(f"there is no track {missing[0]}; known are {listed}{more}")
    return wanted


def _nearest(candidates: Mapping[int, ScoredPairs], least_overlap_s: float) -> list[int]:
    if not candidates:
        return []
    overlap = {number: float(np.ptp(pairs.time_utc_s)) for number, pairs in candidates.items()}
    least = min(least_overlap_s, max(overlap.values()))
    long_enough = [number for number in candidates if overlap[number] >= least]
    # What crosses the log for a moment is nearer to it then than the target itself.
    agreeing = [number for number in long_enough if _agrees(candidates[number])]
    if agreeing:
        least = _AS_LONG * max(overlap[number] for number in agreeing)
        long_enough = [number for number in agreeing if overlap[number] >= least]
    return [min(long_enough, key=lambda number: float(np.median(candidates[number].error_m)))]


def _log_goes(pairs: ScoredPairs) -> bool:
    """Whether the log is under way for most of the time of a track."""
    log = np.stack([pairs.true_east_m, pairs.true_north_m], axis=1)
    return bool(under_way(pairs.time_utc_s, log, pairs.time_utc_s).mean() > 0.5)


def _agrees(pairs: ScoredPairs) -> bool:
    """Whether the log lies within the ellipses of a track for most of its time."""
    return bool(coverage(pairs).p95 > 0.5)


def _continued(chosen: list[int], candidates: Mapping[int, ScoredPairs]) -> list[int]:
    """Further tracks of the same target: seen while the chosen were not, and as near to the log.

    A target that left the picture, or was hidden for long, comes back under another number. What
    belongs to it lies within its own ellipses about the log for most of its time.
    """
    if not chosen:
        return []
    limit_m = _AS_NEAR * float(np.median(candidates[chosen[0]].error_m))
    spans = [candidates[number].time_utc_s[[0, -1]] for number in chosen]
    more: list[int] = []
    for number in sorted(candidates, key=lambda n: -len(candidates[n])):
        pairs = candidates[number]
        first, last = pairs.time_utc_s[[0, -1]]
        apart = all(last < begin or first > end for begin, end in spans)
        error_m = float(np.median(pairs.error_m))
        if number in chosen or not apart or error_m > limit_m:
            continue
        if not _agrees(pairs):
            continue
        more.append(number)
        spans.append(np.array([first, last]))
    return more


def _log_of(fixes: Fixes | Mapping[str, Fixes], name: str) -> Fixes:
    if isinstance(fixes, Fixes):
        return fixes
    if name not in fixes:
        listed = ", ".join(fixes) or "none"
        raise InputError(f"{_where(name)}there is no log; logs are known for {listed}")
    return fixes[name]


def _where(name: str) -> str:
    return f"recording {name}: " if name else ""


def _refuse_moored(tracks: list[Track], logs: list[Fixes]) -> None:
    """Raise InputError where tracks overlap the log, and none of them moves."""
    overlap = any(
        track.time_utc_s[0] <= log.time_utc_s[-1] and track.time_utc_s[-1] >= log.time_utc_s[0]
        for track in tracks
        for log in logs
        if len(track) and len(log)
    )
    if overlap and all(track.never_moves for track in tracks):
        raise InputError(
            "every track stays in its place (moored) while the log is under way, so none is of its "
            "vessel; name its track_id if that is wrong"
        )


def _refuse_nothing(
    pairs: ScoredPairs,
    times: FloatArray,
    logs: list[Fixes],
    gap_s: float,
) -> None:
    """Raise InputError where no pair could be compared, with the reason."""
    if len(pairs):
        return
    if pairs.without_position:
        raise InputError(
            f"none of the {pairs.asked} boxes has a position, so nothing can be compared with the "
            "log; do the boxes lie above the horizon?"
        )
    known = times[np.isfinite(times)]
    stamps = [log.time_utc_s for log in logs if len(log)]
    if known.size == 0:
        raise InputError("no position has a time, so none can be compared with the log")
    if not stamps:
        raise InputError("the log has no fixes")
    log_start, log_end = min(s[0] for s in stamps), max(s[-1] for s in stamps)
    spans = [
        f"{rfc3339(a)} to {rfc3339(b)}"
        for a, b in ((known.min(), known.max()), (log_start, log_end))
    ]
    raise InputError(
        f"no position falls between two fixes at most {gap_s:g} s apart: the positions run from "
        f"{spans[0]}, the log from {spans[1]}; is a clock off, or in local time?"
    )
