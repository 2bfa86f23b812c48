"""`sightline fit`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sightline.cli.common import (
    check_model_is_there,
    check_scene_is_there,
    progress,
    say,
    write_result,
)
from sightline.cli.defaults import DEFAULT_DETECTOR, DEFAULT_MODEL, LARGEST_OFFSET_S
from sightline.cli.options import (
    DetectorOption,
    JsonOption,
    ModelNameOption,
    OverwriteOption,
    SceneArgument,
    SeedOption,
)
from sightline.cli.outputs import Attempts, keep_apart
from sightline.cli.replacing import keep_others


def fit(
    scene: SceneArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="MODEL", dir_okay=False, help="Where the model goes."
        ),
    ],
    model: ModelNameOption = DEFAULT_MODEL,
    seed: SeedOption = 0,
    detector: DetectorOption = DEFAULT_DETECTOR,
    largest_offset_s: Annotated[
        float,
        typer.Option(
            "--largest-offset",
            metavar="SECONDS",
            min=0.0,
            max=600.0,
            help="Largest clock offset of camera and log, where no boxes are drawn.",
        ),
    ] = LARGEST_OFFSET_S,
    update: Annotated[
        Path | None,
        typer.Option(
            "--update",
            metavar="MODEL",
            dir_okay=False,
            help="Recalibrate this model, and say whether its camera was rotated since.",
        ),
    ] = None,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Fit a georeferencer: learn where a box in the image lies on the earth.

    Without drawn boxes, the logged vessels are recognised among the recordings' detections, or
    among what the detector finds in their pictures.
    """
    keep_apart([output, json], [scene, update, detector])
    check_scene_is_there(scene)
    check_model_is_there(update)
    from sightline.georeferencing.georeferencer import load_model
    from sightline.pipeline.fit_unlabelled import fit_scene, update_scene
    from sightline.scene import Scene

    with progress() as tell:
        tell(f"fitting {model}", float("nan"))
        loaded = Scene.load(scene)
        keep_apart([output, json], loaded.files)
        keep_others([(output, "model"), (json, "result")], overwrite=overwrite)
        if update is not None:
            old = load_model(update)
            model = old.model
            fitted = update_scene(
                loaded,
                old,
                seed=seed,
                detector=detector,
                largest_offset_s=largest_offset_s,
                progress=tell,
            )
        else:
            fitted = fit_scene(
                loaded,
                model,
                seed=seed,
                detector=detector,
                largest_offset_s=largest_offset_s,
                progress=tell,
            )
        attempts = Attempts()
        with attempts.one():
            fitted.save(output)
        saved = not attempts.failed
    report = fitted.report
    with attempts.one():
        write_result(json, {"model": str(output), "fit": report.to_dict()})
    points = f"{report.control_points} control points"
    if report.n:
        more = f" and {points}" if report.control_points else ""
        say(
            f"{model}: learned from {report.n} of {report.asked} boxes{more}; they lie "
            f"{report.rmse_m:.1f} m RMSE, {report.median_m:.1f} m in the median from the log"
            f"{' and the map' if report.control_points else ''}"
        )
    else:
        say(
            f"{model}: learned from {points}; they lie {report.rmse_m:.2f} m RMSE, "
            f"{report.median_m:.2f} m in the median from the map"
        )
    for parameter in report.parameters:
        mark = "" if parameter.determined else "  (not determined by the data)"
        say(
            f"  {parameter.name:12} {parameter.value:9.3f} ± {parameter.sigma:.3f} "
            f"{parameter.unit}{mark}"
        )
    for source in report.sources:
        say(
            f"  boxes of {source.name or 'unnamed'!s}: lower edge {source.bias_m:+.2f} ± "
            f"{source.sigma_m:.2f} m above the waterline, {source.bias_px:+.1f} ± "
            f"{source.sigma_px:.1f} px"
        )
    for statement in report.statements:
        say(f"note: {statement}")
    if saved:
        say(f"model: {output}")
    attempts.check()
