"""The report as one HTML file that stands alone: map, numbers in words, tables and figures.

The file loads nothing, from the network or beside it, and says so to the browser in a content
security policy; names from the data are escaped wherever they appear.
"""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from itertools import groupby
from pathlib import Path

import numpy as np
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from sightline.atomic import atomic_path
from sightline.evaluation.comparison import Comparison, number, paper_rows, percent, smallest
from sightline.evaluation.metrics import ScoredPairs
from sightline.evaluation.report import Matched, Report, TracksUsed, without_nan
from sightline.geodesy import LocalPlane
from sightline.reporting.plots import data_uri
from sightline.synchronisation import LARGEST_GAP_S, distinct, synchronise
from sightline.text import xml_text
from sightline.types import Fixes, FloatArray, IntArray, PointKind, Track, ellipses, utc_text

KNOTS_PER_MPS = 3600.0 / 1852.0

_MOST_POINTS = 12_000
_MOST_ELLIPSES = 400
_TYPICAL_WIDTH_PX = 1000.0
_PROBABILITY = 0.95
_FEWEST_TO_JUDGE = 20


@dataclass(frozen=True)
class ModelRow:
    """One quantity of a fitted model.

    Attributes:
        name: What it is, in words.
        value: NaN where there is none.
        unit: ``"m"``, ``"px"``, ``"°"``, or ``""``.
        sigma: Its standard deviation in the same unit; None where it was not estimated.
        determined: False if the data could not tell it, so that it is what was assumed before.
    """

    name: str
    value: float
    unit: str = ""
    sigma: float | None = None
    determined: bool = True


@dataclass(frozen=True)
class SourceRow:
    """The bias of one source of boxes.

    Attributes:
        source: The annotator's or the detector's name.
        boxes: How many the model learned from.
        bias_px: How much lower its boxes end than the target does; negative is higher.
        sigma_px: Standard deviation of that.
    """

    source: str
    boxes: int
    bias_px: float
    sigma_px: float


@dataclass(frozen=True)
class OutlierRow:
    """A box that the fit did not trust.

    Attributes:
        recording: The recording's name.
        frame: The frame's number; None where there is none.
        time_utc_s: POSIX seconds; NaN where not known.
        source: Who made the box.
        residual_px: How far the box is from where the fit expects it, pixels.
    """

    recording: str
    frame: int | None
    time_utc_s: float
    source: str
    residual_px: float


@dataclass(frozen=True, eq=False)
class PageFigure:
    """A figure of the page.

    Attributes:
        title: Its heading.
        figure: The figure.
        alt: What it shows, in words, for those who cannot see it.
        caption: How to read it.
    """

    title: str
    figure: Figure
    alt: str
    caption: str = ""


@dataclass(frozen=True, eq=False)
class ReportPage:
    """All that the page shows.

    Attributes:
        title: The heading.
        scene_name: Which camera it is about.
        plane: Where the camera stands.
        reports: By what they score, for example ``"single boxes"`` and ``"smoothed tracks"``; the
            first one gives the figures at the top.
        tracks: Of each recording.
        fixes: The log of each recording.
        positions: Single positions beside the log, of each recording.
        model_name: Which model placed the boxes.
        model: What it found.
        sources: The biases of the sources of boxes.
        outliers: Boxes that the fit did not trust.
        statements: Sentences that the page says besides its own.
        warnings: Sentences that it says first, such as what could not be determined.
        figures: In their order.
        comparison: Models beside each other.
        made_utc_s: When the report was made; None: not said.
        learned_from: Names of the reports whose recordings the model learned from: how well it
            does elsewhere they do not tell, so none of them is the headline.
    """

    title: str
    scene_name: str
    plane: LocalPlane
    reports: Mapping[str, Report] = field(default_factory=dict)
    tracks: Mapping[str, Sequence[Track]] = field(default_factory=dict)
    fixes: Mapping[str, Fixes] = field(default_factory=dict)
    positions: Mapping[str, ScoredPairs] = field(default_factory=dict)
    model_name: str = ""
    model: Sequence[ModelRow] = ()
    sources: Sequence[SourceRow] = ()
    outliers: Sequence[OutlierRow] = ()
    statements: Sequence[str] = ()
    warnings: Sequence[str] = ()
    figures: Sequence[PageFigure] = ()
    comparison: Comparison | None = None
    made_utc_s: float | None = None
    learned_from: frozenset[str] = frozenset()


