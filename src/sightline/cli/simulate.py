"""`sightline simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline import signals
from sightline.cli.common import folder_for_results, progress, say, write_result
from sightline.cli.options import JsonOption, OverwriteOption, SeedOption
from sightline.cli.outputs import Attempts, keep_apart
from sightline.cli.replacing import keep_other_folder, keep_others
from sightline.errors import InputError
from sightline.stopping import Stop

if TYPE_CHECKING:
    from sightline.simulation.harbour import Harbour
    from sightline.simulation.simulate import ClockKind


def simulate(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Where the harbour goes.")
    ],
    recordings: Annotated[int, typer.Option(help="How many videos.")] = 3,
    duration_s: Annotated[float, typer.Option("--duration", help="Of each, seconds.")] = 60.0,
    rate_hz: Annotated[float, typer.Option("--rate", help="Frames a second.")] = 12.0,
    clock: Annotated[
        str, typer.Option(help="How the scene tells times: start, exact or stepped.")
    ] = "start",
    video: Annotated[bool, typer.Option(help="Render the videos.")] = True,
    moving: Annotated[
        bool, typer.Option("--moving", help="The camera is on a vessel under way in a swell.")
    ] = False,
    shore: Annotated[
        bool,
        typer.Option("--shore", help="A town with a port and moored boats lies behind the water."),
    ] = False,
    moored: Annotated[
        int, typer.Option(min=0, max=200, help="How many boats lie along the shore.")
    ] = 30,
    serve: Annotated[
        str | None,
        typer.Option(
            metavar="http://HOST:PORT/",
            help="Then stream what happens in it as if it happened now, for sightline live: "
            "pictures as MJPEG, until it is over or somebody ends it.",
        ),
    ] = None,
    serve_ais: Annotated[
        str | None,
        typer.Option(metavar="tcp://HOST:PORT", help="With --serve: what is broadcast by AIS."),
    ] = None,
    seed: SeedOption = 0,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Write a synthetic harbour: videos, clocks, boxes, logs, the truth, and a scene."""
    if serve_ais is not None and serve is None:
        raise InputError("--serve-ais is told of what --serve streams; give --serve as well")
    with signals.stoppable() as stop:
        from sightline.simulation.serve import local_address

        pictures = local_address(serve, "http") if serve is not None else None
        ais = local_address(serve_ais, "tcp") if serve_ais is not None else None
        from sightline.simulation.simulate import SimulationSettings
        from sightline.simulation.simulate import simulate as simulate_harbour

        keep_apart([json], [])
        keep_others([(json, "result")], overwrite=overwrite)
        keep_other_folder(output, overwrite=overwrite)
        kind: ClockKind = clock  # type: ignore[assignment]
        with folder_for_results(output) as folder, progress() as tell:
            made = simulate_harbour(
                folder.work,
                SimulationSettings(
                    seed=seed,
                    recordings=recordings,
                    duration_s=duration_s,
                    rate_hz=rate_hz,
                    clock=kind,
                    video=video,
                    moving=moving,
                    shore=shore,
                    moored=moored,
                ),
                progress=lambda share: tell("rendering", share),
            )
        scene = folder.place(made.scene)
        attempts = Attempts()
        with attempts.one():
            write_result(
                json, {"scene": str(scene), "recordings": [one.name for one in made.recordings]}
            )
        say(f"scene: {scene}")
        attempts.check()
        if pictures is not None:
            stop.begun = True
            _serve(made.harbour, pictures, ais, rate_hz, stop)


def _serve(
    harbour: Harbour,
    pictures: tuple[str, int],
    ais: tuple[str, int] | None,
    rate_hz: float,
    stop: Stop,
) -> None:
    from sightline.simulation.serve import HarbourServer

    server = HarbourServer(harbour, pictures, ais=ais, rate_hz=rate_hz)
    try:
        server.start()
        for scheme, (host, port) in zip(("http", "tcp"), server.addresses, strict=False):
            what = "pictures" if scheme == "http" else "AIS"
            say(f"{what}: {scheme}://{host}:{port}/".removesuffix("/" * (scheme == "tcp")))
        server.wait(stop)
    finally:
        server.close()
