"""`sightline detector adapt`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline import _optional
from sightline.cli.common import (
    check_model_is_there,
    check_scene_is_there,
    progress,
    say,
    warn,
    write_result,
)
from sightline.cli.defaults import (
    ADAPTED_MARGIN,
    ADAPTED_MINUTES,
    ADAPTED_STEPS,
    DEFAULT_DETECTOR,
    DEFAULT_LABEL,
)
from sightline.cli.options import (
    ClassesOption,
    DetectorOption,
    EnlargeOption,
    JsonOption,
    OverwriteOption,
    RecordingsOption,
    SceneArgument,
    SeedOption,
    ThreadsOption,
    ViewsOption,
    detector_options,
)
from sightline.cli.outputs import keep_apart
from sightline.cli.parsing import parse_names
from sightline.cli.replacing import keep_others
from sightline.errors import InputError

if TYPE_CHECKING:
    from sightline.evaluation.detection import DetectionReport


def adapt(
    scene: SceneArgument,
    model: Annotated[
        Path,
        typer.Option("--model", metavar="MODEL", help="A model of this camera, as run writes it."),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE.onnx",
            dir_okay=False,
            help="The tuned detector; not written where it gained nothing.",
        ),
    ],
    detector: DetectorOption = DEFAULT_DETECTOR,
    recordings: RecordingsOption = None,
    minutes: Annotated[
        float, typer.Option(help="That all of it may take, by the clock.")
    ] = ADAPTED_MINUTES,
    steps: Annotated[
        int, typer.Option(help="Batches that it learns from at most.")
    ] = ADAPTED_STEPS,
    label: Annotated[
        str, typer.Option("--label", help="The class of its boxes: boat, car, ...")
    ] = DEFAULT_LABEL,
    margin: Annotated[
        str,
        typer.Option(
            metavar="PX[+SHARE%]",
            help="Added on every side of the boxes that the log proposes, which are tight.",
        ),
    ] = ADAPTED_MARGIN,
    keep_moored: Annotated[
        bool,
        typer.Option(
            "--keep-moored", help="Do not unlearn what the detector is sure of and never moves."
        ),
    ] = False,
    classes: ClassesOption = None,
    views: ViewsOption = None,
    enlarge: EnlargeOption = None,
    threads: ThreadsOption = 0,
    seed: SeedOption = 0,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Tune a detector to a camera by its log, without drawn boxes, and say what it gained.

    The last part of the log is not learned from. Where the tuned detector finds no more there than
    the one before, nothing is written.
    """
    keep_apart([output, json], [scene, model, detector])
    check_scene_is_there(scene)
    check_model_is_there(model)
    if output.suffix != ".onnx":
        raise InputError(f"{output}: the file of a detector must end in .onnx")
    keep_others([(output, "detector"), (json, "result")], overwrite=overwrite)
    from sightline.scene import Scene

    loaded = Scene.load(scene)
    if recordings is not None:
        loaded = loaded.select(parse_names(recordings))
    keep_apart([output, json], loaded.files)
    for library, extra in (("torch", "train"), ("onnx", "train"), ("pycocotools", "train")):
        _optional.module(library, extra)
    from sightline.formats.labels import parse_margins
    from sightline.georeferencing.georeferencer import load_model
    from sightline.labelling.lessons import TeacherSettings
    from sightline.tally import Tally
    from sightline.training.adaptation import AdaptSettings
    from sightline.training.adaptation import adapt as adapt_detector

    settings = AdaptSettings(
        minutes=minutes,
        steps=steps,
        label=label,
        margin=parse_margins([f"log={margin}"])["log"],
        teacher=TeacherSettings(keep_moored=keep_moored),
        seed=seed,
        threads=threads,
        options=detector_options(None, classes, None, None, views, enlarge=enlarge),
    )
    tally = Tally(scene)
    with progress() as tell:
        made = adapt_detector(
            loaded, load_model(model), detector, output, settings, tally=tally, progress=tell
        )
    if tally.left_out:
        warn(f"{scene}: left out: {tally.reasons()}")
    write_result(json, {"detector": str(output) if made.gained else detector, **made.to_dict()})
    say(
        f"learned from {made.learned_from} ({made.steps} batches, "
        f"{made.elapsed_s / 60.0:.1f} min in all)"
    )
    say(f"judged by {made.judged_by}, which it did not learn from:")
    say(f"  before: {_line(made.before)}")
    say(f"  after:  {_line(made.after)}")
    if made.gained:
        say(f"detector: {output} (gained {made.gain:.2f} in average precision)")
    else:
        say(f"gained nothing ({made.gain:+.2f} in average precision): keep {detector}; not written")


def _line(report: DetectionReport) -> str:
    from sightline.evaluation.comparison import number, percent

    return (
        f"AP {number(report.average_precision)}, recall {percent(report.recall)}, "
        f"precision {percent(report.precision)}, {number(report.false_per_frame)} false boxes a "
        f"frame; recall {percent(report.recall_at_allowed)} at {report.allowed_per_frame:g} false "
        "boxes a frame"
    )
