"""`detector evaluate` on pictures with labels, without any scene."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from cli.test_cli_detect import BOX, detector_file
from sightline.scene.labelled_pictures import detect_pictures, labelled_pictures
from sightline.types import Boxes, Frame

Command = Callable[..., Any]

SIZE = (640, 360)


def yolo(box: list[float], number: int = 0) -> str:
    x1, y1, x2, y2 = (v / side for v, side in zip(box, SIZE * 2, strict=True))
    return f"{number} {(x1 + x2) / 2:.6f} {(y1 + y2) / 2:.6f} {x2 - x1:.6f} {y2 - y1:.6f}\n"


def beside(box: list[float], x: float) -> list[float]:
    return [box[0] + x, box[1], box[2] + x, box[3]]


def picture(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((SIZE[1], SIZE[0], 3), 90, np.uint8))


LABELS = {
    "pier-0": yolo(BOX),
    # 30 of 70 px are in common.
    "pier-1": yolo(beside(BOX, 20.0)),
    "quay-0": yolo(BOX) + yolo([400.0, 100.0, 440.0, 120.0]),
    "quay-1": "",
}
"""In each the detector finds `BOX`, with 0.8."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    out = tmp_path / "pictures"
    (out / "labels").mkdir(parents=True)
    for name, text in LABELS.items():
        picture(out / "images" / f"{name}.png")
        (out / "labels" / f"{name}.txt").write_text(text)
    detector_file(tmp_path / "net.onnx")
    return out


@pytest.fixture
def measure(sightline: Command, tmp_path: Path) -> Callable[..., dict]:
    def call(path: Path, *options: object) -> dict:
        done = sightline(
            "detector", "evaluate", path, "--detector", tmp_path / "net.onnx", "--views", "whole",
            "--json", tmp_path / "r.json", "--overwrite", *options,
        )  # fmt: skip
        assert done.status == 0, done.err
        return {**json.loads((tmp_path / "r.json").read_text()), "out": done.out, "err": done.err}

    return call


def test_each_prefix_is_measured_and_the_mean_of_them(
    folder: Path, measure: Callable[..., dict]
) -> None:
    """Of the first group both are found; of the second one of two, and one box is false."""
    told = measure(folder, "--group-by-prefix")
    assert (told["frames"], told["drawn"], told["found"]) == (4, 4, 4)
    assert told["recall"] == 0.75
    assert told["false_per_frame"] == 0.25
    pier, quay = told["groups"]["pier"], told["groups"]["quay"]
    assert (pier["recall"], pier["average_precision"]) == (1.0, pytest.approx(1.0))
    assert (quay["recall"], quay["false_per_frame"]) == (0.5, 0.5)
    # COCO reads the precision at 101 recalls, 51 of which are at most a half.
    assert quay["average_precision"] == pytest.approx(51 / 101)
    mean = told["mean_of_groups"]
    assert mean["average_precision"] == pytest.approx((1.0 + 51 / 101) / 2)
    assert mean["recall"] == 0.75
    assert "mean of 2 groups: at IoU 0.3 AP 0.75, recall 75 %" in told["out"]
    assert "recordings" not in told


def test_how_often_boxes_are_right_by_their_confidence_is_told_and_drawn(
    folder: Path, measure: Callable[..., dict], tmp_path: Path
) -> None:
    """Of four boxes at 0.8 three are right."""
    figure = tmp_path / "reliability.png"
    told = measure(folder, "--reliability", figure)
    assert told["calibration_error"] == pytest.approx(0.05, abs=1e-3)
    assert "expected calibration error 5.0 %" in told["out"]
    assert cv2.imread(str(figure)) is not None


def test_a_figure_of_an_unknown_kind_is_refused(folder: Path, sightline: Command) -> None:
    done = sightline("detector", "evaluate", folder, "--reliability", "reliability.txt")
    assert done.status == 2
    assert "a figure ends in .png" in done.err


def test_the_overlap_that_is_asked_for_is_that_of_the_average_precision(
    folder: Path, measure: Callable[..., dict]
) -> None:
    strict = measure(folder, "--iou", "0.5", "--group-by-prefix")["groups"]["pier"]
    assert strict["average_precision"] == strict["map_50"] == pytest.approx(51 / 101)
    loose = measure(folder, "--iou", "0.42", "--group-by-prefix")["groups"]["pier"]
    assert (loose["average_precision"], loose["map_50"]) == (pytest.approx(1.0), strict["map_50"])


def test_low_boxes_are_neither_missed_nor_false(folder: Path, measure: Callable[..., dict]) -> None:
    """All that was drawn is 20 px high; what is found elsewhere stays false."""
    told = measure(folder, "--least-height", "20.5")
    assert (told["drawn"], told["false_per_frame"]) == (0, 0.25)
    assert measure(folder, "--least-height", "19.5")["drawn"] == 4


