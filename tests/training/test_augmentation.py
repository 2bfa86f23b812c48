from __future__ import annotations

import numpy as np
import pytest
import torch
from pond import BOAT_RGB, SIZE_PX, picture

from sightline.errors import InputError
from sightline.training.augmentation import Augmentation, Batches
from sightline.training.data import Picture, Sprite

PLAIN = Augmentation(
    rotation=False,
    brightness=False,
    exposure=False,
    blur=False,
    noise=False,
    flip=False,
    color=False,
    compression=False,
    paste=False,
    wash=False,
)


def _picture(boxes: list[tuple[int, int, int, int]], seed: int = 0, *, label: int = 0) -> Picture:
    corners = np.array(boxes, dtype=np.float32).reshape(-1, 4)
    labels = np.full(len(boxes), label, dtype=np.int64)
    return Picture(
        "a",
        seed,
        picture(boxes, seed),
        corners,
        labels,
        np.zeros(len(boxes), bool),
        np.ones(len(boxes), np.float32),
    )


def _red(image: torch.Tensor) -> torch.Tensor:
    return (image[0] > 0.55) & (image[1] < 0.35)


def _batches(augmentation: Augmentation, **settings: object) -> Batches:
    pictures = [_picture([(60, 70, 120, 100)], 1), _picture([(150, 90, 200, 120)], 2)]
    chosen: dict[str, object] = {"size_px": (128, 96), "batch": 6, "seed": 4, **settings}
    return Batches(pictures, [], [], augmentation, **chosen)  # type: ignore[arg-type]


def test_a_batch_is_a_function_of_its_number() -> None:
    one, other = _batches(Augmentation(mosaic=True)), _batches(Augmentation(mosaic=True))
    other(3)
    images, targets = one(7)
    again, same = other(7)
    assert torch.equal(images, again)
    assert all(
        torch.equal(a.boxes_xyxy_px, b.boxes_xyxy_px) for a, b in zip(targets, same, strict=True)
    )
    assert not torch.equal(images, one(8)[0])
    assert images.shape == (6, 3, 96, 128)
    assert images.min() >= 0.0
    assert images.max() <= 1.0


@pytest.mark.parametrize(
    "augmentation",
    [
        PLAIN,
        Augmentation(**{**PLAIN.__dict__, "flip": True}),
        Augmentation(**{**PLAIN.__dict__, "mosaic": True}),
        Augmentation(**{**PLAIN.__dict__, "rotation": True, "rotation_deg": 3.0}),
        Augmentation(**{**PLAIN.__dict__, "scales": (0.5, 0.5)}),
        Augmentation(**{**PLAIN.__dict__, "blur": True, "noise": True}),
    ],
    ids=["plain", "flip", "mosaic", "rotation", "half", "pixels"],
)
def test_boxes_stay_with_their_boats(augmentation: Augmentation) -> None:
    batches = _batches(augmentation)
    seen = 0
    for number in range(6):
        for image, target in zip(*batches(number), strict=True):
            red = _red(image)
            inside = torch.zeros_like(red)
            for x1, y1, x2, y2 in target.boxes_xyxy_px.tolist():
                inside[
                    max(round(y1) - 3, 0) : round(y2) + 3, max(round(x1) - 3, 0) : round(x2) + 3
                ] = True
            assert not (red & ~inside).any()
            counted = target.boxes_xyxy_px[~target.ignore]
            for x1, y1, x2, y2 in counted.tolist():
                part = red[round(y1) : round(y2), round(x1) : round(x2)]
                assert part.float().mean() > 0.6
                seen += 1
    assert seen > 10


def test_what_a_scale_makes_too_small_is_ignored() -> None:
    batches = _batches(Augmentation(**{**PLAIN.__dict__, "scales": (0.1, 0.1)}))
    _, targets = batches(0)
    boxes = sum(len(target.ignore) for target in targets)
    assert boxes > 0
    assert all(target.ignore.all() for target in targets)


def test_pasted_boats_are_labelled_and_sized_by_their_row() -> None:
    sprite = Sprite(
        "a",
        np.full((40, 60, 3), BOAT_RGB, np.uint8),
        np.pad(np.ones((20, 40), np.float32), 10),
        np.array([10.0, 10.0, 50.0, 30.0]),
        waterline_px=120.0,
        label=1,
    )
    empty = _picture([])
    batches = Batches(
        [empty],
        [],
        [sprite],
        Augmentation(**{**PLAIN.__dict__, "paste": True, "scales": (1.0, 1.0)}),
        size_px=SIZE_PX,
        batch=8,
        seed=0,
        vanishing_row_px=40.0,
    )
    found = []
    for number in range(12):
        for image, target in zip(*batches(number), strict=True):
            kept = ~target.ignore
            assert (target.labels[kept] == 1).all()
            assert bool(_red(image).any()) == bool(len(target.ignore))
            found += target.boxes_xyxy_px[kept].tolist()
    assert len(found) > 20
    boxes = np.array(found)
    whole = (boxes[:, 0] > 1) & (boxes[:, 2] < SIZE_PX[0] - 1) & (boxes[:, 3] < SIZE_PX[1] - 1)
    heights, rows = (boxes[:, 3] - boxes[:, 1])[whole], boxes[whole, 3]
    # 20 px at row 120, 80 below the vanishing row: a quarter of a pixel for each row.
    slope = np.polyfit(rows, heights, 1)[0]
    assert slope == pytest.approx(0.25, abs=0.06)


def test_scales_that_cannot_be_are_refused() -> None:
    with pytest.raises(InputError, match="scales of crops"):
        Augmentation(scales=(2.0, 1.0))
