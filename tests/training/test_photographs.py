"""Folders of photographs: what is read, what is cut out, and what is made of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from pond import SIZE_PX, picture

from sightline.cli.detector.train import train
from sightline.detection import OnnxDetector
from sightline.errors import InputError
from sightline.scene import Scene
from sightline.training.augmentation import Augmentation
from sightline.training.collage import Collage, CollageBatches
from sightline.training.photographs import (
    IGNORED,
    cut_outs,
    read_backgrounds,
    read_yolo_folder,
)

CLASSES = ("boat", "buoy", "ignore")
BOX = (60, 50, 180, 100)
AROUND = (54, 44, 186, 106)
"""As people draw them: not every pixel is the boat's."""
PLAIN = Augmentation(
    rotation=False,
    brightness=False,
    exposure=False,
    blur=False,
    noise=False,
    flip=False,
    color=False,
    compression=False,
)


def line(kind: int, box: tuple[int, int, int, int]) -> str:
    """A box as YOLO has it."""
    x1, y1, x2, y2 = box
    width, height = SIZE_PX
    shares = ((x1 + x2) / 2 / width, (y1 + y2) / 2 / height, (x2 - x1) / width, (y2 - y1) / height)
    return " ".join([str(kind), *(f"{share:.6f}" for share in shares)])


def folder(path: Path, labels: str, count: int = 1, ending: str = "png") -> Path:
    """Pictures of one red boat each."""
    for name in ("images", "labels"):
        (path / name).mkdir(parents=True, exist_ok=True)
    for number in range(count):
        image = picture([BOX], number)[..., ::-1]
        cv2.imwrite(str(path / "images" / f"{number}.{ending}"), image)
        (path / "labels" / f"{number}.txt").write_text(labels + "\n", encoding="utf-8")
    return path


def gray(path: Path, count: int = 2) -> Path:
    """Pictures without a boat."""
    path.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        cv2.imwrite(str(path / f"{number}.png"), picture([], number))
    return path


def test_boxes_are_where_the_labels_say(tmp_path: Path) -> None:
    labels = "\n".join([line(0, BOX), line(1, (10, 10, 20, 30)), line(2, (200, 100, 240, 140))])
    (one,) = read_yolo_folder(folder(tmp_path, labels), CLASSES, ("boat",))
    assert one.size_px == SIZE_PX
    np.testing.assert_allclose(one.boxes_xyxy_px[0], BOX, atol=0.01)
    assert one.labels.tolist() == [0, -1, IGNORED]
    red = one.image[70, 100].astype(int)
    assert red[0] > red[2] + 100


def test_what_reaches_beyond_the_picture_ends_at_its_border(tmp_path: Path) -> None:
    (one,) = read_yolo_folder(folder(tmp_path, "0 0.5 0.5 1.02 1.01"), CLASSES, ("boat",))
    np.testing.assert_allclose(one.boxes_xyxy_px[0], [0, 0, *SIZE_PX], atol=0.01)


@pytest.mark.parametrize(
    ("labels", "what"),
    [
        ("3 0.5 0.5 0.1 0.1", "line 1: class 3 has no name"),
        ("0.5 0.5 0.5 0.1 0.1", "line 1: class 0.5 has no name"),
        ("0 0.5 0.5 0.1", "line 1: expected class x y width height"),
        ("0 0.5 0.5 0.1 0.1\n0 120 80 40 20", "line 2: expected shares"),
        ("0 0.5 0.5 nan 0.1", "line 1: expected shares"),
        ("0 0.5 0.5 0 0.1", "line 1: expected shares"),
    ],
)
def test_labels_of_another_kind_are_refused(tmp_path: Path, labels: str, what: str) -> None:
    with pytest.raises(InputError, match=what) as caught:
        read_yolo_folder(folder(tmp_path, labels), CLASSES, ("boat",))
    assert "\n" not in str(caught.value)


def test_a_picture_that_is_cut_short_is_refused(tmp_path: Path) -> None:
    path = folder(tmp_path, line(0, BOX), ending="jpg")
    (path / "images" / "0.jpg").write_bytes(b"\xff\xd8\xff")
    with pytest.raises(InputError, match="no whole picture"):
        read_yolo_folder(path, CLASSES, ("boat",))


def test_folders_without_pictures_or_labels_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no folder labels"):
        read_yolo_folder(tmp_path, CLASSES, ("boat",))
    (tmp_path / "labels").mkdir()
    (tmp_path / "images").mkdir()
    with pytest.raises(InputError, match="has no pictures"):
        read_yolo_folder(tmp_path, CLASSES, ("boat",))


def test_a_boat_is_cut_out_along_its_outline(tmp_path: Path) -> None:
    boats = read_yolo_folder(folder(tmp_path, line(0, AROUND)), CLASSES, ("boat",))
    (sprite,) = cut_outs(boats)
    # The drawn box is 6 px larger on each side than the red that there is.
    scale = 128.0 / 132.0
    width, height = sprite.box_xyxy_px[2:] - sprite.box_xyxy_px[:2]
    assert width == pytest.approx(scale * (BOX[2] - BOX[0]), abs=4)
    assert height == pytest.approx(scale * (BOX[3] - BOX[1]), abs=4)
    inside = sprite.image[sprite.opacity > 0.9]
    assert (inside[:, 0] > inside[:, 2].astype(int) + 60).mean() > 0.95


def test_what_is_no_boat_or_is_cut_off_is_not_cut_out(tmp_path: Path) -> None:
    other = read_yolo_folder(folder(tmp_path / "a", line(1, BOX)), CLASSES, ("boat",))
    edge = read_yolo_folder(folder(tmp_path / "b", line(0, (0, 50, 180, 100))), CLASSES, ("boat",))
    assert cut_outs(other) == cut_outs(edge) == []


