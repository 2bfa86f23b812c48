"""`sightline compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sightline.cli.common import check_scene_is_there, progress, say, stdout
from sightline.cli.defaults import MODELS
from sightline.cli.options import JsonOption, OverwriteOption, SceneArgument, SeedOption
from sightline.cli.outputs import Attempts, keep_apart
from sightline.cli.parsing import parse_names
from sightline.cli.replacing import keep_others


def compare(
    scene: SceneArgument,
    models: Annotated[
        str, typer.Option(help="Names of models, with commas between them.")
    ] = ",".join(MODELS),
    trajectory: Annotated[
        str | None,
        typer.Option(
            help="paper or rts, after every model; absent: the paper's chain after the paper's "
            "models, the smoother after ours."
        ),
    ] = None,
    map_file: Annotated[
        Path | None,
        typer.Option(
            "--map", metavar="FILE", dir_okay=False, help="Map plots like the paper's Figure 3."
        ),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="FILE", dir_okay=False, help="A report as one HTML file.")
    ] = None,
    seed: SeedOption = 0,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Compare models by leave-one-out cross-validation, and print the paper's Table 2."""
    keep_apart([map_file, report, json], [scene])
    check_scene_is_there(scene)
    from sightline.evaluation.comparison import overview_table, paper_table
    from sightline.pipeline.evaluate import clock_notes
    from sightline.pipeline.evaluate import compare as compare_models
    from sightline.reporting.page import write_page
    from sightline.reporting.plots import MapPanel, map_figure, save_figure
    from sightline.reporting.run_report import compare_page, single_pairs
    from sightline.scene import Scene

    loaded = Scene.load(scene)
    keep_apart([map_file, report, json], loaded.files)
    kinds = [(map_file, "figure"), (report, "page"), (json, "result")]
    keep_others(kinds, overwrite=overwrite)
    with progress() as tell:
        result, placed = compare_models(
            loaded, parse_names(models), trajectory=trajectory, seed=seed, progress=tell
        )
    attempts = Attempts()
    said: dict[str, Path] = {}
    if json is not None:
        with attempts.one():
            result.write(json)
    if map_file is not None:
        with attempts.one():
            panels = [MapPanel(name, single_pairs(parts)) for name, parts in placed.items()]
            save_figure(map_figure(panels), map_file)
            said["map"] = map_file
    if report is not None:
        with attempts.one():
            write_page(compare_page(result, placed, loaded.camera.name or scene.stem), report)
            said["report"] = report
    clocks = {one.recording: one.clock for one in next(iter(placed.values()))}
    for note in clock_notes(clocks):
        say(f"note: {note}")
    stdout.print(overview_table(result, "single boxes, each recording left out"))
    stdout.print(paper_table(result.models, "without the trajectory stage"))
    stdout.print(paper_table(result.smoothed, "with the trajectory stage"))
    for what, path in said.items():
        say(f"{what}: {path}")
    attempts.check()
