"""Proposed boxes in a synthetic harbour, against its exact boxes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sightline import Boxes, Georeferencer, InputError, Scene, fit
from sightline.cli import main
from sightline.formats import read_boxes
from sightline.formats.labels import read_labels
from sightline.labelling import Proposals, TargetSize, expect, learn_size, propose
from sightline.labelling.expected import place_of
from sightline.labelling.snapping import Background, BoxPrior, Look, snap
from sightline.overlap import iou
from sightline.simulation.simulate import SimulationSettings, simulate
from sightline.types import Frame

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def harbour(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings of a small picture; the second has no boxes."""
    folder = tmp_path_factory.mktemp("labelled")
    simulate(
        folder,
        SimulationSettings(
            seed=2,
            recordings=2,
            duration_s=40.0,
            rate_hz=1.5,
            annotation_interval_s=1.0,
            image_size_px=(768, 432),
            unlabelled=1,
        ),
    )
    return folder


@pytest.fixture(scope="module")
def scene(harbour: Path) -> Scene:
    return Scene.load(harbour / "scene.toml")


@pytest.fixture(scope="module")
def model(scene: Scene) -> Georeferencer:
    return fit(scene, "camera")


@pytest.fixture(scope="module")
def proposals(scene: Scene, model: Georeferencer) -> Proposals:
    return propose(scene["02"], model, learn_size(scene, model), every_s=0.0)


def overlaps(proposals: Proposals, exact: Boxes) -> np.ndarray:
    """The overlap of each proposed box with the exact one of its frame; 0 where there is none."""
    boxes = proposals.boxes()
    of_frame = {int(f): b for f, b in zip(exact.frame, exact.xyxy_px, strict=True)}
    return np.array(
        [
            iou(box, of_frame[int(frame)]) if int(frame) in of_frame else 0.0
            for frame, box in zip(boxes.frame, boxes.xyxy_px, strict=True)
        ]
    )


def test_boxes_of_a_recording_without_any_agree_with_the_truth(
    harbour: Path, proposals: Proposals
) -> None:
    truth = read_boxes(harbour / "truth-boxes" / "02.csv")
    target = truth[truth.track_id == truth.track_id.min()]
    overlap = overlaps(proposals, target)
    assert len(target) > 30
    assert len(overlap) >= 0.7 * len(target)
    assert np.median(overlap) >= 0.6
    sure = proposals.confidence[proposals.made] >= 0.5
    assert np.mean(overlap[sure] >= 0.5) >= 0.8


def test_frames_without_a_box_say_why(proposals: Proposals) -> None:
    without = ~proposals.made
    assert (proposals.reason[without] != "").all()
    assert (proposals.reason[proposals.made] == "").all()
    assert (proposals.confidence[without] == 0.0).all()


def test_less_sure_boxes_go_as_asked(proposals: Proposals) -> None:
    sure = proposals.surer_than(0.5)
    kept = proposals.confidence >= 0.5
    assert 0 < kept.sum() < proposals.made.sum()
    np.testing.assert_array_equal(sure.made, kept)
    np.testing.assert_array_equal(sure.boxes().xyxy_px, proposals.xyxy_px[kept])
    assert (sure.reason[proposals.made & ~kept] == "less sure than was asked for").all()
    np.testing.assert_array_equal(sure.reason[~proposals.made], proposals.reason[~proposals.made])


def test_a_table_of_proposals_names_the_logged_boat_alone(
    harbour: Path, scene: Scene, model: Georeferencer, tmp_path: Path
) -> None:
    model.save(tmp_path / "camera.safetensors")
    out = tmp_path / "labels"
    with pytest.raises(SystemExit) as stopped:
        main(
            [
                *("detector", "label", str(scene.path), "-o", str(out), "--recordings", "02"),
                *("--model", str(tmp_path / "camera.safetensors"), "--least-confidence", "0.5"),
            ]
        )
    assert stopped.value.code == 0
    labels = read_labels(out / "02.csv")
    assert labels.target.all()
    assert labels.boxes.confidence.min() >= 0.5
    # And a scene may have it for its boxes.
    np.testing.assert_array_equal(read_boxes(out / "02.csv").frame, labels.boxes.frame)


def test_frames_are_left_out_as_asked(scene: Scene, model: Georeferencer) -> None:
    size = TargetSize()
    drawn = scene["01"].boxes().frame
    proposals = propose(scene["01"], model, size, every_s=2.0, leave_out=drawn)
    assert not set(proposals.frame.tolist()) & set(drawn.tolist())
    assert np.diff(proposals.time_utc_s).min() >= 2.0


