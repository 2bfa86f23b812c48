"""`sightline detector export`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline import _optional
from sightline.cli.common import progress, say, write_result
from sightline.cli.defaults import PUBLISHED
from sightline.cli.options import JsonOption, OverwriteOption
from sightline.cli.outputs import keep_apart
from sightline.cli.parsing import parse_known_names, parse_size_px
from sightline.cli.replacing import keep_others
from sightline.errors import InputError

if TYPE_CHECKING:
    from sightline.training.architecture import Trainable

_USUAL_SIZE_PX = (640, 384)


def export(
    source: Annotated[
        str,
        typer.Argument(
            metavar="DIR|CFG",
            help="The folder that detector train left; or a Darknet .cfg, or the name of a "
            f"published one: {', '.join(PUBLISHED)}.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE", dir_okay=False, help="The ONNX file."),
    ],
    weights: Annotated[
        Path | None,
        typer.Argument(metavar="[WEIGHTS]", help="With a .cfg: the .weights that belongs to it."),
    ] = None,
    mean: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DIR",
            help="With DIR: another training that began with the same weights; the mean of the "
            "weights is written. May be given several times.",
        ),
    ] = None,
    names: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="With a .cfg: a class in a line. Absent: COCO's, if there are 80 classes.",
        ),
    ] = None,
    classes: Annotated[
        str,
        typer.Option(
            metavar="NAME,...", help="What is looked for when nobody says; absent: all of a .cfg."
        ),
    ] = "",
    size: Annotated[
        str,
        typer.Option(
            metavar="WxH",
            help="Let the file take pictures of this size alone, px, rounded up to what the "
            "network can take. Absent: any size.",
        ),
    ] = "",
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Write a detector as an ONNX file, and check that file against the network."""
    _optional.module("torch", "train")
    from sightline.training.export import export_onnx
    from sightline.training.trained import load_darknet, load_mean

    keep_apart([output, json], [source, weights, names, *(mean or [])])
    keep_others([(output, "detector"), (json, "result")], overwrite=overwrite)
    if output.suffix != ".onnx":
        raise InputError(f"{output}: the file of a detector must end in .onnx")
    size_px = parse_size_px("--size", size) if size else None
    darknet = source in PUBLISHED or source.endswith(".cfg")
    if darknet and weights is None:
        raise InputError(
            f"{source}: says how the network is built, not what it has learned; give the "
            ".weights behind it"
        )
    if not darknet and (weights is not None or names is not None):
        raise InputError(f"{source}: is no .cfg, and only a .cfg goes with .weights and --names")
    if darknet and mean:
        raise InputError(f"{source}: is a .cfg; --mean is for folders that detector train left")
    with progress() as tell:
        tell("reading the network", float("nan"))
        trainable: Trainable
        if weights is not None:
            trainable = load_darknet(source, weights, names)
        else:
            trainable = load_mean([source, *(mean or [])])
        wanted = parse_known_names(classes, "class", trainable.class_names)
        if not wanted and darknet:
            wanted = trainable.class_names
        tell("exporting", float("nan"))
        difference = export_onnx(
            trainable,
            output,
            size_px=size_px or _USUAL_SIZE_PX,
            fixed=size_px is not None,
            default_classes=wanted or None,
        )
    count = len(trainable.class_names)
    write_result(
        json,
        {
            "detector": str(output),
            "architecture": trainable.name,
            "classes": list(trainable.class_names),
            "parameters": sum(p.numel() for p in trainable.module.parameters()),
            "export_difference": difference,
        },
    )
    say(
        f"{trainable.name}, {count} class{'es' * (count != 1)}: the file differs from the network "
        f"by {difference:.1g}"
    )
    say(f"detector: {output}")
