"""`sightline detector combine`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sightline import _optional
from sightline.cli.common import progress, say, write_result
from sightline.cli.options import JsonOption, OverwriteOption, RecordingsOption, SeedOption
from sightline.cli.outputs import keep_apart
from sightline.cli.parsing import parse_names
from sightline.cli.replacing import keep_others
from sightline.errors import InputError

_FRAMES, _EVERYWHERE, _CHECKED = 40, 4, 4
_CROPS_OF_FEW, _MANY = 6, 500
_ROWS = 120


def combine(
    specialist: Annotated[
        Path,
        typer.Argument(
            metavar="DETECTOR", help="ONNX file of a detector that was trained at one place."
        ),
    ],
    general: Annotated[
        Path,
        typer.Argument(
            metavar="GENERAL",
            help="ONNX file of YOLOX-nano with COCO's classes, for everywhere else.",
        ),
    ],
    scene: Annotated[
        Path,
        typer.Option("--scene", metavar="SCENE", help="The place: its recordings have frames."),
    ],
    outside: Annotated[
        list[Path],
        typer.Option(
            metavar="FOLDER", help="Pictures of anything else. May be given several times."
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE", dir_okay=False, help="The ONNX file."),
    ],
    recordings: RecordingsOption = "",
    synthetic: Annotated[
        int, typer.Option(help="Pictures of the synthetic harbour that are of the place, too.")
    ] = 0,
    seed: SeedOption = 0,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Join a detector of one place with a general one, and learn where each is to be asked.

    Boxes of the general one are of the class vessel. Where a picture looks like those of the place,
    the detector of the place counts; elsewhere the general one. How often that goes wrong is
    measured on recordings and pictures that were left out.
    """
    _optional.module("torch", "train")
    import numpy as np

    from sightline.detection import DetectorOptions, OnnxDetector, TilingSettings
    from sightline.scene import Scene
    from sightline.training.data import Labels, synthetic_pictures
    from sightline.training.gated import (
        Described,
        Describer,
        check_specialist,
        crop,
        fit_gate,
        join,
        kind_of,
        made_small,
        shown_parts,
        spread_frames,
    )
    from sightline.training.photographs import read_backgrounds
    from sightline.training.yolox import YoloxDetector, load_onnx_weights

    keep_apart([output, json], [specialist, general, scene, *outside])
    keep_others([(output, "detector"), (json, "result")], overwrite=overwrite)
    if output.suffix != ".onnx":
        raise InputError(f"{output}: the file of a detector must end in .onnx")
    check_specialist(specialist)
    network = YoloxDetector("yolox-nano", ("boat",))
    load_onnx_weights(network.network, general, ("boat",))
    network.module.eval()
    describe = Describer(network.network, specialist)
    place = Scene.load(scene)
    chosen = place.select(list(parse_names(recordings))) if recordings else place
    rng = np.random.default_rng(seed)
    views = [
        OnnxDetector(specialist, options=DetectorOptions(views=TilingSettings(kind=kind)))
        for kind in ("strip", "everywhere")
    ]
    inside: list[tuple[str, list[Described], list[str]]] = []
    checked = []
    with progress() as tell:
        filmed = [one for one in chosen.recordings if one.source is not None]
        if not filmed:
            raise InputError(f"{scene}: its recordings have no frames; a gate is learned from them")
        # One recording's frames at a time are in memory.
        frames = ((one.name, image) for one in filmed for image in spread_frames(one, _FRAMES))
        rendered = synthetic_pictures(synthetic, seed, Labels(("boat",)))
        # Ten pictures of a harbour are alike.
        made = ((f"rendered {number // 10}", one.image) for number, one in enumerate(rendered))
        for kind, pictures in ((str(scene), frames), ("--synthetic", made)):
            own: list[Described] = []
            groups: list[str] = []
            for number, (group, image) in enumerate(pictures):
                if not groups or groups[-1] != group:
                    checked.append(image)
                    for one in views:
                        one.reset()
                for one in views[: 2 if number % _EVERYWHERE == 0 else 1]:
                    parts = shown_parts(one, image)
                    own += [describe(part) for part in parts]
                    groups += [group] * len(parts)
                tell(f"{kind}: {group}", float("nan"))
            if own:
                inside.append((kind, own, groups))
        other, names = [], []
        for folder in outside:
            photographs = read_backgrounds(folder)
            each = _CROPS_OF_FEW if len(photographs) < _MANY else 1
            for number, photograph in enumerate(photographs):
                other += [describe(crop(photograph.image, rng)) for _ in range(each)]
                names += [f"{folder}/{kind_of(photograph.name)}"] * each
                tell(f"pictures of {folder}", number / len(photographs))
            for kind, rows in made_small(photographs, _ROWS, rng):
                other.append(describe(rows))
                names.append(f"{folder}/{kind}")
        tell("fitting the gate", float("nan"))
        gate = fit_gate(inside, other, names)
        difference = join(
            specialist,
            network,
            gate,
            output,
            pictures=[one[: one.shape[0] // 32 * 32, : one.shape[1] // 32 * 32] for one in checked][
                :_CHECKED
            ],
        )
    shown = sum(len(own) for _, own, _ in inside)
    figures = {
        "detector": str(output),
        "inside": shown,
        "outside": len(names),
        "strength": gate.strength,
        "most_alone": gate.most_alone,
        "inside_missed": gate.inside_missed,
        "outside_passed": gate.outside_passed,
        "export_difference": difference,
    }
    write_result(json, figures)
    say(
        f"gate: of {shown} parts of recordings left out {100 * gate.inside_missed:.1f} % "
        f"were taken for another place, of {len(names)} of pictures left out "
        f"{100 * gate.outside_passed:.1f} % for this one"
    )
    say(f"detector: {output}")
