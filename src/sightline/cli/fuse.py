"""`sightline fuse`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.cli.common import say, warn, write_result
from sightline.cli.options import JsonOption, OverwriteOption, TrackFilesOption
from sightline.cli.outputs import Attempts, Outputs, keep_apart
from sightline.cli.replacing import keep_others

if TYPE_CHECKING:
    from sightline.fusion import CameraSummary

_TOO_FAR = 1.5


def fuse(
    fleet: Annotated[
        Path, typer.Argument(metavar="FLEET", help="The cameras and their tracks: a fleet.toml.")
    ],
    output: TrackFilesOption,
    interval_s: Annotated[
        float | None,
        typer.Option(
            "--interval", metavar="SECONDS", help="Between points; 1, or as the fleet file says."
        ),
    ] = None,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Fuse tracks of several cameras that see the same water to one track a target.

    The bias of each camera is estimated from targets that two of them see, and taken off.
    """
    keep_apart([*output, json], [fleet])
    keep_others([*((path, "tracks") for path in output), (json, "result")], overwrite=overwrite)
    from functools import partial

    from sightline import formats
    from sightline.fleet import fuse_fleet, read_fused_fleet
    from sightline.fleet.fused import summary

    known = read_fused_fleet(fleet)
    keep_apart([*output, json], [path for camera in known.cameras for path in camera.tracks])
    attempts = Attempts()
    with Outputs(partial(formats.track_writer, fused=True), attempts) as files:
        files.open(output)
        fusion = fuse_fleet(known, interval_s=interval_s)
        for track in fusion.tracks:
            files.add(track)
        files.finish()
    with attempts.one():
        written = [str(path) for path in files.written]
        write_result(json, {**summary(fusion), "files": written})
    say(
        f"{len(fusion.tracks)} targets of {sum(one.tracks for one in fusion.cameras)} tracks; "
        f"{fusion.shared} seen by several cameras, {fusion.handovers} taken up again after a gap"
    )
    for camera in fusion.cameras:
        say(f"camera {camera.name}: {_on(camera)}")
    if fusion.scatter > _TOO_FAR:
        warn(
            f"where two cameras see a target they are {fusion.scatter:.1f} times as far apart as "
            "their ellipses say; is a model wrong, or a clock?"
        )
    if not fusion.shared:
        warn("no target is seen by two cameras; their biases cannot be told")
    for path in files.written:
        say(f"tracks: {path}")
    attempts.check()


def _on(camera: CameraSummary) -> str:
    """What a camera adds, and its bias."""
    said = f"{camera.tracks} tracks of {camera.targets} targets, {camera.shared} shared"
    if not camera.compared:
        return f"{said}; its bias is not known"
    said += (
        f"; bias {camera.bias_east_m:+.1f} m east, {camera.bias_north_m:+.1f} m north "
        f"(± {camera.bias_sigma_m:.1f} m)"
    )
    if camera.bias_heading_deg is not None:
        said += (
            f", heading {camera.bias_heading_deg:+.2f}° (± {camera.bias_heading_sigma_deg:.2f}°)"
        )
    return said
