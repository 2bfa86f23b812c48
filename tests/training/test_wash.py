from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from pond import BOAT_RGB, SIZE_PX, picture

from sightline.training.augmentation import Augmentation, Batches, BatchSettings
from sightline.training.data import Picture, Sprite
from sightline.training.wash import Hull, draw_wash, hull_of, inner

WATER = 100
SIZE = (240, 320)
NOTHING = np.zeros((0, 4))
AWAY, RIGHT, COMING = 0.0, 0.5 * np.pi, np.pi
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
)


def _hull(heading_rad: float) -> Hull:
    """A boat 10 px/m large, 60 px below the horizon, in the middle of row 100."""
    return Hull(160.0, 100.0, 10.0, 60.0, heading_rad)


def _foam(heading_rad: float, seeds: int = 40) -> NDArray[np.float64]:
    """Mean of what is added to grey water."""
    added = np.zeros(SIZE)
    for seed in range(seeds):
        image = np.full((*SIZE, 3), WATER, np.uint8)
        draw_wash(np.random.default_rng(seed), image, _hull(heading_rad), kept_xyxy_px=NOTHING)
        added += image.astype(float).mean(axis=2) - WATER
    return added / seeds


def _centre_and_spread(row: NDArray[np.float64]) -> tuple[float, float]:
    columns = np.arange(len(row)) + 0.5
    weight = row.clip(0.0)
    centre = float((columns * weight).sum() / weight.sum())
    return centre, float(np.sqrt(((columns - centre) ** 2 * weight).sum() / weight.sum()))


def test_behind_a_boat_that_goes_away_the_wash_widens_towards_the_camera() -> None:
    foam = _foam(AWAY)
    assert np.abs(foam[:40]).max() < 0.5
    assert foam[105:140, 140:180].mean() > 12.0
    assert foam[105:140].mean() > 2.0 * foam[50:85].mean()
    near, far = (
        _centre_and_spread(foam[160:200].sum(axis=0)),
        _centre_and_spread(foam[103:113].sum(axis=0)),
    )
    assert near[1] > 1.2 * far[1]
    assert far[0] == pytest.approx(160.0, abs=10.0)


def test_the_wash_of_a_boat_that_comes_lies_beyond_its_bow() -> None:
    foam = _foam(COMING)
    assert np.abs(foam[105:]).max() < 1.0
    assert foam[70:100, 120:200].mean() > 10.0


def test_the_wash_of_a_boat_that_passes_lies_on_the_side_of_its_stern() -> None:
    foam = _foam(RIGHT)
    stern, bow = 160.0 - 33.0, 160.0 + 33.0
    assert foam[:, : int(stern)].sum() > 20.0 * foam[:, int(bow) + 10 :].sum()
    mirrored = _foam(-RIGHT)
    assert mirrored[:, int(bow) :].sum() > 20.0 * mirrored[:, : int(stern) - 10].sum()


def test_foam_keeps_off_hulls_and_fades_into_their_margin() -> None:
    boxes = np.array([[120.0, 60.0, 200.0, 110.0], [10.0, 150.0, 60.0, 190.0]])
    changed = np.zeros(SIZE, dtype=bool)
    for seed in range(30):
        rng = np.random.default_rng(seed)
        image = np.random.default_rng(1).integers(80, 120, (*SIZE, 3)).astype(np.uint8)
        before = image.copy()
        hull = hull_of(rng, boxes[0], 40.0)
        assert hull is not None
        draw_wash(rng, image, hull, kept_xyxy_px=boxes)
        changed |= (image != before).any(axis=2)
    for x1, y1, x2, y2 in inner(boxes).tolist():
        own = np.s_[int(np.floor(y1)) : int(np.ceil(y2)), int(np.floor(x1)) : int(np.ceil(x2))]
        assert not changed[own].any()
    assert changed[112:130, 130:190].mean() > 0.9


