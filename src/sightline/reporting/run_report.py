"""What a run made, as the page and the figures that people look at."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from sightline.atomic import as_placed, atomic_folder
from sightline.camera.parameters import LOG_FOCAL
from sightline.clock_offset import USUAL_SIGMA_S
from sightline.evaluation.comparison import Comparison
from sightline.evaluation.metrics import ScoredPairs, pair_track
from sightline.evaluation.report import Report
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.labelling import SheetBox, write_sheet
from sightline.overlap import iou
from sightline.pipeline.evaluate import LocatedRecording
from sightline.pipeline.first_look import FirstLook
from sightline.pipeline.run import RunResult
from sightline.reporting.page import (
    ModelRow,
    OutlierRow,
    PageFigure,
    ReportPage,
    SourceRow,
    write_page,
)
from sightline.reporting.plots import (
    MapPanel,
    calibration,
    error_against_range,
    error_over_time,
    map_figure,
    save_figure,
)
from sightline.scene import Scene
from sightline.types import NO_FRAME, FloatArray, IntArray

LEFT_OUT = "each recording left out"
LEARNED_FROM = "recordings learned from"
_SINGLE = "single boxes"
_LONGEST_NAME = 60
_CLOCK_KNOWN_S = 0.7 * USUAL_SIGMA_S

_FILES = {
    "report": "report.html",
    "figures": "report.json",
    "model": "model.safetensors",
    "tracks": "tracks",
    "map": "map.png",
    "found": "found.png",
}
# A page has twenty.
_OF_A_KIND = {"moving": 10, "not told yet": 4, "moored": 6}
_TRACK_SUFFIXES = (".geojson", ".csv", ".gpx", ".kml")

_WORDS = {
    "height_m": "height above the water or road",
    "pitch_deg": "pitch, down is positive",
    "roll_deg": "roll, right end of the horizon lower is positive",
    "heading_deg": "heading, clockwise from north",
    "focal_px": "focal length",
    "k1": "radial distortion k1",
    "k2": "radial distortion k2",
    "east_m": "east of the stated place",
    "north_m": "north of the stated place",
    "half_length_m": "half length of the target",
    "half_beam_m": "half beam of the target",
}


def run_page(result: RunResult) -> ReportPage:
    """The page of a run."""
    scene, model = result.scene, result.model
    reports = run_reports(result)
    fixes = {r.name: r.fixes() for r in scene.recordings if r.fixes_path is not None}
    positions = {one.recording: one.single() for one in result.placed}
    positions = {name: pairs for name, pairs in positions.items() if len(pairs)}
    warnings = list(result.notes)
    if result.detected:
        warnings.append(
            f"In {_listed(result.detected)} a detector found the boxes; whatever moved is tracked, "
            "and the track nearest to the log counts as the target."
        )
    return ReportPage(
        title="Tracks on the earth",
        scene_name=scene.camera.name or scene.path.stem,
        plane=model.plane,
        reports=reports,
        tracks={name: tuple(tracks) for name, tracks in result.tracks.items() if len(tracks)},
        fixes=fixes,
        positions=positions,
        model_name=model.model,
        model=_model_rows(model),
        sources=_source_rows(model),
        outliers=_outlier_rows(model),
        statements=model.report.statements,
        warnings=warnings,
        figures=_figures(positions, reports),
        made_utc_s=time.time(),
        learned_from=frozenset(name for name in reports if name.endswith(LEARNED_FROM)),
    )


def run_reports(result: RunResult) -> dict[str, Report]:
    """The reports of a run by what they score, and whether the model had learned from it."""
    how = LEFT_OUT if result.left_out else LEARNED_FROM
    reports = (
        (f"smoothed tracks, {how}", result.smoothed),
        (f"{_SINGLE}, {how}", result.single),
        (f"smoothed tracks, {LEARNED_FROM}", result.smoothed_learned_from),
        (f"{_SINGLE}, {LEARNED_FROM}", result.single_learned_from),
    )
    return {name: report for name, report in reports if report is not None}


def write_run(result: RunResult, folder: Path) -> dict[str, Path]:
    """Write everything that a run made into a folder: tracks, model, report, map, sheet.

    Returns:
        What lies where, by ``"tracks"``, ``"model"``, ``"report"``, ``"figures"``, ``"map"`` and
        ``"found"``.

    Raises:
        InputError: Files cannot be written; see `write_run_files` for what becomes of the others.
    """
    with atomic_folder(folder, inputs=result.scene.files) as made:
        written = write_run_files(result, made, folder)
        check_earlier_run(written, made, folder)
    if written.failed:
        raise written.failed[0]
    return {what: folder / path.relative_to(made) for what, path in written.paths.items()}


@dataclass(frozen=True)
class WrittenRun:
    """Files of a run.

    Attributes:
        paths: What lies where.
        failed: What could not be written, and why.
    """

    paths: dict[str, Path]
    failed: list[Exception]


def check_earlier_run(written: WrittenRun, made: Path, goal: Path) -> None:
    """Raise where something is missing and the rest would mix with an earlier run's files."""
    files = [path.relative_to(made) for path in made.rglob("*") if path.is_file()]
    if written.failed and any((goal / path).exists() for path in files):
        raise written.failed[0]