class Remembers:
    """A detector that finds a box in the first picture that it is shown, and in no other."""

    name = "first"

    def __init__(self) -> None:
        self.seen = 0

    def reset(self) -> None:
        self.seen = 0

    def detect(self, frame: Frame) -> Boxes:
        self.seen += 1
        return Boxes.of([BOX] * (self.seen == 1), frame=frame.index, confidence=0.5)


def test_pictures_have_nothing_to_do_with_one_another(folder: Path) -> None:
    judged = detect_pictures(labelled_pictures(folder), Remembers(), ["0"])
    assert [len(one.found_xyxy_px) for one in judged] == [1, 1, 1, 1]
    assert [one.name for one in judged] == sorted(f"{name}.png" for name in LABELS)


def test_labels_may_lie_beside_the_pictures_and_in_folders(
    folder: Path, measure: Callable[..., dict], tmp_path: Path
) -> None:
    for name, text in LABELS.items():
        camera, number = name.split("-")
        picture(tmp_path / "plain" / camera / f"{number}.png")
        (tmp_path / "plain" / camera / f"{number}.txt").write_text(text)
    told, same = measure(tmp_path / "plain", "--group-by-prefix"), measure(folder)
    assert set(told["groups"]) == {"pier", "quay"}
    assert told["recall"] == same["recall"]
    assert told["average_precision"] == same["average_precision"]


def test_a_picture_without_labels_holds_nothing_and_is_told(
    folder: Path, measure: Callable[..., dict]
) -> None:
    (folder / "labels" / "quay-1.txt").unlink()
    (folder / "labels" / "lost.txt").write_text("")
    told = measure(folder)
    assert told["recall"] == 0.75
    assert "1 pictures have no labels, and are taken to hold nothing" in told["err"]
    assert "1 labels without a picture (lost.txt)" in told["err"]


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("labels/classes.txt", "vessel\nboat\n"),
        ("data.yaml", "nc: 2\nnames: ['vessel', 'boat']\n"),
        ("data.yaml", "names:\n  0: vessel\n  1: boat\nnc: 2\n"),
        ("data.yaml", "path: x\nnames:\n- vessel\n- boat\n"),
    ],
)
def test_classes_that_the_detector_does_not_look_for_are_open(
    folder: Path, measure: Callable[..., dict], file: str, text: str
) -> None:
    (folder / file).write_text(text)
    (folder / "labels" / "quay-0.txt").write_text(
        yolo(BOX, 1) + yolo([400.0, 100.0, 440.0, 120.0], 0)
    )
    (folder / "labels" / "pier-0.txt").write_text(yolo(BOX, 0))
    (folder / "labels" / "pier-1.txt").write_text(yolo(BOX, 1))
    told = measure(folder, "--classes", "boat")
    assert (told["drawn"], told["recall"], told["false_per_frame"]) == (2, 1.0, 0.25)
    vessels = measure(folder, "--classes", "boat", "--targets", "vessel")
    assert (vessels["drawn"], vessels["recall"]) == (2, 0.5)
    both = measure(folder, "--targets", "vessel,boat")
    assert (both["drawn"], both["recall"]) == (4, 0.75)
    wrong = measure(folder, "--classes", "boat", "--others-false")
    assert wrong["false_per_frame"] == 0.5


def test_names_of_classes_may_be_given(folder: Path, measure: Callable[..., dict]) -> None:
    (folder / "labels" / "quay-0.txt").write_text(yolo(BOX, 2))
    told = measure(folder, "--label-classes", "boat,buoy,ship", "--targets", "ship")
    assert (told["drawn"], told["recall"]) == (1, 1.0)


def coco() -> dict[str, Any]:
    """The same as `LABELS`, with a crowd where nothing is told apart."""
    out: dict[str, Any] = {
        "images": [
            {"id": 7 + i, "file_name": f"{name}.png", "width": 640, "height": 360}
            for i, name in enumerate(LABELS)
        ],
        "categories": [{"id": 3, "name": "boat"}, {"id": 4, "name": "car"}],
        "annotations": [],
    }
    boxes = [(7, BOX), (8, beside(BOX, 20.0)), (9, BOX), (9, [400.0, 100.0, 440.0, 120.0])]
    for i, (image, (x1, y1, x2, y2)) in enumerate(boxes):
        out["annotations"].append(
            {"id": i, "image_id": image, "category_id": 3, "bbox": [x1, y1, x2 - x1, y2 - y1]}
        )
    return out