def test_a_clock_that_the_fit_found_late_is_set_right(scene: Scene, model: Georeferencer) -> None:
    times = scene["02"].clock().time_utc_s(np.arange(10, 50))
    late = replace(model, report=replace(model.report, clock_offset_s={"02": 5.0}))
    on_time = replace(model, report=replace(model.report, clock_offset_s={}))
    moved = place_of(scene["02"], late, times)
    there = place_of(scene["02"], on_time, times + 5.0)
    np.testing.assert_allclose(moved.east_m, there.east_m)
    np.testing.assert_allclose(moved.north_m, there.north_m)


def test_what_is_expected_lies_over_the_exact_boxes(
    harbour: Path, scene: Scene, model: Georeferencer
) -> None:
    truth = read_boxes(harbour / "truth-boxes" / "02.csv")
    target = truth[truth.track_id == truth.track_id.min()]
    times = scene["02"].clock().time_utc_s(target.frame)
    expected = expect(place_of(scene["02"], model, times), model, learn_size(scene, model))
    known = ~expected.in_gap
    inside = (target.xyxy_px[known, 0] > 2.0) & (target.xyxy_px[known, 2] < 766.0)
    middle = 0.5 * (target.xyxy_px[:, 0] + target.xyxy_px[:, 2])[known][inside]
    found = 0.5 * (expected.xyxy_px[:, 0] + expected.xyxy_px[:, 2])[known][inside]
    width = (target.xyxy_px[:, 2] - target.xyxy_px[:, 0])[known][inside]
    allowed = 3.0 * np.hypot(expected.sigma_px[known, 0][inside], 0.3 * width)
    assert np.mean(np.abs(found - middle) <= allowed) >= 0.95


def sea(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(118, 138, (200, 300, 3)).astype(np.uint8)


def test_a_box_takes_in_the_hull_and_not_the_wake() -> None:
    rng = np.random.default_rng(0)
    background = Background.of((Frame(i, float(i), sea(rng)) for i in range(9)), "01")
    image = sea(rng)
    cv2.rectangle(image, (140, 100), (179, 117), (20, 20, 20), -1)
    cv2.rectangle(image, (180, 114), (260, 117), (250, 250, 250), -1)
    cv2.line(image, (158, 60), (158, 100), (250, 250, 250), 1)
    belief = BoxPrior(np.array([133.0, 97.0, 173.0, 115.0]), np.array([10.0, 6.0]), 0.4)
    found = snap(Look.at(background, image, belief), belief)
    assert found is not None
    np.testing.assert_allclose(found[0], [140.0, 100.0, 180.0, 118.0], atol=2.0)


def test_where_nothing_stands_out_there_is_no_box() -> None:
    rng = np.random.default_rng(1)
    background = Background.of((Frame(i, float(i), sea(rng)) for i in range(9)), "01")
    belief = BoxPrior(np.array([130.0, 95.0, 180.0, 122.0]), np.array([10.0, 6.0]), 0.4)
    assert snap(Look.at(background, sea(rng), belief), belief) is None


def test_a_model_without_a_camera_is_refused(scene: Scene) -> None:
    paper = fit(scene, "qkr")
    with pytest.raises(InputError, match=r"qkr model cannot say .* fit camera or camera\+gpr"):
        learn_size(scene, paper)


@pytest.mark.parametrize("count", [0, 2])
def test_too_few_frames_for_a_background_are_refused(count: int) -> None:
    rng = np.random.default_rng(2)
    with pytest.raises(InputError, match=rf"recording 01: {count} frames do not show"):
        Background.of((Frame(i, float(i), sea(rng)) for i in range(count)), "01")


def test_frames_of_two_sizes_are_refused() -> None:
    frames = [Frame(i, float(i), np.zeros((20 + i, 30, 3), np.uint8)) for i in range(4)]
    with pytest.raises(InputError, match="frame 1 is of another size than the first"):
        Background.of(frames, "01")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (('fixes = "target.gpx"\n', ""), "no recording has both pictures and a log"),
        (("camera.safetensors", "qkr.safetensors"), "a qkr model cannot say where"),
    ],
)
def test_the_command_refuses_in_one_line(
    harbour: Path,
    scene: Scene,
    model: Georeferencer,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    change: tuple[str, str],
    complaint: str,
) -> None:
    text = scene.path.read_text(encoding="utf-8")
    spoilt = harbour / "spoilt.toml"
    spoilt.write_text(text.replace(*change), encoding="utf-8")
    name = "camera.safetensors".replace(*change)
    (fit(scene, "qkr") if "qkr" in name else model).save(tmp_path / name)
    out = tmp_path / "labels"
    with pytest.raises(SystemExit) as stopped:
        main(["detector", "label", str(spoilt), "--model", str(tmp_path / name), "-o", str(out)])
    assert stopped.value.code == 2
    error = capfd.readouterr().err
    assert complaint in error
    assert error.count("\n") == 1
    assert not out.exists()