def run_file_names(scene: Scene) -> list[Path]:
    """Names of all files that a run of a scene may write, in the folder of its results."""
    tracks = [
        Path("tracks") / f"{name}{suffix}"
        for name in _file_names(recording.name for recording in scene.recordings)
        for suffix in _TRACK_SUFFIXES
    ]
    return [Path(name) for name in _FILES.values() if name != "tracks"] + tracks


def write_run_files(result: RunResult, folder: Path, goal: Path) -> WrittenRun:
    """Write the files of a run one by one; one that cannot be written spoils no other.

    Args:
        result: Of the run.
        folder: Of the run's own.
        goal: Where the files will be, for messages.
    """
    paths = {what: folder / name for what, name in _FILES.items()}
    failed: list[Exception] = []

    def write(function: Callable[[Path], object], path: Path) -> None:
        try:
            function(path)
        except Exception as error:
            failed.append(as_placed(error, folder, goal))

    for file_name, tracks in zip(_file_names(result.tracks), result.tracks.values(), strict=True):
        for suffix in _TRACK_SUFFIXES:
            write(tracks.write, paths["tracks"] / f"{file_name}{suffix}")
    write(result.model.save, paths["model"])
    write(partial(_write_map, result), paths["map"])
    if result.smoothed is not None:
        write(result.smoothed.write, paths["figures"])
    if result.first_look is not None:
        write(partial(write_found, result.first_look), paths["found"])
    write(lambda path: write_page(run_page(result), path), paths["report"])
    return WrittenRun({what: path for what, path in paths.items() if path.exists()}, failed)


def write_found(look: FirstLook, path: Path) -> None:
    """Write a contact sheet of what a first look found; nothing where it kept no picture.

    What moves comes first, then what is not told yet, then what is moored: of each kind boxes of
    different places, from as many pictures as can be.

    Raises:
        InputError: The page cannot be written.
    """
    boxes = look.boxes
    shown = np.isin(boxes.frame, np.array(list(look.pictures), dtype=np.int64))
    cells: list[SheetBox] = []
    for word, rows in (
        ("moving", look.moving),
        ("not told yet", look.untold),
        ("moored", look.moored),
    ):
        for i in _apart(boxes.xyxy_px, np.flatnonzero(rows & shown))[: _OF_A_KIND[word]]:
            frame = int(boxes.frame[i])
            picture = cv2.imdecode(np.frombuffer(look.pictures[frame], np.uint8), cv2.IMREAD_COLOR)
            if picture is not None:
                caption = f"{word} {boxes.confidence[i]:.2f}  {look.recording}/{frame}"
                image = np.asarray(picture, dtype=np.uint8)
                cells.append(SheetBox(image, boxes.xyxy_px[i], caption, word == "moving"))
    if cells:
        write_sheet(cells, path)


def _apart(xyxy_px: FloatArray, rows: IntArray) -> list[int]:
    """Rows of boxes of which none overlaps one before it; then the others."""
    first: list[int] = []
    again: list[int] = []
    for i in rows.tolist():
        taken = np.array(first, dtype=np.int64)
        seen = bool(taken.size) and bool((iou(xyxy_px[i], xyxy_px[taken]) > 0.0).any())
        (again if seen else first).append(i)
    return first + again


def _write_map(result: RunResult, path: Path) -> None:
    panels = _panels(result)
    if panels:
        save_figure(map_figure(panels), path)


def compare_page(
    comparison: Comparison, placed: Mapping[str, Sequence[LocatedRecording]], scene_name: str
) -> ReportPage:
    """The page of a comparison of models."""
    some = next(iter(placed.values()))
    series = {name: single_pairs(parts) for name, parts in placed.items()}
    ours = "camera+gpr" if "camera+gpr" in placed else next(iter(placed))
    figures = [
        PageFigure(
            "Where each model puts the boxes",
            map_figure([MapPanel(name, pairs) for name, pairs in series.items()]),
            "One map a model: the log as a line, the model's positions as points.",
            "Every recording was placed by a model that never saw it.",
        ),
        PageFigure(
            "Error against range",
            error_against_range(series),
            "Median error of each model against the distance from the camera.",
        ),
        PageFigure(
            "Do the ellipses hold what they promise?",
            calibration(series),
            "Share of true positions inside the stated ellipses, against the stated probability.",
            "On the diagonal a model is as unsure as it ought to be; below it is too sure.",
        ),
    ]
    return ReportPage(
        title="Models compared",
        scene_name=scene_name,
        plane=some[0].model.plane,
        reports={f"{ours}, single boxes": comparison.models[ours]},
        fixes={one.recording: one.fixes for one in some},
        positions={one.recording: one.single() for one in placed[ours] if len(one.single())},
        model_name=ours,
        figures=figures,
        comparison=comparison,
        made_utc_s=time.time(),
    )


