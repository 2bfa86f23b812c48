"""`sightline run`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.atomic import check_places
from sightline.cli.check import refuse_problems
from sightline.cli.common import (
    check_scene_is_there,
    describe,
    folder_for_results,
    progress,
    say,
    say_aside,
    warn,
    write_result,
)
from sightline.cli.defaults import DEFAULT_DETECTOR, DEFAULT_MODEL, DEFAULT_TRAJECTORY
from sightline.cli.options import (
    BudgetOption,
    ClassesOption,
    DetectorOption,
    EnlargeOption,
    IntervalOption,
    JsonOption,
    ModelNameOption,
    OverwriteOption,
    SceneArgument,
    SeedOption,
    ThresholdOption,
    TrajectoryOption,
    ViewsOption,
    detector_options,
    tiles_in_turn,
)
from sightline.cli.outputs import Attempts, keep_apart
from sightline.cli.replacing import keep_others, kind_of_result
from sightline.errors import FitError, SightlineError

if TYPE_CHECKING:
    from sightline.detection import Detector
    from sightline.pipeline.first_look import FirstLook
    from sightline.pipeline.run import RunResult


def run(
    scene: SceneArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Where the results go.")
    ],
    model: ModelNameOption = DEFAULT_MODEL,
    detector: DetectorOption = DEFAULT_DETECTOR,
    classes: ClassesOption = None,
    threshold: ThresholdOption = None,
    views: ViewsOption = None,
    enlarge: EnlargeOption = None,
    budget: BudgetOption = None,
    trajectory: TrajectoryOption = DEFAULT_TRAJECTORY,
    interval_s: IntervalOption = None,
    seed: SeedOption = 0,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Run the whole pipeline: detect where there are no boxes, fit, track, smooth, evaluate."""
    keep_apart([json], [scene, detector])
    check_scene_is_there(scene)
    from sightline.detection import DetectorOptions
    from sightline.detection.registry import takes_options
    from sightline.pipeline.check import check_scene
    from sightline.pipeline.run import run as run_scene
    from sightline.pipeline.sources import make_detector
    from sightline.pipeline.track import TrackSettings
    from sightline.reporting.run_report import check_earlier_run, run_file_names, write_run_files
    from sightline.scene import Scene

    loaded = Scene.load(scene)
    inputs: list[Path | str] = [*loaded.files, detector]
    places = [output / name for name in run_file_names(loaded)]
    keep_apart([json], [*inputs, *places])
    if output.is_dir():
        check_places(places, inputs)
    keep_others([(json, "result")], overwrite=overwrite)
    keep_others([(path, kind_of_result(path)) for path in places], overwrite=overwrite)
    checked = check_scene(loaded, every_picture=False)
    for line in checked.warnings:
        warn(line)
    refuse_problems(checked)
    looking = detector_options(
        None, classes, threshold, None, views, enlarge=enlarge, budget=budget
    )
    looks: str | Detector = detector
    if looking != DetectorOptions() or (takes_options(detector) and loaded.looking.rotates):
        over = looking.over(loaded.looking) if takes_options(detector) else looking
        looks = make_detector(detector, None, over)
    look = _Look()
    with folder_for_results(output, inputs) as folder, progress() as tell:
        try:
            result = run_scene(
                loaded,
                model=model,
                detector=looks,
                settings=TrackSettings(trajectory=trajectory, interval_s=interval_s),
                seed=seed,
                progress=tell,
                first_look=look.tell,
            )
        except FitError as error:
            raise with_sheet(error, look.seen, output) from error
        tell("writing the results", float("nan"))
        written = write_run_files(result, folder.work, output)
        check_earlier_run(written, folder.work, output)
    attempts = Attempts()
    attempts.failed += written.failed
    paths = {what: folder.place(path) for what, path in written.paths.items()}
    with attempts.one():
        write_result(json, result_dict(result, paths))
    tell_result(result, paths)
    for line in [] if isinstance(looks, str) else tiles_in_turn(looks):
        say(line)
    attempts.check()


@dataclass
class _Look:
    """Tells at once what the first minute shows, and keeps it."""

    seen: FirstLook | None = None

    def tell(self, look: FirstLook) -> None:
        self.seen = look
        first, *more = look.sentences()
        say_aside("seen:", first, "cyan")
        for line in more:
            warn(line)


def with_sheet(error: FitError, look: FirstLook | None, output: Path) -> FitError:
    """What a run failed by; what was found is shown beside where its results would have been."""
    from sightline.reporting.run_report import write_found

    sheet = output.with_name(f"{output.name}-found.png")
    if look is None or not look.pictures or sheet.exists():
        return error
    try:
        write_found(look, sheet)
    except (SightlineError, OSError):
        return error
    return FitError(f"{error}; what was found is shown in {sheet}") if sheet.exists() else error


def tell_result(result: RunResult, paths: dict[str, Path]) -> None:
    """Print a summary of the result, and where its files are."""
    from sightline.reporting.run_report import run_reports

    for what, report in run_reports(result).items():
        say(describe(report, what))
    for note in (*result.notes, *result.model.report.statements):
        say(f"note: {note}")
    for what, path in paths.items():
        say(f"{what + ':':9} {path}")


def result_dict(result: RunResult, paths: dict[str, Path]) -> dict[str, object]:
    """The result as JSON has it: the report of the tracks, that of single boxes, and the files.

    Both are of the recordings of ``left_out``, and those of others stand apart; where nothing was
    left out, they are of recordings that the model learned from.
    """
    out: dict[str, object] = result.smoothed.to_dict() if result.smoothed is not None else {}
    out["single"] = result.single.to_dict() if result.single is not None else None
    out["left_out"] = list(result.left_out)
    apart = {"smoothed": result.smoothed_learned_from, "single": result.single_learned_from}
    out["learned_from"] = {
        what: None if report is None else report.to_dict() for what, report in apart.items()
    }
    out["files"] = {what: str(path) for what, path in paths.items()}
    out["tracks_per_recording"] = {name: len(tracks) for name, tracks in result.tracks.items()}
    out["clocks"] = {
        name: {
            "offset_s": clock.offset_s,
            "sigma_s": clock.sigma_s,
            "stated": clock.stated,
            "used_s": clock.used_s,
        }
        for name, clock in result.clocks.items()
    }
    out["first_look"] = None if result.first_look is None else result.first_look.to_dict()
    out["moored_per_recording"] = {
        name: sum(track.never_moves for track in tracks) for name, tracks in result.tracks.items()
    }
    out["untold_per_recording"] = {
        name: sum(track.untold for track in tracks) for name, tracks in result.tracks.items()
    }
    out["left_out_of_area"] = dict(result.left_out_of_area)
    out["notes"] = [*result.notes, *result.model.report.statements]
    return out
