"""`sightline detector compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from sightline import _optional
from sightline.cli.common import progress, say, stdout, write_result
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
    parse_distinct_names,
    parse_names,
    parse_options_by_architecture,
    parse_pair,
    parse_size_px,
)
from sightline.cli.replacing import keep_others


def compare(
    scene: SceneArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR",
            file_okay=False,
            help="Where trainings, table and plot go. A comparison that was stopped goes on.",
        ),
    ],
    test: Annotated[str, typer.Option(help="Recordings to measure on, with commas.")],
    train: TrainingRecordingsOption = "",
    validation: ValidationRecordingsOption = "",
    arch: Annotated[str, typer.Option(help="Which, with commas.")] = ",".join(ARCHITECTURES),
    labels: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Drawn boxes of all recordings; absent: the scene's own."),
    ] = None,
    augmentations: Annotated[
        bool,
        typer.Option(help="Train YOLOv4 with its own augmentation, the added, both and none, too."),
    ] = True,
    classes: TaughtClassesOption = "boat",
    steps: Annotated[int, typer.Option(help="Batches that each learns from.")] = 6000,
    minutes: Annotated[
        float, typer.Option(help="Of learning that each has at most; 0: no limit.")
    ] = 0.0,
    batch: BatchOption = 16,
    size: CropSizeOption = "416x416",
    scales: ScalesOption = "0.5-1.5",
    rate: RateOption = 1e-3,
    option: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ARCH.NAME=VALUE",
            help="Of an architecture, for example faster-rcnn.backbone=resnet50. May be given "
            "several times.",
        ),
    ] = None,
    validate_every: ValidateEveryOption = 500,
    device: DeviceOption = "auto",
    threads: ThreadsOption = 0,
    seed: SeedOption = 0,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Train detectors alike and measure them on recordings that none has seen."""
    _optional.module("torch", "train")
    from sightline.scene import Scene
    from sightline.training.augmentation import Augmentation
    from sightline.training.comparison import (
        COMPARISON,
        HEADINGS,
        ComparisonError,
        ComparisonSettings,
        compare_detectors,
        comparison_cells,
    )
    from sightline.training.data import Labels
    from sightline.training.loop import TrainingSettings
    from sightline.training.recipe import Recipe

    keep_apart([json], [scene])
    loaded = Scene.load(scene)
    keep_apart([json], loaded.files)
    keep_others([(json, "result")], overwrite=overwrite)
    for_test, for_validation = parse_names(test), parse_names(validation)
    for_training = parse_names(train) or tuple(
        one.name for one in loaded.recordings if one.name not in (*for_validation, *for_test)
    )
    recipe = Recipe(
        architecture=ARCHITECTURES[0],
        train=for_training,
        validation=for_validation,
        labels=Labels(
            class_names=parse_distinct_names("--classes", classes),
            folders=(labels,) if labels is not None else (),
        ),
        size_px=parse_size_px("--size", size),
        batch=batch,
        augmentation=Augmentation(scales=parse_pair("--scales", scales, "-")),
        training=TrainingSettings(
            steps=steps,
            minutes=minutes,
            rate=rate,
            validate_every=validate_every,
            seed=seed,
            device=device,
            threads=threads,
        ),
    )
    with progress() as tell:
        made = compare_detectors(
            loaded,
            recipe,
            for_test,
            output,
            ComparisonSettings(
                architectures=parse_distinct_names("--arch", arch),
                options=parse_options_by_architecture(option or [], ARCHITECTURES),
                augmentations=augmentations,
            ),
            labels=labels,
            progress=tell,
        )
    write_result(json, made.to_dict())
    table = Table(*HEADINGS)
    for cells in comparison_cells(made):
        table.add_row(*cells)
    stdout.print(table)
    ran = made.hardware
    trained_on = ran["gpu"] or "the same"
    drawn = made.rows[0].report.drawn if made.rows else 0
    say(
        f"{drawn} boxes in recordings {', '.join(for_test)}; frames on {ran['cpu']} "
        f"({ran['cores']} cores), training on {trained_on}"
    )
    say(f"comparison: {output / COMPARISON}")
    if made.failed:
        raise ComparisonError(
            "; ".join(f"{name} could not be compared: {why}" for name, why in made.failed.items())
        )
