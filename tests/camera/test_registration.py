"""How a view lies against another, by pictures that were shifted and turned by so much."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sightline.camera.registration import (
    ReferenceView,
    agree,
    coarse_shift,
    consensus,
    displacement,
    largest_shift,
    rigid_shifts,
    scattered,
)
from sightline.types import FloatArray

WIDTH, HEIGHT, STRIPS = 128, 128, 6
LEFT = np.arange(STRIPS, dtype=np.int64) * WIDTH + 40
TOP = np.full(STRIPS, 60, dtype=np.int64) + np.arange(STRIPS)


def scenery(seed: int = 0) -> FloatArray:
    """A picture of things of all sizes from three pixels on."""
    noise = np.random.default_rng(seed).normal(0.0, 1.0, (260, 860))
    picture = sum(cv2.GaussianBlur(noise, (0, 0), size) * size for size in (1.5, 4.0, 12.0))
    return 128.0 + 30.0 * (picture - picture.mean()) / picture.std()


def moved(picture: FloatArray, across_px: float, down_px: float, slope_px: float) -> FloatArray:
    """Further right and down, and the more so to the right, by so much over all strips."""
    middle = LEFT[0] + 0.5 * STRIPS * WIDTH
    share = slope_px / (STRIPS * WIDTH)
    matrix = np.array([[1.0, 0.0, across_px], [share, 1.0, down_px - share * middle]])
    return cv2.warpAffine(
        picture, matrix, picture.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )


def view(picture: FloatArray, down_px: int = 0, landmarks: bool = True) -> ReferenceView:
    top = TOP + down_px
    strips = [picture[y : y + HEIGHT, x : x + WIDTH] for x, y in zip(LEFT, top, strict=True)]
    grey = np.clip(np.round(np.stack(strips)), 0, 255).astype(np.uint8)
    return ReferenceView(grey, top, LEFT, landmarks)


@pytest.mark.parametrize(
    ("across_px", "down_px", "slope_px"),
    [(0.0, 0.0, 0.0), (4.0, -3.0, 0.0), (-6.4, 2.3, 3.0), (24.0, 9.0, 0.0), (-21.0, -8.0, -4.0)],
)
@pytest.mark.parametrize("cut_px", [0, 11])
def test_what_stands_still_is_found_where_it_was_put(
    across_px: float, down_px: float, slope_px: float, cut_px: int
) -> None:
    """However the strips of the second view are cut out of its picture."""
    picture = scenery()
    found = displacement(view(picture), view(moved(picture, across_px, down_px, slope_px), cut_px))
    assert found is not None
    assert found.landmarks
    np.testing.assert_array_equal(found.at_px[:, 0], LEFT + 64.0)
    np.testing.assert_array_equal(found.at_px[:, 1], TOP + 64.0)
    np.testing.assert_allclose(found.moved_px[:, 0], across_px, atol=0.4)
    at = (np.arange(STRIPS) + 0.5) / STRIPS - 0.5
    np.testing.assert_allclose(found.moved_px[:, 1], down_px + slope_px * at, atol=0.4)


@pytest.mark.parametrize("cut_px", [0, 7])
def test_a_horizon_alone_tells_how_far_down_it_went(cut_px: int) -> None:
    rows = np.arange(260.0)[:, None]
    picture = np.tile(90.0 + 80.0 / (1.0 + np.exp(-(rows - 124.0) / 0.6)), (1, 860))
    found = displacement(
        view(picture, landmarks=False), view(moved(picture, 0.0, 5.4, 2.0), cut_px, False)
    )
    assert found is not None
    assert not found.landmarks
    np.testing.assert_array_equal(found.moved_px[:, 0], 0.0)
    at = (np.arange(STRIPS) + 0.5) / STRIPS - 0.5
    np.testing.assert_allclose(found.moved_px[:, 1], 5.4 + 2.0 * at, atol=0.4)
    # One with landmarks tells no more beside one without.
    mixed = displacement(view(picture), view(picture, landmarks=False))
    assert mixed is not None
    assert not mixed.landmarks


def test_views_of_other_sizes_are_not_compared() -> None:
    one = view(scenery())
    smaller = ReferenceView(one.strips[:, :, 1:], one.top_px, one.left_px)
    assert displacement(one, smaller) is None


@pytest.mark.parametrize("width", [120, 121, 125, 128, 131])
def test_the_size_of_strips_puts_nothing_off(width: int) -> None:
    picture = scenery()
    there, here = np.zeros(3, dtype=np.int64), np.array([0, 200, 400])
    strips, shifted = (
        np.stack([picture[60 : 60 + HEIGHT, x - back : x - back + width] for x in here + 20])
        for back in (0, 2)
    )
    one, other = (
        ReferenceView(np.clip(part, 0, 255).astype(np.uint8), there, here)
        for part in (strips, shifted)
    )
    for view_of, across_px in ((one, 0.0), (other, 2.0)):
        found = displacement(one, view_of)
        assert found is not None
        np.testing.assert_allclose(found.moved_px, np.tile([across_px, 0.0], (3, 1)), atol=0.02)


def test_from_afar_a_shift_is_told_to_a_few_pixels() -> None:
    picture = scenery()
    x, y = coarse_shift(view(picture).strips, view(moved(picture, 24.0, -12.0, 0.0)).strips)
    assert abs(x - 24) <= 4
    assert abs(y + 12) <= 4


def test_a_few_strips_that_are_off_do_not_count() -> None:
    truth = rigid_shifts(3.0, -2.0, 1.5, 9)
    np.testing.assert_allclose(truth[:, 0], 3.0)
    # By so much more down at the right edge than at the left.
    np.testing.assert_allclose(np.polyfit((np.arange(9) + 0.5) / 9, truth[:, 1], 1)[0], 1.5)
    assert truth[4].tolist() == [3.0, -2.0]
    off = truth.copy()
    off[[1, 6]] += [40.0, -25.0]
    assert consensus(off) == pytest.approx((3.0, -2.0, 1.5), abs=0.2)
    assert consensus(truth) == pytest.approx((3.0, -2.0, 1.5))


def test_shifts_agree_where_most_strips_tell_one_turn() -> None:
    assert largest_shift(3.0, -4.0, 2.0) == 5.0
    assert largest_shift(0.3, 0.4, -6.0) == 3.0
    turn = (0.0, 10.0, 0.0)
    truth = np.tile([0.0, 10.0], (7, 1))
    # Three tenths of what moved.
    for apart_px, told in ((2.9, True), (3.1, False)):
        off = truth.copy()
        off[:4, 0] += apart_px
        assert agree(off[None], *turn) is told
    few = truth.copy()
    few[:3] += 50.0
    assert agree(few[None], *turn)
    # Of what moved little, so many pixels.
    still = np.zeros((1, 7, 2))
    still[0, :, 1] = 0.5
    assert agree(still, 0.0, 0.0, 0.0, noise_px=0.5)
    assert not agree(still, 0.0, 0.0, 0.0, noise_px=0.4)


def test_strips_that_tell_nothing_of_the_way_across_are_scattered() -> None:
    across = np.array([5.0, 5.0, 5.0, 6.5, 3.5, 6.5, 3.5])
    told = np.stack([across, np.linspace(-90.0, 90.0, 7)], axis=1)[None]
    assert not scattered(told)
    told[..., 0] = 5.0 + 1.01 * (told[..., 0] - 5.0)
    assert scattered(told)
