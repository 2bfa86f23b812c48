"""`sightline demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sightline.cli.common import folder_for_results, progress, say, write_result
from sightline.cli.options import JsonOption, OverwriteOption, SeedOption
from sightline.cli.outputs import Attempts, keep_apart
from sightline.cli.replacing import keep_other_folder, keep_others, kind_of_result
from sightline.cli.run import result_dict, tell_result


def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Where everything goes.")
    ] = Path("sightline-demo"),
    duration_s: Annotated[
        float, typer.Option("--duration", help="Of each of the three videos, seconds.")
    ] = 60.0,
    seed: SeedOption = 1,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Simulate a harbour, run the whole pipeline on it, and say where the results lie.

    The camera is learned from the boxes and the log of two recordings; the third is given as a
    video alone, in which a detector has to find the boats.
    """
    keep_apart([json], [])
    keep_others([(json, "result")], overwrite=overwrite)
    keep_other_folder(output / "harbour", overwrite=overwrite)
    results = output / "results"
    earlier = [*results.glob("*.*"), *(results / "tracks").glob("0[1-3].*")]
    keep_others([(path, kind_of_result(path)) for path in earlier], overwrite=overwrite)
    from sightline.pipeline.run import run as run_scene
    from sightline.reporting.run_report import write_run_files
    from sightline.scene import Scene
    from sightline.simulation.simulate import SimulationSettings
    from sightline.simulation.simulate import simulate as simulate_harbour

    with folder_for_results(output) as folder, progress() as tell:
        made = simulate_harbour(
            folder.work / "harbour",
            SimulationSettings(seed=seed, duration_s=duration_s, rate_hz=10.0, unlabelled=1),
            progress=lambda share: tell("rendering the harbour", share),
        )
        result = run_scene(Scene.load(made.scene), seed=seed, progress=tell)
        tell("writing the results", float("nan"))
        written = write_run_files(result, folder.work / "results", output / "results")
        if written.failed and output.exists():
            # Of an earlier demo something would stay that does not belong to the rest.
            raise written.failed[0]
    attempts = Attempts()
    attempts.failed += written.failed
    paths = {what: folder.place(path) for what, path in written.paths.items()}
    with attempts.one():
        write_result(json, result_dict(result, paths))
    say(f"A harbour was simulated in {output / 'harbour'}.")
    camera = result.model.camera
    truth = made.harbour.camera
    if camera is not None:
        say(
            f"camera: height {camera.height_m:.2f} m (true {truth.height_m:.2f}), focal length "
            f"{camera.focal_px:.0f} px (true {truth.focal_length_px:.0f}), pitch "
            f"{camera.pitch_deg:.2f} degrees (true {truth.pitch_deg:.2f})"
        )
    tell_result(result, paths)
    if "report" in paths:
        say(f"\nOpen {paths['report']} in a browser.")
    attempts.check()
