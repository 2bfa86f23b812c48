"""A detector tuned to a camera by its log, in a synthetic harbour."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sightline import Georeferencer, InputError, Scene, fit
from sightline.cli import defaults, main
from sightline.detection import DetectorOptions, OnnxDetector, _onnxruntime
from sightline.formats import read_boxes
from sightline.formats.labels import Margin, parse_margins
from sightline.labelling.lessons import Lesson, TeacherSettings, learn_lessons
from sightline.overlap import iou
from sightline.simulation.simulate import SimulationSettings, simulate
from sightline.training import adaptation, loop
from sightline.training.adaptation import AdaptSettings, adapt, split
from sightline.training.export import export_onnx

SIZE_PX = (640, 360)


@pytest.fixture(scope="module")
def harbour(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings of a small picture, of which only the first has boxes, for the model."""
    folder = tmp_path_factory.mktemp("adapted")
    simulate(
        folder,
        SimulationSettings(
            seed=2,
            recordings=2,
            duration_s=36.0,
            rate_hz=1.0,
            annotation_interval_s=1.0,
            image_size_px=SIZE_PX,
            unlabelled=1,
        ),
    )
    return folder


@pytest.fixture(scope="module")
def scene(harbour: Path) -> Scene:
    return Scene.load(harbour / "scene.toml")


@pytest.fixture(scope="module")
def model(scene: Scene, harbour: Path) -> Georeferencer:
    fitted = fit(scene, "camera")
    fitted.save(harbour / "camera.safetensors")
    return fitted