def made(tmp_path: Path) -> CollageBatches:
    boats = read_yolo_folder(folder(tmp_path / "boats", line(0, AROUND), 3), CLASSES, ("boat",))
    material = Collage(boats, read_backgrounds(gray(tmp_path / "gray")), [], cut_outs(boats))
    return CollageBatches(material, PLAIN, size_px=(160, 128), batch=4, seed=1)


def test_boats_are_where_the_boxes_of_a_made_harbour_say(tmp_path: Path) -> None:
    batches = made(tmp_path)
    redness, elsewhere = [], []
    for number in range(12):
        images, targets = batches(number)
        for image, target in zip(images, targets, strict=True):
            red = (image[0] - image[2]).numpy()
            covered = np.zeros_like(red, dtype=bool)
            for box, ignore in zip(target.boxes_xyxy_px.numpy(), target.ignore, strict=True):
                x1, y1, x2, y2 = (round(float(v)) for v in box)
                covered[max(y1 - 1, 0) : y2 + 1, max(x1 - 1, 0) : x2 + 1] = True
                if not ignore and min(x2 - x1, y2 - y1) >= 8:
                    redness.append(red[y1:y2, x1:x2].mean())
            elsewhere.append(float((red[~covered] > 0.4).mean()) if (~covered).any() else 0.0)
    assert len(redness) > 20
    # Some are whitened, or stand in haze; most are red where they are said to be, and only there.
    assert np.mean(np.array(redness) > 0.1) > 0.8
    assert np.mean(elsewhere) < 0.01


def test_made_harbours_are_small_boats_and_large(tmp_path: Path) -> None:
    batches = made(tmp_path)
    sizes = np.concatenate(
        [
            (one.boxes_xyxy_px[:, 2] - one.boxes_xyxy_px[:, 0])[~one.ignore].numpy()
            for number in range(12)
            for one in batches(number)[1]
        ]
    )
    assert (sizes < 25).mean() > 0.2
    assert sizes.max() > 60


def test_bare_pictures_show_what_stands_around_boats_and_no_boat(tmp_path: Path) -> None:
    path = folder(tmp_path / "boats", line(0, AROUND), 2)
    for number in range(2):
        # A house above and beside: green and blue, and much of it.
        image = cv2.imread(str(path / "images" / f"{number}.png"))
        assert image is not None
        image[:40, ::2] = (200, 90, 20)
        image[:, 200:] = image[:, 200:] // 3
        image[::3, 200:] = (90, 220, 10)
        cv2.imwrite(str(path / "images" / f"{number}.png"), image)
    boats = read_yolo_folder(path, CLASSES, ("boat",))
    nothing = read_yolo_folder(folder(tmp_path / "none", ""), CLASSES, ("boat",))
    assert len(nothing[0].labels) == 0
    material = Collage(boats, read_backgrounds(gray(tmp_path / "gray")), [], cut_outs(boats), 0, 1)
    batches = CollageBatches(material, PLAIN, size_px=(160, 128), batch=4, seed=1)
    colours = []
    for number in range(8):
        images, targets = batches(number)
        assert all(len(target.labels) == 0 for target in targets)
        colours.append((images[:, 0] - images[:, 2]).numpy())
    # No red of the boats, and blue of what stood around them.
    assert (np.array(colours) > 0.4).mean() < 1e-3
    assert (np.array(colours) < -0.2).mean() > 0.05


def test_a_batch_is_the_same_whenever_it_is_asked_for(tmp_path: Path) -> None:
    batches = made(tmp_path)
    first, again, other = batches(5), batches(5), batches(6)
    assert torch.equal(first[0], again[0])
    assert all(
        torch.equal(a.boxes_xyxy_px, b.boxes_xyxy_px)
        for a, b in zip(first[1], again[1], strict=True)
    )
    assert not torch.equal(first[0], other[0])


SMALL: dict[str, Any] = {
    "arch": "yolox-nano",
    "train": "a",
    "steps": 2,
    "batch": 4,
    "size": "96x64",
    "classes": "boat",
    "option": ["width=0.125"],
    "picture_classes": "boat,buoy,ignore",
    "validate_every": 2,
    "device": "cpu",
    "threads": 1,
}


def test_training_on_photographs_leaves_a_detector(scene: Scene, tmp_path: Path) -> None:
    boats = folder(tmp_path / "boats", line(0, AROUND), 3)
    train(
        scene.path,
        output=tmp_path / "out",
        pictures=[boats],
        background=[gray(tmp_path / "gray")],
        **SMALL,
    )
    assert OnnxDetector(tmp_path / "out" / "yolox-nano.onnx").classes == ("boat",)
    configuration = (tmp_path / "out" / "config.json").read_text(encoding="utf-8")
    assert '"pictures": 3' in configuration
    assert '"share": 0.6' in configuration


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"background": ["gray"]}, "name a folder of pictures with boats"),
        ({"pictures": ["boats"], "picture_share": 1.5}, "share of 1.5"),
        ({"pictures": ["boats"], "picture_share": 0.01}, "without any"),
        ({"pictures": ["nowhere"]}, "has no folder labels"),
    ],
)
def test_folders_and_shares_that_cannot_be_are_refused(
    scene: Scene, tmp_path: Path, changes: dict[str, Any], what: str
) -> None:
    folder(tmp_path / "boats", line(0, BOX))
    gray(tmp_path / "gray")
    for name in ("pictures", "background"):
        if name in changes:
            changes = changes | {name: [tmp_path / one for one in changes[name]]}
    with pytest.raises(InputError, match=what) as caught:
        train(scene.path, output=tmp_path / "out", **(SMALL | changes))
    assert "\n" not in str(caught.value)