def write_page(page: ReportPage, path: str | Path) -> None:
    """Write the page, whole or not at all.

    Args:
        page: What to show.
        path: The HTML file.

    Raises:
        InputError: The file cannot be written.
    """
    text = render_page(page)
    with atomic_path(Path(path)) as temporary:
        temporary.write_text(text, encoding="utf-8")


def render_page(page: ReportPage) -> str:
    """The page as HTML text that needs no other file."""
    script, style = asset("report.js"), asset("report.css")
    # What no page can hold is shown as such; a zero or an escape in a name is none of the markup.
    return xml_text(
        environment()
        .from_string(asset("report.html.j2"))
        .render(
            page=page,
            script=Markup(script),  # noqa: S704 - the package's own file
            style=Markup(style),  # noqa: S704
            script_hash=integrity(script),
            style_hash=integrity(style),
            version=version("sightline"),
            headline=_headline(page),
            headlined=_headlined(page),
            statements={name: plain_statements(report) for name, report in page.reports.items()},
            map=_map(page),
            tracks=_track_rows(page),
            paper=_paper_tables(page.comparison),
            figures=[(figure, data_uri(figure.figure)) for figure in page.figures],
        )
    )


def plain_statements(report: Report) -> list[str]:
    """What a report says, in sentences for people who have not read the paper.

    Args:
        report: The report; its parts for each recording do not matter here.
    """
    ape = report.ape
    if ape.n == 0:
        return ["Nothing could be compared with the log, so nothing is known of the errors."]
    said = [
        (
            f"Half of the positions are within {_metres(ape.median)} of the log, nine in ten "
            f"within {_metres(ape.p90)}; the worst is {_metres(ape.max)} off."
        )
    ]
    if math.isfinite(ape.per_range):
        said.append(
            f"On average the error is {percent(ape.per_range)} of the distance from the camera."
        )
    said.extend(_about_bias(report))
    said.append(_about_coverage(report))
    if report.rpe.n:
        said.append(
            f"Over {report.rpe.delta_s:g} s a target's movement is off by "
            f"{_metres(report.rpe.rmse)} (root mean square)."
        )
    if ape.n < report.matched.asked:
        said.append(_about_matched(report.matched))
    if report.tracks is not None:
        said.append(_about_tracks(report.tracks))
    return said


def _about_bias(report: Report) -> list[str]:
    bias = report.bias
    if not math.isfinite(bias.bias_along):
        return []
    lean = "far from" if bias.bias_along > 0.0 else "near to"
    if report.ape.n >= _FEWEST_TO_JUDGE and abs(bias.bias_along) > 0.5 * bias.rmse_along:
        return [
            (
                f"Positions lie too {lean} the camera, by {_metres(abs(bias.bias_along))} on "
                "average: most of the error is systematic."
            )
        ]
    return [
        (
            f"Errors are {_metres(bias.rmse_along)} along the line of sight and "
            f"{_metres(bias.rmse_across)} across it (root mean square); on average positions lie "
            f"{_metres(abs(bias.bias_along))} too {lean} the camera."
        )
    ]


def _about_coverage(report: Report) -> str:
    coverage, n = report.coverage, report.coverage.n
    if n == 0:
        return "The positions state no uncertainty, so there is none to check."
    held = coverage.p95_with_log
    if coverage.reference_sigma_m > 0.0:
        share = (
            f"With the log's own error of {number(coverage.reference_sigma_m)} m counted, the "
            f"stated 95 % ellipses hold {percent(held)} of its positions"
        )
    else:
        share = f"The stated 95 % ellipses hold {percent(held)} of the log's positions"
    if n < _FEWEST_TO_JUDGE:
        return f"{share}; {n} positions are too few to judge them by."
    if held < 0.90:
        return f"{share}: they are too small. Do not rely on them."
    if held <= 0.98:
        return f"{share}: they can be believed."
    if coverage.p95 > 0.98:
        return f"{share}: they are larger than they need to be."
    return (
        f"{share}, and {percent(coverage.p95)} if it had none: they are not too small, and the log "
        "is too inexact to say more."
    )


def _about_matched(matched: Matched) -> str:
    outside = matched.asked - matched.matched - matched.without_position
    reasons = []
    if outside:
        reasons.append(f"{outside:,} fall outside the log or into its gaps")
    if matched.without_position:
        reasons.append(f"the model has no position for {matched.without_position:,}")
    return (
        f"{matched.matched:,} of {matched.asked:,} could be compared "
        f"({percent(matched.share)}): {', and '.join(reasons)}."
    )


