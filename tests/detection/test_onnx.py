"""Detectors in ONNX files: pictures in, boxes of the frame out."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto

from sightline.detection import (
    DetectorOptions,
    OnnxDetector,
    Tile,
    TilingSettings,
    detector_by_name,
)
from sightline.detection.metadata import DetectorMetadata, LowerEdge
from sightline.detection.onnx import available_providers
from sightline.errors import InputError
from sightline.overlap import iou
from sightline.scene import Scene
from sightline.types import Frame

MakeFile = Callable[..., Path]

WHOLE = TilingSettings(kind="whole")


def bright(*squares: tuple[int, int], size: tuple[int, int] = (1280, 720)) -> Frame:
    """A black frame with white squares of 8 x 8 px at these upper left corners."""
    image = np.zeros((size[1], size[0], 3), np.uint8)
    for x, y in squares:
        image[y : y + 8, x : x + 8] = 255
    return Frame(3, 1e9, image)


def boxes_of(*squares: tuple[int, int]) -> list[list[float]]:
    return [[x, y, x + 8, y + 8] for x, y in squares]


def by_place(xyxy: np.ndarray) -> list[list[float]]:
    return sorted(np.round(xyxy, 3).tolist())


def own(**more: Any) -> dict[str, str]:
    content = {"format": 1, "decoder": "yolov8", "classes": ["light"], **more}
    return {"sightline": json.dumps(content)}


EIGHTS = {"color": "rgb", "scale": 1 / 255, "pad": 0, "stride": 8}


@pytest.mark.parametrize(
    "shape",
    [
        ("batch", 3, "height", "width"),
        (1, 3, "height", "width"),
        (1, 3, 360, 640),
        ("batch", 3, 360, 640),
        (4, 3, 360, 640),
    ],
)
def test_boxes_are_of_the_frame_whatever_the_network_takes(
    shape: tuple[int | str, ...], bright_cells_file: MakeFile
) -> None:
    file = bright_cells_file(shape=shape, metadata=own(input=EIGHTS))
    options = DetectorOptions(views=TilingSettings(kind="tiles", near_scale=0.0), threshold=0.9)
    squares = ((8, 16), (640, 360), (1272, 712), (320, 0))
    boxes = OnnxDetector(file, options=options).detect(bright(*squares))
    assert by_place(boxes.xyxy_px) == sorted(boxes_of(*squares))
    assert set(boxes.label) == {"light"}
    assert boxes.frame.tolist() == [3] * 4
    np.testing.assert_allclose(boxes.confidence, 1.0, atol=1e-6)


def test_only_the_strip_is_looked_at_as_it_is(bright_cells_file: MakeFile) -> None:
    file = bright_cells_file(metadata=own(input=EIGHTS))
    settings = TilingSettings(above_px=40, below_px=120, near_scale=0.0)
    options = DetectorOptions(views=settings, threshold=0.9)
    detector = OnnxDetector(file, options=options, horizon_px=(400.0, 400.0))
    frame = bright((80, 368), (80, 512), (80, 344), (80, 600))
    assert detector.views(frame) == (Tile(0, 360, 1280, 160, 1.0),)
    assert by_place(detector.detect(frame).xyxy_px) == boxes_of((80, 368), (80, 512))


def test_what_is_near_and_large_is_found_scaled_down(bright_cells_file: MakeFile) -> None:
    file = bright_cells_file(metadata=own(input=EIGHTS))
    options = DetectorOptions(threshold=0.9, views=TilingSettings(below_px=120))
    detector = OnnxDetector(file, options=options, horizon_px=(400.0, 400.0))
    frame = bright()
    frame.image_bgr[616:648, 64:96] = 255
    (near,) = detector.detect(frame).xyxy_px
    # From row 360 on in cells of 32 px.
    np.testing.assert_allclose(near, [64, 616, 96, 648])


def test_a_batch_of_frames_gives_what_each_gives(bright_cells_file: MakeFile) -> None:
    detector = OnnxDetector(
        bright_cells_file(metadata=own(input=EIGHTS)),
        options=DetectorOptions(threshold=0.9),
        horizon_px=(400.0, 400.0),
    )
    frames = [bright((8 * i, 400)) for i in range(5)]
    together = detector.detect_batch(frames)
    for frame, boxes in zip(frames, together, strict=True):
        np.testing.assert_array_equal(boxes.xyxy_px, detector.detect(frame).xyxy_px)
        assert len(boxes) == 1


def test_the_input_is_what_the_file_asks_for(bright_cells_file: MakeFile) -> None:
    """(pixel * scale - mean) / std, in the order of the channels; the score is the mean of it."""
    form = {
        "color": "rgb",
        "scale": 0.01,
        "mean": [0.1, 0.2, 0.3],
        "std": [0.5, 1.0, 2.0],
        "pad": 0,
        "stride": 8,
    }
    frame = bright(size=(64, 64))
    frame.image_bgr[8:16, 8:16] = (30, 60, 90)
    wanted = {
        "rgb": np.mean([(0.9 - 0.1) / 0.5, (0.6 - 0.2) / 1.0, (0.3 - 0.3) / 2.0]),
        "bgr": np.mean([(0.3 - 0.1) / 0.5, (0.6 - 0.2) / 1.0, (0.9 - 0.3) / 2.0]),
    }
    for color, score in wanted.items():
        file = bright_cells_file(metadata=own(input=form | {"color": color}), name=f"{color}.onnx")
        detector = OnnxDetector(file, options=DetectorOptions(threshold=0.2, views=WHOLE))
        boxes = detector.detect(frame)
        np.testing.assert_allclose(boxes.xyxy_px, [[8, 8, 16, 16]])
        np.testing.assert_allclose(boxes.confidence, [score], atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "shape"),
    [
        (TensorProto.UINT8, (1, 320, 320, 3)),
        (TensorProto.FLOAT16, (1, 3, 320, 320)),
        (TensorProto.FLOAT, (3, 320, 320)),
        (TensorProto.FLOAT, ("batch", 320, 320, 3)),
    ],
)
def test_pictures_of_other_types_and_layouts(
    kind: int, shape: tuple[int | str, ...], constant_file: MakeFile
) -> None:
    rows = np.zeros((1, 100, 6), np.float32)
    rows[0, 0] = [10, 20, 50, 60, 0.9, 9]
    file = constant_file({"detections": rows}, shape=shape, input_type=kind)
    boxes = OnnxDetector(file, options=DetectorOptions(views=WHOLE)).detect(bright(size=(640, 640)))
    np.testing.assert_allclose(boxes.xyxy_px, [[20, 40, 100, 120]])
    assert boxes.label.tolist() == ["boat"]


def head(*rows: tuple[list[float], int, float], classes: int = 80) -> dict[str, np.ndarray]:
    """Ultralytics' outputs from boxes, classes and scores."""
    array = np.zeros((1, 4 + classes, 2100), np.float32)
    for i, (box, label, score) in enumerate(rows):
        x1, y1, x2, y2 = box
        array[0, :4, i] = [(x1 + x2) / 2, (y1 + y2) / 2, x2 - x1, y2 - y1]
        array[0, 4 + label, i] = score
    return {"output0": array}


