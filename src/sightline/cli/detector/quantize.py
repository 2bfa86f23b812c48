"""`sightline detector quantize`."""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline import _optional
from sightline.cli.common import say, write_result
from sightline.cli.defaults import DEFAULT_DETECTOR
from sightline.cli.options import JsonOption, OverwriteOption, SeedOption
from sightline.cli.outputs import keep_apart
from sightline.cli.replacing import keep_others
from sightline.errors import InputError, unknown_name

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_PRECISIONS = ("int8", "fp16")


def quantize(
    source: Annotated[str, typer.Argument(metavar="DETECTOR", help="harbour, or an ONNX file.")],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE", dir_okay=False, help="The ONNX file."),
    ],
    pictures: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FOLDER",
            help="Pictures like those that it will see. May be given several times.",
        ),
    ] = None,
    synthetic: Annotated[
        int, typer.Option(min=0, max=1000, help="And so many of the simulated harbour.")
    ] = 0,
    precision: Annotated[
        str, typer.Option(help="int8: for CPUs; fp16: for GPUs and TensorRT.")
    ] = "int8",
    most: Annotated[
        int, typer.Option(min=1, max=10_000, help="So many of the pictures, evenly spread.")
    ] = 100,
    seed: SeedOption = 0,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Write a detector in eight-bit integers or in half precision, and compare it with itself."""
    if precision not in _PRECISIONS:
        raise unknown_name("precision", precision, _PRECISIONS)
    if output.suffix != ".onnx":
        raise InputError(f"{output}: the file of a detector must end in .onnx")
    folders = pictures or []
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"{folder}: is no folder of pictures")
    if not folders and not synthetic:
        raise InputError("there is no picture to measure ranges on; give --pictures or --synthetic")
    keep_apart([output, json], [None if source == DEFAULT_DETECTOR else source, *folders])
    keep_others([(output, "detector"), (json, "result")], overwrite=overwrite)
    _optional.module("onnx", "quantize")
    from sightline.detection.quantization import quantize as write_quantized
    from sightline.detection.registry import shipped_file
    from sightline.video.pictures import PICTURE_SUFFIXES, read_picture

    shipped = source == DEFAULT_DETECTOR
    if not shipped and not Path(source).is_file():
        raise InputError(f"{source}: there is no such ONNX file; give harbour, or a file")
    files = [
        one
        for folder in folders
        for one in sorted(folder.rglob("*"))
        if one.suffix.lower() in PICTURE_SUFFIXES
    ]
    if folders and not files:
        raise InputError(f"{folders[0]}: holds no picture ({', '.join(sorted(PICTURE_SUFFIXES))})")
    chosen = [files[i * len(files) // min(most, len(files))] for i in range(min(most, len(files)))]
    shown = [read_picture(one) for one in chosen] + _made(synthetic, seed)
    with shipped_file() if shipped else nullcontext(Path(source)) as path:
        result = write_quantized(path, output, shown, precision=precision)
    write_result(
        json,
        {"detector": str(output), "precision": precision, "pictures": len(shown)}
        | dataclasses.asdict(result),
    )
    what = "convolutions" if precision == "int8" else "nodes"
    say(f"{result.layers} of {result.of} {what} in {precision}, by {len(shown)} pictures")
    say(
        f"of {result.boxes} boxes in these {result.found_again} are found again, and "
        f"{result.more} more"
    )
    each = 1e3 / len(shown)
    say(
        f"a picture takes {each * result.quantized_s:.1f} ms, and took "
        f"{each * result.original_s:.1f} ms, on one thread of this machine "
        f"({result.original_s / result.quantized_s:.2f} times as quick)"
    )
    say(f"{result.quantized_bytes / 1e6:.1f} MB, of {result.original_bytes / 1e6:.1f} MB: {output}")


def _made(count: int, seed: int) -> list[NDArray[np.uint8]]:
    """Pictures of the simulated harbour, ten of each."""
    from sightline.simulation import Harbour, HarbourSettings, Renderer

    made = []
    for number in range(count):
        if number % 10 == 0:
            harbour = Harbour.random(seed + number // 10, HarbourSettings(duration_s=100.0))
            renderer = Renderer(harbour)
        made.append(renderer.image(harbour.start_utc_s + 10.0 * (number % 10)))
    return made