def _about_tracks(tracks: TracksUsed) -> str:
    overlap = f"{tracks.overlapping} overlap the log in time"
    many = len(tracks.used) != 1
    listed = ", ".join(str(number) for number in tracks.used[:10])
    if tracks.chosen_by == "track_id":
        verb = "were" if many else "was"
        return (
            f"As asked, track{'s' * many} {listed} {verb} taken for the logged target; {overlap}."
        )
    if many:
        return (
            "In each recording the track nearest to the log was taken for the logged target; in "
            f"all {overlap}."
        )
    return f"Track {listed}, the nearest to the log, was taken for the logged target; {overlap}."


def _metres(value: float) -> str:
    return f"{number(value)} m" if value < 100.0 else f"{value:,.0f} m"


@dataclass(frozen=True)
class _Tile:
    label: str
    value: str
    note: str


def _headlined(page: ReportPage) -> str | None:
    """The name of the first report of what the model had not learned from."""
    return next((name for name in page.reports if name not in page.learned_from), None)


def _headline(page: ReportPage) -> list[_Tile]:
    name = _headlined(page)
    if name is None or (report := page.reports[name]).ape.n == 0:
        return []
    tiles = [
        _Tile("median error", _metres(report.ape.median), "half of the positions are nearer"),
        _Tile("RMSE", _metres(report.ape.rmse), f"over {report.ape.n:,} positions"),
        _Tile("nine in ten within", _metres(report.ape.p90), "90th percentile of the error"),
        _Tile("of the distance", percent(report.ape.per_range), "mean error per range"),
    ]
    if report.coverage.n:
        tiles.append(
            _Tile(
                "in the 95 % ellipse",
                percent(report.coverage.p95_with_log),
                "95 % would be honest"
                if report.coverage.reference_sigma_m == 0.0
                else "95 % would be honest; the log's own error counts",
            )
        )
    return tiles


@dataclass(frozen=True)
class _TrackRow:
    recording: str
    track: int
    label: str
    start: str
    duration_s: float
    points: int
    speed_mps: float
    semi_major_m: float
    median_error_m: float
    scored: bool


def _target_log(page: ReportPage, recording: str, track: Track) -> Fixes | None:
    """The log of a track, where that was taken for the logged target's; None of any other.

    How far another vessel is from the one that kept the log is no error.
    """
    for report in page.reports.values():
        used = report.recordings[recording].tracks if recording in report.recordings else None
        if used is not None and track.track_id in used.used:
            return page.fixes.get(recording)
    return None


def _track_rows(page: ReportPage) -> list[_TrackRow]:
    rows = []
    for recording, tracks in page.tracks.items():
        for track in tracks:
            if not len(track):
                continue
            axes = ellipses(track.covariance_m2, _PROBABILITY).semi_major_m
            log = _target_log(page, recording, track)
            error = _errors(track, log)
            rows.append(
                _TrackRow(
                    recording=recording,
                    track=track.track_id,
                    label=track.label,
                    start=clock_time(float(track.time_utc_s[0])),
                    duration_s=float(np.ptp(track.time_utc_s)),
                    points=len(track),
                    speed_mps=float(np.median(track.speed_mps)),
                    semi_major_m=_median(axes),
                    median_error_m=_median(error),
                    scored=log is not None,
                )
            )
    return rows


def _errors(track: Track, fixes: Fixes | None) -> FloatArray:
    """(N,) metres from the log, NaN where it does not tell."""
    if fixes is None:
        return np.full(len(track), np.nan)
    log = synchronise(fixes, track.time_utc_s, track.plane)
    error: FloatArray = np.hypot(track.east_m - log.east_m, track.north_m - log.north_m)
    return error


