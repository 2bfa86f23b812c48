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
from sightline.formats import read_boxes, write_boxes
from sightline.pipeline.evaluate import LocatedRecording, place_boxes
from sightline.pipeline.fit_unlabelled import fit_scene
from sightline.pipeline.run import RunResult, track_recording
from sightline.pipeline.track import TrackSettings
from sightline.reporting.run_report import write_run
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