@pytest.mark.parametrize("place", ["beside", "annotations", "named"])
def test_a_coco_file_says_the_same(
    folder: Path, measure: Callable[..., dict], tmp_path: Path, place: str
) -> None:
    same = measure(folder, "--group-by-prefix")
    for text in (folder / "labels").iterdir():
        text.unlink()
    (folder / "labels").rmdir()
    content = json.dumps(coco())
    if place == "named":
        (tmp_path / "boxes.json").write_text(content)
        told = measure(folder, "--labels", tmp_path / "boxes.json", "--group-by-prefix")
    else:
        at = folder / ("annotations" if place == "annotations" else ".") / "boxes.json"
        at.parent.mkdir(exist_ok=True)
        at.write_text(content)
        told = measure(folder, "--group-by-prefix")
        itself = measure(at, "--group-by-prefix")
        assert itself["groups"] == told["groups"]
    for name, group in same["groups"].items():
        # What is written in six digits is a fraction of a pixel off.
        assert told["groups"][name] == pytest.approx(group, abs=1e-3)
    assert told["average_precision"] == same["average_precision"]


def test_a_crowd_is_neither_missed_nor_false(
    folder: Path, measure: Callable[..., dict], tmp_path: Path
) -> None:
    content = coco()
    content["annotations"][0]["iscrowd"] = 1
    (tmp_path / "boxes.json").write_text(json.dumps(content))
    told = measure(folder, "--labels", tmp_path / "boxes.json")
    assert (told["drawn"], told["false_per_frame"]) == (3, 0.25)


FOLDER = "detector evaluate {p} --detector {t}/net.onnx --json {t}/out/e.json"
BOXES = "detector evaluate {p} --labels {t}/boxes.json --detector {t}/net.onnx"

REFUSED = [
    (
        "a class that nobody names",
        "7 0.5 0.5 0.1 0.1",
        r"pier-0.txt: line 1: nothing names class 7",
    ),
    ("a class below zero", "-1 0.5 0.5 0.1 0.1", r"line 1: its class is -1"),
    ("no class", "0.5 0.5 0.5 0.1 0.1", r"line 1: its class is 0.5"),
    ("pixels", "0 320 180 64 36", r"line 1: 320 is no share of the picture"),
    ("a little out of range", "0 0.5 0.5 1.01 0.1", r"line 1: 1.01 is no share"),
    ("no height", "0 0.5 0.5 0.1 0", r"line 1: its box has no width or no height"),
    ("cut short", "0 0.5 0.5 0.1 0.1\n0 0.5", r"line 2: has 2 numbers; expected class, x, y"),
    ("words", "boat 0.5 0.5 0.1 0.1", r"line 1: boat 0.5 .* are not all numbers"),
    ("not a number", "0 0.5 0.5 nan 0.1", r"line 1: .* are not all finite"),
    ("huge", "0 1e999 0.5 0.1 0.1", r"line 1: .* are not all finite"),
]


@pytest.mark.parametrize(
    ("text", "message"), [case[1:] for case in REFUSED], ids=[c[0] for c in REFUSED]
)
def test_labels_that_cannot_be_used_end_in_a_line(
    sightline: Command, folder: Path, tmp_path: Path, text: str, message: str
) -> None:
    (folder / "labels" / "pier-0.txt").write_text(text)
    refused(sightline, FOLDER.format(p=folder, t=tmp_path), message)


def test_a_class_beyond_those_that_are_named(
    sightline: Command, folder: Path, tmp_path: Path
) -> None:
    (folder / "labels" / "classes.txt").write_text("boat\nship\n")
    (folder / "labels" / "pier-0.txt").write_text("2 0.5 0.5 0.1 0.1")
    refused(
        sightline,
        FOLDER.format(p=folder, t=tmp_path),
        r"pier-0.txt: line 1: unknown class 2; known are 0 boat, 1 ship",
    )


def refused(sightline: Command, command: str, message: str) -> None:
    done = sightline(*command.split())
    assert done.status == 2, done.out
    assert done.err.startswith("error: ")
    assert len(done.err.splitlines()) == 1, done.err
    assert re.search(message, done.err), done.err


