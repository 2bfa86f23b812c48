"""`sightline export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sightline.cli.common import say, write_result
from sightline.cli.options import JsonOption, OverwriteOption, TrackFilesOption
from sightline.cli.outputs import Attempts, Outputs, keep_apart
from sightline.cli.parsing import parse_time
from sightline.cli.replacing import keep_others
from sightline.errors import InputError


def export(
    store: Annotated[Path, typer.Argument(metavar="STORE", help="What sightline live kept.")],
    output: TrackFilesOption,
    begin: Annotated[
        str | None, typer.Option("--from", metavar="TIME", help="From then on, ISO 8601.")
    ] = None,
    end: Annotated[
        str | None, typer.Option("--to", metavar="TIME", help="Until then, ISO 8601.")
    ] = None,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Write what live kept, in any format of tracks; live may go on meanwhile."""
    keep_apart([*output, json], [store])
    keep_others([*((path, "tracks") for path in output), (json, "result")], overwrite=overwrite)
    from_utc_s, to_utc_s = parse_time("--from", begin), parse_time("--to", end)
    if from_utc_s is not None and to_utc_s is not None and not from_utc_s < to_utc_s:
        raise InputError(f"--from {begin} is not before --to {end}")
    from functools import partial

    from sightline import formats
    from sightline.live.store import check_store, stored_tracks

    check_store(store)
    attempts = Attempts()
    tracks = points = 0
    with Outputs(partial(formats.track_writer, fused=True), attempts) as files:
        files.open(output)
        for track in stored_tracks(store, from_utc_s, to_utc_s):
            files.add(track)
            tracks += 1
            points += len(track)
        files.finish()
    written = [str(path) for path in files.written]
    with attempts.one():
        write_result(json, {"tracks": tracks, "points": points, "files": written})
    say(f"{tracks} tracks, {points} points")
    for path in files.written:
        say(f"tracks: {path}")
    attempts.check()
