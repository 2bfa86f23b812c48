"""Each family's outputs, written by its own published formula, come back as the same box."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto

from sightline.detection import DetectorOptions, OnnxDetector, TilingSettings
from sightline.detection.decoders import DECODERS
from sightline.errors import InputError
from sightline.types import Frame

SIDE = 320
BOX = np.array([100.0, 84.0, 164.0, 116.0])
"""Its middle is (132, 100): in cell (8, 6) of a grid of 16 px, a quarter of the cell on."""
MIDDLE, SIZE = np.array([132.0, 100.0]), np.array([64.0, 32.0])
BOAT = 8
SCORE = 0.75
WHOLE = TilingSettings(kind="whole")

Outputs = dict[str, np.ndarray]


def logit(p: float) -> float:
    return math.log(p / (1.0 - p))


def f32(array: Any) -> np.ndarray:
    return np.asarray(array, np.float32)


def darknet(anchors: Any, stretch: float, classes: int = 80) -> Outputs:
    """Raw heads of three scales; the box is in the middle one, of its second anchor."""
    heads = {}
    for number, stride in enumerate((8, 16, 32)):
        cells = SIDE // stride
        head = np.zeros((3, 5 + classes, cells, cells))
        head[:, 4:] = -20.0
        if stride == 16:
            inside = (0.25 + 0.5 * (stretch - 1.0)) / stretch
            head[1, 0:2, 6, 8] = logit(inside)
            head[1, 2:4, 6, 8] = np.log(SIZE / anchors[1][1])
            # The score is the product of there being something and of what it is.
            head[1, 4, 6, 8] = logit(SCORE / 0.9)
            head[1, 5 + BOAT, 6, 8] = logit(0.9)
        heads[f"head_{number}"] = f32(head.reshape(1, -1, cells, cells))
    return heads


V3 = [
    [[10, 13], [16, 30], [33, 23]],
    [[30, 61], [62, 45], [59, 119]],
    [[116, 90], [156, 198], [373, 326]],
]
V4 = [
    [[12, 16], [19, 36], [40, 28]],
    [[36, 75], [76, 55], [72, 146]],
    [[142, 110], [192, 243], [459, 401]],
]


def darknet_boxes() -> Outputs:
    boxes, confidence = np.zeros((1, 30, 1, 4)), np.zeros((1, 30, 80))
    boxes[0, 7, 0] = BOX / SIDE
    confidence[0, 7, BOAT] = SCORE
    return {"boxes": f32(boxes), "confs": f32(confidence)}


def yolox() -> Outputs:
    head = np.zeros((1, 40 * 40 + 20 * 20 + 10 * 10, 85))
    row = 40 * 40 + 6 * 20 + 8
    head[0, row, :2] = 0.25
    head[0, row, 2:4] = np.log(SIZE / 16.0)
    head[0, row, 4], head[0, row, 5 + BOAT] = SCORE / 0.9, 0.9
    return {"output": f32(head)}


def yolov8(classes: int = 80) -> Outputs:
    head = np.zeros((1, 4 + classes, 2100))
    head[0, :4, 1234] = [*MIDDLE, *SIZE]
    head[0, 4 + BOAT, 1234] = SCORE
    return {"output0": f32(head)}


def yolov5() -> Outputs:
    head = np.zeros((1, 3 * 2100, 85))
    head[0, 4321, :4] = [*MIDDLE, *SIZE]
    head[0, 4321, 4], head[0, 4321, 5 + BOAT] = SCORE / 0.9, 0.9
    return {"output": f32(head)}


def queries(classes: int) -> Outputs:
    """Shares of the picture and scores, a row a query."""
    rows = np.zeros((1, 300, 4 + classes))
    rows[0, 17, :4] = np.r_[MIDDLE, SIZE] / SIDE
    rows[0, 17, 4 + min(BOAT, classes - 1)] = SCORE
    return {"output0": f32(rows)}


def six_columns(number: int) -> Outputs:
    rows = np.zeros((1, 100, 6))
    rows[0, 3] = [*BOX, SCORE, number]
    return {"output": f32(rows)}


def detr() -> Outputs:
    labels, boxes, scores = np.zeros((1, 300), np.int64), np.zeros((1, 300, 4)), np.zeros((1, 300))
    labels[0, 5], boxes[0, 5], scores[0, 5] = BOAT, BOX, SCORE
    return {"labels": labels, "boxes": f32(boxes), "scores": f32(scores)}


def logits(number: int, classes: int, boxes_name: str, logits_name: str) -> Outputs:
    """Each class for itself."""
    score, boxes = np.full((1, 300, classes), -20.0), np.full((1, 300, 4), 0.5)
    score[0, 5, number] = logit(SCORE)
    boxes[0, 5] = np.r_[MIDDLE, SIZE] / SIDE
    return {boxes_name: f32(boxes), logits_name: f32(score)}


def softmax(number: int) -> Outputs:
    """One class of 92; elsewhere it is the last, which is nothing."""
    score, boxes = np.full((1, 100, 92), -1e4), np.full((1, 100, 4), 0.5)
    score[0, :, 91] = 0.0
    score[0, 5, number], score[0, 5, 91] = logit(SCORE), 0.0
    boxes[0, 5] = np.r_[MIDDLE, SIZE] / SIDE
    return {"logits": f32(score), "pred_boxes": f32(boxes)}


def torchvision(number: int) -> Outputs:
    return {
        "boxes": f32([BOX, [5, 5, 9, 9]]),
        "labels": np.array([number, 1]),
        "scores": f32([SCORE, 0.01]),
    }


# Of effdet's Anchors for 640 x 384 px: x1, y1, x2, y2 by number.
EFFDET = {
    0: [-12.0, -12.0, 20.0, 20.0],
    5: [-10.1111, -24.2222, 18.1111, 32.2222],
    34573: [-32.4445, -20.2222, 80.4445, 36.2222],
    46034: [291.53769, -248.9245, 860.46228, 888.92462],
}
LEVELS = (40, 20, 10, 5, 3)


def efficientdet_code() -> np.ndarray:
    """The box by the anchor of 32 px in the cell (16, 12) of the finest level, whose middle is
    (132, 100): y, x, height, width."""
    return np.array([0.0, 0.0, math.log(32 / 32), math.log(64 / 32)])


def efficientdet_rows() -> Outputs:
    count = 9 * sum(side**2 for side in LEVELS)
    score, code = np.full((1, count, 90), -20.0), np.zeros((1, count, 4))
    row = 9 * (12 * 40 + 16)
    score[0, row, BOAT], code[0, row] = logit(SCORE), efficientdet_code()
    return {"regression": f32(code), "classification": f32(score)}


def efficientdet_maps() -> Outputs:
    out: Outputs = {}
    for kind, width in (("class", 90), ("box", 4)):
        for level, side in enumerate(LEVELS):
            array = np.full((9, width, side, side), -20.0 if kind == "class" else 0.0)
            if level == 0 and kind == "class":
                array[0, BOAT, 12, 16] = logit(SCORE)
            elif level == 0:
                array[0, :, 12, 16] = efficientdet_code()
            out[f"{kind}_{level}"] = f32(array.reshape(1, 9 * width, side, side))
    return out


def fastestdet() -> Outputs:
    head = np.zeros((1, 85, 20, 20))
    head[0, 1:3, 6, 8] = math.atanh(0.25)
    head[0, 3:5, 6, 8] = [logit(64 / SIDE), logit(32 / SIDE)]
    head[0, 0, 6, 8], head[0, 5 + BOAT, 6, 8] = 0.8, (SCORE / 0.8**0.6) ** (1 / 0.4)
    return {"758": f32(head)}


def own(decoder: str, **more: Any) -> dict[str, str]:
    names = [f"thing {i}" for i in range(80)]
    names[BOAT] = "boat"
    return {"sightline": json.dumps({"format": 1, "decoder": decoder, "classes": names, **more})}


NAMES = {"names": str({i: "boat" if i == BOAT else f"thing {i}" for i in range(80)})}
RTDETR = {"description": "Ultralytics rtdetr-l model trained on boats", "task": "detect"}


def names(*each: str) -> dict[str, str]:
    return {"names": str(dict(enumerate(each)))}


SIZES = {
    "images": (TensorProto.FLOAT, (1, 3, SIDE, SIDE)),
    "orig_target_sizes": (TensorProto.INT64, (1, 2)),
}

FAMILIES: dict[str, tuple[str, Outputs, dict[str, Any]]] = {
    "Darknet's heads, anchors in the file": (
        "darknet",
        darknet(V3, 1.0),
        {"metadata": own("darknet", anchors=V3)},
    ),
    "Darknet's heads, stretched": (
        "darknet",
        darknet(V4, 1.1),
        {"metadata": own("darknet", anchors=V4, scale_xy=[1.2, 1.1, 1.05])},
    ),
    "Darknet's boxes": ("darknet-boxes", darknet_boxes(), {}),
    "YOLOX": ("yolox", yolox(), {}),
    "YOLOv5": ("yolov5", yolov5(), {}),
    "Ultralytics": ("yolov8", yolov8(), {}),
    "Ultralytics, names in the file": ("yolov8", yolov8(), {"metadata": NAMES}),
    "Ultralytics, end to end": ("yolo-end-to-end", six_columns(BOAT), {"metadata": NAMES}),
    "YOLO11, YOLO12, their own classes": (
        "yolov8",
        {"output0": yolov8()["output0"][:, [0, 1, 2, 3, 4, 4 + BOAT]]},
        {"metadata": names("buoy", "boat")},
    ),
    "YOLO11, YOLO12, one class": (
        "yolov8",
        {"output0": yolov8()["output0"][:, [0, 1, 2, 3, 4 + BOAT]]},
        {"metadata": names("boat")},
    ),
    "RT-DETR of Ultralytics": ("rtdetr", queries(80), {"metadata": NAMES}),
    "RT-DETR of Ultralytics, one class": ("rtdetr", queries(1), {"metadata": names("boat")}),
    "RT-DETR of Ultralytics, two classes": (
        "rtdetr",
        queries(2),
        {"metadata": {**names("buoy", "boat"), **RTDETR}},
    ),
    "EfficientDet, chosen": ("efficientdet", six_columns(BOAT + 1), {}),
    "EfficientDet, in two": ("efficientdet", efficientdet_rows(), {}),
    "EfficientDet, maps": ("efficientdet", efficientdet_maps(), {}),
    "RT-DETR, D-FINE": ("detr", detr(), {"inputs": SIZES}),
    "RT-DETR's logits": ("detr-logits", logits(BOAT, 80, "pred_boxes", "logits"), {}),
    "D-FINE's logits": ("detr-logits", logits(BOAT, 80, "pred_boxes", "logits"), {}),
    "RF-DETR": ("rf-detr", logits(BOAT + 1, 91, "dets", "labels"), {}),
    "DETR": ("detr-softmax", softmax(BOAT + 1), {}),
    "torchvision": ("torchvision", torchvision(BOAT + 1), {"shape": (3, SIDE, SIDE)}),
    "FastestDet": ("fastestdet", fastestdet(), {}),
}


def picture() -> Frame:
    return Frame(7, 1e9, np.zeros((SIDE, SIDE, 3), np.uint8))


@pytest.mark.parametrize("family", FAMILIES)
def test_a_family_is_known_by_its_outputs_and_its_box_comes_back(
    family: str, constant_file: Callable[..., Any]
) -> None:
    decoder, outputs, settings = FAMILIES[family]
    detector = OnnxDetector(
        constant_file(outputs, **settings), options=DetectorOptions(views=WHOLE)
    )
    assert detector.decoder == decoder
    boxes = detector.detect(picture())
    assert boxes.label.tolist() == ["boat"]
    np.testing.assert_allclose(boxes.xyxy_px, [BOX], atol=1e-3)
    np.testing.assert_allclose(boxes.confidence, [SCORE], atol=1e-5)
    assert boxes.frame.tolist() == [7]
    assert boxes.source.tolist() == ["constant"]


@pytest.mark.parametrize(("name", "anchors", "stretch"), [("yolov3", V3, 1.0), ("yolov4", V4, 1.1)])
def test_raw_heads_without_anchors_need_the_name_of_their_network(
    name: str, anchors: Any, stretch: float, constant_file: Callable[..., Any]
) -> None:
    file = constant_file(dict(reversed(darknet(anchors, stretch).items())))
    with pytest.raises(InputError, match=r"raw heads of a Darknet network.* --decoder yolov3"):
        OnnxDetector(file)
    detector = OnnxDetector(file, options=DetectorOptions(decoder=name, views=WHOLE))
    boxes = detector.detect(picture())
    np.testing.assert_allclose(boxes.xyxy_px, [BOX], atol=1e-3)
    assert boxes.label.tolist() == ["boat"]


def test_anchors_of_efficientdet_are_those_of_its_implementation() -> None:
    from sightline.detection.decoders import Outputs as Put
    from sightline.detection.decoders import decoder_by_name

    count = 46035
    put = Put(("class", "box"), (np.zeros((1, count, 3)), np.zeros((1, count, 4))), (640, 384))
    found = decoder_by_name("efficientdet").of_one(put, 0).xyxy_px
    for number, box in EFFDET.items():
        np.testing.assert_allclose(found[number], box, atol=2e-4)


def test_outputs_that_fit_none_are_described(constant_file: Callable[..., Any]) -> None:
    file = constant_file({"logits": f32(np.zeros((1, 1000)))})
    with pytest.raises(InputError, match=r"no decoder .*: logits 1x1000 float32; .*yolov8"):
        OnnxDetector(file)


@pytest.mark.parametrize("name", DECODERS)
def test_a_decoder_that_does_not_fit_says_what_the_outputs_look_like(
    name: str, constant_file: Callable[..., Any]
) -> None:
    file = constant_file({"embedding": f32(np.zeros((1, 7)))})
    with pytest.raises(InputError, match=rf"not those of the decoder '{name}': embedding"):
        OnnxDetector(file, options=DetectorOptions(decoder=name))


def test_an_unknown_decoder_lists_the_known() -> None:
    with pytest.raises(InputError, match=r"unknown decoder 'yolo99'; known are darknet, .*yolox"):
        DetectorOptions(decoder="yolo99")


def test_what_is_no_number_is_no_box(constant_file: Callable[..., Any]) -> None:
    outputs = yolov8()
    outputs["output0"][0, :4, 5] = np.nan
    outputs["output0"][0, 4 + BOAT, 5] = 0.9
    outputs["output0"][0, :4, 6] = np.inf
    outputs["output0"][0, 4 + BOAT, 6] = 0.9
    outputs["output0"][0, 4 + BOAT, 7] = np.nan
    detector = OnnxDetector(constant_file(outputs), options=DetectorOptions(views=WHOLE))
    np.testing.assert_allclose(detector.detect(picture()).xyxy_px, [BOX], atol=1e-3)
