"""`sightline detector label`."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.atomic import check_places
from sightline.cli.common import (
    check_model_is_there,
    check_scene_is_there,
    folder_for_results,
    progress,
    say,
)
from sightline.cli.common import write_result as write_json_result
from sightline.cli.defaults import DEFAULT_LABEL
from sightline.cli.options import JsonOption, OverwriteOption, RecordingsOption, SceneArgument
from sightline.cli.outputs import Attempts, keep_apart
from sightline.cli.parsing import parse_names
from sightline.cli.replacing import keep_others
from sightline.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from sightline.labelling import Proposals
    from sightline.scene import Recording

_DOUBTFUL = 0.3


def label(
    scene: SceneArgument,
    model: Annotated[
        Path,
        typer.Option("--model", metavar="MODEL", help="A fitted model with a camera."),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="FOLDER", file_okay=True, help="Where the labels go."
        ),
    ],
    recordings: RecordingsOption = None,
    every_s: Annotated[
        float, typer.Option(min=0.0, help="Least time between two frames that are labelled.")
    ] = 1.0,
    all_frames: Annotated[
        bool, typer.Option("--all", help="Also frames in which boxes were drawn.")
    ] = False,
    least_confidence: Annotated[
        float,
        typer.Option(min=0.0, max=1.0, help="Boxes that are less sure are not proposed."),
    ] = 0.0,
    name: Annotated[str, typer.Option("--label", help="The class of the boxes.")] = DEFAULT_LABEL,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Propose boxes of the logged target, for a person to check and a detector to learn from."""
    keep_apart([json], [scene, model])
    check_scene_is_there(scene)
    check_model_is_there(model)
    from sightline.formats.labels import Labels, write_labels
    from sightline.georeferencing.georeferencer import load_model
    from sightline.labelling import contact_sheets, learn_size, propose
    from sightline.scene import Scene

    loaded = Scene.load(scene)
    if recordings is not None:
        loaded = loaded.select(parse_names(recordings))
    fitted = load_model(model)
    size = learn_size(loaded, fitted)
    usable = [r for r in loaded.recordings if r.source is not None and r.fixes_path is not None]
    if not usable:
        raise InputError(
            f"{scene}: no recording has both pictures and a log; give frames or video, and fixes"
        )
    inputs = [*loaded.files, model]
    places = [output / f"{name}.csv" for name in (*(r.name for r in usable), "frames")]
    keep_apart([json], [*inputs, *places])
    keep_others([(json, "result")], overwrite=overwrite)
    if output.is_dir():
        check_places(places, inputs)
    made: list[Proposals] = []
    pages: list[Path] = []
    with folder_for_results(output, inputs) as folder, progress() as tell:
        for i, recording in enumerate(usable):
            tell(f"labelling {recording.name}", i / len(usable))
            drawn = None if all_frames else _drawn(recording)
            proposals = propose(recording, fitted, size, every_s=every_s, leave_out=drawn)
            proposals = proposals.surer_than(least_confidence)
            made.append(proposals)
            if proposals.made.any():
                labels = Labels.of_target(proposals.boxes(name))
                write_labels(labels, folder.work / f"{recording.name}.csv")
            pages += contact_sheets(proposals, recording, folder.work / "sheets")
        _write_frames(made, folder.work / "frames.csv")
    attempts = Attempts()
    with attempts.one():
        results = {one.recording: _summary(one) for one in made}
        write_json_result(json, {"labels": str(output), "recordings": results})
    for one in made:
        reasons = ", ".join(f"{n} {why}" for why, n in _reasons(one).items())
        say(
            f"{one.recording}: {int(one.made.sum())} boxes in {len(one)} frames"
            + (f"; none in others: {reasons}" if reasons else "")
        )
    total = sum(int(one.made.sum()) for one in made)
    doubtful = sum(int((one.made & (one.confidence < _DOUBTFUL)).sum()) for one in made)
    say(f"{total} boxes, {doubtful} of them doubtful (confidence below {_DOUBTFUL:g}): {output}")
    if pages:
        say(f"check them on {len(pages)} pages: {folder.place(pages[0]).parent}")
    attempts.check()


def _drawn(recording: Recording) -> np.ndarray | None:
    return None if recording.boxes_path is None else recording.boxes().frame


def _reasons(proposals: Proposals) -> dict[str, int]:
    import numpy as np

    names, counts = np.unique(proposals.reason[~proposals.made], return_counts=True)
    return {str(why): int(n) for why, n in zip(names, counts, strict=True)}


def _summary(proposals: Proposals) -> dict[str, object]:
    return {
        "frames": len(proposals),
        "boxes": int(proposals.made.sum()),
        "without": _reasons(proposals),
    }


def _write_frames(made: list[Proposals], path: Path) -> None:
    """Write a table of all examined frames, with the reason where there is no box."""
    import numpy as np

    from sightline.atomic import atomic_path

    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["recording", "frame", "confidence", "range_m", "reason"])
        for one in made:
            for i, frame in enumerate(one.frame.tolist()):
                range_m = one.expected.range_m[i]
                table.writerow(
                    [
                        one.recording,
                        frame,
                        f"{one.confidence[i]:.3f}",
                        f"{range_m:.1f}" if np.isfinite(range_m) else "",
                        one.reason[i],
                    ]
                )
