"""Options that several commands share, declared once."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.cli.defaults import DECODERS, PROVIDERS, VIEWS
from sightline.cli.parsing import parse_names
from sightline.errors import unknown_name

if TYPE_CHECKING:
    from sightline.detection import Detector, DetectorOptions

# Of nearly every command.

SceneArgument = Annotated[Path, typer.Argument(metavar="SCENE", help="The scene file.")]
JsonOption = Annotated[
    Path | None,
    typer.Option("--json", metavar="FILE", dir_okay=False, help="Write the result as JSON."),
]
OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="Replace files that sightline did not write, too.")
]
SeedOption = Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Of whatever is random.")]
RecordingsOption = Annotated[
    str | None, typer.Option(metavar="NAME,...", help="Only these recordings.")
]

# How positions and tracks are made.

ModelNameOption = Annotated[
    str, typer.Option("--model", help="nn, gpr, qkr, qkr+nn, qkr+gpr, camera or camera+gpr.")
]
TrajectoryOption = Annotated[str, typer.Option(help="rts or paper.")]
IntervalOption = Annotated[
    float | None,
    typer.Option("--interval", help="Seconds between points; absent: a point a box."),
]

TrackFilesOption = Annotated[
    list[Path],
    typer.Option(
        "--output",
        "-o",
        metavar="FILE",
        help="Where the tracks go: .geojson, .gpx, .kml, .csv, .parquet, .gpkg or .mfjson. May "
        "be given several times.",
    ),
]

# Where targets can be, and where nothing is looked at.

AreaOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--area",
        metavar="FILE",
        help="GeoJSON polygons where targets can be; what lies outside is left out, and counted. "
        "May be given several times.",
    ),
]
MaskOption = Annotated[
    Path | None,
    typer.Option(
        "--mask",
        metavar="FILE",
        help="A picture as large as the frames, black where they are neither looked at nor kept.",
    ),
]

# When the frames of a source were taken.

StartOption = Annotated[
    str | None, typer.Option(metavar="TIME", help="When a video begins, ISO 8601.")
]
ClockOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="A table frame,utc that tells the times.")
]

# How a detector is run.

DetectorOption = Annotated[
    str,
    typer.Option(metavar="NAME|FILE.onnx", help="motion, harbour, or a detector in an ONNX file."),
]
DecoderOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help=f"What the ONNX file's outputs mean; absent: seen from them. {', '.join(DECODERS)}.",
    ),
]
ClassesOption = Annotated[
    str | None, typer.Option(metavar="NAME,...", help="Only boxes of these classes.")
]
ThresholdOption = Annotated[
    float | None,
    typer.Option(min=0.0, max=1.0, help="Least confidence of a box; absent: the detector's own."),
]
ProviderOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help=f"What the network runs on: {', '.join(PROVIDERS)}; absent: a GPU where there is one.",
    ),
]
BasemapOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE", help="MBTiles or PMTiles that the page's map shows, pictures or vectors."
    ),
]
ViewsOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help=f"Tiles of a frame: {', '.join(VIEWS)}; absent: the detector's own choice.",
    ),
]
EnlargeOption = Annotated[
    float | None,
    typer.Option(
        metavar="FACTOR",
        help="Pixels that the network is shown for a pixel of the frame; absent: 1, and 1.5 "
        "everywhere.",
    ),
]
FrameWidthOption = Annotated[
    int | None,
    typer.Option(
        metavar="PX", min=1, help="Scale wider frames down to it first; absent: they are not."
    ),
]
BudgetOption = Annotated[
    float | None,
    typer.Option(
        metavar="MS",
        help="Milliseconds a frame that looking may take: tiles with what moves first, the others "
        "in turn; how many is measured at the start. Absent: all tiles of every frame.",
    ),
]
HorizonModelOption = Annotated[
    Path | None,
    typer.Option(
        "--model",
        metavar="MODEL",
        help="A fitted model, which knows where the horizon lies.",
    ),
]

# How detectors are trained.

TrainingRecordingsOption = Annotated[
    str,
    typer.Option("--train", help="Recordings to learn from, with commas; absent: all others."),
]
ValidationRecordingsOption = Annotated[
    str,
    typer.Option("--validation", help="Recordings that choose the best weights, with commas."),
]
TaughtClassesOption = Annotated[
    str, typer.Option("--classes", help="What is told apart, with commas.")
]
BatchOption = Annotated[int, typer.Option(help="Crops in a batch.")]
CropSizeOption = Annotated[str, typer.Option("--size", metavar="WxH", help="Of a crop, px.")]
ScalesOption = Annotated[
    str, typer.Option(metavar="LOW-HIGH", help="Of the crops; 1 is the picture's own.")
]
RateOption = Annotated[float, typer.Option(max=10.0, help="The highest learning rate.")]
ValidateEveryOption = Annotated[int, typer.Option(help="Steps between two validations.")]
DeviceOption = Annotated[str, typer.Option(help="auto, cpu, cuda, ...")]
ThreadsOption = Annotated[int, typer.Option(min=0, help="Of the CPU; 0: as many as there are.")]


def detector_options(
    decoder: str | None,
    classes: str | None,
    threshold: float | None,
    provider: str | None,
    views: str | None,
    *,
    enlarge: float | None = None,
    frame_width: int | None = None,
    budget: float | None = None,
) -> DetectorOptions:
    """Detector options from the command line.

    Raises:
        InputError: A name is not known.
    """
    if views is not None and views not in VIEWS:
        raise unknown_name("kind of views", views, VIEWS)
    from sightline.detection import DetectorOptions, TilingSettings

    return DetectorOptions(
        decoder=decoder,
        classes=parse_names(classes) if classes is not None else None,
        threshold=threshold,
        provider=provider,
        views=TilingSettings(kind=views) if views is not None else None,
        enlarge=enlarge,
        frame_width_px=frame_width,
        budget_ms=budget,
    )


def tiles_in_turn(detector: Detector) -> list[str]:
    """A line on how much of each frame was looked at, where a budget bounds that."""
    from sightline.detection import OnnxDetector

    if not isinstance(detector, OnnxDetector) or not detector.remembers:
        return []
    if detector.tiles_per_frame is None:
        return []
    return [f"looked at {detector.tiles_per_frame} of {detector.tile_count} tiles of each frame"]


WaterLevelOption = Annotated[
    str | None,
    typer.Option(
        metavar="METRES|FILE",
        help="How high the water stands above the datum of the model's scene; or a table, "
        "time_utc,water_level_m.",
    ),
]