@pytest.fixture(scope="module")
def weak(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The general detector, which was made to forget where there is anything, and what."""
    made = adaptation.start_of("harbour", "boat")
    torch.manual_seed(0)
    with torch.no_grad():
        for name, value in made.network.named_parameters():
            if "something_output" in name or "kind_output" in name:
                value.normal_(0.0 if value.ndim > 1 else -4.0, 0.01)
    path = tmp_path_factory.mktemp("weak") / "weak.onnx"
    export_onnx(made, path, size_px=(320, 192), tolerance=1e-3)
    return path


@pytest.fixture(scope="module")
def lessons(scene: Scene, model: Georeferencer, weak: Path) -> list[Lesson]:
    detector = OnnxDetector(weak, options=DetectorOptions(threshold=0.03))
    return learn_lessons(scene, model, detector, TeacherSettings())


def lesson(recording: str, second: float, boxes: int = 1) -> Lesson:
    return Lesson(
        recording,
        int(second),
        second,
        np.zeros((8, 8, 3), np.uint8),
        np.array([[1.0, 1.0, 4.0, 4.0]])[:boxes],
        np.empty((0, 4)),
    )


@pytest.mark.slow
def test_what_the_log_teaches_agrees_with_the_truth(harbour: Path, lessons: list[Lesson]) -> None:
    overlaps, opened = [], []
    for name in ("01", "02"):
        truth = read_boxes(harbour / "truth-boxes" / f"{name}.csv")
        target = int(truth.track_id.min())
        for one in (one for one in lessons if one.recording == name):
            own = truth[truth.frame == one.frame]
            logged = own.xyxy_px[own.track_id == target]
            if len(one.target_xyxy_px):
                overlaps.append(iou(one.target_xyxy_px[0], logged).max(initial=0.0))
            others = own.xyxy_px[(own.track_id != target) & (own.label == "motorboat")]
            for box in others:
                x, y = 0.5 * (box[:2] + box[2:])
                known = np.concatenate([one.open_xyxy_px, one.target_xyxy_px])
                inside = (known[:, 0] <= x) & (x <= known[:, 2])
                opened.append(bool((inside & (known[:, 1] <= y) & (y <= known[:, 3])).any()))
    assert len(overlaps) >= 20
    assert np.median(overlaps) >= 0.6
    assert np.mean(np.array(overlaps) >= 0.3) >= 0.9
    # Who moves besides is neither taught nor unlearned.
    assert not opened or np.mean(opened) >= 0.6


@pytest.mark.slow
def test_a_detector_that_misses_the_boat_learns_to_find_it(
    scene: Scene, model: Georeferencer, weak: Path, harbour: Path, tmp_path: Path
) -> None:
    path = tmp_path / "tuned.onnx"
    result = adapt(scene, model, str(weak), path, AdaptSettings(steps=40))
    assert result.before.average_precision < 0.2
    assert result.after.average_precision > 0.5
    assert result.gained
    # Against the truth, in the recording that it did not learn from.
    held_out = result.judged_by.rsplit(" ", 1)[1]
    truth = read_boxes(harbour / "truth-boxes" / f"{held_out}.csv")
    target = truth[truth.track_id == truth.track_id.min()]
    margin = Margin(2.5, 0.16)
    recall = {}
    for name, file in (("before", weak), ("after", path)):
        detector = OnnxDetector(file, options=DetectorOptions(threshold=0.05))
        hits = []
        for frame in scene[held_out].frames():
            wanted = margin.widened(target.xyxy_px[target.frame == frame.index])
            if len(wanted):
                found = detector.detect(frame).xyxy_px
                hits.append(iou(wanted[0], found).max(initial=0.0) >= 0.3)
        recall[name] = np.mean(hits)
    assert recall["before"] < 0.2
    assert recall["after"] >= 0.6
    tuned = OnnxDetector(path)
    assert tuned.wanted == ("boat",)
    assert tuned.lower_edge is not None
    assert tuned.lower_edge.share == 0.16


class Ticking:
    """A clock that goes on by a second whenever somebody looks at it."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def monotonic(self) -> float:
        self.now_s += 1.0
        return self.now_s


@pytest.mark.slow
def test_the_time_that_was_given_is_kept(
    scene: Scene,
    model: Georeferencer,
    weak: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Ticking()
    monkeypatch.setattr(loop, "time", clock)
    settings = AdaptSettings(steps=10_000, minutes=0.5)
    result = adapt(
        scene, model, str(weak), tmp_path / "tuned.onnx", settings, clock=clock.monotonic
    )
    assert 5 <= result.steps <= 30
    # Two looks a step, of which one is within it.
    assert clock.now_s <= 2.0 * 60.0 * settings.minutes + 10.0


def adapted(scene: Path, harbour: Path, weak: Path, path: Path, *more: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(
            [
                *("detector", "adapt", str(scene), "-o", str(path), "--detector", str(weak)),
                *("--model", str(harbour / "camera.safetensors"), *more),
            ]
        )
    return int(ended.value.code or 0)


@pytest.mark.slow
def test_where_nothing_is_gained_nothing_is_written(
    model: Georeferencer,
    harbour: Path,
    weak: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    # After a single batch it is what it was.
    told = tmp_path / "told.json"
    path = tmp_path / "tuned.onnx"
    scene = harbour / "scene.toml"
    assert adapted(scene, harbour, weak, path, "--steps", "1", "--json", str(told)) == 0
    assert not path.exists()
    said = capsys.readouterr().out
    assert "gained nothing" in said
    assert f"keep {weak}" in said
    content = json.loads(told.read_text())
    assert content["gained"] is False
    assert content["detector"] == str(weak)


@pytest.mark.slow
def test_a_model_of_another_camera_is_refused(
    scene: Scene, model: Georeferencer, weak: Path, tmp_path: Path
) -> None:
    path = tmp_path / "tuned.onnx"
    larger = replace(scene, camera=replace(scene.camera, image_size_px=(1280, 720)))
    with pytest.raises(InputError, match="1280 x 720 px, and the model is of a camera with 640 x"):
        adapt(larger, model, str(weak), path)
    away = replace(scene, camera=replace(scene.camera, latitude_deg=10.0, longitude_deg=20.0))
    with pytest.raises(InputError, match="km from that of the model"):
        adapt(away, model, str(weak), path)
    assert not path.exists()


@pytest.mark.slow
def test_a_log_that_is_nowhere_in_view_is_refused(
    model: Georeferencer,
    harbour: Path,
    weak: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    text = (harbour / "scene.toml").read_text()
    behind = tmp_path / "behind.csv"
    camera = model.plane
    start_s = float(Scene.load(harbour / "scene.toml").recordings[0].start_utc_s or 0.0)
    lines = ["time_utc,latitude_deg,longitude_deg"]
    lines += [
        f"{start_s + second},{camera.latitude_deg - 0.1 - 1e-5 * second},{camera.longitude_deg}"
        for second in range(-10, 4000)
    ]
    behind.write_text("\n".join(lines) + "\n")
    moved = "\n".join(
        f'fixes = "{behind}"' if line.startswith("fixes") else line
        for line in text.splitlines()
        if not line.startswith("boxes")
    )
    path = harbour / "behind.toml"
    path.write_text(moved + "\n")
    assert adapted(path, harbour, weak, tmp_path / "tuned.onnx") == 2
    said = capsys.readouterr().err
    assert "never in view" in said
    assert len(said.strip().splitlines()) == 1


@pytest.mark.slow
def test_without_the_extra_train_it_says_what_is_missing(
    model: Georeferencer,
    harbour: Path,
    weak: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    assert adapted(harbour / "scene.toml", harbour, weak, tmp_path / "tuned.onnx") == 2
    assert "sightline[train]" in capsys.readouterr().err


def test_defaults_of_the_help_are_those_of_tuning() -> None:
    assert defaults.ADAPTED_MINUTES == adaptation.MINUTES
    assert defaults.ADAPTED_STEPS == adaptation.STEPS
    assert parse_margins([f"log={defaults.ADAPTED_MARGIN}"])["log"] == adaptation.MARGIN


def test_a_detector_of_another_network_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no network that can be tuned"):
        adaptation.start_of("motion", "boat")
    with pytest.raises(InputError, match="is not there"):
        adaptation.start_of(str(tmp_path / "none.onnx"), "boat")


def test_whole_recordings_are_held_out_where_there_are_several() -> None:
    counts = {"a": 30, "b": 12, "c": 10}
    given = [lesson(name, s) for name, count in counts.items() for s in range(count)]
    taught, held_out = split(given)
    # A quarter of 52 is 13.
    assert {one.recording for one in held_out} == {"b"}
    assert len(taught) + len(held_out) == len(given)


def test_of_a_single_recording_the_last_quarter_is_held_out() -> None:
    taught, held_out = split([lesson("a", 2.0 * second) for second in range(40)])
    assert len(held_out) == 10
    assert min(one.time_utc_s for one in held_out) == 60.0
    # Frames shortly before are too much like it.
    assert max(one.time_utc_s for one in taught) < 55.0


def test_a_log_that_shows_its_vessel_too_seldom_is_refused() -> None:
    with pytest.raises(InputError, match="in 15 frames, and 16 or more"):
        split([lesson("a", float(second)) for second in range(15)])


@pytest.mark.parametrize(("minutes", "steps"), [(0.0, 10), (float("nan"), 10), (1.0, 0)])
def test_settings_that_cannot_be_are_refused(minutes: float, steps: int) -> None:
    with pytest.raises(InputError):
        AdaptSettings(minutes=minutes, steps=steps)


def test_the_general_detector_is_taken_out_of_the_one_that_ships() -> None:
    made = adaptation.start_of("harbour", "boat")
    rng = np.random.default_rng(0)
    picture = torch.from_numpy(rng.uniform(0, 255, (1, 3, 64, 96)).astype(np.float32))
    with torch.no_grad():
        boxes, something, kinds, _ = made.network(picture)
    packaged = Path(adaptation.__file__).parents[1] / "detection" / "harbour" / "harbour.onnx"
    session = _onnxruntime.load().InferenceSession(str(packaged))
    # The file takes red first, and bytes as shares of 255.
    found = session.run(None, {"images": picture.flip(1).numpy() / np.float32(255.0)})[0][0]
    own = found[:, found.shape[1] // 2 :]
    middle = 0.5 * (boxes[0, :, :2] + boxes[0, :, 2:])
    assert np.allclose(own[:2].T, middle.numpy(), atol=1e-2)
    scores = (kinds[0, :, 0].sigmoid() * something[0].sigmoid()).numpy()
    assert (own[-1] <= scores + 1e-5).all()
    assert (own[-1] >= 0.08 * scores - 1e-4).all()