def _median(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else math.nan


_PaperGroup = tuple[str, list[tuple[str, list[tuple[str, bool]]]]]


@dataclass(frozen=True)
class _PaperTable:
    """Of each recording its rows: the metric, and each model's number and whether it is best."""

    title: str
    models: list[str]
    groups: list[_PaperGroup]


def _paper_tables(comparison: Comparison | None) -> list[_PaperTable]:
    if comparison is None:
        return []
    tables = []
    for title, reports in (
        ("Single boxes", comparison.models),
        ("With the trajectory stage", comparison.smoothed),
    ):
        if not reports:
            continue
        groups: list[_PaperGroup] = []
        for recording, rows in groupby(paper_rows(reports), key=lambda row: row.recording):
            lines = [
                (
                    row.metric,
                    [
                        (number(value), model in smallest(row.values))
                        for model, value in row.values.items()
                    ],
                )
                for row in rows
            ]
            groups.append((recording, lines))
        tables.append(_PaperTable(title, list(reports), groups))
    return tables


@dataclass(frozen=True)
class _Ellipse:
    east_m: float
    north_m: float
    semi_major_m: float
    semi_minor_m: float
    angle_deg: float


@dataclass(frozen=True)
class _MapRecording:
    """The layers of one recording; paths are SVG path data in metres, y down."""

    name: str
    log: str
    boxes: str
    errors: str
    tracks: list[tuple[str, str]]
    ellipses: list[_Ellipse]


@dataclass(frozen=True)
class _Ring:
    """A distance from the camera, and where on it to write it."""

    radius_m: float
    label_east_m: float
    label_north_m: float


@dataclass(frozen=True)
class _Map:
    view: tuple[float, float, float, float]
    metres_per_px: float
    rings: list[_Ring]
    recordings: list[_MapRecording]
    data: object
    has_boxes: bool
    has_tracks: bool
    has_log: bool
    whole_logs: list[str]
    extent: str


def _map(page: ReportPage) -> _Map | None:
    names = list(dict.fromkeys([*page.tracks, *page.positions, *page.fixes]))
    points = sum(len(track) for group in page.tracks.values() for track in group)
    step = max(math.ceil(points / _MOST_POINTS), 1)
    count = sum(len(group) for group in page.tracks.values()) + len(page.positions)
    each = max(_MOST_ELLIPSES // max(count, 1), 3)
    recordings, series, core, estimates = [], [], [np.zeros((1, 2))], [np.zeros((0, 2))]
    for name in names:
        tracks = [track for track in page.tracks.get(name, ()) if len(track)]
        pairs = page.positions.get(name)
        log_times, log = _log_in(page, name, tracks, pairs)
        core.append(log)
        shapes: list[_Ellipse] = []
        paths = []
        for track in tracks:
            rows = np.unique(np.r_[np.arange(0, len(track), step), len(track) - 1])
            thin = track[rows]
            places = np.column_stack([thin.east_m, thin.north_m])
            estimates.append(places)
            paths.append((f"track {track.track_id}", _path(thin.time_utc_s, places, math.inf)))
            apart = _apart(thin.covariance_m2, places)
            shapes.extend(_ellipses(thin.covariance_m2[apart], places[apart], each))
            series.append(_series(name, thin, _target_log(page, name, track)))
        boxes = errors = ""
        if pairs is not None and len(pairs):
            places = np.column_stack([pairs.east_m, pairs.north_m])
            true = np.column_stack([pairs.true_east_m, pairs.true_north_m])
            estimates.append(places)
            core.append(true)
            boxes = "".join(f"M{_xy(place)}h0" for place in places)
            errors = "".join(f"M{_xy(a)}L{_xy(b)}" for a, b in zip(true, places, strict=True))
            if not tracks:
                shapes.extend(_ellipses(pairs.covariance_m2, places, each))
            series.append(_box_series(name, pairs))
        recordings.append(
            _MapRecording(name, _path(log_times, log, LARGEST_GAP_S), boxes, errors, paths, shapes)
        )
    every = np.concatenate(estimates)
    if len(every) == 0 and sum(map(len, core)) == 1:
        return None
    low, high = _extent(np.concatenate(core), every)
    width, height = (high - low).tolist()
    return _Map(
        view=(float(low[0]), float(-high[1]), width, height),
        metres_per_px=width / _TYPICAL_WIDTH_PX,
        rings=_rings(low, high),
        recordings=recordings,
        data=without_nan(
            {
                "view": [float(low[0]), float(-high[1]), width, height],
                "series": series,
                "kinds": {int(kind): kind.name.lower() for kind in PointKind},
                "knots": KNOTS_PER_MPS,
            }
        ),
        has_boxes=any(recording.boxes for recording in recordings),
        has_tracks=any(recording.tracks for recording in recordings),
        has_log=any(recording.log for recording in recordings),
        whole_logs=_whole_logs(page),
        extent=_geographic_extent(page.plane, low, high),
    )


def _whole_logs(page: ReportPage) -> list[str]:
    """The paths of the logs from end to end, each once; recordings often share one.

    Beside them a reader sees the way in and out, and so where he is.
    """
    distinct_logs: list[Fixes] = []
    for fixes in page.fixes.values():
        if not any(
            np.array_equal(fixes.time_utc_s, other.time_utc_s)
            and np.array_equal(fixes.latitude_deg, other.latitude_deg)
            for other in distinct_logs
        ):
            distinct_logs.append(fixes)
    paths = []
    for fixes in distinct_logs:
        log = distinct(fixes)
        log = log[:: max(math.ceil(len(log) * len(distinct_logs) / _MOST_POINTS), 1)]
        usual_s = float(np.median(np.diff(log.time_utc_s))) if len(log) > 1 else 0.0
        places = np.column_stack(page.plane.to_plane(log.latitude_deg, log.longitude_deg))
        paths.append(_path(log.time_utc_s, places, max(LARGEST_GAP_S, 3.0 * usual_s)))
    return [path for path in paths if path]


def _geographic_extent(plane: LocalPlane, low: FloatArray, high: FloatArray) -> str:
    """What the first view shows, in latitude and longitude."""
    latitude, longitude = plane.to_geographic(*np.stack([low, high], axis=1))
    return (
        f"{_degrees(latitude[0], 'N', 'S')} to {_degrees(latitude[1], 'N', 'S')}, "
        f"{_degrees(longitude[0], 'E', 'W')} to {_degrees(longitude[1], 'E', 'W')}"
    )


def _degrees(angle_deg: float, positive: str, negative: str) -> str:
    return f"{abs(angle_deg):.4f}° {positive if angle_deg >= 0.0 else negative}"


def _log_in(
    page: ReportPage, name: str, tracks: Sequence[Track], pairs: ScoredPairs | None
) -> tuple[FloatArray, FloatArray]:
    """Times and (N, 2) places of a recording's log, as long as there is something beside it."""
    fixes = page.fixes.get(name)
    if fixes is None or not len(fixes):
        return np.empty(0), np.empty((0, 2))
    log = distinct(fixes)
    times = [track.time_utc_s for track in tracks]
    times += [pairs.time_utc_s] if pairs is not None and len(pairs) else []
    if times:
        every = np.concatenate(times)
        near = (log.time_utc_s >= every.min() - LARGEST_GAP_S) & (
            log.time_utc_s <= every.max() + LARGEST_GAP_S
        )
        log = log[near]
    elif page.tracks or page.positions:
        # A log often runs for hours beside recordings of minutes; one of which nothing came
        # would only shrink the map of the others.
        return np.empty(0), np.empty((0, 2))
    log = log[:: max(math.ceil(len(log) / _MOST_POINTS), 1)]
    return log.time_utc_s, np.column_stack(page.plane.to_plane(log.latitude_deg, log.longitude_deg))


def _extent(core: FloatArray, estimates: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners of the first view: log and camera, and estimates that are not absurd."""
    if len(core) == 1:
        middle = np.median(estimates, axis=0)
        size = 4.0 * max(float(np.median(np.abs(estimates - middle))), 10.0)
        core = np.concatenate([core, [middle - size, middle + size]])
    low, high = core.min(axis=0), core.max(axis=0)
    reach = 0.35 * max(float((high - low).max()), 20.0)
    inside = ((estimates > low - reach) & (estimates < high + reach)).all(axis=1)
    shown = np.concatenate([core, estimates[inside]])
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = 0.06 * max(float((high - low).max()), 20.0)
    low, high = low - margin, high + margin
    # Neither a slit nor a tower: the map is between half as high as wide and as high as wide.
    width, height = high - low
    grow = np.array([max(height - width, 0.0), max(0.5 * width - height, 0.0)]) / 2.0
    return low - grow, high + grow


def _rings(low: FloatArray, high: FloatArray) -> list[_Ring]:
    """Three to six round distances, written towards the corner that is farthest from the camera."""
    corner = np.where(np.abs(high) >= np.abs(low), high, low)
    reach = float(np.hypot(*corner))
    power = 10.0 ** math.floor(math.log10(reach / 3.0))
    step = max(factor * power for factor in (1.0, 2.0, 5.0) if factor * power <= reach / 3.0)
    east, north = (corner / reach).tolist()
    radii = [step * k for k in range(1, int(reach / step) + 1)]
    return [_Ring(radius, radius * east, radius * north) for radius in radii]


def _path(time_utc_s: FloatArray, places: FloatArray, largest_gap_s: float) -> str:
    parts = []
    for i, place in enumerate(places):
        leap = i == 0 or time_utc_s[i] - time_utc_s[i - 1] > largest_gap_s
        parts.append(("M" if leap else "L") + _xy(place))
    return "".join(parts)


def _xy(place: FloatArray) -> str:
    return f"{place[0]:.2f} {-place[1]:.2f}"


def _apart(covariance_m2: FloatArray, places: FloatArray) -> IntArray:
    """Of places one after another those that lie a standard deviation from the one before.

    The ellipses of a target that hardly moves would lie on one another, and hide its track.
    """
    chosen: list[int] = []
    precision = np.zeros((2, 2))
    for i in np.flatnonzero(np.isfinite(covariance_m2).all(axis=(1, 2))):
        if chosen:
            off = places[i] - places[chosen[-1]]
            if off @ precision @ off < 1.0:
                continue
        chosen.append(int(i))
        precision = np.linalg.pinv(covariance_m2[i], hermitian=True)
    return np.array(chosen, dtype=np.int64)


def _ellipses(covariance_m2: FloatArray, places: FloatArray, most: int) -> list[_Ellipse]:
    rows = np.unique(np.linspace(0, len(places) - 1, min(most, len(places))).astype(int))
    shape = ellipses(covariance_m2[rows], _PROBABILITY)
    return [
        _Ellipse(*map(float, values))
        for values in zip(
            places[rows, 0],
            places[rows, 1],
            shape.semi_major_m,
            shape.semi_minor_m,
            shape.bearing_deg - 90.0,
            strict=True,
        )
        if np.isfinite(values).all()
    ]


def _series(recording: str, track: Track, fixes: Fixes | None) -> dict[str, object]:
    return {
        "recording": recording,
        "name": f"track {track.track_id}" + (f", {track.label}" if track.label else ""),
        "track": True,
        **_columns(track, _errors(track, fixes)),
        "speed": np.round(track.speed_mps, 2).tolist(),
        "course": np.round(track.course_deg, 0).tolist(),
        "kind": track.kind.tolist(),
    }


def _box_series(recording: str, pairs: ScoredPairs) -> dict[str, object]:
    return {
        "recording": recording,
        "name": "single box",
        "track": False,
        **_columns(pairs, pairs.error_m),
    }


def _columns(points: Track | ScoredPairs, error_m: FloatArray) -> dict[str, object]:
    """What every series shows of its points."""
    shape = ellipses(points.covariance_m2, _PROBABILITY)
    return {
        "time": np.round(points.time_utc_s, 2).tolist(),
        "east": np.round(points.east_m, 2).tolist(),
        "north": np.round(points.north_m, 2).tolist(),
        "major": np.round(shape.semi_major_m, 2).tolist(),
        "minor": np.round(shape.semi_minor_m, 2).tolist(),
        "bearing": np.round(shape.bearing_deg, 1).tolist(),
        "error": np.round(error_m, 2).tolist(),
    }


def _to_sigma(value: float, sigma: float | None) -> str:
    """A value to the digit at which it is unsure."""
    if not math.isfinite(value):
        return "–"
    if sigma is None or not math.isfinite(sigma) or sigma <= 0.0:
        return f"{value:.4g}".replace("-", "\N{MINUS SIGN}")
    digits = min(max(1 - math.floor(math.log10(sigma)), 0), 6)
    # Adding zero takes the sign from what is rounded to nothing.
    return f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "\N{MINUS SIGN}")


def _signed(value: float) -> str:
    if not math.isfinite(value):
        return "–"
    return f"{value:+.2f}".replace("-", "\N{MINUS SIGN}")


def clock_time(time_utc_s: float) -> str:
    """Date and time of day to the second, UTC; a dash where not known."""
    if not math.isfinite(time_utc_s):
        return "–"
    return f"{utc_text(time_utc_s)} UTC"


@cache
def asset(name: str) -> str:
    """The text of a file that pages are made of."""
    return (files("sightline.reporting") / "templates" / name).read_text(encoding="utf-8")


def integrity(text: str) -> str:
    """What names a script or a style in a content security policy."""
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return "sha256-" + base64.b64encode(digest).decode("ascii")


@cache
def environment() -> Environment:
    """What templates of pages are rendered by."""
    made = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    made.filters.update(
        number=number, percent=percent, signed=_signed, to_sigma=_to_sigma, clock=clock_time
    )
    return made
