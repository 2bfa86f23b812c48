"""`sightline count`."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.cli.common import say, warn, write_result
from sightline.cli.options import JsonOption, OverwriteOption
from sightline.cli.outputs import Attempts, keep_apart
from sightline.cli.parsing import parse_duration_s
from sightline.cli.replacing import keep_others
from sightline.errors import InputError

if TYPE_CHECKING:
    from sightline.area import Area, Line
    from sightline.counting import Flow


def count(
    tracks: Annotated[Path, typer.Argument(metavar="TRACKS", help="Tracks in a file.")],
    lines: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="GeoJSON LineString features, each with a name; or sections of OTAnalytics "
            "(.otflow), with --model.",
        ),
    ] = None,
    zones: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="GeoJSON Polygon features, each with a name."),
    ] = None,
    every: Annotated[
        str, typer.Option(metavar="TIME", help="Length of an interval: 30s, 15min, 1h, 1d.")
    ] = "15min",
    closest: Annotated[
        float | None,
        typer.Option(metavar="METRES", help="Tell of tracks that come closer to each other."),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            metavar="MODEL", help="Of the camera in whose picture an .otflow's sections are drawn."
        ),
    ] = None,
    flows: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Where the counts of flows go, as OTAnalytics' table (.csv): those of an .otflow, "
            "else from each line to each other.",
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Where a figure of the counts goes: .png, .svg, .pdf."),
    ] = None,
    output: Annotated[
        list[Path] | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Where the counts go: .csv, .json or .parquet. May be given several times.",
        ),
    ] = None,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Count crossings of lines, stays in zones, journeys and near misses."""
    outputs = output or []
    keep_apart([*outputs, flows, plot, json], [tracks, lines, zones, model])
    if lines is None and zones is None and closest is None:
        raise InputError("there is nothing to count; give --lines, --zones or --closest")
    if closest is not None and not 0.0 < closest < float("inf"):
        raise InputError(f"--closest {closest:g}: is no distance; give metres, more than 0")
    if flows is not None and (lines is None or flows.suffix.lower() != ".csv"):
        raise InputError("--flows FILE: needs --lines, and is a table that ends in .csv")
    if plot is not None and lines is None and zones is None:
        raise InputError("--plot FILE: there is nothing to draw; give --lines or --zones")
    every_s = parse_duration_s("--every", every)
    for path in (tracks, lines, zones, model):
        if path is not None and not path.exists():
            raise InputError(f"{path}: there is no such file")
    from sightline.formats.counts import check_counts_ending, write_counts
    from sightline.formats.otanalytics import write_flow_counts

    for path in outputs:
        check_counts_ending(path)
    kinds = [(path, "result" if path.suffix.lower() == ".json" else "counts") for path in outputs]
    others = [(flows, "flows"), (plot, "figure"), (json, "result")]
    keep_others([*kinds, *others], overwrite=overwrite)
    if plot is not None:
        from sightline.reporting.plots import check_figure_ending

        check_figure_ending(plot)
    from sightline.counting import CountSettings
    from sightline.counting import count as count_tracks
    from sightline.tracks import Tracks

    read = Tracks.read(tracks).tracks
    what = _what(lines, zones, model)
    report = count_tracks(
        read,
        lines=what.lines,
        zones=what.zones,
        flows=what.flows_or_all() if flows is not None else what.flows,
        settings=CountSettings(every_s, closest),
    )
    if report.without_covariance:
        warn(
            f"{report.without_covariance} of {report.tracks} tracks do not say how unsure they "
            "are; their crossings count as certain, without an uncertainty"
        )
    attempts = Attempts()
    for path in outputs:
        with attempts.one():
            write_counts(report.rows(), report.to_dict(), path)
    with attempts.one():
        write_result(json, report.to_dict())
    if flows is not None:
        with attempts.one():
            write_flow_counts(report.flows, flows)
    if plot is not None:
        from sightline.reporting.counts_figure import counts_figure
        from sightline.reporting.plots import save_figure

        with attempts.one():
            save_figure(counts_figure(report), plot)
    say(f"{report.tracks} tracks, of which {report.moored} never move")
    for kind, rows, key in (("line", report.lines, "direction"), ("zone", report.zones, "class")):
        for line in _totals(kind, rows, key):
            say(line)
    for line in _flow_totals(report.flows):
        say(line)
    if closest is not None:
        say(f"near misses under {closest:g} m: {len(report.near_misses)}")
    attempts.check()


