"""What `run` says of recordings that were left out, and of those that could not be."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sightline import Scene, fit, run
from sightline.cli.run import result_dict
from sightline.errors import FitError
from sightline.evaluation.report import pair_target
from sightline.formats import read_boxes, read_fixes, write_boxes
from sightline.formats.fixes_csv import write_fixes_csv
from sightline.pipeline.evaluate import LocatedRecording, compare, left_out_inputs, place_boxes
from sightline.pipeline.fit_unlabelled import fit_scene
from sightline.pipeline.run import RunResult, track_recording
from sightline.pipeline.track import TrackSettings
from sightline.reporting.run_report import write_run
from sightline.scene.correspondences import collect
from sightline.scene.detections import SceneDetections
from sightline.simulation.simulate import SimulationSettings, simulate


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Recording 02 is too short to learn from: 01 cannot be left out, and 02 can."""
    made = simulate(
        tmp_path_factory.mktemp("harbour"),
        SimulationSettings(video=False, recordings=2, duration_s=120.0, rate_hz=4.0, seed=1),
    )
    scene = Scene.load(made.scene)
    folder = made.scene.parent
    for kind, longest_s in (("boxes", 0.6), ("detections", 6.0)):
        boxes = read_boxes(folder / kind / "02.csv", skip_empty=True)
        begun = boxes.frame < boxes.frame.min() + longest_s * 4.0
        write_boxes(boxes[begun], folder / kind / "02.csv")
    return scene


@pytest.fixture(scope="module")
def undrawn(scene: Scene) -> Scene:
    return replace(scene, recordings=tuple(replace(r, boxes_path=None) for r in scene.recordings))


@pytest.fixture(scope="module")
def drawn_run(scene: Scene) -> RunResult:
    return run(scene, model="qkr", detector="motion")


@pytest.fixture(scope="module")
def undrawn_run(undrawn: Scene) -> RunResult:
    return run(undrawn, model="camera", detector="motion")


def of_one(scene: Scene, name: str, model: str, without: str | None) -> LocatedRecording:
    """The boxes of a recording, as they are placed by a model fitted to the scene without one."""
    fitted = fit(scene if without is None else scene.without([without]), model)
    (placed,) = place_boxes(scene.select([name]), lambda _: fitted)
    return placed


def test_the_short_recording_alone_teaches_nothing(scene: Scene, undrawn: Scene) -> None:
    with pytest.raises(FitError):
        fit(scene.without(["01"]), "qkr")
    with pytest.raises(FitError):
        fit_scene(undrawn.without(["01"]), "camera")


