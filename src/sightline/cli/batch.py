"""`sightline batch`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline import signals
from sightline.cli.common import progress, say, say_aside, warn, write_result
from sightline.cli.options import JsonOption, OverwriteOption
from sightline.cli.outputs import keep_apart
from sightline.cli.replacing import keep_others
from sightline.errors import InputError, OutputError, unknown_name

if TYPE_CHECKING:
    from sightline.fleet.engines import Engine

ENGINES = ("local", "ray")

_MOST_LINES = 10


def batch(
    fleet: Annotated[Path, typer.Argument(metavar="FLEET", help="The cameras: a fleet.toml.")],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="DIR", file_okay=False, help="Where results go."),
    ],
    engine: Annotated[
        str,
        typer.Option(
            metavar="NAME", help="What performs the work: local (processes), or ray (a cluster)."
        ),
    ] = "local",
    address: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Of a Ray cluster, HOST:PORT; else one is started."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Processes; as many as processors unless given."),
    ] = None,
    memory_mb: Annotated[
        int | None,
        typer.Option(
            "--memory", metavar="MB", min=1, help="That a recording asks for in a Ray cluster."
        ),
    ] = None,
    retries: Annotated[
        int,
        typer.Option(
            metavar="N",
            min=0,
            max=100,
            help="How often more a recording whose process dies is tried.",
        ),
    ] = 2,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Track all recordings of many cameras; the same command goes on where it was stopped.

    What is finished is not done again, as long as its source, its model and its settings are the
    same. Ctrl-C stops: what is finished stays.
    """
    if engine not in ENGINES:
        raise unknown_name("engine", engine, ENGINES)
    if engine == "local" and (address is not None or memory_mb is not None):
        raise InputError("--address and --memory are of a cluster; give --engine ray with them")
    keep_apart([json], [fleet])
    with signals.stoppable() as stop:
        from sightline._optional import module
        from sightline.fleet import read_fleet, run_batch
        from sightline.fleet.catalogue import PAGE, catalogue, write_catalogue
        from sightline.fleet.tasks import tasks_of

        module("pyarrow", "parquet")
        known = read_fleet(fleet)
        keep_apart([json], known.files)
        keep_others([(json, "result")], overwrite=overwrite)
        stop.begun = True
        with progress() as tell:
            result = run_batch(
                known,
                output,
                lambda: _engine(engine, address, workers, memory_mb),
                retries=retries,
                progress=tell,
                stop=stop,
            )
        table = catalogue(output, tasks_of(known), result.failed)
        write_catalogue(output, table)
    write_result(json, result.to_dict())
    if result.stopped:
        say_aside("stopped:", "what is finished stays; the same command goes on", "yellow")
    said = f"{result.done} of {result.recordings} recordings tracked"
    say(said + (f", {result.before} had been before" if result.before else ""))
    say(f"summary: {output / PAGE}")
    for name, line in list(result.failed.items())[:_MOST_LINES]:
        warn(f"{name}: {line}")
    if result.failed:
        raise OutputError(
            f"{len(result.failed)} of {result.recordings} recordings could not be tracked; "
            f"{output / PAGE} names each"
        )


def _engine(name: str, address: str | None, workers: int | None, memory_mb: int | None) -> Engine:
    if name == "ray":
        from sightline.fleet.ray_engine import RayEngine

        return RayEngine(address, workers=workers, memory_mb=memory_mb)
    from sightline.fleet.engines import LocalEngine

    return LocalEngine(workers)