def test_the_best_of_overlapping_boxes_of_a_class_stays(constant_file: MakeFile) -> None:
    file = constant_file(
        head(
            ([100, 100, 140, 120], 8, 0.6),
            ([102, 100, 142, 120], 8, 0.8),
            ([102, 100, 142, 120], 2, 0.7),
            ([200, 100, 240, 120], 8, 0.3),
            ([250, 100, 290, 120], 8, 0.1),
        )
    )
    detector = OnnxDetector(file, options=DetectorOptions(views=WHOLE))
    boxes = detector.detect(bright(size=(320, 320)))
    assert list(zip(boxes.label.tolist(), boxes.confidence.round(2).tolist(), strict=True)) == [
        ("boat", 0.8),
        ("car", 0.7),
        ("boat", 0.3),
    ]


def test_boxes_end_where_the_frame_does(constant_file: MakeFile) -> None:
    """What a network puts beyond the picture, or into the grey beside it, nobody saw."""
    in_frame = np.array(
        [
            [-20, 100, 30, 120],
            [300, -10, 350, 25],
            [140, 190, 180, 230],
            [150, 100, 190, 120],
            [330, 100, 350, 120],
            [100, 210, 140, 240],
        ]
    )
    # A frame of 320 x 200 px lies in the middle of the square that the network takes.
    shown = (in_frame + np.array([0, 60, 0, 60])).tolist()
    scores = (0.9, 0.8, 0.7, 0.6, 0.5, 0.4)
    file = constant_file(head(*((box, 8, s) for box, s in zip(shown, scores, strict=True))))
    detector = OnnxDetector(file, options=DetectorOptions(views=WHOLE))
    boxes = detector.detect(bright(size=(320, 200)))
    np.testing.assert_allclose(
        boxes.xyxy_px,
        [[0, 100, 30, 120], [300, 0, 320, 25], [140, 190, 180, 200], [150, 100, 190, 120]],
        atol=1e-4,
    )
    np.testing.assert_allclose(boxes.confidence, [0.9, 0.8, 0.7, 0.6], atol=1e-6)


