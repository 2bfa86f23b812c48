"""Evaluation of a model's positions and tracks against the logs of a scene."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sightline import formats
from sightline.clock_offset import ClockOffset
from sightline.errors import FitError, InputError
from sightline.evaluation.clock_match import match_clock
from sightline.evaluation.comparison import Comparison
from sightline.evaluation.forecast import forecast_errors
from sightline.evaluation.metrics import ScoredPairs, pair_positions, pair_track
from sightline.evaluation.report import Report, evaluate_tracks, summarise
from sightline.georeferencing.fit import FitInputs, FitSettings
from sightline.georeferencing.fit import fit as fit_inputs
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.georeferencing.models import DEFAULT_MODEL, MODELS, ModelType, model_type
from sightline.georeferencing.paper.model import PAPER_MODELS
from sightline.pipeline.camera_state import recording_history
from sightline.pipeline.track import (
    DEFAULT_TRAJECTORY,
    TrackSettings,
    check_platform,
    positions_on_earth,
    smooth_boxes,
    states,
)
from sightline.platform import Platform
from sightline.plausibility import check_near
from sightline.progress import Progress
from sightline.scene import Recording, Scene
from sightline.scene.correspondences import collect, settled
from sightline.synchronisation import LARGEST_GAP_S
from sightline.threads import on_one_thread
from sightline.tracks import Tracks
from sightline.trajectory import TrajectoryMethod, method
from sightline.trajectory.forecast import MotionModel, MotionState
from sightline.types import Boxes, Fixes, LocatedBoxes, Track


@on_one_thread
def evaluate(
    what: Tracks | Iterable[Track] | Scene | str | os.PathLike[str],
    *,
    fixes: Fixes | str | os.PathLike[str] | None = None,
    model: Georeferencer | None = None,
    smooth: bool = False,
    trajectory: str | TrajectoryMethod = DEFAULT_TRAJECTORY,
    track_id: int | None = None,
    mmsi: int | None = None,
    delta_s: float = 1.0,
) -> Report:
    """Evaluate tracks against a log, or a model against a scene's boxes and logs.

    Args:
        what: Tracks, or a scene; or the file of either.
        fixes: The log, for tracks.
        model: For a scene.
        smooth: For a scene: score the trajectories made of the boxes, at the boxes' times.
        trajectory: The method of ``smooth``.
        track_id: Which track is the target; absent: the nearest to the log.
        mmsi: Which vessel of an AIS log.
        delta_s: The time of the relative error, seconds.

    Raises:
        InputError: Something is missing, or nothing can be compared.

    Examples:
        Tracks against a log, and the boxes of a scene as a model places them:

        >>> report = sightline.evaluate("tracks.geojson", fixes="target.gpx")
        >>> print(f"{report.ape.rmse:.0f} m RMSE")
        6 m RMSE
        >>> model = sightline.load("model.safetensors")
        >>> sightline.evaluate("scene.toml", model=model).ape.n
        162
    """
    if isinstance(what, str | os.PathLike):
        path = Path(what)
        what = Scene.load(path) if path.suffix.lower() == ".toml" else Tracks.read(path)
    if isinstance(what, Scene):
        if model is None:
            raise InputError("a scene is scored with a model; give the model")
        placed = place_boxes(what, lambda _: model)
        report = score(placed, trajectory if smooth else None, delta_s=delta_s)
        return with_forecasts(report, placed)
    if fixes is None:
        raise InputError("tracks are scored against a log; give fixes")
    log = fixes if isinstance(fixes, Fixes) else formats.read_fixes(fixes, mmsi=mmsi)
    tracks = list(what)
    report = evaluate_tracks(tracks, log, track_id=track_id, delta_s=delta_s)
    where = "the log" if isinstance(fixes, Fixes) else str(fixes)
    check_near(log, tracks[0].latitude_deg[0], tracks[0].longitude_deg[0], where, "the tracks")
    return report


@dataclass(frozen=True, eq=False)
class LocatedRecording:
    """The located boxes of the target in one recording, with its log.

    Attributes:
        recording: Its name.
        boxes: With their times and positions.
        model: That placed them.
        fixes: The log.
        platform: What the camera stands on, where that moves.
        clock: How far the camera's clock is ahead of the log's, by these boxes and their model; the
            boxes' times are the log's. None where too few boxes meet the log to tell.
    """

    recording: str
    boxes: LocatedBoxes
    model: Georeferencer
    fixes: Fixes
    platform: Platform | None = None
    clock: ClockOffset | None = None

    def single(self) -> ScoredPairs:
        """Single boxes paired with the log."""
        return pair_positions(
            self.boxes.time_utc_s,
            positions_on_earth(self.boxes, self.platform),
            self.fixes,
            platform=self.platform,
            reference_sigma_m=self.model.reference_sigma_m,
        )

    def track(self, trajectory: str | TrajectoryMethod) -> Track | None:
        """The trajectory of the boxes, at their times."""
        settings = TrackSettings(trajectory=trajectory)
        return smooth_boxes(
            self.boxes, method(trajectory), settings, track_id=1, platform=self.platform
        )

    def states(self, motion: MotionModel | None = None) -> MotionState | None:
        """Filtered states of the target, one a box.

        None where no box has a place.

        Args:
            motion: How targets move. Absent: as vessels do.
        """
        return states(self.boxes, self.platform, motion=motion)


def place_boxes(scene: Scene, model_for: Callable[[str], Georeferencer]) -> list[LocatedRecording]:
    """Locate the boxes of all recordings that have boxes and a log, each with its model.

    The clock of each is estimated from its boxes and its log, with the model held; of a model
    without a camera, and on board, by a camera that is fitted to the boxes. Where it is off for
    sure, or somebody stated it, the boxes' times are corrected; a clock that may be right is not
    fitted to the log that is to score it.

    Args:
        scene: The scene.
        model_for: From a recording's name to the model that locates its boxes.

    Raises:
        InputError: No recording has both.
    """
    placed = []
    by_camera: Scene | None = None
    for recording in scene.recordings:
        if recording.boxes_path is None or recording.fixes_path is None:
            continue
        model, platform = model_for(recording.name), recording.platform()
        check_platform(model, platform, f"recording {recording.name}: ")
        pictures = scene.camera.compensate_rotation
        boxes = _placed(recording, model, pictures)
        if model.regressor.camera_fit is not None and platform is None:
            clock = clock_of(recording, boxes, model)
        else:
            # Models without a camera do not say how far off they may be, nor does one from on board
            # say how far the compass and the vessel's log are just then: a clock would make up for
            # it. A camera that is fitted to these very boxes does.
            by_camera = by_camera or settled(scene)
            clock = by_camera[recording.name].clock_found
        if clock is not None and clock.used_s != recording.clock_offset_s:
            recording = recording.with_clock(clock.used_s)
            boxes = _placed(recording, model, pictures)
        placed.append(
            LocatedRecording(recording.name, boxes, model, recording.fixes(), platform, clock)
        )
    if not placed:
        raise InputError(
            f"{scene.path}: no recording has boxes and fixes, so there is nothing to compare"
        )
    return placed


def _placed(recording: Recording, model: Georeferencer, pictures: bool) -> LocatedBoxes:
    history = recording_history(recording, model, pictures=pictures)
    return model.place(history.observed(recording.boxes()))


def clock_of(recording: Recording, boxes: LocatedBoxes, model: Georeferencer) -> ClockOffset | None:
    """The clock offset of a recording, by its located boxes and its log.

    Args:
        recording: With a log, of a camera that stands still.
        boxes: Of the logged target, at the recording's times.
        model: That located them.

    Returns:
        None where too few boxes meet the log.
    """
    return match_clock(
        boxes.time_utc_s + recording.clock_offset_s,
        positions_on_earth(boxes),
        recording.fixes(),
        prior=recording.clock_prior,
        reference_sigma_m=model.reference_sigma_m,
    )


def clock_notes(clocks: Mapping[str, ClockOffset | None]) -> tuple[str, ...]:
    """Sentences on the clock offsets that scores are corrected for.

    Args:
        clocks: By recording.
    """
    return tuple(
        f"The clock of recording {name} is {clock.words}, by its own boxes and log; it is scored "
        "in the log's time."
        for name, clock in clocks.items()
        if clock is not None and clock.used_s
    )


def score(
    placed: Sequence[LocatedRecording],
    trajectory: str | TrajectoryMethod | None = None,
    *,
    delta_s: float = 1.0,
) -> Report:
    """Report of located boxes, single or as trajectories.

    Recordings of which no box falls into the log are left out.

    Raises:
        InputError: No box falls into a log.
    """
    parts: dict[str, ScoredPairs] = {}
    for one in placed:
        if trajectory is None:
            pairs = one.single()
        else:
            made = one.track(trajectory)
            if made is None:
                continue
            pairs = pair_track(
                made,
                one.fixes,
                platform=one.platform,
                reference_sigma_m=one.model.reference_sigma_m,
            )
        if len(pairs):
            parts[one.recording] = pairs
    if not parts:
        raise InputError(
            "no box falls between two fixes of its log that are near enough to each other for a "
            f"score ({LARGEST_GAP_S:g} s); check the clocks, and that the log is not too sparse"
        )
    report = summarise(parts, delta_s=delta_s)
    off = {one.recording: one.clock for one in placed if one.clock and one.clock.used_s}
    recordings = {
        name: replace(part, clock=off.get(name)) for name, part in report.recordings.items()
    }
    return replace(report, recordings=recordings)


def with_forecasts(report: Report, placed: Sequence[LocatedRecording]) -> Report:
    """Add the errors of forecasts to a report of located boxes.

    Args:
        report: Of these boxes.
        placed: Each is taken for one target.
    """
    targets = {
        one.recording: (states, one.fixes)
        for one in placed
        if one.recording in report.recordings and (states := one.states()) is not None
    }
    parts = {
        name: replace(part, forecast=forecast_errors([targets[name]] if name in targets else []))
        for name, part in report.recordings.items()
    }
    return replace(report, forecast=forecast_errors(targets.values()), recordings=parts)


@on_one_thread
def leave_one_out(
    scene: Scene,
    model: str | ModelType = DEFAULT_MODEL,
    *,
    seed: int = 0,
    extra: Mapping[str, Boxes] | None = None,
    inputs: Mapping[str, FitInputs] | None = None,
) -> dict[str, Georeferencer]:
    """Leave-one-out models: for each recording with correspondences one that never saw it.

    Args:
        scene: The scene.
        model: Name of the model.
        seed: Of whatever is random in the fits.
        extra: Further boxes of the logged target, by recording; see `fit`.
        inputs: What `left_out_inputs` made of the scene. Absent: it is asked.

    Raises:
        FitError: Fewer than two recordings have pairs, or what is left is too little.
    """
    kind = model_type(model)
    pictures = kind.name not in PAPER_MODELS
    if inputs is None:
        inputs = left_out_inputs(scene, extra=extra, pictures=pictures)
    if not pictures:
        inputs = {name: replace(own, static_intervals={}) for name, own in inputs.items()}
    settings = FitSettings(model=kind, seed=seed)
    return {name: fit_inputs(own, settings) for name, own in inputs.items()}


def left_out_inputs(
    scene: Scene, *, extra: Mapping[str, Boxes] | None = None, pictures: bool = True
) -> dict[str, FitInputs]:
    """Inputs of leave-one-out fits, by the recording that each was collected without.

    Each is collected anew: the clocks of the others are told without the one that is left out.

    Args:
        scene: The scene.
        extra: Further boxes of the logged target, by recording; see `fit`.
        pictures: Whether the pictures of the recordings are asked if the camera was turned.

    Raises:
        FitError: See `leave_one_out`.
    """
    asked = [r.name for r in scene.recordings if r.boxes_path and r.fixes_path]
    try:
        inputs = {
            name: collect(scene.without([name]), extra=extra, pictures=pictures) for name in asked
        }
        held = {name for one in inputs.values() for name in _recordings(one)}
    except (FitError, InputError):
        # Nothing is left without one of those that are asked, or one alone teaches.
        inputs, held = {}, set()
    if len(held) < 2:
        whole = collect(scene, extra=extra, pictures=False)
        held = set(recordings_with_correspondences(scene, whole))
        inputs = {
            name: collect(scene.without([name]), extra=extra, pictures=pictures)
            for name in asked
            if name in held
        }
    return {name: own for name, own in inputs.items() if name in held}


def _recordings(inputs: FitInputs) -> set[str]:
    return set(inputs.correspondences.recording.tolist())


def recordings_with_correspondences(scene: Scene, inputs: FitInputs) -> list[str]:
    """Names of the recordings to leave out in turn: at least two.

    Args:
        scene: In whose order they come.
        inputs: Collected from the scene.

    Raises:
        FitError: Fewer than two recordings have boxes and fixes at the same times.
    """
    held = _recordings(inputs)
    names = [recording.name for recording in scene.recordings if recording.name in held]
    if len(names) < 2:
        raise FitError(
            f"{scene.path}: leaving one recording out needs at least two recordings with boxes "
            f"and fixes at the same times; there {'is' if len(names) == 1 else 'are'} {len(names)}"
        )
    return names


@on_one_thread
def compare(
    scene: Scene,
    models: Sequence[str] = MODELS,
    *,
    trajectory: str | TrajectoryMethod | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Comparison, dict[str, list[LocatedRecording]]]:
    """Compare models by leave-one-out cross-validation, as in the paper's Table 2.

    Args:
        scene: At least two recordings with boxes and fixes.
        models: Names of models.
        trajectory: The method after each model. Absent: the paper's chain after the paper's
            models, the smoother after ours.
        seed: Of whatever is random in the fits.
        progress: Told how far it is.

    Returns:
        The comparison, and the boxes as each model placed them.

    Raises:
        InputError: A name is not known.
        FitError: See `leave_one_out`.

    Examples:
        >>> scene = sightline.Scene.load("scene.toml")
        >>> comparison, located = sightline.compare(scene, ["camera", "qkr"])
        >>> for name, report in comparison.models.items():
        ...     print(f"{name}: {report.ape.n} boxes, {report.ape.rmse:.0f} m RMSE")
        camera: 162 boxes, 9 m RMSE
        qkr: 162 boxes, 25 m RMSE
        >>> [one.recording for one in located["camera"]]
        ['01', '02', '03']
    """
    if not models:
        raise InputError(f"no model is named; known are {', '.join(MODELS)}")
    for name in models:
        model_type(name)
    if trajectory is not None:
        method(trajectory)
    single: dict[str, Report] = {}
    smooth: dict[str, Report] = {}
    all_placed: dict[str, list[LocatedRecording]] = {}
    inputs = left_out_inputs(scene, pictures=any(name not in PAPER_MODELS for name in models))
    for i, name in enumerate(models):
        if progress:
            progress(f"fitting {name}", i / len(models))
        fitted = leave_one_out(scene, name, seed=seed, inputs=inputs)
        placed = place_boxes(scene.select(fitted), fitted.__getitem__)
        single[name] = score(placed)
        after = trajectory or ("paper" if name in PAPER_MODELS else DEFAULT_TRAJECTORY)
        smooth[name] = score(placed, after)
        all_placed[name] = placed
    return Comparison(single, smooth), all_placed
