from __future__ import annotations

import numpy as np
import pytest
import torch
from pond import BOAT_RGB, SIZE_PX, picture
from scipy import ndimage

from sightline.errors import InputError
from sightline.training.augmentation import (
    Augmentation,
    Batches,
    BatchSettings,
    rotate_boxes,
    rotate_image,
)
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
    return Batches(pictures, [], [], augmentation, BatchSettings(**chosen))  # type: ignore[arg-type]


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
        BatchSettings(size_px=SIZE_PX, batch=8, seed=0, vanishing_row_px=40.0),
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


CHART_PX = (64, 40)
MARK = 250


def _chart(boxes: list[tuple[int, int, int, int]]) -> Picture:
    """A picture whose pixels say where they are: red four times the column, green the row."""
    rows, columns = np.mgrid[: CHART_PX[1], : CHART_PX[0]]
    pixels = np.stack([4 * columns, 4 * rows, np.full_like(rows, MARK)], axis=-1)
    corners = np.array(boxes, dtype=np.float32).reshape(-1, 4)
    many = len(boxes)
    return Picture(
        *("a", 0, pixels.astype(np.uint8), corners, np.arange(many) % 2),
        *(np.zeros(many, bool), np.ones(many, np.float32)),
    )


def _corner(image: torch.Tensor, scale: float) -> np.ndarray:
    """Column and row of the chart at which a crop begins, to an eighth of a pixel.

    A column is told by a pixel whose middle is half a pixel further right.
    """
    levels = image.numpy().astype(float) * 255.0
    # What lies outside is grey, and what is beside it may be mixed with it.
    known = ndimage.binary_erosion(levels[2] > MARK - 1, iterations=2, border_value=1)
    rows, columns = np.nonzero(known)
    return np.array(
        [
            np.mean(levels[0][known] / 4.0 + 0.5 - (columns + 0.5) / scale),
            np.mean(levels[1][known] / 4.0 + 0.5 - (rows + 0.5) / scale),
        ]
    )


@pytest.mark.parametrize("scale", [0.4, 0.6, 1.0, 1.7, 4.0])
def test_boxes_are_where_the_pixels_of_their_crop_say(scale: float) -> None:
    """Whole, cut off by an edge of the crop, or out of it; by less than half or by more."""
    boxes = [(2, 5, 15, 12), (18, 8, 28, 22), (30, 15, 50, 25), (48, 28, 62, 38)]
    window = np.array([32.0, 24.0])
    settings = Augmentation(**{**PLAIN.__dict__, "scales": (scale, scale), "native_share": 0.0})
    batches = Batches(
        *([_chart(boxes)], [], [], settings),
        BatchSettings(size_px=(32, 24), batch=8, seed=1, smallest_px=(0.1, 0.1)),
    )
    seen = {"whole": 0, "cut": 0, "mostly out": 0, "out": 0}
    for number in range(12):
        for image, target in zip(*batches(number), strict=True):
            corner = np.tile(_corner(image, scale), 2)
            wanted = (np.array(boxes, float) - corner) * scale
            low, high = np.maximum(wanted[:, :2], 0.0), np.minimum(wanted[:, 2:], window)
            shares = (high - low).prod(axis=1) / (wanted[:, 2:] - wanted[:, :2]).prod(axis=1)
            # The chart cannot tell on which side of a limit a box is that is beside it.
            if (np.abs(shares - 0.5) < 0.06).any() or (np.abs(high - low) < 0.3 * scale).any():
                continue
            there = (high > low).all(axis=1)
            clipped = np.concatenate([low, high], axis=1)[there]
            np.testing.assert_allclose(target.boxes_xyxy_px, clipped, atol=0.13 * scale)
            assert target.ignore.tolist() == (shares[there] < 0.5).tolist()
            assert target.labels.tolist() == (np.arange(4) % 2)[there].tolist()
            seen["whole"] += int((there & (shares > 0.99)).sum())
            seen["cut"] += int((there & (shares > 0.5) & (shares < 0.99)).sum())
            seen["mostly out"] += int((there & (shares < 0.5)).sum())
            seen["out"] += int((~there).sum())
    rare = {0.4: ("cut", "mostly out", "out"), 4.0: ("whole", "cut")}
    for what, many in seen.items():
        assert many > 0 or what in rare.get(scale, ()), (what, seen)