@pytest.mark.parametrize(
    ("size_m", "aspect"), [((2.4, 2.3), "end-on"), ((6.7, 2.3), "abeam")], ids=["end-on", "abeam"]
)
def test_the_course_follows_from_the_shape_of_a_box(
    size_m: tuple[float, float], aspect: str
) -> None:
    width, height = 12.0 * np.array(size_m)
    # The margin that boxes have: `inner` takes it off again.
    margin = (0.14 * height + 1.0) / (1.0 - 0.28)
    box = np.array([100.0, 100.0, 100.0 + width, 100.0 + height])
    box = box + margin * np.array([-1.0, -1.0, 1.0, 1.0])
    assert inner(box) == pytest.approx([100.0, 100.0, 100.0 + width, 100.0 + height], abs=0.5)
    hulls = [hull_of(np.random.default_rng(seed), box, 60.0) for seed in range(100)]
    across = np.array([abs(np.sin(hull.heading_rad)) for hull in hulls if hull is not None])
    assert len(across) == 100
    assert np.median(across) < 0.35 if aspect == "end-on" else np.median(across) > 0.75
    # Both signs of both parts occur: a box does not tell them.
    signs = {
        (np.sin(hull.heading_rad) > 0.0, np.cos(hull.heading_rad) > 0.0)
        for hull in hulls
        if hull is not None and abs(np.sin(hull.heading_rad)) > 1e-6
    }
    assert len(signs) == 4


def test_the_smallest_boats_have_no_wash() -> None:
    assert hull_of(np.random.default_rng(0), np.array([10.0, 10.0, 30.0, 16.0]), None) is None


def _batches(*, wash: bool, paste: bool, boat_px: tuple[int, int] = (28, 14)) -> Batches:
    boxes = [(60, 70, 120, 100), (150, 90, 200, 120)]
    pictures = [
        Picture(
            "a",
            i,
            picture([box], i),
            np.array([box], np.float32),
            np.zeros(1, np.int64),
            np.zeros(1, bool),
            np.ones(1, np.float32),
        )
        for i, box in enumerate(boxes)
    ]
    width, height = boat_px
    sprite = Sprite(
        "a",
        np.full((height + 20, width + 20, 3), BOAT_RGB, np.uint8),
        np.pad(np.ones((height, width), np.float32), 10),
        np.array([10.0, 10.0, 10.0 + width, 10.0 + height]),
        waterline_px=100.0,
        label=0,
    )
    settings = Augmentation(**{**PLAIN.__dict__, "wash": wash, "paste": paste})
    return Batches(
        pictures,
        [],
        [sprite],
        settings,
        BatchSettings(size_px=SIZE_PX, batch=8, seed=2, vanishing_row_px=40.0),
    )


@pytest.mark.parametrize("paste", [False, True])
def test_wash_changes_the_water_and_neither_boxes_nor_hulls(paste: bool) -> None:
    dry, wet, again = (_batches(wash=wash, paste=paste) for wash in (False, True, True))
    whitened = 0
    for number in range(6):
        before, expected = dry(number)
        after, targets = wet(number)
        assert (after == again(number)[0]).all()
        for one, other, target, same in zip(before, after, targets, expected, strict=True):
            assert (target.boxes_xyxy_px == same.boxes_xyxy_px).all()
            assert (target.ignore == same.ignore).all()
            # Of the pond nothing is white: water is grey, boats are red.
            assert not (one.min(dim=0).values > 0.5).any()
            white = (other.min(dim=0).values > 0.5).numpy()
            whitened += int(white.any())
            for x1, y1, x2, y2 in inner(target.boxes_xyxy_px[~target.ignore].numpy()).tolist():
                # What is pasted comes over the foam, at whole pixels.
                own = np.s_[round(y1) + 1 : round(y2) - 1, round(x1) + 1 : round(x2) - 1]
                assert not white[own].any()
    assert 8 < whitened < 40


def test_some_near_boats_are_turned_towards_the_camera_and_their_boxes_with_them() -> None:
    aspects: dict[bool, list[float]] = {False: [], True: []}
    for wash, seen in aspects.items():
        batches = _batches(wash=wash, paste=True, boat_px=(60, 20))
        for number in range(12):
            for image, target in zip(*batches(number), strict=True):
                red = (image[0] > 1.6 * image[1]).numpy()
                for x1, y1, x2, y2 in target.boxes_xyxy_px[~target.ignore].tolist():
                    whole = x1 > 1.0 and x2 < SIZE_PX[0] - 1.0 and y2 < SIZE_PX[1] - 1.0
                    # Dark or pale, narrow or wide, the boat is in its box.
                    assert red[round(y1) : round(y2), round(x1) : round(x2)].mean() > 0.55
                    if whole:
                        seen.append((x2 - x1) / (y2 - y1))
    dry, wet = np.array(aspects[False]), np.array(aspects[True])
    # The pond's own boats have 2 and 1.7, what is pasted in has 3 unless it is turned.
    assert not (dry < 1.5).any()
    assert 0.05 < (wet < 1.55).mean() < 0.4