@pytest.mark.parametrize("result", ["drawn_run", "undrawn_run"])
def test_a_recording_that_could_not_be_left_out_stands_apart_by_name(
    result: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    made: RunResult = request.getfixturevalue(result)
    assert made.left_out == ("02",)
    assert made.smoothed is not None
    assert set(made.smoothed.recordings) == {"02"}
    assert made.smoothed_learned_from is not None
    assert set(made.smoothed_learned_from.recordings) == {"01"}
    (note,) = (note for note in made.notes if "could not be left out" in note)
    assert note.startswith("Recording 01 could not be left out (")
    paths = write_run(made, tmp_path / "out")
    found = result_dict(made, paths)
    assert found["left_out"] == ["02"]
    assert set(found["recordings"]) == {"02"}
    assert set(found["learned_from"]["smoothed"]["recordings"]) == {"01"}
    page = paths["report"].read_text()
    assert note.split(" (")[0] in page
    left_out = page.index("Errors of smoothed tracks, each recording left out")
    apart = page.index("Errors of smoothed tracks, recordings learned from")
    assert '<th scope="row">01</th>' not in page[left_out:apart]
    assert '<th scope="row">01</th>' in page[apart:]


def test_drawn_boxes_are_scored_by_the_model_that_never_saw_them(
    scene: Scene, drawn_run: RunResult
) -> None:
    single, apart = drawn_run.single, drawn_run.single_learned_from
    assert single is not None
    assert apart is not None
    unseen = of_one(scene, "02", "qkr", without="02").single()
    assert single.ape.rmse == pytest.approx(np.sqrt(np.mean(unseen.error_m**2)))
    seen = of_one(scene, "01", "qkr", without=None).single()
    assert apart.ape.rmse == pytest.approx(np.sqrt(np.mean(seen.error_m**2)))
    # The difference is not one of rounding.
    learned = of_one(scene, "02", "qkr", without=None).single()
    assert single.ape.rmse != pytest.approx(np.sqrt(np.mean(learned.error_m**2)), rel=1e-3)


def test_tracks_are_scored_by_the_model_that_never_saw_them(
    undrawn: Scene, undrawn_run: RunResult
) -> None:
    assert undrawn_run.smoothed is not None
    recording, seen = undrawn["02"], SceneDetections(undrawn, "motion")
    rmse_m = []
    for learned_from in (undrawn.without(["02"]), undrawn):
        model = fit_scene(learned_from, "camera", seen=seen)
        tracks = track_recording(recording, model, seen, TrackSettings())
        pairs, _ = pair_target(tracks, recording.fixes())
        rmse_m.append(np.sqrt(np.mean(pairs.error_m**2)))
    assert undrawn_run.smoothed.ape.rmse == pytest.approx(rmse_m[0])
    assert rmse_m[0] != pytest.approx(rmse_m[1], rel=1e-3)


def test_nothing_stands_apart_where_each_recording_was_left_out(tmp_path: Path) -> None:
    made = simulate(
        tmp_path, SimulationSettings(video=False, recordings=2, duration_s=20.0, seed=1)
    )
    result = run(Scene.load(made.scene), model="qkr", detector="motion")
    assert result.left_out == ("01", "02")
    assert result.smoothed_learned_from is None
    assert result.single_learned_from is None
    assert not any("left out" in note for note in result.notes)


@pytest.mark.slow
def test_a_scene_is_collected_once_as_a_whole_at_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = simulate(
        tmp_path / "harbour",
        SimulationSettings(video=False, recordings=3, duration_s=30.0, rate_hz=2.0, seed=1),
    )
    asked: list[tuple[str, ...]] = []

    def counted(scene: Scene, **options: object) -> object:
        asked.append(tuple(recording.name for recording in scene.recordings))
        return collect(scene, **options)  # type: ignore[arg-type]

    for module in ("run", "evaluate", "fit"):
        monkeypatch.setattr(f"sightline.pipeline.{module}.collect", counted)
    pairs = [("02", "03"), ("01", "03"), ("01", "02")]
    ran = run(Scene.load(made.scene), model="qkr")
    assert ran.left_out == ("01", "02", "03")
    assert asked == [("01", "02", "03"), *pairs]
    asked.clear()
    _, placed = compare(Scene.load(made.scene), ["qkr"])
    assert [one.recording for one in placed["qkr"]] == ["01", "02", "03"]
    assert asked == pairs


@pytest.mark.slow
def test_a_recording_that_teaches_nothing_is_not_left_out_of_a_comparison(tmp_path: Path) -> None:
    made = simulate(
        tmp_path / "harbour",
        SimulationSettings(video=False, recordings=3, duration_s=30.0, rate_hz=2.0, seed=1),
    )
    scene = Scene.load(made.scene)
    fixes = read_fixes(tmp_path / "harbour" / "target.gpx")

    def with_early(early_s: float, *names: str) -> Scene:
        """The scene with logs that end so long before the second recording."""
        end_s = scene["02"].boxes().time_utc_s.min() - early_s
        early = replace(fixes, time_utc_s=fixes.time_utc_s - (fixes.time_utc_s.max() - end_s))
        path = tmp_path / f"{early_s}.csv"
        write_fixes_csv(early, path)
        recordings = [
            replace(r, fixes_path=path if r.name in names else r.fixes_path)
            for r in scene.recordings
        ]
        return replace(scene, recordings=tuple(recordings))

    # No time zone explains days.
    days_s = 5.0 * 86_400.0
    assert set(left_out_inputs(with_early(days_s, "02"), pictures=False)) == {"01", "03"}
    with pytest.raises(FitError, match=r"needs at least two recordings .* there is 1"):
        left_out_inputs(with_early(days_s, "02", "03"), pictures=False)
    # One explains an hour, though not in every recording.
    every = left_out_inputs(with_early(3600.0, "02", "03"), pictures=False)
    assert "01" in every