def test_a_picture_is_rotated_as_scipy_does() -> None:
    rng = np.random.default_rng(0)
    smooth = ndimage.gaussian_filter(rng.uniform(0.0, 255.0, (3, 96, 128)), (0, 3, 3))
    levels = ((smooth - smooth.min()) / np.ptp(smooth) * 255.0).astype(np.uint8)
    rows, columns = np.mgrid[:96, :128].astype(float)
    for angle_deg in (-4.0, 1.3, 30.0):
        angle = np.deg2rad(angle_deg)
        # About the middle of the picture, counter-clockwise as one looks at it.
        x, y = columns - 63.5, rows - 47.5
        from_x = np.cos(angle) * x - np.sin(angle) * y + 63.5
        from_y = np.sin(angle) * x + np.cos(angle) * y + 47.5
        made = rotate_image(torch.from_numpy(levels), angle_deg).numpy().astype(float)
        inside = (from_x >= 0) & (from_x <= 127) & (from_y >= 0) & (from_y <= 95)
        beyond = (from_x < -1.5) | (from_x > 128.5) | (from_y < -1.5) | (from_y > 96.5)
        for channel, turned in zip(levels.astype(float), made, strict=True):
            wanted = ndimage.map_coordinates(channel, [from_y, from_x], order=1)
            assert np.abs(turned - wanted)[inside].max() <= 0.51
            assert (turned[beyond] == 114.0).all()


def test_rotated_boxes_hold_the_rotated_ellipses() -> None:
    boxes = np.array(
        [[10.0, 20.0, 60.0, 40.0], [100.0, 5.0, 112.0, 60.0], [60.0, 40.0, 68.0, 56.0]]
    )
    around = np.linspace(0.0, 2.0 * np.pi, 100_000)
    for angle_deg in (-4.0, 0.0, 2.5, 37.0):
        turn = np.exp(-1j * np.deg2rad(angle_deg))
        made = rotate_boxes(boxes, angle_deg, (128, 96))
        for (x1, y1, x2, y2), box in zip(boxes, made, strict=True):
            points = (x1 + x2) / 2 + (x2 - x1) / 2 * np.cos(around)
            points = points + 1j * ((y1 + y2) / 2 + (y2 - y1) / 2 * np.sin(around))
            # Rows count downwards, so counter-clockwise is the other way round.
            points = (points - (64 + 48j)) * turn + (64 + 48j)
            wanted = [points.real.min(), points.imag.min(), points.real.max(), points.imag.max()]
            np.testing.assert_allclose(box, wanted, atol=1e-6)


def test_a_quarter_turn_swaps_the_sides_of_a_box() -> None:
    (box,) = rotate_boxes(np.array([[0.0, 0.0, 10.0, 4.0]]), 90.0, (20, 20))
    # The upper left goes to the lower left.
    np.testing.assert_allclose(box, [0.0, 10.0, 4.0, 20.0], atol=1e-12)


def test_a_rotated_picture_has_its_boats_in_its_rotated_boxes() -> None:
    pixels = torch.zeros(3, 96, 128, dtype=torch.uint8)
    rows, columns = np.mgrid[:96, :128] + 0.5
    boxes = np.array([[26.0, 10.0, 56.0, 22.0], [80.0, 60.0, 120.0, 76.0]])
    for x1, y1, x2, y2 in boxes:
        within = ((columns - (x1 + x2) / 2) / (x2 - x1)) ** 2
        within += ((rows - (y1 + y2) / 2) / (y2 - y1)) ** 2
        pixels[:, torch.from_numpy(within <= 0.25)] = 255
    for angle_deg in (-4.0, 3.0, 20.0):
        made = rotate_boxes(boxes, angle_deg, (128, 96))
        bright = rotate_image(pixels, angle_deg)[0].numpy() > 127
        parts, many = ndimage.label(bright & (rotate_image(pixels, angle_deg)[1].numpy() > 127))
        seen = [
            [part[1].start, part[0].start, part[1].stop, part[0].stop]
            for part in ndimage.find_objects(parts)
            # The corners that came into view are grey, and not bright.
            if part[0].stop - part[0].start > 4
        ]
        assert many == 2
        np.testing.assert_allclose(sorted(seen), made[np.argsort(made[:, 0])], atol=1.0)


def test_a_boat_that_a_rotation_takes_out_of_the_picture_is_not_to_be_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A box in the corner of the picture, of which a rotation leaves less or more."""
    # Crops are the whole picture, so that what is cut off is cut off by the rotation.
    monkeypatch.setattr(Batches, "_corner", lambda *_: (0.0, 0.0))
    box = (216, 0, 256, 24)
    turned = {"rotation": True, "rotation_deg": 12.0, "scales": (1.0, 1.0), "native_share": 0.0}
    settings = Augmentation(**{**PLAIN.__dict__, **turned})
    whole = Picture(
        *("a", 0, picture([box], 0), np.array([box], np.float32), np.zeros(1, np.int64)),
        *(np.zeros(1, bool), np.ones(1, np.float32)),
    )
    batches = Batches([whole], [], [], settings, BatchSettings(SIZE_PX, batch=8, seed=0))
    seen = {True: 0, False: 0}
    for number in range(20):
        for image, target in zip(*batches(number), strict=True):
            left = float(_red(image).sum()) / ((box[2] - box[0]) * (box[3] - box[1]))
            # Near a half it depends on how the boat, askew, fills its box.
            if abs(left - 0.5) > 0.15:
                counted = bool((~target.ignore).any())
                assert counted == (left > 0.5)
                seen[counted] += 1
    assert min(seen.values()) > 5