def single_pairs(placed: Sequence[LocatedRecording]) -> ScoredPairs:
    """The boxes of all recordings beside their logs."""
    return ScoredPairs.concatenate([one.single() for one in placed])


def _figures(
    positions: Mapping[str, ScoredPairs], reports: Mapping[str, Report]
) -> list[PageFigure]:
    """Figures of single boxes; of those in recordings left out, where there are any."""
    which = next((name for name in reports if name.startswith(_SINGLE)), None)
    if which is None:
        return []
    positions = {name: positions[name] for name in reports[which].recordings}
    everything = {_SINGLE: ScoredPairs.concatenate(positions.values())}
    return [
        PageFigure(
            "Error against range",
            error_against_range(everything),
            f"Errors of {which}, against the distance from the camera.",
            "Errors grow with the square of the range: a pixel at the horizon is a long way.",
        ),
        PageFigure(
            "Do the ellipses hold what they promise?",
            calibration(everything),
            f"Share of true positions inside the stated ellipses, of {which}, against the stated "
            "probability.",
            "On the diagonal the model is as unsure as it ought to be; below it is too sure.",
        ),
        PageFigure(
            "Error over time",
            error_over_time(positions),
            f"Errors of {which}, over time, one panel a recording.",
        ),
    ]


def _panels(result: RunResult) -> list[MapPanel]:
    panels = []
    for recording in result.scene.recordings:
        if recording.fixes_path is None:
            continue
        pairs = [
            pair_track(track, recording.fixes(), platform=recording.platform())
            for track in result.tracks.get(recording.name, ())
            if track.track_id == 1 or recording.boxes_path is None
        ]
        found = [one for one in pairs if len(one)]
        if found:
            best = min(found, key=lambda one: float(np.median(one.error_m)))
            panels.append(MapPanel(f"recording {recording.name}", best, smooth=True))
    return panels


def _model_rows(model: Georeferencer) -> list[ModelRow]:
    return [
        ModelRow(
            name=_WORDS.get(p.name, p.name.replace("_", " ")),
            value=p.value,
            unit="°" if p.unit == "degrees" else p.unit,
            sigma=p.sigma,
            determined=p.determined,
        )
        for p in model.report.parameters
    ] + [
        ModelRow(
            name=f"clock of recording {name} ahead of the log's",
            value=clock.offset_s,
            unit="s",
            sigma=clock.sigma_s,
            determined=clock.sigma_s < _CLOCK_KNOWN_S,
        )
        for name, clock in model.report.clocks.items()
    ]


def _source_rows(model: Georeferencer) -> list[SourceRow]:
    fit = model.regressor.camera_fit
    if fit is None:
        return []
    pixels_per_metre = float(np.exp(fit.vector[LOG_FOCAL])) / fit.typical_range_m
    return [
        SourceRow(
            source=source.name or "(unnamed)",
            boxes=source.n,
            # An edge that lies above the waterline ends higher in the image.
            bias_px=source.bias_px - source.bias_m * pixels_per_metre,
            sigma_px=float(np.hypot(source.sigma_px, source.sigma_m * pixels_per_metre)),
        )
        for source in model.report.sources
    ]


def _outlier_rows(model: Georeferencer) -> list[OutlierRow]:
    return [
        OutlierRow(
            recording=box.recording,
            frame=box.frame if box.frame != NO_FRAME else None,
            time_utc_s=float("nan"),
            source=box.source or "(unnamed)",
            residual_px=box.residual_px,
        )
        for box in model.report.boxes
        if box.outlier
    ]


def _listed(names: Sequence[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else list(names))


def _file_names(names: Iterable[str]) -> list[str]:
    """A name of a file for each recording, each another."""
    out: list[str] = []
    for name in names:
        plain = "".join(c if c.isalnum() or c in "-_." else "_" for c in name).lstrip(".")
        # What a name and an ending may have in bytes, in any script.
        plain = plain[:_LONGEST_NAME] or "recording"
        same = (f"{plain}-{i}" for i in itertools.count(2))
        out.append(next(one for one in itertools.chain([plain], same) if one not in out))
    return out
