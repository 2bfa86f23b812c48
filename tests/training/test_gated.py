"""Two detectors in one file, and the gate between them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from test_yolox import published_file

from sightline.cli.detector.combine import combine
from sightline.detection import OnnxDetector, _onnxruntime
from sightline.detection.classes import COCO
from sightline.detection.metadata import LowerEdge
from sightline.errors import InputError
from sightline.scene import Scene
from sightline.training.architecture import build
from sightline.training.export import export_onnx
from sightline.training.gated import (
    GENERAL_CLASS,
    GENERAL_EDGE,
    REMAINS,
    Described,
    Gate,
    Likeness,
    _alone,
    check_specialist,
    crop,
    fit_gate,
    join,
    kind_of,
    shown_parts,
)
from sightline.training.yolox import YoloxDetector, YoloxNetwork

FEATURES = 2 * (64 + 128 + 256)


@pytest.fixture(scope="module")
def specialist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A detector of a place with random weights."""
    torch.manual_seed(1)
    path = tmp_path_factory.mktemp("place") / "place.onnx"
    export_onnx(
        build("harbour", ("boat", "sailboat"), width=0.5),
        path,
        about={"lower_edge": LowerEdge(px=2.0, share=0.1).model_dump()},
    )
    return path


@pytest.fixture(scope="module")
def general() -> YoloxDetector:
    torch.manual_seed(2)
    made = YoloxDetector("yolox-nano", ("boat",))
    made.module.eval()
    return made


def gate(offset: float, most_alone: float = 1e9, limit: float = 1e9) -> Gate:
    """A gate that is open or closed by its offset alone."""
    place = Likeness(
        np.zeros(FEATURES), np.ones(FEATURES), np.eye(FEATURES)[:2], np.ones(2), 1.0, limit
    )
    return Gate(np.zeros(FEATURES), offset, (place,), most_alone, 1.0, 0.0, 0.0)


def picture(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (96, 160, 3)).astype(np.uint8)


def outputs(path: Path, image: np.ndarray) -> np.ndarray:
    session = _onnxruntime.load().InferenceSession(str(path), providers=["CPUExecutionProvider"])
    fed = image.transpose(2, 0, 1)[None].astype(np.float32) / 255.0
    found: np.ndarray = session.run(None, {"images": fed})[0][0]
    return found


def alone_outputs(general: YoloxDetector, image: np.ndarray, path: Path) -> np.ndarray:
    """What the general network says by itself, written by the other exporter."""
    export_onnx(general, path)
    session = _onnxruntime.load().InferenceSession(str(path), providers=["CPUExecutionProvider"])
    fed = image.transpose(2, 0, 1)[None, ::-1].astype(np.float32)
    found: np.ndarray = session.run(None, {"images": np.ascontiguousarray(fed)})[0][0]
    return found


@pytest.mark.parametrize(("offset", "inside"), [(50.0, 1.0), (-50.0, 0.0)])
def test_the_gate_decides_whose_scores_count(
    specialist: Path, general: YoloxDetector, tmp_path: Path, offset: float, inside: float
) -> None:
    path = tmp_path / "joined.onnx"
    join(specialist, general, gate(offset), path)
    image = picture()
    place, other = outputs(specialist, image), alone_outputs(general, image, tmp_path / "g.onnx")
    both = outputs(path, image)
    count = place.shape[1]
    np.testing.assert_allclose(both[:4, :count], place[:4], rtol=1e-4, atol=1e-3)
    # Far below its limit, "near" is 0.9975: the logistic function of 6.
    sure = inside / (1.0 + np.exp(-6.0)) ** 2
    np.testing.assert_allclose(both[4:6, :count], place[4:] * sure, atol=1e-5)
    assert not both[6, :count].any()
    np.testing.assert_allclose(both[:4, count:], other[:4], rtol=1e-3, atol=1e-2)
    assert not both[4:6, count:].any()
    left = 1.0 - (1.0 - REMAINS) * sure
    np.testing.assert_allclose(both[6, count:], other[4] * left, atol=1e-5)