@dataclass
class _What:
    """Lines, zones and flows that tracks are counted at."""

    lines: dict[str, Line]
    zones: dict[str, Area]
    flows: list[Flow]

    def flows_or_all(self) -> list[Flow]:
        """The flows; where none are named, from each line to each other."""
        from sightline.counting import Flow

        return self.flows or [
            Flow(f"{a} --> {b}", a, b) for a, b in itertools.permutations(self.lines, 2)
        ]


def _what(lines: Path | None, zones: Path | None, model: Path | None) -> _What:
    """Read what lies on the earth, and place what was drawn in pixels.

    A file of OTAnalytics brings its lines and areas, whichever option names it.
    """
    from sightline.counting import Flow
    from sightline.formats import read_lines, read_zones
    from sightline.formats.otanalytics import is_otflow, read_otflow

    what = _What({}, {}, [])
    drawn = list(dict.fromkeys(one for one in (lines, zones) if one is not None and is_otflow(one)))
    if drawn and model is None:
        raise InputError(f"{drawn[0]}: its sections are in pixels; give --model, to place them")
    if model is not None and not drawn:
        raise InputError(f"--model {model}: is for sections in pixels, of an .otflow file")
    if lines is not None and lines not in drawn:
        what.lines |= read_lines(lines)
    if zones is not None and zones not in drawn:
        what.zones |= read_zones(zones)
    for path in drawn:
        from sightline.georeferencing.georeferencer import load_model
        from sightline.pipeline.sections import place_sections

        assert model is not None, "checked above"
        sections = read_otflow(path)
        placed, areas = place_sections(sections, load_model(model), str(path))
        for name in what.lines.keys() & placed.keys() | what.zones.keys() & areas.keys():
            raise InputError(f"{path}: section {name} has the name of another")
        what.lines |= placed
        what.zones |= areas
        what.flows += [Flow(*flow) for flow in sections.flows]
        if sections.offsets:
            name, (x, y) = next(iter(sections.offsets.items()))
            warn(
                f"{path}: {len(sections.offsets)} of its sections are crossed by another point of "
                f"a box than where it stands ({name}: {x:g}, {y:g} of its size); here they are "
                "taken to be drawn on the ground"
            )
    return what


def _flow_totals(rows: list[dict[str, str | int | float | None]]) -> list[str]:
    """A line for each flow that was counted, over all intervals and classes."""
    totals: dict[str, int] = {}
    for row in rows:
        totals[str(row["name"])] = totals.get(str(row["name"]), 0) + int(row["count"] or 0)
    return [f"flow {name}: {n}" for name, n in totals.items() if n]


def _totals(kind: str, rows: list[dict[str, str | int | float | None]], key: str) -> list[str]:
    """A line for each line and direction, or zone and class, over all intervals."""
    number = "count" if kind == "line" else "entries_count"
    totals: dict[str, tuple[int, float]] = {}
    for row in rows:
        direction = f", {row[key]}" + (f" ({row['bound']})" if kind == "line" else "")
        name = f"{kind} {row['name']}{direction}"
        so_far, expected = totals.get(name, (0, 0.0))
        more = float(row[number.replace("count", "expected")] or 0.0)
        totals[name] = (so_far + int(row[number] or 0), expected + more)
    what = "crossings" if kind == "line" else "entries"
    return [f"{name}: {n} {what}, expected {mean:.2f}" for name, (n, mean) in totals.items()]