def test_pictures_that_cannot_be_used_end_in_a_line(
    sightline: Command, folder: Path, tmp_path: Path
) -> None:
    command = FOLDER.format(p=folder, t=tmp_path)
    whole = cv2.imencode(".jpg", np.full((360, 640, 3), 90, np.uint8))[1].tobytes()
    (folder / "images" / "quay-0.png").unlink()
    (folder / "images" / "quay-0.jpg").write_bytes(whole[: len(whole) // 2])
    refused(sightline, command, r"quay-0.jpg: is no picture that can be read, or is damaged")
    for one in (folder / "images").iterdir():
        one.unlink()
    refused(sightline, command, r"pictures: holds no picture; expected")


def test_folders_without_labels_end_in_a_line(
    sightline: Command, folder: Path, tmp_path: Path
) -> None:
    command = FOLDER.format(p=folder, t=tmp_path)
    for one in (folder / "labels").iterdir():
        one.unlink()
    refused(sightline, command, r"pictures: no picture has labels; expected NAME.txt")
    refused(sightline, command.replace("pictures", "none"), r"there is no such")
    refused(sightline, command + f" --labels {tmp_path}/none", r"there is no such folder")


def spoilt(change: Callable[[dict], object]) -> str:
    content = coco()
    change(content)
    return json.dumps(content)


WRONG = [
    ("no JSON", json.dumps(coco())[:-40], r"is no JSON, or is cut short"),
    ("no COCO", "[1]", r"is no COCO file; expected lists images, annotations, categories"),
    ("empty", "", r"is empty"),
    (
        "unknown category",
        spoilt(lambda c: c["annotations"][1].update(category_id=9)),
        r"boxes.json: annotation 1: unknown category 9; known are 3 boat, 4 car",
    ),
    (
        "unknown picture",
        spoilt(lambda c: c["annotations"][1].update(image_id=99)),
        r"annotation 1: is of picture 99, which the file does not list",
    ),
    (
        "out of the picture",
        spoilt(lambda c: c["annotations"][2].update(bbox=[600, 100, 80, 20])),
        r"annotation 2: its box .* reaches out of the picture of 640 x 360 px",
    ),
    (
        "no width",
        spoilt(lambda c: c["annotations"][2].update(bbox=[600, 100, 0, 20])),
        r"annotation 2: its box has no width or no height",
    ),
    (
        "no box",
        spoilt(lambda c: c["annotations"][2].pop("bbox")),
        r"annotation 2: bbox is None; expected x, y, width, height, px",
    ),
    (
        "a missing picture",
        spoilt(lambda c: c["images"][0].update(file_name="lost.png")),
        r"lists lost.png, which is not in",
    ),
    (
        "another size",
        spoilt(lambda c: c["images"][0].update(width=1280, height=720)),
        r"pier-0.png: has 640 x 360 px, and its labels are of a picture of 1280 x 720 px",
    ),
    (
        "a number without end",
        spoilt(lambda c: c["annotations"][2].update(bbox=[10**400, 0, 5, 5])),
        r"annotation 2: bbox is .*; expected x, y, width, height, px",
    ),
    (
        "a width without end",
        spoilt(lambda c: c["images"][2].update(width=10**400)),
        r"width of .* is no whole number",
    ),
    ("no id", spoilt(lambda c: c["images"][0].pop("id")), r"id of .* is no whole number"),
    ("no name", spoilt(lambda c: c["images"][0].pop("file_name")), r"file_name of .* is no text"),
    ("twice", spoilt(lambda c: c["images"][1].update(file_name="pier-0.png")), r"pier-0.png twice"),
]


@pytest.mark.parametrize(
    ("text", "message"), [case[1:] for case in WRONG], ids=[c[0] for c in WRONG]
)
def test_coco_files_that_cannot_be_used_end_in_a_line(
    sightline: Command, folder: Path, tmp_path: Path, text: str, message: str
) -> None:
    (tmp_path / "boxes.json").write_text(text)
    refused(sightline, BOXES.format(p=folder, t=tmp_path), message)


OPTIONS = [
    ("--recordings 01", r"pictures: --recordings is for a scene, and these are pictures"),
    ("--margin eye=1", r"--margin is for a scene"),
    ("--budget 40", r"--budget is for a scene"),
    ("--targets ship", r"unknown class of the labels in .* 'ship'; known are 0"),
    ("--label-classes a,a", r"names a twice"),
    ("--detector motion", r"'motion' finds what moves from frame to frame"),
]


@pytest.mark.parametrize(("option", "message"), OPTIONS)
def test_options_of_scenes_are_refused(
    sightline: Command, folder: Path, tmp_path: Path, option: str, message: str
) -> None:
    refused(sightline, f"{FOLDER.format(p=folder, t=tmp_path)} {option}", message)


def test_no_result_over_a_picture_or_a_label(
    sightline: Command, folder: Path, tmp_path: Path
) -> None:
    for path in ("labels/pier-0.txt", "images/pier-0.png"):
        command = FOLDER.format(p=folder, t=tmp_path).replace(
            f"{tmp_path}/out/e.json", str(folder / path)
        )
        before = (folder / path).read_bytes()
        refused(sightline, command, r"is read by this command")
        assert (folder / path).read_bytes() == before