def test_what_is_unlike_the_place_is_left_to_the_general_one(
    specialist: Path, general: YoloxDetector, tmp_path: Path
) -> None:
    path = tmp_path / "joined.onnx"
    join(specialist, general, gate(50.0, limit=1e-9), path)
    assert outputs(path, picture())[4:6].max() < 1e-6


def test_what_is_found_alone_is_counted_in_things() -> None:
    levels = [torch.zeros(1, 1, rows, 2 * rows) for rows in (8, 4, 2)]
    cells = 128 + 32 + 8
    place, vessel = torch.zeros(1, 6, cells), torch.zeros(1, cells)
    # Nine cells of one thing, by the second class, that no other cell supports ...
    place[0, 5, [0, 1, 2, 16, 17, 18, 32, 33, 34]] = 0.9
    # ... one that is supported two cells beside it, and one that is not sure.
    place[0, 4, 128 - 1] = 0.9
    vessel[0, 128 - 3] = 0.5
    place[0, 4, 64 + 8] = 0.2
    assert float(_alone(place, vessel, levels)[0]) == pytest.approx(0.9)
    # A coarse cell says so of all that it covers: here of the thing as well.
    vessel[0, 128] = 0.5
    assert float(_alone(place, vessel, levels)[0]) == 0.0


def test_a_file_of_both_is_a_detector_whose_boxes_say_by_which(
    specialist: Path, general: YoloxDetector, tmp_path: Path
) -> None:
    path = tmp_path / "joined.onnx"
    join(specialist, general, gate(-50.0), path)
    detector = OnnxDetector(path, name="mine")
    assert detector.classes == ("boat", "sailboat", "vessel")
    assert detector.wanted == ("boat", "vessel")
    assert detector.lower_edges == {
        "mine": LowerEdge(px=2.0, share=0.1),
        "mine/vessel": GENERAL_EDGE,
    }
    with pytest.raises(InputError, match="is joined with another already"):
        check_specialist(path)


def test_only_what_was_trained_here_can_be_the_detector_of_a_place(
    general: YoloxDetector, tmp_path: Path
) -> None:
    export_onnx(general, tmp_path / "general.onnx")
    with pytest.raises(InputError, match="cannot be joined with another; expected"):
        check_specialist(tmp_path / "general.onnx")
    with pytest.raises(InputError, match="is not there"):
        check_specialist(tmp_path / "none.onnx")
    (tmp_path / "broken.onnx").write_bytes(b"\x08\x07nothing")
    with pytest.raises(InputError, match=r"broken\.onnx"):
        check_specialist(tmp_path / "broken.onnx")


def crops(rng: np.random.Generator, mean: float, count: int, size: int = 40) -> list[Described]:
    return [Described(rng.normal(mean, 1.0, size), 0.1) for _ in range(count)]


def test_a_gate_lets_left_out_recordings_in_and_strangers_out() -> None:
    rng = np.random.default_rng(4)
    inside, outside = crops(rng, 0.0, 400), crops(rng, -1.5, 400)
    made = fit_gate(
        [("bay", inside, [f"{i // 80}" for i in range(400)])],
        outside,
        [f"kind {i // 100}" for i in range(400)],
    )
    assert made.inside_missed <= 0.03
    assert made.outside_passed == 0.0
    # What nobody showed, on the place's side of the regression and far beyond it.
    stranger = np.full((1, 40), 6.0)
    assert (stranger @ made.weights + made.offset)[0] > 0.0
    (place,) = made.places
    assert place.distance(stranger)[0] > 2.0 * place.limit
    assert made.most_alone == pytest.approx(1.5)


def test_the_mean_distance_of_what_a_likeness_was_made_from_is_two() -> None:
    rng = np.random.default_rng(0)
    mixed = rng.normal(size=(300, 4)) @ rng.normal(size=(4, 50)) + 0.1 * rng.normal(size=(300, 50))
    own = [Described(row, 0.0) for row in mixed]
    made = fit_gate(
        [("bay", own, [f"{i // 60}" for i in range(300)])],
        crops(rng, 9.0, 100, 50),
        [f"{i // 25}" for i in range(100)],
    )
    assert made.places[0].distance(mixed).mean() == pytest.approx(2.0, abs=0.01)


