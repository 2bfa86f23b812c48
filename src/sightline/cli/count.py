"""`sightline count`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sightline.cli.common import say, warn, write_result
from sightline.cli.options import JsonOption, OverwriteOption
from sightline.cli.outputs import Attempts, keep_apart
from sightline.cli.parsing import parse_duration_s
from sightline.cli.replacing import keep_others
from sightline.errors import InputError


def count(
    tracks: Annotated[Path, typer.Argument(metavar="TRACKS", help="Tracks in a file.")],
    lines: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="GeoJSON LineString features, each with a name."),
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
    keep_apart([*outputs, json], [tracks, lines, zones])
    if lines is None and zones is None and closest is None:
        raise InputError("there is nothing to count; give --lines, --zones or --closest")
    if closest is not None and not 0.0 < closest < float("inf"):
        raise InputError(f"--closest {closest:g}: is no distance; give metres, more than 0")
    every_s = parse_duration_s("--every", every)
    for path in (tracks, lines, zones):
        if path is not None and not path.exists():
            raise InputError(f"{path}: there is no such file")
    from sightline.formats import read_lines, read_zones
    from sightline.formats.counts import check_counts_ending, write_counts

    for path in outputs:
        check_counts_ending(path)
    kinds = [(path, "result" if path.suffix.lower() == ".json" else "counts") for path in outputs]
    keep_others([*kinds, (json, "result")], overwrite=overwrite)
    from sightline.counting import CountSettings
    from sightline.counting import count as count_tracks
    from sightline.tracks import Tracks

    report = count_tracks(
        Tracks.read(tracks).tracks,
        lines=read_lines(lines) if lines is not None else None,
        zones=read_zones(zones) if zones is not None else None,
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
    say(f"{report.tracks} tracks, of which {report.moored} never move")
    for kind, rows, key in (("line", report.lines, "direction"), ("zone", report.zones, "class")):
        for line in _totals(kind, rows, key):
            say(line)
    if closest is not None:
        say(f"near misses under {closest:g} m: {len(report.near_misses)}")
    attempts.check()


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