def test_only_boxes_of_the_classes_that_are_asked_for(constant_file: MakeFile) -> None:
    rows = head(([100, 100, 140, 120], 8, 0.6), ([200, 100, 240, 120], 2, 0.7))
    # A thing that is most like a car is still somewhat like a boat.
    rows["output0"][0, 4 + 8, 1] = 0.5
    file = constant_file(rows)
    options = DetectorOptions(classes=("boat",), views=WHOLE)
    boxes = OnnxDetector(file, options=options).detect(bright(size=(320, 320)))
    assert boxes.label.tolist() == ["boat", "boat"]
    np.testing.assert_allclose(boxes.confidence, [0.6, 0.5], atol=1e-6)
    with pytest.raises(InputError, match="unknown class of constant 'ship'; known are person, "):
        OnnxDetector(file, options=DetectorOptions(classes=("ship",)))


def test_the_file_says_what_it_is_for(constant_file: MakeFile) -> None:
    rows = head(([100, 100, 140, 120], 0, 0.4), ([200, 100, 240, 120], 1, 0.9), classes=2)
    metadata = DetectorMetadata(
        decoder="yolov8",
        classes=("boat", "sailboat"),
        default_classes=("boat",),
        score_threshold=0.35,
        views=TilingSettings(kind="whole"),
        lower_edge=LowerEdge(px=2.0, share=0.15, spread_px=0.5),
    )
    file = constant_file(rows, metadata={"sightline": metadata.to_json()})
    detector = OnnxDetector(file)
    assert detector.lower_edge == LowerEdge(px=2.0, share=0.15, spread_px=0.5)
    frame = bright(size=(320, 320))
    assert detector.threshold == 0.35
    assert detector.views(frame) == (Tile(0, 0, 320, 320, 1.0),)
    assert detector.detect(frame).label.tolist() == ["boat"]
    both = OnnxDetector(file, options=DetectorOptions(classes=("sailboat", "boat")))
    assert both.detect(frame).label.tolist() == ["sailboat", "boat"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is no JSON object"),
        ("[1]", "is no JSON object"),
        ('{"format": 2}', r"describes its detector in version 2, .* up to 1; install a newer"),
        ('{"format": 1, "decoder": "yolov8"}', "classes: Field required"),
        ('{"format": 1, "decoder": "yolov8", "classes": []}', "classes: "),
        ('{"format": 1, "decoder": "magic", "classes": ["a"]}', "unknown decoder 'magic'"),
        (
            '{"decoder": "yolov8", "classes": ["a"], "default_classes": ["b"]}',
            "default_classes names 'b', which is no class",
        ),
        ('{"decoder": "yolov8", "classes": ["a"], "input": {"std": [0, 1, 1]}}', "input.std"),
        ('{"decoder": "yolov8", "classes": ["a"], "views": {"kind": "all"}}', "kind of views"),
        (
            '{"decoder": "yolov8", "classes": ["a"], "lower_edge": {"px": 2.0, "spread_px": 0.0}}',
            "lower_edge.spread_px",
        ),
        ('{"decoder": "yolov8", "classes": ["a"]}', "names 1 classes and puts out 80"),
        ('{"decoder": "yolov8", "classes": ["a"], "input": {"size": [64, 64]}}', "64 x 64 px"),
    ],
)
def test_metadata_that_cannot_be_used_is_refused_in_a_line(
    text: str, message: str, constant_file: MakeFile
) -> None:
    file = constant_file(head(), metadata={"sightline": text})
    with pytest.raises(InputError, match=message) as refused:
        OnnxDetector(file)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"no protocol buffer", "is no ONNX file that can be run, or is damaged"),
        (None, "there is no such ONNX file"),
    ],
)
def test_a_file_that_is_none(content: bytes | None, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.onnx"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        OnnxDetector(path)


def test_a_file_cut_short(bright_cells_file: MakeFile) -> None:
    path = bright_cells_file()
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(InputError, match=r"bright\.onnx: is no ONNX file|can be run|no decoder"):
        OnnxDetector(path)


def test_networks_that_take_no_picture(constant_file: MakeFile) -> None:
    output = {"y": np.zeros((1, 3), np.float32)}
    text = constant_file(output, shape=(1, 128), name="text.onnx")
    with pytest.raises(InputError, match=r"takes a picture; its inputs are images \[1, 128\]"):
        OnnxDetector(text)
    grey = constant_file(output, shape=(1, 1, 28, 28), name="grey.onnx")
    with pytest.raises(InputError, match="pictures of 1 channels; expected 3"):
        OnnxDetector(grey)
    number = constant_file(output, input_type=TensorProto.INT64, name="number.onnx")
    with pytest.raises(InputError, match=r"takes pictures as tensor\(int64\)"):
        OnnxDetector(number)


def test_a_network_of_pictures_that_no_memory_holds(constant_file: MakeFile) -> None:
    huge = constant_file(head(), shape=(1, 3, 100_000, 100_000), name="huge.onnx")
    with pytest.raises(InputError, match="takes pictures of 100000 x 100000 px; expected 1 to"):
        OnnxDetector(huge)


def test_a_gpu_that_is_not_there(constant_file: MakeFile) -> None:
    file = constant_file(head())
    for provider in ("cuda", "tensorrt"):
        if provider in available_providers():
            continue
        with pytest.raises(InputError, match=rf"with {provider}, .*; available are .*cpu"):
            OnnxDetector(file, options=DetectorOptions(provider=provider))
    assert OnnxDetector(file, options=DetectorOptions(provider="cpu")).provider == "cpu"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"provider": "tpu"}, "unknown provider 'tpu'; known are cpu, cuda, tensorrt"),
        ({"threshold": 1.5}, "threshold is 1.5"),
        ({"overlap": 0.0}, "overlap is 0"),
        ({"classes": ()}, "classes names no class"),
    ],
)
def test_options_that_make_no_sense(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        DetectorOptions(**values)


def test_detectors_by_name(constant_file: MakeFile) -> None:
    file = constant_file(head())
    assert detector_by_name(str(file)).detect(bright(size=(320, 320))).source.tolist() == []
    with pytest.raises(InputError, match=r"unknown detector 'x'; known are motion, harbour, a fi"):
        detector_by_name("x")
    with pytest.raises(InputError, match=r"'motion' .* runs no network"):
        detector_by_name("motion", options=DetectorOptions(threshold=0.5))


def test_the_horizon_is_found_where_nobody_tells_it(bright_cells_file: MakeFile) -> None:
    detector = OnnxDetector(bright_cells_file(metadata=own(input=EIGHTS)))
    image = np.full((720, 1280, 3), 200, np.uint8)
    image[300:] = 60
    strip, near = detector.views(Frame(0, np.nan, image))
    assert abs(strip.y - (300 - 40)) <= 3
    assert (strip.scale, near.scale) == (1.0, 0.25)
    detector.reset()
    assert detector.views(bright()) == (Tile(0, 0, 1280, 720, 1.0),)


def test_a_published_detector_finds_boats_on_real_frames(data_dir: Path) -> None:
    """`FastestDet.onnx`, of COCO: on whole frames it loses what the strip shows."""
    scene = Scene.load(data_dir / "tracks-at-sea" / "scene.toml")
    recording = scene["08"]
    drawn = recording.boxes()
    best: dict[str, list[float]] = {}
    for kind in ("whole", "strip"):
        options = DetectorOptions(classes=("boat",), views=TilingSettings(kind=kind))
        detector = OnnxDetector(data_dir / "weights" / "FastestDet.onnx", options=options)
        assert detector.decoder == "fastestdet"
        for frame in recording.frames():
            own_boxes = drawn.xyxy_px[drawn.frame == frame.index]
            if len(own_boxes):
                found = detector.detect(frame)
                assert set(found.label) <= {"boat"}
                overlap = iou(own_boxes[:, None], found.xyxy_px).max(initial=0.0)
                best.setdefault(kind, []).append(float(overlap))
    share = {kind: float(np.mean(np.array(values) >= 0.3)) for kind, values in best.items()}
    assert share["strip"] == 1.0
    assert share["whole"] < 1.0