def test_a_gate_wants_something_to_leave_out() -> None:
    rng = np.random.default_rng(0)
    own, other = crops(rng, 0.0, 20), crops(rng, 3.0, 20)
    with pytest.raises(InputError, match=r"bay: a gate is judged by recordings .* at least two"):
        fit_gate([("bay", own, ["a"] * 20)], other, ["x", "y"] * 10)
    with pytest.raises(InputError, match="outside: a gate is judged"):
        fit_gate([("bay", own, ["a", "b"] * 10)], other, ["x"] * 20)


def test_parts_are_as_large_as_networks_take() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        part = crop(np.zeros((100, 130, 3), np.uint8), rng)
        assert part.shape[0] % 32 == part.shape[1] % 32 == 0


def test_frames_are_parted_as_a_detector_parts_them(specialist: Path) -> None:
    detector = OnnxDetector(specialist)
    frame = np.zeros((360, 640, 3), np.uint8)
    parts = shown_parts(detector, frame)
    assert len(parts) == detector.tile_count > 0
    assert all(part.shape[0] % 32 == part.shape[1] % 32 == 0 for part in parts)


@pytest.fixture
def folders(tmp_path: Path) -> dict[str, Path]:
    """What `detector combine` is given: a published file, and pictures of two kinds."""
    torch.manual_seed(3)
    network = YoloxNetwork(len(COCO)).eval()
    with torch.no_grad():
        for value in network.parameters():
            if value.ndim == 1:
                value.uniform_(-0.5, 0.5)
    rng = np.random.default_rng(5)
    (tmp_path / "others").mkdir()
    for number in range(6):
        image = np.full((120, 200, 3), rng.integers(0, 256, 3), np.uint8)
        image[:, :: 2 + number] = 255
        cv2.imwrite(
            str(tmp_path / "others" / f"{'hill' if number % 2 else 'town'}{number}.png"), image
        )
    return {
        "general": published_file(tmp_path / "published.onnx", network),
        "outside": tmp_path / "others",
        "output": tmp_path / "both.onnx",
    }


def test_a_file_of_both_is_made_of_a_scene_and_folders(
    specialist: Path, folders: dict[str, Path], scene: Scene, tmp_path: Path
) -> None:
    combine(
        specialist,
        folders["general"],
        scene.path,
        [folders["outside"]],
        folders["output"],
        json=tmp_path / "gate.json",
    )
    detector = OnnxDetector(folders["output"])
    assert detector.classes[-1] == GENERAL_CLASS
    told = json.loads((tmp_path / "gate.json").read_text())
    # Three recordings of six frames, each in one view or two, two of them everywhere as well.
    assert told["inside"] >= 18
    assert told["outside"] == 36
    assert told["outside_passed"] == 0.0


def test_what_cannot_be_joined_is_refused_before_anything_is_learned(
    specialist: Path, folders: dict[str, Path], scene: Scene
) -> None:
    rest = (scene.path, [folders["outside"]])
    with pytest.raises(InputError, match=r"must end in \.onnx"):
        combine(specialist, folders["general"], *rest, folders["output"].with_suffix(".pt"))
    with pytest.raises(InputError, match="is of another network than YOLOX-nano"):
        combine(specialist, specialist, *rest, folders["output"])
    with pytest.raises(InputError, match="cannot be joined"):
        combine(folders["general"], folders["general"], *rest, folders["output"])
    with pytest.raises(InputError, match="at least two"):
        combine(specialist, folders["general"], *rest, folders["output"], recordings="a")
    assert not folders["output"].exists()


@pytest.mark.parametrize(
    ("name", "kind"), [("ships5-0012.jpg", "ships"), ("mate-Dune.jpg", "mate"), ("a_b.png", "a")]
)
def test_pictures_of_a_kind_begin_alike(name: str, kind: str) -> None:
    assert kind_of(name) == kind
