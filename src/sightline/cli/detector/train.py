"""`sightline detector train`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sightline import _optional
from sightline.cli.common import progress, say, write_result
from sightline.cli.defaults import ARCHITECTURES
from sightline.cli.options import (
    BatchOption,
    CropSizeOption,
    DeviceOption,
    JsonOption,
    OverwriteOption,
    RateOption,
    ScalesOption,
    SceneArgument,
    SeedOption,
    TaughtClassesOption,
    ThreadsOption,
    TrainingRecordingsOption,
    ValidateEveryOption,
    ValidationRecordingsOption,
)
from sightline.cli.outputs import keep_apart
from sightline.cli.parsing import (
    parse_architecture_options,
    parse_distinct_names,
    parse_names,
    parse_pair,
    parse_size_px,
)
from sightline.cli.replacing import keep_others
from sightline.errors import unknown_name


def train(
    scene: SceneArgument,
    arch: Annotated[str, typer.Option("--arch", help=f"{', '.join(ARCHITECTURES)}.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR",
            file_okay=False,
            help="Where weights, history and the ONNX file go. A run that was stopped goes on.",
        ),
    ],
    train: TrainingRecordingsOption = "",
    validation: ValidationRecordingsOption = "",
    labels: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DIR",
            help="Tables NAME.csv of boxes, and empty.csv of frames without anything, instead of "
            "the scene's boxes in their frames. May be given several times.",
        ),
    ] = None,
    others: Annotated[
        float,
        typer.Option(
            help="Share of the full score that is taught for boats that a table marks as others "
            "than the target."
        ),
    ] = 1.0,
    classes: TaughtClassesOption = "boat,sailboat",
    margin: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SOURCE=PX[+SHARE%]",
            help="Added on every side of the boxes of an annotator, whose bias it evens out: "
            "pixels, and a share of the box's height. May be given several times.",
        ),
    ] = None,
    synthetic: Annotated[
        int, typer.Option(help="Pictures of the synthetic harbour to learn from as well.")
    ] = 0,
    pictures: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FOLDER",
            help="Photographs to learn from as well, images/NAME.jpg with labels/NAME.txt as YOLO "
            "has them: boats in them are cut out and laid, small, on made harbours. May be given "
            "several times.",
        ),
    ] = None,
    picture_classes: Annotated[
        str,
        typer.Option(
            metavar="NAMES",
            help="Of the labels of --pictures, by number. Those of --classes are to be found, of "
            "ignore nothing is said, the others are to be told from them. Empty: as --classes.",
        ),
    ] = "",
    background: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FOLDER",
            help="Pictures without any boat, of which made harbours are made with --pictures. May "
            "be given several times.",
        ),
    ] = None,
    picture_share: Annotated[
        float, typer.Option(help="Share of each batch that is made of --pictures.")
    ] = 0.6,
    steps: Annotated[int, typer.Option(help="Batches to learn from.")] = 6000,
    minutes: Annotated[
        float,
        typer.Option(help="Of learning after which it stops, if steps are left; 0: no limit."),
    ] = 0.0,
    batch: BatchOption = 16,
    size: CropSizeOption = "320x192",
    scales: ScalesOption = "0.2-1.5",
    rate: RateOption = 2e-3,
    rotation: Annotated[bool, typer.Option(help="Turn crops a little.")] = True,
    brightness: Annotated[bool, typer.Option(help="Vary brightness.")] = True,
    exposure: Annotated[bool, typer.Option(help="Vary contrast and gamma.")] = True,
    blur: Annotated[bool, typer.Option(help="Blur some crops.")] = True,
    noise: Annotated[bool, typer.Option(help="Add noise to some crops.")] = True,
    mosaic: Annotated[bool, typer.Option(help="Make half of the crops of four, as YOLOv4.")] = (
        False
    ),
    paste: Annotated[
        bool, typer.Option(help="Put boats, cut out of other pictures, into the crops.")
    ] = True,
    wash: Annotated[
        bool, typer.Option(help="Render foam around boats, and on water without any.")
    ] = True,
    option: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="Of the architecture. May be given several times."),
    ] = None,
    initial: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Weights (.safetensors) of an earlier training."),
    ] = None,
    validate_every: ValidateEveryOption = 500,
    patience: Annotated[
        int,
        typer.Option(min=0, help="Stop after as many validations without a better one; 0: never."),
    ] = 0,
    device: DeviceOption = "auto",
    precision: Annotated[str, typer.Option(help="auto, float32 or bfloat16.")] = "auto",
    threads: ThreadsOption = 0,
    seed: SeedOption = 0,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Train a detector on the boxes of a scene, and export it to ONNX."""
    if arch not in ARCHITECTURES:
        raise unknown_name("architecture", arch, ARCHITECTURES)
    _optional.module("torch", "train")
    from sightline.scene import Scene
    from sightline.training.augmentation import Augmentation
    from sightline.training.data import Labels, parse_margins
    from sightline.training.loop import TrainingSettings
    from sightline.training.recipe import Photographs, Recipe, train_detector

    keep_apart([json], [scene])
    loaded = Scene.load(scene)
    keep_apart([json], loaded.files)
    keep_others([(json, "result")], overwrite=overwrite)
    for_validation = parse_names(validation)
    for_training = parse_names(train) or tuple(
        one.name for one in loaded.recordings if one.name not in for_validation
    )
    taught = parse_distinct_names("--classes", classes)
    recipe = Recipe(
        architecture=arch,
        train=for_training,
        validation=for_validation,
        labels=Labels(
            class_names=taught,
            folders=tuple(labels or []),
            others=others,
            margins=parse_margins(margin or []),
        ),
        synthetic=synthetic,
        size_px=parse_size_px("--size", size),
        batch=batch,
        augmentation=Augmentation(
            rotation=rotation,
            brightness=brightness,
            exposure=exposure,
            blur=blur,
            noise=noise,
            mosaic=mosaic,
            paste=paste,
            wash=wash,
            scales=parse_pair("--scales", scales, "-"),
        ),
        training=TrainingSettings(
            steps=steps,
            minutes=minutes,
            rate=rate,
            validate_every=validate_every,
            patience=patience,
            seed=seed,
            device=device,
            precision=precision,
            threads=threads,
        ),
        options=parse_architecture_options(option or []),
        initial=initial,
        photographs=Photographs(
            pictures=tuple(pictures or []),
            class_names=(
                parse_distinct_names("--picture-classes", picture_classes)
                if picture_classes
                else taught
            ),
            backgrounds=tuple(background or []),
            share=picture_share,
        ),
    )
    with progress() as tell:
        made = train_detector(loaded, recipe, output, progress=tell)
    training = made.training
    write_result(
        json,
        {
            "detector": str(made.path),
            "parameters": made.parameters,
            "export_difference": made.export_difference,
            "steps": training.steps,
            "best_step": training.best_step,
            "best_score": training.best_score,
            "elapsed_s": training.elapsed_s,
            "stopped_early": training.stopped_early,
            "history": [dict(row) for row in training.history],
            "data": dict(made.data),
        },
    )
    early = ", stopped early" if training.stopped_early else ""
    say(
        f"{arch}: {made.parameters:,} parameters, {training.steps} steps in "
        f"{training.elapsed_s / 60.0:.1f} min{early}; kept step {training.best_step}"
    )
    if for_validation:
        say(f"validation ({', '.join(for_validation)}): mAP @ 0.5 IoU {training.best_score:.3f}")
    say(f"detector: {made.path} (differs from the network by {made.export_difference:.1g})")
